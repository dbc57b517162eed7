"""Pictures of plans: the same bytes for the same plan, whole or not at all, and drawn whatever is missing."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

from kraft.errors import Code, InputError
from kraft.plot import PlanPicture, compose, plot_plan
from kraft.plot import style as output
from kraft.plot.labels import Label, draw_labels
from kraft.plot.page import Frame, flow_rows
from kraft.plot.scene import EDGES_MAX, PoseTrajectory, arrowheads, outlines, tree_lines, widest_place
from kraft.plot.style import LABEL, plot_style, shortened, text_width
from kraft.scenario import Bounds, Box, Circle, Goal, OccupancyMap, Polygon, Start, Task, load_scenario
from kraft.vehicles.benchmark import BENCHMARK
from ompl_ext.plan import Contingency, Plan, TreeView
from ompl_ext.vehicle import Footprint, Vehicle

CAR = BENCHMARK
SLED = Vehicle(
    name="sled",
    derivative=lambda x, u, p: x,
    state=("y", "x", "speed"),
    controls={"pull": (0.0, 1.0)},
    footprint=Footprint(0.5, 0.3),
    top_speed=1.0,
    rest=("speed",),
)
TURNS = load_scenario("turns").task()
CELLS = np.zeros((4, 6), dtype=np.bool_)
CELLS[1:3, 2:5] = True
MIXED = Task(
    name="mixed",
    bounds=Bounds(x=(0, 6), y=(0, 5)),
    obstacles=(
        Circle((2.0, 1.6), 0.5, name="column"),
        Polygon(((3.2, 0.4), (4.4, 0.6), (4.2, 1.0), (3.5, 1.7)), name="rock"),
        Box((4.9, 2.6), (1.2, 0.4), 0.5),
        OccupancyMap(CELLS, 0.2, (1.6, 3.0, 0.25)),
    ),
    start=Start(1.0, 0.5, 1.2),
    goal=Goal((5.3, 4.2), 0.3, math.radians(60), math.radians(40)),
)


def drive(vehicle: Vehicle = CAR, seconds: int = 8) -> Plan:
    """A plan that goes straight up from (1, -0.5), with a contingency after the first second."""
    times = np.linspace(0.0, seconds, 10 * seconds + 1)
    columns = {"x": np.ones_like(times), "y": -0.5 + 0.6 * times, "theta": np.full_like(times, math.pi / 2)}
    trajectory = np.column_stack([columns.get(name, np.full_like(times, 0.6)) for name in vehicle.state])
    controls = np.tile([high for _, high in vehicle.controls.values()], (seconds, 1))
    durations = np.ones(seconds)
    braking = Contingency("coast", times[10:21], trajectory[10:21], 0.05)
    return Plan(trajectory[::10], controls, durations, times, trajectory, float(seconds), 0.0, True, braking)


def fan(nodes: int, vehicle: Vehicle = CAR) -> TreeView:
    """A tree whose root at (1, -0.5) has all other nodes as children."""
    states = np.zeros((nodes, len(vehicle.state)))
    angle = np.linspace(0.5, 2.5, nodes)
    states[:, vehicle.index("x")], states[:, vehicle.index("y")] = 1 + np.cos(angle), -0.5 + np.sin(angle)
    if nodes:
        states[0, [vehicle.index("x"), vehicle.index("y")]] = 1.0, -0.5
    costs = np.linspace(0.0, 5.0, nodes)
    parents = np.where(np.arange(nodes) == 0, -1, 0)
    return TreeView(states, parents, np.zeros((nodes, len(vehicle.controls))), costs, costs, costs)


def figure(task: Task, plan: Plan | None, tree: TreeView, vehicle: Vehicle = CAR, cycle: float = 1.0) -> Figure:
    with plot_style():
        return compose(PlanPicture.of(task, vehicle, plan, tree, cycle), "title", {})


def texts(drawn: Figure) -> list[str]:
    everywhere = list(drawn.texts) + [text for axes in drawn.axes for text in axes.texts]
    return [text.get_text() for text in everywhere]


@pytest.mark.parametrize("suffix", output.FORMATS)
def test_the_same_plan_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    for name in ("a", "b"):
        plot_plan(tmp_path / (name + suffix), MIXED, CAR, drive(), fan(3000), notes={"cost": "8 s"})
    first, second = ((tmp_path / (name + suffix)).read_bytes() for name in ("a", "b"))
    assert first == second
    assert first.startswith({".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}[suffix])


def test_a_png_is_1600_pixels_wide_and_small(tmp_path: Path) -> None:
    plot_plan(tmp_path / "p.PNG", TURNS, CAR, drive(), fan(20_000))
    with Image.open(tmp_path / "p.PNG") as image:
        assert image.width == 1600
        assert image.convert("RGB").getpixel((0, 0)) == (255, 255, 255)
    assert (tmp_path / "p.PNG").stat().st_size < 300_000


@pytest.mark.parametrize("name", ["plan.jpg", "plan", "plan.png.txt"])
def test_another_suffix_is_refused_and_the_known_ones_are_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"\.png, \.svg, \.pdf"):
        plot_plan(tmp_path / name, TURNS, CAR, None, fan(1))
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_an_input_error(tmp_path: Path) -> None:
    (tmp_path / "plan.png").mkdir()
    with pytest.raises(InputError) as caught:
        plot_plan(tmp_path / "plan.png", TURNS, CAR, None, fan(1))
    assert [problem.code for problem in caught.value.diagnostics] == [Code.UNWRITABLE]
    assert [p.name for p in tmp_path.iterdir()] == ["plan.png"]


def test_an_error_while_drawing_leaves_the_old_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "plan.svg"
    target.write_text("old")

    def broken(*_: object) -> None:
        raise RuntimeError("out of ink")

    monkeypatch.setattr("kraft.plot.draw_legend", broken)
    with pytest.raises(RuntimeError, match="ink"):
        plot_plan(target, TURNS, CAR, None, fan(1))
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["plan.svg"]


def test_drawing_leaves_matplotlibs_settings_as_they_were(tmp_path: Path) -> None:
    with matplotlib.rc_context({"font.size": 3.0, "axes.facecolor": "red"}):
        before = dict(matplotlib.rcParams)
        plot_plan(tmp_path / "a.png", TURNS, CAR, drive(), fan(50))
        assert dict(matplotlib.rcParams) == before
    plot_plan(tmp_path / "b.png", TURNS, CAR, drive(), fan(50))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_without_a_plan_the_scene_and_the_tree_are_drawn_and_it_says_so() -> None:
    drawn = figure(TURNS, None, fan(200))
    assert "no plan" in texts(drawn)
    assert {"start", "goal", "first box"} <= set(texts(drawn))
    assert len(drawn.axes) == 2  # the map and the scale of the tree's colours


@pytest.mark.parametrize("nodes", [0, 1])
def test_a_tree_without_edges_has_no_scale(nodes: int) -> None:
    drawn = figure(TURNS, None, fan(nodes))
    assert len(drawn.axes) == 1
    assert not any("tree" in text for text in texts(drawn))


def test_a_plan_that_ends_short_of_the_goal_says_how_far_it_is() -> None:
    short = dataclasses.replace(drive(), reaches_goal=False, cost_to_go=3.21)
    assert "goal not reached, 3.2 s or more to go" in texts(figure(TURNS, short, fan(9)))
    lost = dataclasses.replace(short, cost_to_go=math.inf)
    assert "goal not reached" in texts(figure(TURNS, lost, fan(9)))


def test_the_contingency_is_named_where_it_ends_and_absent_without_one() -> None:
    said = texts(figure(TURNS, drive(), fan(9)))
    assert "contingency “coast”\nstands at 2.0 s" in said
    without = texts(figure(TURNS, dataclasses.replace(drive(), contingency=None), fan(9)))
    assert not any("contingency" in text for text in without)


def test_speed_and_controls_have_a_panel_each() -> None:
    drawn = figure(TURNS, drive(), fan(9))
    assert {"speed, m/s", "throttle, share of the largest", "steering, share of the largest"} <= set(texts(drawn))
    assert len(drawn.axes) == 2 + 3


def test_the_first_cycle_of_a_plan_may_be_longer_than_the_plan(tmp_path: Path) -> None:
    plot_plan(tmp_path / "p.png", TURNS, CAR, drive(seconds=2), fan(9), cycle=5.0)
    assert (tmp_path / "p.png").exists()


def test_a_plan_that_begins_in_the_goal_is_drawn_without_panels() -> None:
    at, none = np.array([[1.0, 0.5, 1.2, 0.0]]), np.zeros(0)
    plan = Plan(at, np.zeros((0, len(CAR.controls))), none, np.zeros(1), at, 0.0, 0.0, True, None)
    assert "speed, m/s" in texts(figure(MIXED, drive(), fan(1)))
    assert "speed, m/s" not in texts(figure(MIXED, plan, fan(1)))


def test_a_vehicle_without_heading_is_drawn_without_heading_marks(tmp_path: Path) -> None:
    plan = drive(SLED)
    plot_plan(tmp_path / "p.svg", TURNS, SLED, plan, fan(9, SLED))
    assert not PoseTrajectory.of(plan.times, plan.trajectory, SLED).poses[:, 2].any()
    marks = [
        lines
        for lines in figure(TURNS, plan, fan(1, SLED), SLED).axes[0].collections
        if isinstance(lines, LineCollection)
    ]
    assert not marks


@pytest.mark.parametrize("bounds", [((0, 50), (0, 50)), ((0, 2), (0, 60)), ((0, 60), (0, 2)), ((0, 0.5), (0, 0.4))])
def test_any_size_and_shape_of_scene_is_drawn_to_scale(bounds: tuple[tuple[float, float], ...]) -> None:
    task = dataclasses.replace(MIXED, bounds=Bounds(x=bounds[0], y=bounds[1]))
    for plan in (None, drive()):
        drawn = figure(task, plan, fan(9))
        box = drawn.axes[0].get_position()
        (left, right), (low, high) = drawn.axes[0].get_xlim(), drawn.axes[0].get_ylim()
        across = box.width * drawn.get_figwidth() / (right - left)
        assert across == pytest.approx(box.height * drawn.get_figheight() / (high - low))


def test_text_of_the_user_is_never_mathematics(tmp_path: Path) -> None:
    task = dataclasses.replace(TURNS, name="a$b", obstacles=(Box((0.5, 1.5), (1.0, 1.0), name="$x_"),))
    plot_plan(tmp_path / "p.png", task, CAR, drive(), fan(9), title=r"$\frac{" * 40, notes={"$k": "$v^", "": ""})
    assert (tmp_path / "p.png").exists()


def test_a_tall_scene_is_turned_clockwise() -> None:
    frame = Frame.around(TURNS.bounds)
    assert frame.turned
    assert frame.points(np.array([1.0, 5.0])).tolist() == [5.0, -1.0]
    assert frame.heading(math.pi / 2) == pytest.approx(0.0)
    assert not Frame.around(MIXED.bounds).turned


def test_footprints_and_marks_turn_with_the_vehicle() -> None:
    poses = np.array([[1.0, 2.0, math.pi / 2]])
    corners = outlines(Footprint(0.4, 0.2, 0.1), poses)[0]
    assert sorted(map(tuple, corners.round(9))) == [(0.9, 1.9), (0.9, 2.3), (1.1, 1.9), (1.1, 2.3)]
    assert arrowheads(Footprint(0.4, 0.2), poses)[0, 1] == pytest.approx([1.0, 2.168])


def test_a_motion_is_cut_at_exact_times_and_turns_the_short_way() -> None:
    states = np.array([[0.0, 0.0, 3.1, 0.0], [1.0, 0.0, -3.1, 0.0]])
    motion = PoseTrajectory.of(np.array([0.0, 1.0]), states, CAR)
    part = motion.between(0.25, 0.75)
    assert part[[0, -1], 0].tolist() == [0.25, 0.75]
    assert np.abs(part[:, 2]).min() > 3.1


def test_a_large_tree_is_thinned_evenly() -> None:
    lines = tree_lines(Frame.around(TURNS.bounds), fan(3 * EDGES_MAX), CAR)
    assert lines is not None
    costs = lines.get_array()
    assert costs is not None
    assert len(costs) == EDGES_MAX
    assert (costs[0], costs[-1]) == pytest.approx((5.0, 0.0), abs=1e-3)
    assert np.diff(costs).max() <= 0  # what is reached sooner lies on top
    assert any("33%" in text for text in texts(figure(TURNS, None, fan(3 * EDGES_MAX + 1))))


def test_the_name_of_a_polygon_stands_inside_it() -> None:
    hook = Polygon(((0, 0), (3, 0), (3, 3), (2.6, 3), (2.6, 1), (0, 1)))
    (x, y), room = widest_place(hook)
    assert 0 < x < 3
    assert 0 < y < 1
    assert 0.8 < room <= 1.6


def test_labels_neither_meet_each_other_nor_leave_the_map() -> None:
    frame = Frame((0.0, 4.0), (0.0, 2.0), turned=False)
    drawn = Figure(figsize=(4, 2))
    axes = drawn.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, 4), ylim=(0, 2))
    places = [(0.1, 0.1), (0.15, 0.1), (3.9, 1.9)]
    labels = [Label(f"label {i}\nsecond line", place, "black", 0.05) for i, place in enumerate(places)]
    draw_labels(axes, frame, labels, np.zeros((0, 3)), scale=1.0)
    FigureCanvasAgg(drawn).draw()  # type: ignore[no-untyped-call]
    boxes = [patch.get_window_extent() for text in axes.texts if (patch := text.get_bbox_patch()) is not None]
    assert len(boxes) == 3
    assert all(box.x0 >= 0 and box.y0 >= 0 and box.x1 <= 400 and box.y1 <= 200 for box in boxes)
    assert not any(boxes[i].overlaps(boxes[k]) for i, k in ((0, 1), (0, 2), (1, 2)))


def test_a_long_title_is_cut_to_the_width_it_has() -> None:
    cut = shortened("many words " * 30, LABEL, 100.0)
    assert cut.endswith("…")
    assert 80.0 < text_width(cut, LABEL) <= 100.0
    assert set(cut.removesuffix("…").split()) == {"many", "words"}  # no word is cut
    assert len(shortened("a " + "long" * 60, LABEL, 100.0)) > 10
    assert shortened(" two\nwords ", LABEL, 100.0) == "two words"


def test_items_flow_into_rows_and_one_that_is_too_wide_has_its_own() -> None:
    assert flow_rows([2.0, 2.0, 2.0, 9.0, 1.0], 5.0) == [[0, 1], [2], [3], [4]]
    assert flow_rows([], 5.0) == []


def test_obstacles_without_a_name_have_the_number_by_which_messages_call_them() -> None:
    bounds, thin = Bounds(x=(0, 5), y=(0, 4)), [Box((0.05, 2.0), (0.1, 4.0))] * 11  # walls of generated worlds
    task = dataclasses.replace(MIXED, bounds=bounds, obstacles=(*MIXED.obstacles[:3], *thin))
    with plot_style():
        figure = compose(PlanPicture.of(task, CAR, None, fan(0), 1.0), "", {})
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert [text for text in texts if text.isdigit()] == [str(number) for number in range(2, 14)]
    assert task.obstacle_labels[2] == "obstacles[2]"
    assert {"column", "rock"} <= set(texts)


def test_a_named_obstacle_has_its_name_or_its_number_whatever_its_shape() -> None:
    obstacles = (
        Box((4.0, 4.5), (2.0, 0.4), name="bookshelf"),
        Box((6.0, 7.0), (3.0, 0.9), math.radians(20), name="truck"),
        Box((3.0, 7.0), (0.3, 0.3), name="pillar of the hall"),
    )
    task = dataclasses.replace(MIXED, bounds=Bounds(x=(0, 12), y=(0, 9)), obstacles=obstacles)
    with plot_style():
        drawn = compose(PlanPicture.of(task, CAR, None, fan(0), 1.0), "", {})
    assert [text.get_text() for text in drawn.axes[0].texts][:3] == ["bookshelf", "truck", "2"]
