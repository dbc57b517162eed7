"""Which of several fitted structures is taken."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kraft.sysid.interface import Settings
from kraft.sysid.optimiser import RhoFactors
from kraft.sysid.parameters import parameters_of
from kraft.sysid.selection import is_shown
from kraft.sysid.structure import StructureSearch
from kraft.sysid.structure_choice import Structure, chosen
from kraft.sysid.terms import Searched, searched, simplified
from kraft.vehicles.config import load_vehicle_config

FOLDS = 8
UNUSED: Any = None
CONVERGED: Any = SimpleNamespace(converged=True)
UNFINISHED: Any = SimpleNamespace(converged=False)


def structure(terms: str, error: float, spread: float = 0.0) -> Structure:
    """A structure whose mean error is `error`, and differs between folds by `spread`."""
    errors = error + spread * np.linspace(-1.0, 1.0, FOLDS)[:, None] * np.ones((FOLDS, 3))
    return Structure(tuple(terms.split()), UNUSED, CONVERGED, errors, np.zeros((FOLDS, 1)))


@pytest.mark.parametrize(
    ("path", "taken"),
    [
        ([("drag slip", 1.0), ("slip", 1.03)], 1),
        ([("drag slip", 1.0), ("slip", 1.05)], 0),
        ([("drag slip", 1.0), ("slip", 1.3), ("", 1.03)], 2),
        ([("slip yaw_offset", 1.0), ("slip", 1.03)], 0),
        ([("slip yaw_offset", 1.0), ("slip", 1.01), ("", 1.03)], 2),
        ([("delay slip", 1.0), ("slip", 1.03)], 1),
    ],
    ids=[
        "hardly worse",
        "worse",
        "worse between",
        "an offset of the poses matters",
        "an idle one does not",
        "a delay of a step",
    ],
)
def test_the_simplest_is_taken_that_is_hardly_worse(path: list[tuple[str, float]], taken: int) -> None:
    structures = [structure(*each) for each in path]
    assert chosen(structures) is structures[taken]


def test_a_fold_that_is_too_short_to_be_predicted_does_not_count() -> None:
    best, simpler, worse = structure("drag slip", 1.0), structure("slip", 1.03), structure("", 1.3)
    for each in (best, simpler, worse):
        each.errors[-1], each.errors[0, 2] = np.nan, np.nan
    assert chosen([best, simpler, worse]) is simpler
    assert simpler.score == pytest.approx(1.03)
    single = [replace(each, errors=each.errors[-2:]) for each in (best, simpler, worse)]
    assert chosen(single) is single[1]
    assert not StructureSearch._too_few(single)


def test_what_the_folds_do_not_show_is_not_worse() -> None:
    best, simpler = structure("drag slip", 1.0), structure("slip", 1.1, spread=0.6)
    assert chosen([best, simpler]) is simpler


@pytest.mark.parametrize(
    ("errors", "ended"),
    [((1.0, 1.05, 1.06, 1.07), False), ((1.0, 2.0, 3.0), False), ((1.0, 2.0, 3.0, 4.0), True)],
    ids=["slightly worse", "two that are worse", "three that are worse"],
)
def test_the_search_ends_when_needed_terms_are_off(errors: tuple[float, ...], ended: bool) -> None:
    path = [structure("a " * (len(errors) - k), error) for k, error in enumerate(errors)]
    assert StructureSearch._too_few(path) is ended


def test_a_single_fold_that_is_worse_does_not_end_the_search() -> None:
    """Its drive alone shows a term that is still on, and is predicted with the prior of that term."""
    path = [structure("a " * (4 - k), 1.0 + 0.01 * k) for k in range(4)]
    for k, each in enumerate(path):
        each.errors[0] += 20.0 * k
    assert not StructureSearch._too_few(path)


def with_slide(value: float, std: float, scatter: float = 0.0, by_windows: bool = False) -> Structure:
    """A structure with `slide` at a value; its standard deviation by the noise, and scatter between folds, are given.

    The scatter may be that between the two windows of each fold instead, which do not show it together.
    """
    p = parameters_of(load_vehicle_config("car"), Settings(), ())
    p = replace(p, frozen=frozenset(p.names) - {"slide"})
    k, size = p.index("slide"), len(p.names)
    information, gradient = np.zeros((FOLDS, size, size)), np.zeros((FOLDS, size))
    information[:, k, k] = std**-2.0 / FOLDS
    gradient[:, k] = scatter * information[:, k, k] * np.where(np.arange(FOLDS) % 2, 1.0, -1.0)
    windows = np.concatenate([gradient, -gradient]) if by_windows else None
    gradient = np.zeros((FOLDS, size)) if by_windows else gradient
    rho = p.nominal.copy()
    rho[k] = value
    factors = RhoFactors(information, gradient, np.zeros(size), np.zeros(size), windows)
    optimum: Any = SimpleNamespace(point=SimpleNamespace(rho=rho), factors=factors)
    graph: Any = SimpleNamespace(problem=SimpleNamespace(parameters=p))
    return replace(structure("slide", 1.0), graph=graph, optimum=optimum)


@pytest.mark.parametrize(
    ("term", "gain", "shown"),
    [
        (with_slide(0.15, 0.02), 6.0, True),
        (with_slide(0.15, 0.1), 1.0, False),
        (with_slide(0.15, 0.02, scatter=0.3), 6.0, False),
        (with_slide(0.15, 0.02, scatter=0.3, by_windows=True), 6.0, False),
        (with_slide(0.0005, 0.0001), 6.0, False),
        (with_slide(0.0, 0.1), 0.0, False),
    ],
    ids=[
        "by all folds",
        "by chance",
        "folds that disagree",
        "windows that disagree",
        "far smaller than in cars",
        "at its bound",
    ],
)
def test_the_likelihood_shows_a_term_that_is_more_probable_than_none(term: Structure, gain: float, shown: bool) -> None:
    assert is_shown(term.graph.problem.parameters, term.optimum, "slide", gain) is shown


class KnownSearch(StructureSearch):
    """A search whose structures are known."""

    def __init__(self, *path: Structure) -> None:
        self.known, self.searched = list(path), False

    def full(self) -> Structure:
        return self.known[0]

    def path(self, every: Structure | None = None) -> list[Structure]:
        self.searched = True
        return self.known

    def converged(self, structure: Structure) -> Structure:
        return replace(structure, optimum=CONVERGED) if structure.optimum is UNFINISHED else structure

    def completed(self, structure: Structure, path: Any) -> Structure:
        return structure

    def is_exact(self, structure: Structure) -> bool:
        return False

    def in_long_windows(self, structure: Structure, path: Any) -> tuple[Structure, StructureSearch]:
        return structure, self


@pytest.mark.parametrize(
    ("alike", "own", "taken"),
    [
        (1.02, [1.0, 1.0], "alike"),
        (2.0, [0.6, 0.5], "own"),
        (2.0, [1.2, 0.5], "richer"),
        (0.8, [1.2, 0.5], "own"),
    ],
    ids=[
        "as good with the same terms",
        "no lags: as good with all terms and better with its own",
        "lags: worse with all terms",
        "better with the same terms",
    ],
)
def test_lags_that_the_vehicle_lacks_do_not_hide_the_simpler_model(alike: float, own: list[float], taken: str) -> None:
    path = [structure("drag slip tau", 1.0), structure("slip tau", 1.0)]
    richer = Searched(path[1], UNUSED, path, path)
    same = structure("slip tau" if taken == "alike" else "slip", alike)
    search = KnownSearch(structure("drag slip", own[0]), structure("drag", own[1]))
    found = simplified(richer, same, search)
    assert found.best is {"alike": same, "own": search.known[1], "richer": path[1]}[taken]
    assert sum(each is found.best for each in found.trials) == 1
    assert search.searched == (taken == "own")


@pytest.mark.parametrize(("error", "taken"), [(1.08, "own"), (1.12, "richer")])
def test_logs_that_differ_much_do_not_excuse_a_model_without_lags_that_predicts_a_tenth_worse(
    error: float, taken: str
) -> None:
    path = [structure("drag slip tau", 1.0), structure("slip tau", 1.0)]
    search = KnownSearch(structure("drag slip", 1.0), structure("drag", error, spread=0.5))
    found = simplified(Searched(path[1], UNUSED, path, path), structure("slip", 2.0), search)
    assert found.best is {"own": search.known[1], "richer": path[1]}[taken]


def test_the_chosen_structure_is_fitted_to_the_end() -> None:
    """Structures from which a term was switched off last were fitted with few iterations."""

    class Pruning(KnownSearch):
        def in_long_windows(self, structure: Structure, path: Any) -> tuple[Structure, StructureSearch]:
            return replace(structure, optimum=UNFINISHED, added="slip"), self

    found = searched(Pruning(structure("drag slip", 1.0), structure("slip", 1.0)))
    assert found.best.optimum.converged
    assert found.best.added == "slip"
    assert any(each is found.best for each in found.trials)
