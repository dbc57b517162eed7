"""Evaluations: many trials, their statistics, and a report; the library under `kraft eval`.

The modules are imported when a name is first used, so that a worker process does not import the evaluation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from kraft.evaluation.comparison import Comparison as Comparison
    from kraft.evaluation.comparison import compare as compare
    from kraft.evaluation.evaluator import Evaluation as Evaluation
    from kraft.evaluation.evaluator import Observer as Observer
    from kraft.evaluation.evaluator import evaluate as evaluate
    from kraft.evaluation.experiment import METHODS as METHODS
    from kraft.evaluation.experiment import SUITE as SUITE
    from kraft.evaluation.experiment import TRIALS as TRIALS
    from kraft.evaluation.experiment import Experiment as Experiment
    from kraft.evaluation.journal import TrialRow as TrialRow
    from kraft.evaluation.summary import Result as Result
    from kraft.evaluation.summary import Summary as Summary
    from kraft.evaluation.table import labels as labels
    from kraft.evaluation.table import markdown as markdown
    from kraft.evaluation.table import overview as overview
    from kraft.evaluation.table import tables as tables

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "comparison": ["Comparison", "compare"],
        "evaluator": ["Evaluation", "Observer", "evaluate"],
        "experiment": ["METHODS", "SUITE", "TRIALS", "Experiment"],
        "journal": ["TrialRow"],
        "summary": ["Result", "Summary"],
        "table": ["labels", "markdown", "overview", "tables"],
    },
)
