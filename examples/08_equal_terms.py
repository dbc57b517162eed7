"""Compare methods on equal terms: the same model, footprint and margin, and the clearance of the paper's authors.

The bundled rows differ in more than their names: one-shot rows plan with another model and footprint than replanning
rows, and replanning rows keep a margin.  This varies one of these at a time in Turns and Boxes.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import kraft
from kraft.config import bundled
from kraft.driving.planner_settings import Clearance
from kraft.evaluation import markdown

MODELS = ("mushr", "mushr-drive")
MODES = ("oneshot-openloop", "oneshot-geometric", "oneshot-kinodynamic", "replanner-openloop", "kraft")


def variant(method: str, label: str, **planner: Any) -> kraft.Method:
    """A bundled method with other settings of its planner."""
    base = kraft.load_method(method)
    name = f"{method}-{re.sub('[^a-z0-9]+', '-', label)}"
    settings = base.planner.model_copy(update=planner)
    return base.model_copy(update={"name": name, "title": f"{base.title}, {label}", "planner": settings})


def true_footprint(folder: Path) -> Path:
    """File of the vehicle mushr with the footprint of the true car, 0.44 m long instead of 0.40 m."""
    text = (bundled.folder("vehicle") / "mushr.yaml").read_text(encoding="utf-8")
    short, true = "footprint: {length: 0.4, width: 0.28}", "footprint: {length: 0.44, width: 0.28, offset: -0.005}"
    assert short in text
    path = folder / "mushr-true-footprint.yaml"
    path.write_text(text.replace(short, true), encoding="utf-8")
    return path


def methods(folder: Path) -> list[kraft.Method]:
    """Every variant; `folder` is for a vehicle file."""
    found = [variant(method, model, vehicle=model) for method in MODES for model in MODELS]
    footprint = str(true_footprint(folder))
    found += [variant(method, "true footprint", vehicle=footprint) for method in MODES[:3]]
    found += [variant(method, "no margin", margin=0.0) for method in ("kraft", "conservative-kraft", "filtered-kraft")]
    authors = Clearance(delta=0.05, delta_per_speed=0.25)
    found += [variant("conservative-kraft", "0.05 + 0.25 v", safety=authors)]
    found += [variant("conservative-kraft", "0.05 + 0.25 v without margin", safety=authors, margin=0.0)]
    return found


if __name__ == "__main__":  # worker processes import this file
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenarios", nargs="*", default=["turns", "boxes"])
    parser.add_argument("--trials", type=int, default=30)
    given = parser.parse_args()
    with TemporaryDirectory() as temporary:
        results = kraft.evaluate(given.scenarios, methods(Path(temporary)), trials=given.trials)
    print(markdown(results.summary))
