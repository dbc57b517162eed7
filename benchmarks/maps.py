"""Large maps and many obstacles: set-up, verification, search in large trees, several threads, the whole command."""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.effort import Effort
from benchmarks.report import Report, Row, Target, row
from benchmarks.scaling import cost_at, grow
from benchmarks.scenes import NO_MARGIN, Scene
from benchmarks.startup import kraft
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Bools, Floats
from ompl_ext.exact import ExactClearance
from ompl_ext.kernels.clearance import cover, fields, memory_of_fields
from ompl_ext.kernels.costtogo import cost_to_go
from ompl_ext.obstacles import Circle, Obstacle, OccupancyGrid, Polygon, Workspace, box
from ompl_ext.query import Goal, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Footprint
from ompl_ext.verification import verify

CELLS, RESOLUTION = 2000, 0.05  # of the large map, and the side of a cell (m)
ROOM, WALL = 8.0, 0.15  # side of its rooms and thickness of their walls (m)
OBSTACLES = 1000
THREADS = 2
ITERATIONS = 20_000


@dataclass(frozen=True)
class Sizes:
    """Cells along the side of the map, nodes of the largest tree."""

    cells: int
    nodes: int


def run(effort: Effort) -> Report:
    """Measure on a map of rooms, and on random obstacles."""
    smoke = effort.nodes < 100_000
    sizes = Sizes(400, 3_000) if smoke else Sizes(CELLS, 200_000)
    query = rooms_query(sizes.cells, seed=0)
    rows = [*set_up(query, effort.repeats), *search(query, sizes, effort.repeats), *threads(query, effort.repeats)]
    for side in (20.0, 100.0):
        rows += many_obstacles(side, effort.repeats)
    rows += process(sizes.cells, effort.processes)
    notes = [
        f"The map has {sizes.cells} x {sizes.cells} cells of {RESOLUTION} m: rooms with doors, posts and single cells.",
        "Set-up is both distance fields and the cost-to-go; the kernels are loaded.",
        "Clearance lost: exact distance minus that of the fields, at poses with less than 0.3 m to spare.",
    ]
    return Report("maps", rows, notes=notes)


def rooms(cells: int, resolution: float, seed: int) -> Bools:
    """Occupied cells of a square floor of rooms with doors, round posts and single cells."""
    rng, side = np.random.default_rng(seed), cells * resolution
    occupied = rng.random((cells, cells)) < 0.0005
    thick, count = max(1, round(WALL / resolution)), int(side // ROOM)
    for k in range(count + 1):
        at = min(int(k * ROOM / resolution), cells - thick)
        occupied[at : at + thick] = occupied[:, at : at + thick] = True
    for k in range(1, count + 1):
        at = int(k * ROOM / resolution)
        for room in range(count + 1):
            for axis in (0, 1):
                middle, half = (room + rng.uniform(0.25, 0.75)) * ROOM, rng.uniform(0.6, 1.25)
                door = slice(int((middle - half) / resolution), int((middle + half) / resolution))
                occupied[(slice(at, at + thick), door) if axis else (door, slice(at, at + thick))] = False
    for x, y, radius in rng.uniform((0.0, 0.0, 0.05), (side, side, 0.4), (int(side * side / 100), 3)):
        _fill_disc(occupied, resolution, x, y, radius, True)
    occupied[:thick] = occupied[-thick:] = occupied[:, :thick] = occupied[:, -thick:] = True
    for place in (3.0, side - 3.0):
        _fill_disc(occupied, resolution, place, place, 1.2, False)
    return occupied


def _fill_disc(occupied: Bools, resolution: float, x: float, y: float, radius: float, value: bool) -> None:
    low, high = (np.array([y, x]) - radius) / resolution, (np.array([y, x]) + radius) / resolution
    (row0, column0), (row1, column1) = np.maximum(low.astype(int), 0), high.astype(int) + 1
    part = occupied[row0:row1, column0:column1]
    rows, columns = np.indices(part.shape)
    near = np.hypot((rows + row0 + 0.5) * resolution - y, (columns + column0 + 0.5) * resolution - x) < radius
    part[near] = value


def rooms_query(cells: int, seed: int) -> Scene:
    """From one corner of the floor of rooms to the opposite one, with the benchmark vehicle."""
    side = cells * RESOLUTION
    grid = OccupancyGrid(rooms(cells, RESOLUTION, seed), RESOLUTION, (0.0, 0.0, 0.0))
    goal = Goal((side - 3.0, side - 3.0), 0.5)
    start = np.array([3.0, 3.0, math.pi / 4, 0.0])
    return Scene("rooms", load_vehicle("benchmark"), Workspace(((0.0, side), (0.0, side)), (grid,)), start, goal)


def set_up(query: Scene, repeats: int) -> list[Row]:
    """Time of both fields and the cost-to-go, their memory, and the clearance lost to them."""
    seconds = [maps_seconds(query) for _ in range(repeats + 1)][1:]
    footprint = query.vehicle.footprint
    dirt, rng = query.dirt(1000), np.random.default_rng(0)
    (low, high), _ = query.workspace.bounds
    poses = np.column_stack([rng.uniform(low + 1, high - 1, (20_000, 2)), rng.uniform(-4, 4, 20_000)])
    bound = dirt.clearances(poses)
    near = np.flatnonzero((bound > 0.0) & (bound < 0.3))[:2000]
    point = ExactClearance(query.workspace, Footprint(1e-9, 1e-9))
    centres = np.array([_disc_distance(point, query, pose) for pose in poses[near]])
    lost = centres - cover(footprint).radius - bound[near]
    megabytes = memory_of_fields(query.workspace, footprint, Settings().cell) / 1e6
    return [
        row("set-up", "s", seconds, Target(0.3)),
        row("set-up: memory at most", "MB", [megabytes]),
        row("clearance lost to the grid", "m", lost, Target(0.02, of="worst")),
    ]


def _disc_distance(point: ExactClearance, query: Scene, pose: Floats) -> float:
    """Exact distance of the nearest centre of the covering discs (m), where `point` measures that of a point."""
    x, y, theta = pose
    centres = cover(query.vehicle.footprint).centres
    return min(point.distance(x + d * math.cos(theta), y + d * math.sin(theta)) for d in centres)


def maps_seconds(query: Scene) -> float:
    """Time of everything that is computed once per map and goal (s)."""
    vehicle, goal = query.vehicle, query.goal
    began = time.perf_counter()
    field, _ = fields(query.workspace, vehicle.footprint, cover(vehicle.footprint).radius, Settings().cell)
    cost_to_go(field, vehicle.footprint.inscribed, goal.center, goal.radius, vehicle.top_speed, query.workspace.bounds)
    return time.perf_counter() - began


def search(query: Scene, sizes: Sizes, repeats: int) -> list[Row]:
    """Rates in large trees, and verification of the plan."""
    ratios, rates, verified = [], [], []
    for seed in range(max(1, repeats // 3)):
        windows = grow(query, sizes.nodes, seed)
        small, large = cost_at(windows, 1000), cost_at(windows, sizes.nodes)
        ratios.append(large / small)
        rates.append(32e6 / large)
    dirt = query.dirt()
    dirt.start(query.start, 0)
    dirt.grow(iterations=ITERATIONS)
    plan = dirt.plan()
    assert plan is not None
    for _ in range(repeats):
        began = time.perf_counter()
        verify(dirt, plan)
        verified.append(time.perf_counter() - began)
    return [
        row(f"checked edges at {sizes.nodes:,} nodes", "1/s", rates, Target(3e6, most=False)),
        row(f"iteration at {sizes.nodes:,} nodes over at 1,000", "times", ratios, Target(1.5)),
        row(f"verification of a plan of {plan.cost:.0f} s", "s", verified, Target(0.2)),
    ]


def threads(query: Scene, repeats: int) -> list[Row]:
    """Edges per second of several threads over that of one, alternating."""
    solvers = [
        DirtSolver(query.vehicle, query.workspace, query.goal, NO_MARGIN, Settings(), threads=count)
        for count in (1, THREADS)
    ]
    ratios = []
    for seed in range(repeats):
        rates = []
        for dirt in solvers:
            dirt.start(query.start, seed)
            progress = dirt.grow(iterations=ITERATIONS)
            rates.append(progress.edges / progress.seconds)
        ratios.append(rates[1] / rates[0])
    return [row(f"edges per second of {THREADS} threads over one", "times", ratios, Target(1.8, most=False))]


def many_obstacles(side: float, repeats: int) -> list[Row]:
    """Set-up of a scene of many circles, polygons and boxes."""
    rng, obstacles = np.random.default_rng(1), list[Obstacle]()
    for k, (x, y) in enumerate(rng.uniform(0.5, side - 0.5, (OBSTACLES, 2))):
        if k % 3 == 0:
            obstacles.append(Circle(np.array([x, y]), rng.uniform(0.03, 0.3)))
        elif k % 3 == 1:
            obstacles.append(box((x, y), (rng.uniform(0.1, 0.6), rng.uniform(0.1, 0.3)), rng.uniform(-3, 3)))
        else:
            angles = rng.uniform(0, 1) + np.linspace(0, 2 * math.pi, 6, endpoint=False)
            corners = np.column_stack([np.cos(angles), np.sin(angles)]) * rng.uniform(0.05, 0.3, (6, 1))
            obstacles.append(Polygon(corners + np.array([x, y])))
    workspace = Workspace(((0.0, side), (0.0, side)), tuple(obstacles))
    query = Scene("many", load_vehicle("benchmark"), workspace, np.zeros(4), Goal((side - 1.0, side - 1.0), 0.5))
    seconds = [maps_seconds(query) for _ in range(repeats + 1)][1:]
    return [row(f"set-up of {OBSTACLES:,} obstacles in {side:g} m x {side:g} m", "s", seconds, Target(0.2))]


def process(cells: int, processes: int) -> list[Row]:
    """`kraft plan` of the map, from starting the process to its exit."""
    with tempfile.TemporaryDirectory() as folder:
        scenario = write_scene(Path(folder), cells)
        runs = [kraft("plan", str(scenario)) for _ in range(processes + 1)][1:]
    failed = [each.said for each in runs if each.code != 0]
    if failed:
        raise RuntimeError(failed[0])
    return [
        row("kraft plan", "s", [each.seconds for each in runs], Target(2.5)),
        row("kraft plan: memory", "MB", [each.memory / 1e6 for each in runs]),
    ]


def write_scene(folder: Path, cells: int) -> Path:
    """Write the floor of rooms as a scenario with a map of map_server's format."""
    side = cells * RESOLUTION
    pixels = np.where(np.flipud(rooms(cells, RESOLUTION, 0)), 0, 254).astype(np.uint8)
    Image.fromarray(pixels).save(folder / "rooms.png")
    (folder / "map.yaml").write_text(
        f"{{image: rooms.png, resolution: {RESOLUTION}, origin: [0, 0, 0], negate: 0, "
        "occupied_thresh: 0.65, free_thresh: 0.196}\n",
        encoding="utf-8",
    )
    path = folder / "rooms.yaml"
    path.write_text(
        f"name: rooms\nbounds: {{x: [0, {side}], y: [0, {side}]}}\nobstacles: [{{map: {{file: map.yaml}}}}]\n"
        f"start: {{x: 3, y: 3, heading_deg: 45}}\ngoal: {{center: [{side - 3}, {side - 3}], radius: 0.5}}\n"
        f"planning: {{iterations: {ITERATIONS}}}\n",
        encoding="utf-8",
    )
    return path
