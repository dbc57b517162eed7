"""Whether an iteration stays as cheap when the tree grows, and whether planning again and again takes memory."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.effort import Effort
from benchmarks.machine import resident_bytes
from benchmarks.report import Report, Row, Target, number, row
from benchmarks.scenes import SCENES, Scene, endless, scene
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.search import search
from ompl_ext.problem import lanes_of
from ompl_ext.retainment import edges_to_retain
from ompl_ext.solver import DirtSolver

SIZES = (1_000, 3_000, 10_000, 30_000, 100_000)
SMALL, LARGE = SIZES[0], SIZES[-1]
NEAR = 0.1  # a window counts for a size if its tree is this near, relatively
ITERATIONS = 500  # of a cycle


@dataclass(frozen=True)
class Window:
    """Some iterations in a row: size of the tree in their middle, microseconds and nodes added per iteration."""

    nodes: float
    microseconds: float
    added: float


def run(effort: Effort) -> Report:
    """Measure on all scenes."""
    sizes = [size for size in SIZES if size <= effort.nodes]
    rows: list[Row] = []
    table = [["scene", "search", *(f"{size:,} nodes" for size in sizes), "nodes added per iteration"]]
    for name in SCENES:
        for what, query in (("endless", endless(scene(name))), ("with solutions", scene(name))):
            grown = [grow(query, sizes[-1], seed) for seed in range(max(1, effort.repeats // 2))]
            costs = [[cost_at(windows, size) for size in sizes] for windows in grown]
            ratios = [of_tree[-1] / of_tree[0] for of_tree in costs]
            quantity = f"{name}, {what}: iteration at {sizes[-1]:,} nodes over at {sizes[0]:,}"
            rows.append(row(quantity, "times", ratios, Target(2.0)))
            added = float(np.mean([window.added for windows in grown for window in windows]))
            curve = [number(float(np.median(of_size))) for of_size in zip(*costs, strict=True)]
            table.append([name, what, *curve, number(added)])
        rows += memory(scene(name), effort.cycles)
    notes = [
        "An endless search has a goal that nothing meets: no bound ever turns a candidate away.",
        "Kernels are compiled without numba's memory runtime: within a call of one, nothing can be allocated.",
    ]
    return Report("scaling", rows, {"Time of an iteration (us, median)": table}, notes)


def grow(query: Scene, nodes: int, seed: int) -> list[Window]:
    """Grow one tree up to `nodes` and a tenth more, timing windows of iterations all along."""
    dirt = query.dirt(capacity=int(1.5 * nodes))
    dirt.start(query.start, seed)
    call, tree = kernel_caller(dirt), dirt.tree_arrays
    windows: list[Window] = []
    call(100)
    while tree.count[at.SIZE] < nodes * (1 + NEAR):
        before, iterations = int(tree.count[at.SIZE]), max(50, int(tree.count[at.SIZE]) // 50)
        began = time.perf_counter()
        call(iterations)
        took, size = time.perf_counter() - began, int(tree.count[at.SIZE])
        windows.append(Window((before + size) / 2, 1e6 * took / iterations, (size - before) / iterations))
        if windows[-1].added < 1e-3:
            raise RuntimeError(f"the tree of {query.name} no longer grows at {size} nodes")
    return windows


def kernel_caller(dirt: DirtSolver) -> Callable[[int], None]:
    """A function that visits as many nodes as it is told, in one call of the compiled kernel."""
    vehicle, problem = dirt.vehicle, dirt.problem
    work = lanes_of(vehicle, int(problem.option[at.STEPS]))
    brake = lanes_of(vehicle, int(problem.option[at.BRAKE_STEPS]))
    q, nothing = np.zeros(at.Q_DIM), edges_to_retain([], np.zeros((0, len(vehicle.controls))), np.zeros(0))
    kernel = search().grow
    return lambda iterations: kernel(dirt.tree_arrays, problem, work, brake, q, nothing, iterations, False)


def cost_at(windows: list[Window], size: int) -> float:
    """Median time of an iteration in trees of about `size` nodes (us)."""
    return float(np.median([w.microseconds for w in windows if abs(w.nodes - size) <= NEAR * size]))


def memory(query: Scene, cycles: int) -> list[Row]:
    """Memory that stays taken per cycle of starting anew, planning, and reading the plan."""
    dirt = query.dirt(capacity=10 * ITERATIONS)
    several(query, dirt, cycles)  # what is taken once, is taken now
    gc.collect()
    blocks, resident = sys.getallocatedblocks(), resident_bytes()
    several(query, dirt, cycles)
    gc.collect()
    blocks, resident = sys.getallocatedblocks() - blocks, resident_bytes() - resident
    return [
        row(f"{query.name}: Python memory blocks kept per cycle", "blocks", [round(blocks / cycles)], Target(0)),
        row(f"{query.name}: resident memory grown in {cycles:,} cycles", "bytes", [resident]),
    ]


def several(query: Scene, dirt: DirtSolver, cycles: int) -> None:
    """Cycles as a robot plans them, with the same seeds each time."""
    for seed in range(cycles):
        dirt.start(query.start, seed)
        dirt.grow(iterations=ITERATIONS)
        dirt.plan()
