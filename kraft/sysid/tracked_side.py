"""Whether logs show that the tracked point is beside the middle of the vehicle, so that its model is fitted with that.

Such a point is slower than the middle in turns to its side and faster in others.  Without it, the parameters of the
drive, the lags and the delay are bent by turns.  It is tried with all terms on, as a fit of its own: logs of a point in
the middle are identified as if nobody had asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from kraft.logs.log import Log
from kraft.sysid.fit_progress import OnIteration
from kraft.sysid.parameters import auxiliary_parameters
from kraft.sysid.structure import AUXILIARY, StructureSearch
from kraft.sysid.structure_choice import CLEARLY_WORSE, Structure, is_near

SIDE: Final = "side"
"""Auxiliary parameter: tracked point left of the model's point, m."""
SIDE_MIN: Final = 0.01
"""Least distance that counts, m."""


def search_with_side(
    search: StructureSearch, every: Structure, logs: Sequence[Log], on_iteration: OnIteration
) -> StructureSearch:
    """The search, or that with the side of the tracked point if predictions are clearly better with it.

    Args:
        search: for the terms of a model.
        every: its fit of all terms.
        logs: of that search.
        on_iteration: called after each iteration of each fit.
    """
    settings = search.settings
    if isinstance(settings.auxiliary, tuple) or settings.auxiliary == "none":
        return search
    if SIDE not in auxiliary_parameters(search.model) or SIDE in settings.frozen:
        return search
    wider = StructureSearch(search.vehicle, logs, replace(settings, auxiliary=(*AUXILIARY, SIDE)), on_iteration)
    wider.growth, wider.variation = search.growth, search.variation
    wider.goes_on(search)
    found = wider.alike(every, SIDE)
    k = found.graph.problem.parameters.index(SIDE)
    shown = abs(float(found.optimum.point.rho[k])) >= SIDE_MIN and not is_near(every, found, CLEARLY_WORSE)
    search.goes_on(wider)
    return wider if shown else search
