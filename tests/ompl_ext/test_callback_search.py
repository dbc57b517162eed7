"""The search over OMPL's callbacks keeps each node's own state, and no more states than nodes."""

from __future__ import annotations

from ompl import util as ou
from support.ompl_setup import START, arena

from ompl_ext.callback import PRUNE_EVERY, CallbackSearch
from ompl_ext.kernels import kernel_types as at
from ompl_ext.planner import DIRT
from ompl_ext.system import SimpleSetup

ou.setLogLevel(ou.LOG_NONE)
BLOSSOM = 4


def search_of(planner: DIRT) -> CallbackSearch:
    assert isinstance(planner._search, CallbackSearch)
    return planner._search


def grown(setup: SimpleSetup, iterations: int, **parameters: object) -> DIRT:
    planner = DIRT(setup.getSpaceInformation(), use_callbacks=True, **parameters)  # type: ignore[arg-type]
    setup.setPlanner(planner)
    setup.setup()
    planner.solve(lambda: planner.iterations >= iterations)
    return planner


def wrong_edges(setup: SimpleSetup, planner: DIRT) -> list[int]:
    """Nodes of the tree that are not where their edges end when OMPL propagates them again."""
    si, tree = setup.getSpaceInformation(), planner.tree()
    start, control, end = si.allocState(), si.allocControl(), si.allocState()
    wrong = []
    for node, parent in enumerate(tree.parents.tolist()):
        if parent < 0:
            continue
        for target, values in ((start, tree.states[parent]), (control, tree.controls[node])):
            for k, value in enumerate(values.tolist()):
                target[k] = value
        si.propagate(start, control, round(tree.durations[node] / si.getPropagationStepSize()), end)
        if [end[k] for k in range(len(tree.states[node]))] != tree.states[node].tolist():
            wrong.append(node)
    return wrong


def test_every_edge_ends_in_its_node_after_pruning() -> None:
    setup = arena()
    planner = grown(setup, 2 * PRUNE_EVERY + 100, pruning=True)
    assert search_of(planner).count(at.PRUNED) > 0
    assert wrong_edges(setup, planner) == []
    assert setup.getSolutionPath().check()


def test_every_edge_ends_in_its_node_after_memory_was_full() -> None:
    setup = arena()
    planner = grown(setup, 3_300, max_nodes=1_200, pruning=True, top_speed=0.62, seed=1)
    assert search_of(planner).count(at.PRUNED) > 0
    assert wrong_edges(setup, planner) == []


def test_states_of_pruned_nodes_are_used_again() -> None:
    setup = arena()
    search = search_of(grown(setup, 3_300, max_nodes=1_200, pruning=True, top_speed=0.62))
    nodes = search.count(at.SIZE)
    assert nodes + search.count(at.PRUNED) > 1_600
    assert len(search._states) <= 1_200 + BLOSSOM
    used = {*search._lane_slot, *search._tree.state[:nodes, 0].astype(int).tolist()}
    assert len(used) == nodes + BLOSSOM
    assert used.isdisjoint(search._free)


def test_clear_gives_back_every_state_but_those_of_the_lanes() -> None:
    setup = arena()
    search = search_of(grown(setup, 200))
    states = len(search._states)
    assert states > 100
    search.clear()
    assert len(search._free) == states - BLOSSOM
    assert search._top_speed == 0.0
    start = setup.getSpaceInformation().allocState()
    for k, value in enumerate(START.tolist()):
        start[k] = value
    search.add_root(start)
    search.grow(lambda: search.count(at.ITERATIONS) >= 50)
    assert len(search._states) == states
    assert search.count(at.SIZE) > 10
