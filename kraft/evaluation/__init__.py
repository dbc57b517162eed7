"""Many trials, reduced to a table: the library under `kraft eval`."""

from kraft.evaluation.evaluator import Evaluation, Watch, evaluate, usable_cores
from kraft.evaluation.experiment import METHODS, SCENARIOS, TRIALS, Experiment
from kraft.evaluation.row import TrialRow
from kraft.evaluation.summary import Result, Summary
from kraft.evaluation.table import markdown, tables

__all__ = [
    "METHODS",
    "SCENARIOS",
    "TRIALS",
    "Evaluation",
    "Experiment",
    "Result",
    "Summary",
    "TrialRow",
    "Watch",
    "evaluate",
    "markdown",
    "tables",
    "usable_cores",
]
