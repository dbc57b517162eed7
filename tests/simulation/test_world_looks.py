"""What is only there to be seen is well made and touches nothing."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from support.paths import ROOT

from kraft.scenario import load_scenario
from kraft.simulation import World, car_looks
from kraft.simulation.car_looks import Part, block, loft, mirrored

DRAW = """
import sys
from kraft.scenario import load_scenario
from kraft.simulation import World
from kraft.simulation.render import Painter
world = World(load_scenario("slip"))
with Painter(world, 320, 180) as painter:
    views = [painter.chase(), painter.overview()]
    assert all(view.shape == (180, 320, 3) and view.std() > 20 for view in views)
    red = views[0].astype(int)
    assert ((red[..., 0] > 120) & (red[..., 1] < 90)).sum() > 500, "no car to be seen"
"""


def volume(part: Part) -> float:
    vertices, faces = part
    a, b, c = (vertices[np.array(faces)[:, k]] for k in range(3))
    return float(np.sum(a * np.cross(b, c))) / 6


def test_lofts_are_closed_and_face_outwards() -> None:
    assert volume(block((0, 0, 0), (1, 2, 3))) == pytest.approx(6)
    assert volume(mirrored(block((0, 1, 0), (1, 2, 3)))) == pytest.approx(3)
    prism = [[(x, 0, 0), (x, 1, 0), (x, 0, 1)] for x in (0, 2)]
    assert volume(loft(prism)) == volume(loft(prism[::-1])) == pytest.approx(1)


def test_every_part_of_the_car_faces_outwards() -> None:
    parts = [car_looks._deck(), car_looks._flank(), car_looks._cabin(), *car_looks._roof(), *car_looks._wing()]
    assert all(volume(part) > 0 for part in parts)


def test_looks_have_no_mass_and_touch_nothing() -> None:
    model = World(load_scenario("movable")).model
    looks = model.geom_group == 2
    assert looks.sum() > 20
    assert not model.geom_contype[looks].any()
    assert not model.geom_conaffinity[looks].any()
    car = model.body("car").id
    assert model.body_subtreemass[car] == pytest.approx(3.54 + 4 * 0.5)


def test_looks_stay_within_the_car() -> None:
    world = World(load_scenario("turns"))
    model, data = world.model, world.data
    at = np.array([1.0, -0.5, 0.0])
    for geom in np.flatnonzero(
        (model.body_rootid[model.geom_bodyid] == model.body("car").id) & (model.geom_group == 2)
    ):
        mesh = model.geom_dataid[geom]
        if mesh < 0:
            continue
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        corners = model.mesh_vert[first : first + count] @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        x, y = corners[:, 1] - at[1], at[0] - corners[:, 0]  # the car looks along +y
        assert -0.2255 < x.min() < x.max() < 0.2155
        assert np.abs(y).max() < 0.139


def test_a_world_is_drawn_without_a_window() -> None:
    environment = {**os.environ, "MUJOCO_GL": "egl"}
    probe = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'))"
    if subprocess.run([sys.executable, "-c", probe], env=environment, capture_output=True, check=False).returncode:
        pytest.skip("this machine has no EGL")
    done = subprocess.run([sys.executable, "-c", DRAW], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_pictures_of_the_documentation_are_drawn_as_it_says() -> None:
    """In a process without MUJOCO_GL and without a screen."""
    text = (ROOT / "docs" / "world.md").read_text(encoding="utf-8")
    block = next(block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "Painter" in block)
    hidden = {name: text for name, text in os.environ.items() if name not in ("DISPLAY", "MUJOCO_GL")}
    environment = {**hidden, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    done = subprocess.run([sys.executable, "-c", block], env=environment, capture_output=True, text=True, check=False)
    if "egl" in done.stderr.lower() and "has no attribute" in done.stderr:
        pytest.skip("there is no EGL on this machine")
    assert done.returncode == 0, done.stderr
