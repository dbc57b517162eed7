"""One trial: `run_trial` drives a robot with an approximate model of itself in the simulated world.

`run_trial` loads the simulator, so it is imported when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from kraft.trial.result import Outcome as Outcome
    from kraft.trial.result import TrialResult as TrialResult
    from kraft.trial.result import TrialSpec as TrialSpec
    from kraft.trial.trial import run_trial as run_trial

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, submod_attrs={"result": ["Outcome", "TrialResult", "TrialSpec"], "trial": ["run_trial"]}
)
