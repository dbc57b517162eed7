"""Drawings on the floor: tree, plan, predicted motion, contingency; trail, estimated pose, collision."""

from __future__ import annotations

from typing import Final

import numpy as np

from kraft.driving.messages import Cycle, Reference, ReferenceKind
from kraft.plot.frame import outlines
from kraft.video import palette
from kraft.video.palette import colour
from kraft.video.pen import Pen
from kraft.video.snapshot import Snapshot, poses_of
from ompl_ext.arrays import Matrix
from ompl_ext.plan import TreeView
from ompl_ext.vehicle import Vehicle

EDGES_MAX: Final = 1500
"""Number of edges above which only a part of the tree is drawn."""
PREDICTED_HEIGHT, TREE_HEIGHT, TRAIL_HEIGHT = 0.0025, 0.005, 0.006
PLAN_HEIGHT, CONTINGENCY_HEIGHT, ESTIMATE_HEIGHT = 0.009, 0.012, 0.014
"""Height above the ground, m: what is higher covers what is lower."""


def draw_cycle(pen: Pen, cycle: Cycle, vehicle: Vehicle) -> None:
    """Draw everything that does not change during a cycle."""
    if cycle.tree is not None:
        _draw_tree(pen, cycle.tree, vehicle)
    planned = cycle.kind == ReferenceKind.PLAN
    predicted = poses_of(cycle.predicted.states, vehicle)[:, :2]
    pale = palette.PREDICTED if planned else palette.CONTINGENCY_PALE
    pen.stroke(predicted, vehicle.footprint.width, PREDICTED_HEIGHT, colour(pale))
    if planned:
        pen.stroke(_path(cycle.reference, vehicle), 0.03, PLAN_HEIGHT, colour(palette.PLAN))
    if cycle.contingency is not None:
        _draw_contingency(pen, cycle.contingency, vehicle)


def _draw_tree(pen: Pen, tree: TreeView, vehicle: Vehicle) -> None:
    nodes = np.flatnonzero(tree.parents >= 0)
    if len(nodes) > EDGES_MAX:
        nodes = nodes[np.linspace(0, len(nodes) - 1, EDGES_MAX).astype(np.int64)]
    places = poses_of(tree.states, vehicle)[:, :2]
    edges = np.stack([places[tree.parents[nodes]], places[nodes]], axis=1)
    pen.lines(edges, TREE_HEIGHT, colour(palette.TREE, 0.35), 1.0)


def _draw_contingency(pen: Pen, safe: Reference, vehicle: Vehicle) -> None:
    """Draw the path and the final footprint of a contingency."""
    pen.dashes(_path(safe, vehicle), 0.03, CONTINGENCY_HEIGHT, colour(palette.CONTINGENCY))
    corners = outlines(vehicle.footprint, poses_of(safe.states[-1:], vehicle))[0]
    pen.outline(corners, 0.014, CONTINGENCY_HEIGHT, colour(palette.CONTINGENCY))


def _path(reference: Reference, vehicle: Vehicle) -> Matrix:
    return poses_of(reference.states, vehicle)[:, :2]


def draw_collision(pen: Pen, point: tuple[float, float, float]) -> None:
    """Draw the first point of contact with an obstacle, in the floor's frame, m."""
    pen.sphere(np.array(point), 0.035, colour(palette.FAILURE))


def draw_snapshot(pen: Pen, snapshot: Snapshot, vehicle: Vehicle) -> None:
    """Draw the trail, coloured by speed, and the footprint at the estimated pose."""
    speeds = (snapshot.trail[1:, 2] + snapshot.trail[:-1, 2]) / 2
    pen.shaded(snapshot.trail[:, :2], 0.022, TRAIL_HEIGHT, palette.speed_colours(speeds, vehicle.top_speed))
    estimated = outlines(vehicle.footprint, snapshot.estimate[None, :])[0]
    pen.outline(estimated, 0.01, ESTIMATE_HEIGHT, colour(palette.ESTIMATE))
