"""Evaluations: many trials, their statistics, and a report; the library under `kraft eval`."""

from kraft.evaluation.evaluator import Evaluation, Observer, evaluate, usable_cores
from kraft.evaluation.experiment import METHODS, SUITE, TRIALS, Experiment
from kraft.evaluation.journal import TrialRow
from kraft.evaluation.summary import Result, Summary
from kraft.evaluation.table import markdown, overview, tables

__all__ = [
    "METHODS",
    "SUITE",
    "TRIALS",
    "Evaluation",
    "Experiment",
    "Observer",
    "Result",
    "Summary",
    "TrialRow",
    "evaluate",
    "markdown",
    "overview",
    "tables",
    "usable_cores",
]
