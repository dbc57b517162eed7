"""Replay of a trial: what a reader of the report can watch, in some kilobytes of text.

A replay is a JSON object, compressed with zlib and written in base64.  A series of numbers is ``[quantum, order,
integers]``: rounded to multiples of `quantum` and differenced `order` times, so that smooth series become small
integers.  Poses are (x, y, theta) in m and rad, times are in s of the trial.

- `footprint`: offset, length, width of the vehicle (m).
- `t`, `pose`, `speed`: time, true pose and speed at each tick of the controller.
- `ahead`, `error`: time by which the estimate is ahead of its tick; estimated minus true pose at that time.
- `command`: a series for each control, by its name, with its range and, where it is known, its unit.
- `every`, `clearance`: true distance to the nearest obstacle at every n-th tick (m).
- `seen`: time of each observation, and observed minus true pose.
- `watchdog`: ticks at which the watchdog stopped the car.  `boxes`: pose of each movable box at each tick.
- `cycles`: a list of those that began; the polylines `plan` and `contingency` have x and y at their beginning, at
  multiples of `GRID`, and at their end, `predicted` has poses and delta(v) within the cycle, `blocked` the corners of
  what has blocked the vehicle.  `sent` is false if the message was lost.

Trees are a second text of the same kind: for each cycle points of whole branches, as x and y relative to the point
before, and the number of that point.
"""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from kraft.driving.messages import Cycle, PredictedMotion, Reference, as_driven
from kraft.planning.workspace import workspace_of
from kraft.text import finite
from kraft.trial.measures import Step
from kraft.trial.result import TrialResult, TrialSpec
from kraft.vehicles import control_unit
from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.exact import ExactClearance
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.kernels.specialise import kernels
from ompl_ext.plan import TreeView
from ompl_ext.poses import poses_of
from ompl_ext.vehicle import Vehicle

EVERY: Final = 3
"""Ticks from one measured clearance to the next."""
GRID: Final = 0.2
"""Time between the points of a plan or a contingency, s."""
POINTS: Final = 280
"""Points that are kept of a tree."""
GOLDEN: Final = (5**0.5 - 1) / 2
SUBSTEPS: Final = 4
"""Steps of integration from one point of an edge to the next."""
POSE: Final = (0.001, 0.001, 0.002)
"""Quanta of a true pose, m and rad."""
ERROR: Final = (0.002, 0.002, 0.005)
"""Quanta of an estimate's error."""
NOISE: Final = (0.005, 0.005, 0.01)
"""Quanta of an observation's error."""
LINE: Final = 0.003
"""Quantum of the points of plans and contingencies, m: with a larger one smooth curves through them would waver."""
POINT: Final = 0.01
"""Quantum of the corners of what has blocked the vehicle, and half of that of the points of trees, m."""
SHARE: Final = 200
"""Quanta of a command in the range of its control."""
LEVEL: Final = 6
"""Level of the compression: the highest one, 9, takes three to five times as long for texts that are 2 % shorter."""


@dataclass(frozen=True)
class Replay:
    """Compressed texts of a trial: its drive, and its trees if they were kept."""

    drive: str
    trees: str | None = None


def replay_of(spec: TrialSpec, result: TrialResult) -> Replay | None:
    """Replay of a trial; None if it was over before the first tick."""
    if not result.steps:
        return None
    trees = [_tree(cycle.tree, spec.vehicle) for cycle in result.begun]
    return Replay(packed(_drive(spec, result)), packed(trees) if any(trees) else None)


def packed(content: Any) -> str:
    """JSON as compressed text."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    return base64.b64encode(zlib.compress(text.encode(), LEVEL)).decode()


def series(values: Floats, quantum: float, order: int = 1) -> list[Any]:
    """Series of finite numbers as ``[quantum, order, integers]``."""
    integers = np.rint(np.asarray(values, dtype=float) / quantum).astype(np.int64)
    for _ in range(order):
        integers[1:] -= integers[:-1].copy()
    return [quantum, order, integers.tolist()]


def _drive(spec: TrialSpec, result: TrialResult) -> dict[str, Any]:
    vehicle, steps = spec.vehicle, result.steps
    ticks = np.array([step.time for step in steps])
    true = np.array([step.pose for step in steps])
    true[:, 2] = np.unwrap(true[:, 2])
    ahead = np.array([step.ahead for step in steps])
    estimates = poses_of(np.array([step.estimate for step in steps]), vehicle)
    seen = np.array([o.time for o in result.observations])
    observed = np.array([(o.x, o.y, o.theta) for o in result.observations]).reshape(-1, 3)
    footprint = vehicle.footprint
    drive: dict[str, Any] = {
        "footprint": [footprint.offset, footprint.length, footprint.width],
        "t": series(ticks, 0.001, 2),
        "pose": [series(true[:, k], POSE[k], 2) for k in range(3)],
        "speed": series(np.array([step.speed for step in steps]), 0.002),
        "ahead": series(ahead, 0.001),
        "error": _errors(ticks + ahead, estimates, ticks, true, ERROR),
        "command": _commands(steps, vehicle),
        "every": EVERY,
        "clearance": _clearances(spec, true[::EVERY]),
        "seen": [series(seen, 0.001, 2), *_errors(seen, observed, ticks, true, NOISE)],
        "cycles": [_cycle(cycle, vehicle) for cycle in as_driven(result.begun)],
    }
    if stopped := [k for k, step in enumerate(steps) if step.watchdog]:
        drive["watchdog"] = series(np.array(stopped), 1)
    if steps[0].boxes:
        boxes = np.array([step.boxes for step in steps])
        drive["boxes"] = [
            [series(np.unwrap(boxes[:, k, axis]) if axis == 2 else boxes[:, k, axis], 0.005) for axis in range(3)]
            for k in range(boxes.shape[1])
        ]
    return drive


def _errors(times: Floats, poses: Matrix, ticks: Floats, true: Matrix, quanta: Sequence[float]) -> list[Any]:
    """Poses (n, 3) at `times` minus the true ones."""
    if not len(times):
        return [series(np.zeros(0), quantum) for quantum in quanta]
    errors = poses - interpolated_rows(times, ticks, true)
    errors[:, 2] = np.remainder(errors[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return [series(errors[:, k], quantum) for k, quantum in enumerate(quanta)]


def _commands(steps: Sequence[Step], vehicle: Vehicle) -> dict[str, Any]:
    commands = np.array([step.command for step in steps])
    found = {}
    for k, name in enumerate(vehicle.controls):
        low, high = vehicle.control_bounds[k]
        content = {"range": [float(low), float(high)], "values": series(commands[:, k], float(high - low) / SHARE)}
        found[name] = content | ({"unit": unit} if (unit := control_unit(vehicle, name)) else {})
    return found


def _clearances(spec: TrialSpec, poses: Matrix) -> list[Any] | None:
    """Exact distances at poses (n, 3); None in a scene without obstacles."""
    exact = ExactClearance(workspace_of(spec.scenario, spec.vehicle), spec.vehicle.footprint)
    distances = np.array([exact.distance(*pose) for pose in poses.tolist()])
    return series(distances, 0.002) if np.isfinite(distances).all() else None


def _cycle(cycle: Cycle, vehicle: Vehicle) -> dict[str, Any]:
    content: dict[str, Any] = {
        "t": round(float(cycle.time), 3),
        "kind": str(cycle.kind),
        "plan": _line(cycle.reference, vehicle),
        "predicted": _band(cycle.predicted, vehicle),
        "nodes": cycle.nodes,
        "iterations": cycle.iterations,
    }
    if cycle.contingency is not None and cycle.contingency is not cycle.reference:
        content["contingency"] = _line(cycle.contingency, vehicle)
    if cycle.reason:
        content["reason"] = cycle.reason
    if cycle.contingency_origin is not None:
        content["origin"] = str(cycle.contingency_origin)
    if (cost := finite(cycle.cost_to_goal)) is not None:
        content["cost"] = round(cost, 2)
    if cycle.blocked:
        content["blocked"] = [[series(polygon.vertices[:, k], POINT) for k in range(2)] for polygon in cycle.blocked]
    if not cycle.delivered:
        content["sent"] = False
    return content


def _line(reference: Reference, vehicle: Vehicle) -> list[Any]:
    """Its x and y, at its beginning, at times on the grid, and at its end."""
    first, last = math.ceil(reference.start / GRID - 1e-6), math.floor(reference.end / GRID + 1e-6)
    times = sorted({reference.start, *(GRID * k for k in range(first, last + 1)), reference.end})
    axes = vehicle.index("x"), vehicle.index("y")
    return [series(np.interp(times, reference.times, reference.states[:, axis]), LINE, 2) for axis in axes]


def _band(predicted: PredictedMotion, vehicle: Vehicle) -> dict[str, Any]:
    """Predicted poses within a cycle, and delta(v) if the method asks for a clearance."""
    count = max(2, round(float(predicted.times[-1] - predicted.times[0]) / GRID) + 1)
    times = np.linspace(predicted.times[0], predicted.times[-1], count)
    poses = poses_of(predicted.states, vehicle)
    poses[:, 2] = np.unwrap(poses[:, 2])
    band: dict[str, Any] = {
        "t": [round(float(times[0]), 3), round(float(times[-1]), 3)],
        "pose": [series(np.interp(times, predicted.times, poses[:, k]), q) for k, q in enumerate((0.005, 0.005, 0.01))],
    }
    if predicted.delta is not None:
        band["delta"] = series(np.interp(times, predicted.times, predicted.delta), 0.001)
    return band


def _tree(tree: TreeView | None, vehicle: Vehicle) -> list[Any] | None:
    """Whole branches from the root, as points with x, y and the number of the point before; None without nodes.

    An edge has points at most `GRID` s apart, so that no line cuts a corner that the vehicle drives around.
    """
    if tree is None or not len(tree.states):
        return None
    counts = np.maximum(1, np.ceil(tree.durations / GRID - 1e-6)).astype(int)
    nodes = _branches(tree.parents, counts, POINTS)
    counts, above = counts[nodes], tree.parents[nodes]
    ends = np.cumsum(counts)  # one more than the number of the last point of each node
    lasts = np.full(len(tree.states), -1)
    lasts[nodes] = ends - 1
    before = np.arange(ends[-1]) - 1
    before[ends - counts] = np.where(above >= 0, lasts[above], -1)
    points = np.rint(_points(tree, nodes, counts, vehicle) / (2 * POINT)).astype(int)
    relative = np.where(before[:, None] >= 0, points - points[before], points)  # a point is near the one before
    return [2 * POINT, *relative.T.tolist(), before.tolist()]


def _branches(parents: Ints, counts: Ints, most: int) -> Ints:
    """Nodes of some branches from the root, each after its parent; their `counts` are not more than `most` together.

    Multiples of the golden ratio choose leaves from all over the time in which the tree grew.
    """
    is_leaf = np.ones(len(parents), bool)
    is_leaf[parents[parents >= 0]] = False
    leaves = np.flatnonzero(is_leaf)
    leaves = leaves[np.argsort(np.arange(len(leaves)) * GOLDEN % 1.0)]
    kept, left = dict[int, None](), most
    before, points_of = parents.tolist(), counts.tolist()
    for leaf in leaves.tolist():
        if points_of[leaf] > left and kept:
            continue
        branch, node, points = list[int](), leaf, 0
        while node >= 0 and node not in kept and (points <= left or not kept):
            branch.append(node)
            points += points_of[node]
            node = before[node]
        if points > left and kept:
            continue
        kept.update(dict.fromkeys(reversed(branch)))
        left -= points
        if left == 0:
            break
    return np.array(list(kept))


def _points(tree: TreeView, nodes: Ints, counts: Ints, vehicle: Vehicle) -> Matrix:
    """Points of the edges to `nodes`, the last one of each at its node: (sum of their `counts`, 2), m.

    The model drives along the edges; where the planner had other parameters by then, the rest is spread over the edge.
    """
    axes, number = [vehicle.index("x"), vehicle.index("y")], np.arange(len(nodes))
    driven = np.empty((len(nodes), counts.max() * SUBSTEPS + 1, tree.states.shape[1]))
    driven[:, 0] = tree.states[tree.parents[nodes]]  # that of a root is not used
    steps = tree.durations[nodes] / (counts * SUBSTEPS)
    kernels(vehicle).roll_out(driven, np.ascontiguousarray(tree.controls[nodes]), vehicle.parameter_array, steps)
    ends, begins, edge = tree.states[:, axes][nodes], np.cumsum(counts) - counts, np.repeat(number, counts)
    along = np.arange(len(edge)) - begins[edge] + 1  # number of a point along its edge
    share = np.where(along < counts[edge], along * (1.0 / counts)[edge], 1.0)
    rest = ends - driven[number, counts * SUBSTEPS][:, axes]
    points: Matrix = driven[edge, along * SUBSTEPS][:, axes] + share[:, None] * rest[edge]
    alone = counts == 1  # roots among them
    points[begins[alone]] = ends[alone]
    return points
