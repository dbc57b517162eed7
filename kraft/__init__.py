"""Drive fast and never hit anything, knowing only an approximate model of yourself.

Scenarios, vehicles, methods     load_scenario, load_vehicle, load_method
One plan                         plan -> PlanResult
One trial in simulation          TrialSpec.load, run_trial -> TrialResult
Many trials                      evaluate -> Evaluation
Parameters from logs             read_logs, identify -> Identification

Names are imported when they are first used: `import kraft` loads none of the planner, the simulator or the estimator.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import lazy_loader

if TYPE_CHECKING:
    from kraft.driving.method import Method as Method
    from kraft.driving.method import load_method as load_method
    from kraft.errors import InputError as InputError
    from kraft.errors import KraftError as KraftError
    from kraft.evaluation.evaluator import Evaluation as Evaluation
    from kraft.evaluation.evaluator import evaluate as evaluate
    from kraft.logs.log import LogSet as LogSet
    from kraft.logs.reader import read_logs as read_logs
    from kraft.planning.plan import PlanResult as PlanResult
    from kraft.planning.plan import plan as plan
    from kraft.scenario.loader import load_scenario as load_scenario
    from kraft.scenario.scenario import Scenario as Scenario
    from kraft.sysid.identify import identify as identify
    from kraft.sysid.interface import Identification as Identification
    from kraft.trial.result import Outcome as Outcome
    from kraft.trial.result import TrialResult as TrialResult
    from kraft.trial.result import TrialSpec as TrialSpec
    from kraft.trial.trial import run_trial as run_trial
    from kraft.vehicles.load import load_vehicle as load_vehicle

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "driving.method": ["Method", "load_method"],
        "errors": ["InputError", "KraftError"],
        "evaluation.evaluator": ["Evaluation", "evaluate"],
        "logs.log": ["LogSet"],
        "logs.reader": ["read_logs"],
        "planning.plan": ["PlanResult", "plan"],
        "scenario.loader": ["Scenario", "load_scenario"],
        "sysid.identify": ["identify"],
        "sysid.interface": ["Identification"],
        "trial.result": ["Outcome", "TrialResult", "TrialSpec"],
        "trial.trial": ["run_trial"],
        "vehicles.load": ["load_vehicle"],
    },
)
__version__: Final = "0.1.0"
