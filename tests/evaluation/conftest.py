"""Results of real trials, and a browser for their page."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page, sync_playwright
from support import fake_trials
from support.report_page import CHROMIUM, METHODS, Driven

from kraft.evaluation import evaluate, evaluator
from kraft_cli.work.run import run_command


@pytest.fixture(scope="session")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Driven:
    folder = tmp_path_factory.mktemp("driven") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluator, "Processes", fake_trials.Inline)  # real trials, in this process
        found = evaluate(["turns"], METHODS, trials=2, seed=0, out=folder, command_line=run_command)
    return Driven(folder, found)


@pytest.fixture(scope="module")  # not longer: its event loop would be in the way of the tests of other files
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def tab(browser: Browser) -> Iterator[Page]:
    """A tab whose console has to stay empty."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.set_default_timeout(60_000)
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    yield page
    page.close()
    assert said == []
