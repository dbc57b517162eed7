"""The rendered camera: frames that show what a camera would, and poses as OpenCV finds them."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from kraft.driving.messages import Observation
from kraft.errors import Code, InputError, MissingDependency
from kraft.gl import offscreen_context
from kraft.scenario import Scenario, load_scenario, parse_scenario
from kraft.scenario.schema import MARKER_HEIGHT
from kraft.simulation.imager import Calibration, Imager, Imaging, Lens, View, opencv, rotation_about
from kraft.simulation.rendered_camera import RenderedCamera, TagVision, calibrated_side, view_of
from kraft.simulation.world import World
from kraft.trial.plant import Plant
from kraft.vehicles import CAR_CONTROLS
from ompl_ext.arrays import Matrix

SCENE = load_scenario("turns")
CAMERA = (1.0, 3.0, 5.0)


def rendered(**sensing: Any) -> Scenario:
    return dataclasses.replace(SCENE, sensing=SCENE.sensing.model_copy(update={"preset": "rendered", **sensing}))


def at(x: float, y: float, yaw: float) -> tuple[Any, Matrix]:
    return np.array([x, y, MARKER_HEIGHT]), rotation_about(np.array([0.0, 0.0, yaw]))


def imager(seed: int = 0, **imaging: Any) -> Imager:
    return Imager(Lens(), view_of(CAMERA, SCENE.bounds), Imaging(**imaging), np.random.default_rng(seed))


def drive(camera: RenderedCamera, frames: int = 8) -> list[Observation | None]:
    return [camera.expose(k / 30, *at(1.3, 1.0 + 0.02 * k, 1.3)) for k in range(frames)]


@pytest.fixture(scope="module", autouse=True)
def _drawing() -> None:
    """Skips where neither EGL nor OSMesa can draw."""
    try:
        offscreen_context(16, 16).free()
    except MissingDependency as error:
        pytest.skip(f"nothing can be drawn on this machine: {error}")


# Optics


def test_a_lens_undistorts_what_it_distorts() -> None:
    points = np.array([[0.0, 0.0], [0.6, 0.3], [-0.65, -0.35], [0.1, -0.2]])
    assert Lens().undistorted(Lens().distorted(points)) == pytest.approx(points, abs=1e-6)


def test_the_camera_is_aimed_at_the_middle_of_the_bounds_with_its_width_along_them() -> None:
    view = view_of(CAMERA, SCENE.bounds)
    middle = view.points(np.array([[1.0, 2.5, 0.0], [1.0, 4.0, 0.0]]))
    assert middle[0, :2] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert middle[1, 0] > 1.0
    assert middle[1, 1] == pytest.approx(0.0, abs=1e-12)
    assert np.linalg.det(view.rotation) == pytest.approx(1.0)


# Frames


def test_dark_cells_cover_the_pixels_of_their_projection() -> None:
    frames = imager(blur=0.3)
    for x, y, yaw in ((1.0, 2.5, 0.3), (1.0, -0.5, 0.5 * math.pi), (0.1, 5.2, 2.0)):
        pose = at(x, y, yaw)
        corners = frames.corners(*pose)
        assert corners is not None
        first, size = np.round(corners.min(axis=0) - 12.0), 72
        found = []
        for white in (0.0, 1.0):
            frames._cells = np.full((6, 6), white)
            found.append(frames._light(first, size, [pose]).astype(float))
        ink = (found[1] - found[0]) / (0.80 - 0.05)
        rows, columns = np.mgrid[:size, :size]
        centre = np.array([(ink * columns).sum(), (ink * rows).sum()]) / ink.sum() + first
        a, b = (corners - np.roll(corners, 1, axis=0)).T, (corners + np.roll(corners, 1, axis=0)).T
        assert ink.sum() == pytest.approx(abs((a[0] * b[1] - a[1] * b[0]).sum()) / 4.0, rel=0.005)
        assert centre == pytest.approx(corners.mean(axis=0), abs=0.05)


def test_motion_blurs_a_frame_in_the_direction_of_motion() -> None:
    """The row through the middle of the tag has softer edges while the tag moves along it, which is along y."""
    steepest = []
    for step in (0.0, 0.1):
        frames = imager(read_noise=0.0, full_well=1e9, gain=(0.0, 0.0))
        frames.frame(0.0, *at(1.0, 2.0 - step, 0.0))
        frame = frames.frame(1 / 30, *at(1.0, 2.0, 0.0))
        assert frame is not None
        steepest.append(np.abs(np.diff(frame[0].astype(float), axis=1)).max(axis=1).mean())
    assert steepest[1] < 0.7 * steepest[0]


def test_noise_differs_from_frame_to_frame_and_is_as_large_as_that_of_a_webcam() -> None:
    frames = imager(gain=(0.0, 0.0))
    some = [frames.frame(0.0, *at(1.0, 2.0, 0.3)) for _ in range(12)]
    stack = np.array([frame[0].astype(float) for frame in some if frame is not None])
    assert 1.0 < stack.std(axis=0).mean() < 4.0


def test_without_errors_of_calibration_the_pose_is_found_within_centimetres() -> None:
    view, lens, frames = view_of(CAMERA, SCENE.bounds), Lens(), imager()
    vision = TagVision(lens, view, calibrated_side(CAMERA, SCENE.bounds.x, SCENE.bounds.y))
    errors = []
    for k in range(12):
        pose = at(0.4 + 0.1 * k, 1.5 + 0.2 * k, 0.4 * k)
        frame = frames.frame(0.0, *pose)
        assert frame is not None
        found = vision.pose(*frame)
        if found is not None:
            errors.append((*(found[:2] - pose[0][:2]), math.remainder(found[2] - 0.4 * k, math.tau)))
    assert len(errors) >= 10
    assert (np.median(np.abs(errors), axis=0) < [0.04, 0.04, math.radians(2.0)]).all()


def test_the_error_of_the_calibration_is_a_centimetre_and_stays_for_the_trial() -> None:
    view, lens, frames, generator = view_of(CAMERA, SCENE.bounds), Lens(), imager(), np.random.default_rng(3)
    corners = frames.corners(*at(1.2, 1.0, 1.0))
    assert corners is not None
    found = [TagVision(*Calibration().of(lens, view, generator)).tag(corners) for _ in range(200)]
    spread = np.std([tag[0][:2] for tag in found if tag is not None], axis=0)
    assert spread == pytest.approx([0.012, 0.012], rel=0.3)


# A trial


def test_the_same_seed_gives_the_same_observations_also_in_another_process() -> None:
    code = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "from simulation.test_rendered_camera import *\n"
        "print(drive(RenderedCamera(rendered(), 7)))"
    )
    here = drive(RenderedCamera(rendered(), 7))
    assert here == drive(RenderedCamera(rendered(), 7))
    assert here != drive(RenderedCamera(rendered(), 8))
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert there.strip() == str(here)


def test_a_frame_without_the_tag_is_missed_and_leaves_the_noise_of_the_others_as_it_is() -> None:
    one, other = (RenderedCamera(rendered(), 5) for _ in range(2))
    assert one.expose(0.0, *at(1.0, 40.0, 0.0)) is None
    other.expose(0.0, *at(1.0, 2.0, 0.0))
    one._imager._last = other._imager._last = None
    assert one.expose(1.0, *at(1.0, 2.0, 0.3)) == other.expose(1.0, *at(1.0, 2.0, 0.3))


def test_a_pose_arrives_later_by_the_latency() -> None:
    observations = [o for o in drive(RenderedCamera(rendered(latency=0.07), 1)) if o is not None]
    assert observations
    assert all(o.arrival == pytest.approx(o.time + 0.07) for o in observations)


def test_a_plant_with_a_rendered_camera_observes_the_car() -> None:
    scenario = rendered()
    plant = Plant(World(scenario), scenario, CAR_CONTROLS, 1, 30.0)
    observation = plant.expose()
    assert observation is not None
    assert (observation.x, observation.y) == pytest.approx((1.0, -0.5), abs=0.3)


@pytest.mark.parametrize("camera", ["[1, 30, 5]", "[1, 3, 40]"])
def test_a_camera_that_does_not_see_the_start_is_refused_at_its_line(camera: str) -> None:
    text = f"""name: far
bounds: {{x: [-0.25, 2.25], y: [-1, 6]}}
start: {{x: 1, y: -0.5, heading_deg: 90}}
goal: {{center: [1, 5], radius: 0.25}}
sensing:
  preset: rendered
  camera: {camera}
"""
    scenario = parse_scenario(text)
    with pytest.raises(InputError) as caught:
        Plant(World(scenario), scenario, CAR_CONTROLS, 0, 30.0)
    (diagnostic,) = caught.value.diagnostics
    assert (diagnostic.path, diagnostic.line, diagnostic.column) == ("sensing.camera", 7, 11)
    assert diagnostic.code is Code.GEOMETRY


def test_without_opencv_the_message_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingDependency, match=r"pip install .*\[vision\]"):
        opencv()
    with pytest.raises(MissingDependency):
        RenderedCamera(rendered(), 0)


def test_a_view_from_the_side_has_its_width_along_the_bounds() -> None:
    view = View.towards(np.array([-3.0, 2.5, 2.0]), np.array([1.0, 2.5, 0.0]), np.array([0.0, 1.0, 0.0]))
    assert abs(view.rotation[1, 0]) == pytest.approx(1.0)
