"""Whether identified parameters predict logs that they have not seen better than the initial values do."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from kraft.sysid.forecast import Forecast

ALIKE: Final = 1.01
"""Position errors within a hundredth of each other are alike, as when the initial values come from the same logs."""
FAR_WORSE: Final = 1.5
"""Factor from which the initial values are better beyond doubt.  What five logs of the bundled car say, where the
initial values come from forty, is up to 1.2 times worse by chance; a test of the scatter between windows would object
to a difference that does not matter if it is steady, and would need more windows than a few held-out logs have."""


def no_better(forecast: Forecast) -> tuple[str, ...]:
    """The warning that the initial values predict better, if they do."""
    if _ratio(forecast) <= ALIKE:
        return ()
    return (
        f"the identified values predict held-out logs no better than the initial values do ({_errors(forecast)}): "
        "look for logs of another floor, slope, load or car and leave them out, record more logs, or choose "
        "a model that has what these lack; --plot shows the prediction",
    )


def far_worse(forecast: Forecast) -> tuple[str, ...]:
    """The objection that the initial values predict far better, as part of a sentence, if they do."""
    if _ratio(forecast) < FAR_WORSE:
        return ()
    return (f"held-out logs are predicted far better with the initial values ({_errors(forecast)})",)


def _ratio(forecast: Forecast) -> float:
    """Position error of the identified values in that of the initial ones."""
    after, before = forecast.errors.overall_position, forecast.errors_before.overall_position
    return after / max(before, 1e-12)


def _errors(forecast: Forecast) -> str:
    after, before = forecast.errors.overall_position, forecast.errors_before.overall_position
    return f"position {100 * after:.2f} cm identified, {100 * before:.2f} cm initial"
