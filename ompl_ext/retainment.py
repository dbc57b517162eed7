"""Part of an earlier tree that a later query retains: what lies below the edge that is in progress when it begins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ompl_ext.arrays import Bools, Floats, Ints, Matrix
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.kernel_types import Q_DIM, WAITING, Retained, Tree
from ompl_ext.kernels.tree_memory import add_descendants, keep_with_ancestors, path_along
from ompl_ext.plan import Plan
from ompl_ext.times import SAME_TIME

ROUNDING = 1e-9  # share of a control's range by which rounding may carry it beyond a bound


@dataclass(frozen=True)
class RetainableEdges:
    """Edges that a query may retain, parents before children; the first `remaining` are the remainder of a plan.

    `parents` (n,) are indices of edges, -1 for the root; `controls` (n, nu) are held for `durations` (n,) s.
    `targets` (remaining, Q_DIM) are the configurations in which the plan was to end those.
    """

    parents: Ints
    controls: Matrix
    durations: Floats
    targets: Matrix
    remaining: int


def retainable_edges(tree: Tree, plan: Plan, targets: Matrix, elapsed: float, limit: int) -> RetainableEdges:
    """Remainder of a plan after `elapsed` s, and the most promising edges of its tree that begin on it.

    Args:
        tree: the tree that the plan was found in; parts of the plan that it no longer has are retained too.
        plan: plan of which the remainder is executed.
        targets: configurations (edges, Q_DIM) at the ends of the plan's edges.
        elapsed: time after the plan's start at which the query begins, s.
        limit: largest number of edges beyond the remainder of the plan; the ones with the lowest f are chosen.
    """
    parents, controls, durations = remaining_edges(plan.controls, plan.durations, elapsed)
    remaining, first = len(durations), len(plan.durations) - len(durations)
    path = path_along(tree, np.column_stack([plan.controls, plan.durations]))
    size = int(tree.count[at.SIZE])
    on_path = np.full(size, -2)  # index of the edge to a node, -2 for nodes that are not retained
    begun = elapsed - float(plan.durations[:first].sum())
    if begun < SAME_TIME and first < len(path):
        on_path[path[first]] = -1  # an edge begins where the query begins
    for k, node in enumerate(path[first + 1 :]):
        on_path[node] = k
    chosen = _most_promising(tree, on_path > -2, limit)
    index = on_path
    index[chosen] = remaining + np.arange(len(chosen))
    return RetainableEdges(
        parents=np.concatenate([np.array(parents, np.int64), index[tree.link[chosen, at.PARENT]]]),
        controls=np.vstack([controls, tree.edge[chosen, :-1]]),
        durations=np.concatenate([durations, tree.edge[chosen, -1]]),
        targets=targets[first:],
        remaining=remaining,
    )


def _most_promising(tree: Tree, path: Bools, limit: int) -> Ints:
    """Nodes (n,) below a path, in their order, that can still lead to a better plan: those with the lowest f.

    Their ancestors up to the path count towards the limit.
    """
    size, f = len(path), tree.value[: len(path), at.F]
    link = tree.link[:size, at.PARENT]
    parent = np.where(link < 0, np.arange(size, dtype=link.dtype), link)  # other roots are below no path
    below = path.copy()
    add_descendants(below, parent)
    useful = below & ~path & (tree.value[:size, at.RADIUS] > 0.0) & (f < tree.best[0])
    keep, nodes = path.copy(), np.flatnonzero(useful)
    keep_with_ancestors(keep, parent, nodes[np.argsort(f[nodes], kind="stable")], limit)
    return np.flatnonzero(keep & ~path)


def remaining_edges(
    controls: Floats, durations: Floats, elapsed: float, longest: float = math.inf
) -> tuple[list[int], Floats, Floats]:
    """Parents, controls and durations of the edges that remain of a path after `elapsed` s.

    `controls` has shape (edges, nu), `durations` (edges,).  The edge in progress remains in part.  An edge that lasts
    more than `longest` s becomes several, as by `divided_edges`.  Parents are indices of edges, -1 for the root.
    """
    ends = np.cumsum(durations)
    left = ends > elapsed + SAME_TIME
    durations = np.minimum(durations, ends - elapsed)[left]
    return divided_edges(range(-1, len(durations) - 1), controls[left], durations, longest)


def divided_edges(
    parents: Sequence[int], controls: Floats, durations: Floats, longest: float
) -> tuple[list[int], Floats, Floats]:
    """Parents, controls and durations of the same motions in edges of at most `longest` s, parents before children.

    `controls` has shape (edges, nu), `durations` (edges,); parents are indices of edges, -1 for the root.  An edge of a
    tree with longer ones becomes several: steps of the integrator are shares of an edge.
    """
    pieces = np.maximum(np.ceil(durations / longest - 1e-9), 1.0).astype(np.int64)
    last = np.cumsum(pieces) - 1
    controls, divided = np.repeat(controls, pieces, axis=0), np.repeat(np.minimum(durations, longest), pieces)
    divided[last] = durations - (pieces - 1) * divided[last]
    parent = np.arange(-1, len(divided) - 1)
    parent[last - pieces + 1] = [-1 if each < 0 else last[each] for each in parents]
    return parent.tolist(), controls, divided


def edges_to_retain(
    parent: Sequence[int] | Ints,
    controls: Floats,
    durations: Floats,
    targets: Matrix | None = None,
    known: Ints | None = None,
    bounds: Floats | None = None,
) -> Retained:
    """Initial edges for the kernel `grow`; `controls` has shape (edges, nu), `durations` (edges,).

    The first n edges are corrected to end at `targets` (n, Q_DIM), configurations in the tree's metric.  The first m
    edges may have been added before: `known` (m,) are their nodes.  Edges with a control beyond its `bounds` (nu, 2),
    if these are given, are not added: the earlier plan was that of a vehicle, or had limits, that are no longer there.

    Raises:
        ValueError: edges have another number of controls than bounds are given.
    """
    nu = np.shape(controls)[1]
    if bounds is not None and len(durations) > 0 and nu != len(bounds):  # the kernel reads as many as the vehicle has
        raise ValueError(f"edges to retain have {nu} controls; expected {len(bounds)}")
    edge = np.empty((len(durations), nu + 1))
    edge[:, :-1], edge[:, -1] = controls, durations
    target = np.zeros((0, Q_DIM)) if targets is None else np.ascontiguousarray(targets, dtype=float)
    node = np.full(len(parent), WAITING)
    if bounds is not None:
        node[are_beyond(edge[:, :-1], bounds)] = -1
    if known is not None:
        node[: len(known)] = known
    return Retained(np.array(parent, np.int64), edge, target, node)


def are_beyond(controls: Matrix, bounds: Floats) -> Bools:
    """Whether each of the controls (n, nu) is beyond its bounds (nu, 2) by more than rounding, or is not a number."""
    if not len(controls):
        return np.zeros(0, bool)
    low, high = bounds.T
    allowed = ROUNDING * (high - low)
    beyond: Bools = ~((controls >= low - allowed) & (controls <= high + allowed)).all(axis=1)
    return beyond
