"""The camera: exact where its assumptions hold, wrong by geometry where they do not, and as noisy as was measured."""

from __future__ import annotations

import functools
import math
from typing import Any, Literal

import numpy as np
import pytest

from kraft.driving.estimation.camera_model import PowerLaw
from kraft.driving.messages import Observation
from kraft.errors import Code, InputError
from kraft.scenario import Sensing, load_scenario
from kraft.scenario.schema import MARKER_HEIGHT
from kraft.simulation.camera import PRESETS, ErrorModel, ErrorPart, MarkerCamera
from kraft.simulation.world import World
from ompl_ext.arrays import Floats, Matrix

HEIGHT = 0.2
DEGREE = math.pi / 180
Preset = Literal["planar", "single-tag"]


def turned(yaw: float) -> Matrix:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def leaning(angle: float) -> Matrix:
    """Rotation of a floor that climbs along +y."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def camera(seed: int = 0, **sensing: Any) -> MarkerCamera:
    return MarkerCamera(Sensing(**sensing), HEIGHT, seed)


def exact(**sensing: Any) -> MarkerCamera:
    return camera(noise_scale=0.0, dropout=0.0, **sensing)


def seen(cam: MarkerCamera, x: float, y: float, z: float = HEIGHT, yaw: float = 0.0) -> tuple[float, float, float]:
    observation = cam.expose(0.0, np.array([x, y, z]), turned(yaw))
    assert observation is not None
    return observation.x, observation.y, observation.theta


def errors(preset: Preset, position: Floats, frames: int, seeds: int = 1, **sensing: Any) -> Matrix:
    """Errors (n, 3) of frames of a marker that does not move, less each trial's mean."""
    found = []
    for seed in range(seeds):
        cam = camera(seed, preset=preset, dropout=0.0, **sensing)
        poses = [cam.expose(k / 30, position, turned(0.0)) for k in range(frames)]
        found.append(np.array([(p.x, p.y, p.theta) for p in poses if p is not None]) - [*position[:2], 0.0])
    return np.concatenate(found)


def at_distance(distance: float) -> Floats:
    """Marker to the right of the default camera (1, 3, 5), the line of sight along x."""
    return np.array([1.0 + math.sqrt(distance**2 - (5.0 - HEIGHT) ** 2), 3.0, HEIGHT])


# Geometry


@pytest.mark.parametrize("preset", ["planar", "single-tag"])
@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5, 3.1])
def test_without_noise_a_marker_on_a_flat_floor_is_measured_exactly(preset: Preset, yaw: float) -> None:
    assert seen(exact(preset=preset), 0.3, -0.5, yaw=yaw) == pytest.approx((0.3, -0.5, yaw), abs=1e-12)


def test_a_lifted_marker_is_measured_farther_from_the_camera_along_the_line_of_sight() -> None:
    x, y, theta = seen(exact(), 2.0, 0.5, z=HEIGHT + 0.05)
    stretch = (5.0 - HEIGHT) / (5.0 - HEIGHT - 0.05)
    assert (x, y) == pytest.approx((1.0 + stretch * 1.0, 3.0 - stretch * 2.5))
    assert theta == pytest.approx(0.0, abs=1e-12)


def test_on_a_tilted_floor_the_measured_position_is_more_than_a_decimetre_off() -> None:
    lean = leaning(0.125)
    point = lean @ np.array([0.4, 4.5, HEIGHT])
    observation = exact().expose(0.0, point, lean @ turned(0.0))
    assert observation is not None
    stretch = (5.0 - HEIGHT) / (5.0 - point[2])
    assert (observation.x, observation.y) == pytest.approx((1.0 - stretch * 0.6, 3.0 + stretch * (point[1] - 3.0)))
    assert observation.y - 4.5 > 0.12
    assert observation.x - 0.4 < -0.07


def test_a_heading_on_a_floor_that_leans_is_bent() -> None:
    lean = leaning(0.125)
    along, slanted = (
        exact().expose(0.0, lean @ np.array([1.0, 3.0, HEIGHT]), lean @ turned(yaw)) for yaw in (math.pi / 2, 0.8)
    )
    assert along is not None
    assert slanted is not None
    assert along.theta == pytest.approx(math.pi / 2)
    assert 0.2 * DEGREE < abs(slanted.theta - 0.8) < 5 * DEGREE


@pytest.mark.parametrize(("name", "low", "high"), [("turns", 0.0, 1e-9), ("slope", 0.2, 0.6)])
def test_only_the_slope_scene_is_measured_wrong(name: str, low: float, high: float) -> None:
    frame, goal = World(load_scenario(name)).frame, (0.5, 5.0)
    observation = exact().expose(0.0, frame.to_world(np.array([*goal, HEIGHT])), frame.rotation)
    assert observation is not None
    assert low <= math.hypot(observation.x - goal[0], observation.y - goal[1]) <= high


def test_the_worlds_marker_is_where_the_camera_takes_it_to_be() -> None:
    world = World(load_scenario("turns"))
    observation = MarkerCamera(Sensing(noise_scale=0.0, dropout=0.0), MARKER_HEIGHT, 0).expose(0.0, *world.marker)
    assert observation is not None
    assert (observation.x, observation.y, observation.theta) == pytest.approx(tuple(world.pose), abs=1e-3)


def test_a_marker_above_the_camera_is_not_detected() -> None:
    assert exact().expose(0.0, np.array([1.0, 2.0, 5.5]), turned(0.0)) is None


def test_a_camera_below_the_marker_is_refused() -> None:
    with pytest.raises(InputError) as caught:
        camera(camera=(1.0, 3.0, 0.1))
    (diagnostic,) = caught.value.diagnostics
    assert (diagnostic.file, diagnostic.code) == ("sensing.camera", Code.GEOMETRY)


# Time


def test_a_pose_arrives_later_by_the_latency() -> None:
    observation = exact(latency=0.07).expose(1.5, np.array([1.0, 1.0, HEIGHT]), turned(0.0))
    assert observation is not None
    assert (observation.time, observation.arrival) == (1.5, pytest.approx(1.57))


def poses(cam: MarkerCamera, frames: int = 200) -> list[Observation | None]:
    return [cam.expose(k / 30, np.array([0.5, 0.01 * k, HEIGHT]), turned(0.1)) for k in range(frames)]


def test_the_same_seed_sees_the_same_and_another_one_something_else() -> None:
    assert poses(camera(7)) == poses(camera(7))
    assert poses(camera(7)) != poses(camera(8))


def test_missed_frames_leave_the_others_as_they_would_be() -> None:
    all_of_them, some = poses(camera(3, dropout=0.0)), poses(camera(3, dropout=0.5))
    assert 60 < sum(pose is None for pose in some) < 140
    assert all(one == other for one, other in zip(all_of_them, some, strict=True) if other is not None)


@pytest.mark.parametrize(("given", "expected"), [(None, 0.02), (0.3, 0.3), (0.0, 0.0), (1.0, 1.0)])
def test_as_many_frames_are_missed_as_the_preset_or_the_scenario_says(given: float | None, expected: float) -> None:
    missed = sum(pose is None for pose in poses(camera(1, dropout=given), 4000))
    assert missed / 4000 == pytest.approx(expected, abs=0.02)


# Noise

LAGS = (1, 3, 6, 15, 30, 60, 90)  # frames at 30 Hz
DRIVES = 125


@functools.cache
def deviations(preset: Preset, speed: float, seeds: int, frames: int = 150, **sensing: Any) -> list[Matrix]:
    """Errors (frames, 3) of drives along the line of sight, in units of their stated spread, without mean and bias."""
    noise, found = PRESETS[preset], []
    for seed in range(seeds):
        cam = camera(seed, preset=preset, dropout=0.0, **sensing)
        rows = []
        for k in range(frames):
            x = 1.6 + speed * k / 30
            pose, distance, phi = (
                seen_at(cam, k, x),
                math.hypot(x - 1.0, 5.0 - HEIGHT),
                math.atan2(x - 1.0, 5.0 - HEIGHT),
            )
            error = pose[0] - x, pose[1] - 3.0, pose[2]
            of = zip(error, cam._noise._bias, (noise.along, noise.across, noise.heading), strict=True)
            still = 0.0 if speed > 0.1 and k > 0 else 1.0  # the first frame is as of a tag that stands
            rows.append([])
            for e, bias, m in of:
                factor = 1.0 + still * (m.standing - 1.0)
                rows[-1].append(((e - bias) / factor - m.mean.at(distance, phi)) / m.size.at(distance, phi))
        found.append(np.array(rows))
    return found


def seen_at(cam: MarkerCamera, k: int, x: float) -> tuple[float, float, float]:
    observation = cam.expose(k / 30, np.array([x, 3.0, HEIGHT]), turned(0.0))
    assert observation is not None
    return observation.x, observation.y, observation.theta


def correlation(drives: list[Matrix], lag: int) -> Floats:
    """About zero: a drive's own mean would hide what is constant in it."""
    products = np.concatenate([drive[:-lag] * drive[lag:] for drive in drives])
    found: Floats = products.mean(axis=0) / np.concatenate([drive**2 for drive in drives]).mean(axis=0)
    return found


def copula(model: ErrorModel, correlated: float) -> float:
    """Correlation of a model's deviations whose normal variables have a given correlation."""
    z, w = np.polynomial.hermite_e.hermegauss(60)
    value = np.vectorize(model.deviation)
    second = value(correlated * z[:, None] + math.sqrt(1.0 - correlated**2) * z[None, :])
    return float((w / w.sum() * value(z)) @ second @ (w / w.sum()))


@pytest.mark.parametrize("distance", [4.9, 5.6])
@pytest.mark.parametrize("preset", ["planar", "single-tag"])
@pytest.mark.parametrize("correlation_time", [0.0, 0.05])
def test_errors_have_the_stated_spread(preset: Preset, distance: float, correlation_time: float) -> None:
    found = errors(preset, at_distance(distance), 8000, correlation_time=correlation_time)
    phi, noise = math.acos((5.0 - HEIGHT) / distance), PRESETS[preset]
    stated = [model.standing * model.size.at(distance, phi) for model in (noise.along, noise.across, noise.heading)]
    assert found.std(axis=0) == pytest.approx(stated, rel=0.12)


@pytest.mark.parametrize("speed", [0.0, 0.6])
@pytest.mark.parametrize("preset", ["planar", "single-tag"])
def test_errors_have_the_stated_correlation_whether_the_car_moves_or_stands(preset: Preset, speed: float) -> None:
    drives, noise = deviations(preset, speed, DRIVES), PRESETS[preset]
    for lag in LAGS:
        models = (noise.along, noise.across, noise.heading)
        kept = [sum(p.share * p.kept(speed * lag / 30, lag / 30) for p in model.parts) for model in models]
        expected = [copula(model, value) for model, value in zip(models, kept, strict=True)]
        assert correlation(drives, lag) == pytest.approx(expected, abs=0.1)


def test_a_tag_that_stands_repeats_part_of_its_error_however_long_one_looks() -> None:
    standing, moving = (deviations("single-tag", speed, DRIVES) for speed in (0.0, 0.6))
    assert (correlation(standing, 90)[:2] > correlation(moving, 90)[:2] + 0.2).all()
    assert correlation(standing, 1) == pytest.approx(correlation(standing, 90), abs=0.1)


@pytest.mark.parametrize("preset", ["planar", "single-tag"])
@pytest.mark.parametrize("correlation_time", [0.0, 0.5])
def test_the_correlation_time_of_the_scenario_replaces_that_of_the_preset(
    preset: Preset, correlation_time: float
) -> None:
    noise, drives = PRESETS[preset], deviations(preset, 0.0, DRIVES, correlation_time=correlation_time)
    for lag in LAGS:
        kept = math.exp(-lag / 30 / correlation_time) if correlation_time else 0.0
        expected = [copula(model, kept) for model in (noise.along, noise.across, noise.heading)]
        assert correlation(drives, lag) == pytest.approx(expected, abs=0.1)


def test_the_shares_of_the_parts_of_an_error_add_up_to_one() -> None:
    for noise in PRESETS.values():
        for model in (noise.along, noise.across, noise.heading):
            assert sum(part.share for part in model.parts) == pytest.approx(1.0)


@pytest.mark.parametrize(("skew", "tail"), [(0.0, 0.0), (0.6, 0.0), (0.0, 0.15), (0.4, 0.1)])
def test_skew_and_tails_change_neither_mean_nor_variance(skew: float, tail: float) -> None:
    model = ErrorModel(PowerLaw(1.0), (ErrorPart(1.0),), skew=skew, tail=tail)
    z = np.linspace(-4.0, 4.0, 4001)
    weight = np.exp(-0.5 * z * z) / np.exp(-0.5 * z * z).sum()
    value = np.array([model.deviation(point) for point in z])
    assert weight @ value == pytest.approx(0.0, abs=0.01)
    assert weight @ value**2 == pytest.approx(1.0, abs=0.05)


def test_noise_grows_with_the_distance_as_the_power_law_through_both_measurements() -> None:
    law = PowerLaw.through(0.042, 0.106)
    assert (law.at(3.0), law.at(5.0)) == pytest.approx((0.042, 0.106))
    assert law.at(6.0) > 1.3 * law.at(5.0)
    assert PowerLaw(1.0, 2.0, 0.5).at(10.0, 0.4) == pytest.approx(4.0 * math.exp(0.2))


def test_the_larger_error_lies_along_the_line_of_sight_wherever_the_marker_is() -> None:
    position = np.array([0.0, 1.0, HEIGHT])
    sight = math.atan2(1.0 - 3.0, 0.0 - 1.0)
    found = errors("single-tag", position, 8000, correlation_time=0.0)[:, :2]
    along = found @ np.array([math.cos(sight), math.sin(sight)])
    across = found @ np.array([-math.sin(sight), math.cos(sight)])
    assert along.std() > 1.4 * across.std()


def test_headings_of_a_single_tag_have_heavy_tails_and_those_of_a_known_plane_have_none() -> None:
    for preset, low, high in (("single-tag", 5.0, 40.0), ("planar", 2.7, 3.4)):
        x = errors(preset, at_distance(5.2), 20_000, correlation_time=0.0)[:, 2]  # type: ignore[arg-type]
        kurtosis = np.mean((x - x.mean()) ** 4) / x.var() ** 2
        assert low < kurtosis < high


def test_every_trial_has_an_offset_of_its_own_that_no_averaging_removes() -> None:
    spread = np.array(
        [np.mean([(o.x - 1.5, o.y - 2.0) for o in still(seed) if o is not None], axis=0) for seed in range(40)]
    )
    assert 0.009 < spread.std() < 0.04


def still(seed: int) -> list[Observation | None]:
    cam = camera(seed, dropout=0.0)
    return [cam.expose(k / 30, np.array([1.5, 2.0, HEIGHT]), turned(0.0)) for k in range(900)]


def test_the_scale_multiplies_every_error() -> None:
    position = at_distance(5.0)
    once, twice = (errors("single-tag", position, 100, noise_scale=scale) for scale in (1.0, 2.0))
    assert twice == pytest.approx(2.0 * once, abs=1e-9)


def test_headings_stay_within_half_a_turn() -> None:
    cam = camera(2, dropout=0.0)
    found = [cam.expose(k / 30, np.array([1.0, 1.0, HEIGHT]), turned(math.pi)) for k in range(500)]
    headings = [pose.theta for pose in found if pose is not None]
    assert min(headings) < -2.0
    assert max(headings) > 2.0
    assert all(abs(heading) <= math.pi for heading in headings)
