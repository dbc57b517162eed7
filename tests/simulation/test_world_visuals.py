"""What is only there to be seen is well made and touches nothing."""

from __future__ import annotations

import numpy as np
import pytest

from kraft.evaluation.suite import load_suite
from kraft.scenario import load_scenario
from kraft.simulation import World, appearance
from kraft.simulation.appearance import Part, block, loft, mirrored


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
    parts = [
        appearance._deck(),
        appearance._flank(),
        appearance._cabin(),
        *appearance._roof(),
        *appearance._wing(),
    ]
    assert all(volume(part) > 0 for part in parts)


def test_visual_geoms_have_no_mass_and_touch_nothing() -> None:
    model = World(load_scenario("movable")).model
    visual = model.geom_group == 2
    assert visual.sum() > 20
    assert not model.geom_contype[visual].any()
    assert not model.geom_conaffinity[visual].any()
    car = model.body("car").id
    assert model.body_subtreemass[car] == pytest.approx(3.54 + 4 * 0.5)


def test_visual_geoms_stay_within_the_car() -> None:
    world = World(load_scenario("turns"))
    model, data = world.model, world.data
    at = np.array([1.0, -0.5, 0.0])
    visual = (model.body_rootid[model.geom_bodyid] == model.body("car").id) & (model.geom_group == 2)
    assert (model.geom_dataid[visual] >= 0).any()
    for geom in np.flatnonzero(visual):
        mesh = model.geom_dataid[geom]
        if mesh < 0:
            continue
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        corners = model.mesh_vert[first : first + count] @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        x, y = corners[:, 1] - at[1], at[0] - corners[:, 0]  # the car visual along +y
        assert -0.2255 < x.min() < x.max() < 0.2155
        assert np.abs(y).max() < 0.139


@pytest.mark.parametrize("name", ["bump", "movable", "slope-down-9"])
def test_a_world_without_visuals_moves_to_the_same_bytes(name: str) -> None:
    """Also where a wheel just touches the floor at the start, as in slope-down-9."""
    harder = {entry.name: entry.scenario for entry in load_suite("hard")}
    scenario = harder.get(name) or load_scenario(name)
    seen, plain = World(scenario), World(scenario, visuals=False)
    assert plain.model.ngeom <= seen.model.ngeom - 20
    assert not (plain.model.geom_group == 2).any()
    for world in (seen, plain):
        world.apply([0.5, 0.05])
        world.step(2000)
    assert plain.configuration.tobytes() == seen.configuration.tobytes()
