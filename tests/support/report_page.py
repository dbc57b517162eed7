"""Page of an evaluation in a browser, as tests open and read it."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page

from kraft.evaluation import Evaluation
from kraft.evaluation.journal import REPLAYS, Replays
from support.replays import unpacked

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
METHODS = ("kraft", "oneshot-openloop")
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None and "CI" not in os.environ, reason="Chromium is not installed: apt-get install chromium"
)


@dataclass(frozen=True)
class Driven:
    """Results folder of real trials, with what is recorded of them."""

    folder: Path
    evaluation: Evaluation

    @property
    def url(self) -> str:
        return (self.folder / "report.html").as_uri()

    @property
    def summary(self) -> Any:
        return json.loads((self.folder / "summary.json").read_text())

    def drive(self, method: str, seed: int) -> Any:
        return unpacked(Replays(self.folder / REPLAYS).read(("turns", method, seed)).drive)


def open_trial(tab: Page, url: str, method: str = "kraft", seed: int = 0) -> None:
    tab.goto(f"{url}#trial=turns/{method}/{seed}")
    tab.wait_for_selector("#plots figure")


def car(tab: Page) -> str:
    return tab.get_attribute("#stage .car.body", "d") or ""


def seek(tab: Page, time: float) -> None:
    tab.evaluate("t => { const r = document.getElementById('replay-time'); r.value = t; r.oninput(); }", time)


def shown(tab: Page, plot: str) -> float:
    """Number under the cursor of a plot."""
    text = tab.locator(f"#plots figcaption:has-text('{plot}') .value").first.inner_text()
    return float(text.split()[0])
