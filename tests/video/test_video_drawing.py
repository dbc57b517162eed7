"""What is drawn into the scene lies where it belongs, and the camera sees it."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import mujoco
import numpy as np
import pytest
from PIL import Image, ImageColor, ImageDraw
from support.passages import passage

from kraft.driving.messages import Cycle, PredictedMotion, Reference, ReferenceKind
from kraft.driving.method import load_method
from kraft.scenario import Box, Scenario, Start, load_scenario
from kraft.simulation.appearance import hidden_features
from kraft.simulation.floor_frame import Surface
from kraft.simulation.world import World
from kraft.trial.measures import Step
from kraft.trial.result import TrialSpec
from kraft.vehicles.load import load_vehicle
from kraft.video.drawing import EDGES_MAX, LINE, TREE, Pen, Snapshot, SnapshotRecorder, draw_cycle, resampled
from kraft.video.history import draw_history
from kraft.video.legend import plan_rows
from kraft.video.renderer import ROOF, SOLID, ChaseCamera, map_aim
from ompl_ext.plan import TreeView

BLUE = (0.0, 0.0, 1.0, 1.0)
MUSHR = load_vehicle("mushr")
ARC = np.column_stack([np.sin(np.linspace(0, 1, 40)), 2 - np.cos(np.linspace(0, 1, 40))])


def canvas(name: str, room: int = 5000) -> tuple[World, Any, Pen]:
    scenario = load_scenario(name)
    world = World(scenario)
    scene = mujoco.MjvScene(world.model, room)
    return world, scene, Pen(scene, Surface.of(scenario, world.frame))


def drawn(scene: Any) -> list[Any]:
    return list(scene.geoms[: scene.ngeom])


@pytest.mark.parametrize("name", ["turns", "slope"])
def test_strokes_lie_flat_on_the_floor_however_it_leans(name: str) -> None:
    world, scene, pen = canvas(name)
    pen.stroke(ARC, 0.03, 0.009, BLUE)
    places = np.array([world.frame.to_floor(np.array(geom.pos)) for geom in drawn(scene)])
    assert len(places) >= 1.0 / 0.05
    assert places[:, 2] == pytest.approx(0.009, abs=0.001)
    assert np.hypot(places[:, 0], places[:, 1] - 2) == pytest.approx(1.0, abs=0.001)
    for geom in drawn(scene):
        assert np.array(geom.mat)[:, 2] == pytest.approx(world.frame.normal, abs=1e-5)
        assert geom.castshadow == 0
    total = sum(2 * geom.size[0] for geom in drawn(scene))
    assert total == pytest.approx(1.0, abs=0.06)  # each piece is a little longer, to close bends


def test_the_ground_that_is_drawn_on_is_the_one_that_is_driven_on() -> None:
    world, _, _ = canvas("bump")
    scenario = load_scenario("bump")
    points = np.column_stack([np.full(301, 1.7), np.linspace(0.8, 3.8, 301)])
    found, geom = [], np.zeros(1, np.int32)
    ground = np.array([1, 0, 0, 1, 0, 0], np.uint8)
    for x, y in points:
        depth = mujoco.mj_ray(
            world.model, world.data, np.array([x, y, 0.15]), np.array([0, 0, -1.0]), ground, True, -1, geom
        )
        found.append(0.15 - depth)
    clear = np.array(found) < 0.149  # the second box stands there
    heights = Surface.of(scenario, world.frame).heights(points)
    assert clear.sum() > 200
    assert heights[clear] == pytest.approx(np.array(found)[clear], abs=0.002)
    assert heights.max() == pytest.approx(0.04, abs=0.001)


def test_strokes_climb_bumps() -> None:
    world, scene, pen = canvas("bump")
    pen.stroke(np.array([(1.7, 1.0), (1.7, 2.0)]), 0.03, 0.01, BLUE)
    top = max(world.frame.to_floor(np.array(geom.pos))[2] for geom in drawn(scene))
    assert top == pytest.approx(0.03 + 0.01, abs=0.003)


def test_a_full_scene_takes_no_more_and_complains_not() -> None:
    _, scene, pen = canvas("turns", room=10)
    pen.stroke(ARC, 0.03, 0.009, BLUE)
    pen.lines(np.zeros((5, 2, 2)), 0.01, BLUE, 1.0)
    assert scene.ngeom == 10


def test_dashes_leave_gaps() -> None:
    _, scene, pen = canvas("turns")
    pen.dashes(np.array([(0.0, 0.0), (1.0, 0.0)]), 0.03, 0.01, BLUE)
    length = sum(2 * geom.size[0] for geom in drawn(scene))
    assert 0.5 < length < 0.75


def cycle(kind: ReferenceKind, nodes: int, time: float = 0.0) -> Cycle:
    times = np.linspace(time, time + 2, 21)
    states = np.zeros((21, len(MUSHR.state)))
    states[:, 1] = np.linspace(0, 1, 21)
    reference = Reference(kind, times, states, np.zeros((20, 2)), np.zeros(2))
    safe = Reference(ReferenceKind.CONTINGENCY, times[:5], states[:5], np.zeros((4, 2)), np.zeros(2))
    view = TreeView(
        np.zeros((nodes, len(MUSHR.state))), np.arange(nodes) - 1, np.zeros((nodes, 2)), *np.zeros((3, nodes))
    )
    predicted = PredictedMotion(times[:11], states[:11], 0.1)
    return Cycle(1, time, 0.0, "", 2.0, passage(0.1), 9, nodes, 0, 1.0, False, reference, safe, predicted, tree=view)


def test_a_plan_is_drawn_with_its_tree_and_a_contingency_without_a_plan() -> None:
    _, scene, pen = canvas("turns")
    draw_cycle(pen, cycle(ReferenceKind.PLAN, 9000), MUSHR)
    lines = [geom for geom in drawn(scene) if geom.type == LINE]
    assert len(lines) == EDGES_MAX
    blue = [geom for geom in drawn(scene) if geom.rgba[2] > 0.6 and geom.rgba[0] < 0.1]
    orange = [geom for geom in drawn(scene) if geom.rgba[0] > 0.8 and geom.rgba[2] < 0.1]
    assert blue
    assert orange
    scene.ngeom = 0
    draw_cycle(pen, cycle(ReferenceKind.CONTINGENCY, 5), MUSHR)
    assert not [geom for geom in drawn(scene) if geom.rgba[2] > 0.6 and geom.rgba[0] < 0.1]


def test_the_tree_lies_below_the_predicted_motion() -> None:
    _, scene, pen = canvas("turns")
    draw_cycle(pen, cycle(ReferenceKind.PLAN, 50), MUSHR)
    tree = [geom.pos[2] for geom in drawn(scene) if geom.type == LINE]
    width = MUSHR.footprint.width / 2
    band = [geom.pos[2] - geom.size[2] for geom in drawn(scene) if geom.type != LINE and geom.size[1] >= width - 1e-6]
    assert band
    assert max(tree) < min(band)


def test_a_cycle_is_shown_from_when_it_begins() -> None:
    scenario = load_scenario("turns")
    world = World(scenario)
    snapshots = SnapshotRecorder(TrialSpec(scenario, load_method("kraft"), MUSHR, 0))
    snapshots.on_cycle(cycle(ReferenceKind.PLAN, 3, time=0.05))
    step = Step(0.0, (1.0, -0.5, 1.57), 0.0, np.zeros(len(MUSHR.state)), np.zeros(2), 0)
    assert snapshots.on_step(world, step).cycle is None
    world.step(25)
    snapshot = snapshots.on_step(world, step)
    assert snapshot.cycle is not None
    assert snapshot.clearance == pytest.approx(0.3, abs=0.2)


def hidden_behind(height: float) -> Scenario:
    """A wall of a height right behind the car."""
    scenario = load_scenario("turns")
    wall = Box((1.0, -0.9), (2.0, 0.2), 0.0, height)
    return dataclasses.replace(scenario, obstacles=(wall,), start=Start(1.0, 0.0, math.pi / 2))


@pytest.mark.parametrize("height", [0.2, 0.9, 1.3])
def test_nothing_stands_between_the_camera_and_the_car(height: float) -> None:
    world = World(hidden_behind(height))
    aim = ChaseCamera(world.model, world.frame).aim(world.data, world.time, world.pose)
    roof = np.array([*world.pose[:2], ROOF])
    sight = aim.position - roof
    hit = mujoco.mj_ray(world.model, world.data, roof, sight, SOLID, True, -1, np.zeros(1, np.int32))
    assert hit < 0 or hit > 1
    assert aim.position @ np.array([0, 1, 0]) < world.pose[1], "it is behind the car"
    assert aim.forward @ sight < 0


def test_the_camera_turns_smoothly_and_gets_there() -> None:
    world = World(hidden_behind(0.2))
    camera, headings = ChaseCamera(world.model, world.frame), []
    camera._turn(0.0, 3.0)
    for k in range(1, 90):
        camera._turn(k / 30, -3.0)  # the short way, over pi
        headings.append(camera._heading)
    steps = np.diff([3.0, *headings])
    assert headings[-1] == pytest.approx(2 * math.pi - 3.0, abs=0.01)
    assert (steps > -1e-9).all()
    assert np.abs(np.diff(steps)).max() < 0.01


@pytest.mark.parametrize("turned", [False, True])
def test_the_map_shows_the_whole_scene_square_to_the_floor(turned: bool) -> None:
    world, _, _ = canvas("slope")
    bounds = load_scenario("slope").bounds
    if turned:
        bounds = bounds.model_copy(update={"x": bounds.y, "y": bounds.x})
    aim = map_aim(world.frame, bounds, 0.4)
    right = np.cross(aim.forward, aim.up)
    assert -aim.forward == pytest.approx(world.frame.normal)
    for x in bounds.x:
        for y in bounds.y:
            offset = world.frame.to_world(np.array([x, y, 0.0])) - aim.position
            assert abs(offset @ aim.up) < aim.half
            assert abs(offset @ right) < 0.4 * aim.half


def test_curves_keep_their_ends() -> None:
    points = resampled(np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)]), 0.3)
    assert points[0] == pytest.approx([0, 0])
    assert points[-1] == pytest.approx([1, 1])
    assert len(resampled(np.zeros((4, 2)), 0.1)) == 1


def test_what_was_hidden_is_shown_where_it_ended() -> None:
    scenario = load_scenario("movable")
    before = hidden_features(scenario)
    moved = World(scenario).movable_poses + np.array([0.5, 0.0, 0.0])
    after = hidden_features(scenario, moved)
    assert {thing.kind for thing in before} == {"box"}
    for one, other in zip(before, after, strict=True):
        assert other.corners.mean(axis=0) - one.corners.mean(axis=0) == pytest.approx([0.5, 0.0], abs=1e-6)
    assert {thing.kind for thing in hidden_features(load_scenario("slip"))} == {"patch"}
    assert {thing.kind for thing in hidden_features(load_scenario("bump"))} == {"bump"}


def test_pieces_of_a_wide_band_meet_at_the_outside_of_a_bend() -> None:
    world, scene, pen = canvas("turns")
    bend, width = 0.4, 0.28
    corner = np.array([0.5, 0.0])
    path = np.array([(0.45, 0.0), tuple(corner), (0.5 + 0.05 * math.cos(bend), 0.05 * math.sin(bend))])
    pen.shaded(path, width, 0.0025, np.tile(BLUE, (2, 1)))
    outside = corner + 0.499 * width * np.array([math.sin(bend / 2), -math.cos(bend / 2)]) / math.cos(bend / 2)
    for geom in drawn(scene):
        place = np.array(geom.mat).T @ (world.frame.to_world(np.array([*outside, 0.0025])) - np.array(geom.pos))
        assert (np.abs(place[:2]) <= np.array(geom.size)[:2] + 1e-6).all()


def test_the_legend_shows_the_tree_in_its_colour() -> None:
    image = Image.new("RGB", (60, 40))
    dict(plan_rows())["search tree"](ImageDraw.Draw(image), 10, 20)
    assert ImageColor.getrgb(TREE) in {colour for _, colour in image.getcolors() or ()}


def test_the_curve_of_the_speed_has_times_and_the_top_speed_of_the_legend(monkeypatch: pytest.MonkeyPatch) -> None:
    times = (0.0, 6.0, 12.0)
    past = [Snapshot(t, np.zeros(3), 0.72, None, 1.0, None, np.zeros((2, 3)), np.zeros(1), None) for t in times]
    draw, written = ImageDraw.Draw(Image.new("RGB", (300, 80))), []
    monkeypatch.setattr(draw, "text", lambda place, text, *rest: written.append(text))
    draw_history(draw, (0, 0, 300, 80), past, 0.706)
    assert {"0", "0.71", "5 s", "10 s"} <= set(written)
    assert "0.72" not in written
