"""Trials on the page: the data of its script, the replays that fit into it, and the list with its filters."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final
from urllib.parse import quote
from xml.etree.ElementTree import Element

from kraft.evaluation.journal import Key, Replays, TrialRow
from kraft.evaluation.report.elements import element, script_data
from kraft.evaluation.report.results import Results
from kraft.trial.result import outcome_text

LIMIT: Final = 18_000_000
"""Size of the replays on a page, bytes; the others are read from the folder."""
ELSEWHERE: Final = "This replay is in the results folder only; kraft report FOLDER --serve shows it."
UNRECORDED: Final = (
    "No replay was recorded: the trial is of an older kraft, or it failed. Its command drives it again, and films it."
)


def trial_link(key: Key) -> str:
    """Address of a trial on the page: ``#trial=turns/kraft/5``."""
    return "#trial=" + "/".join(quote(str(part), safe="!'()*") for part in key)


def trials_section() -> Element:
    """List of all trials, which the page's script fills."""
    names = ("outcome", "method", "cause", "entry")
    filters = [
        element("label", name, element("select", element("option", "all", value=""), id=f"filter-{name}"))
        for name in names
    ]
    table = element("table", element("thead", element("tr")), element("tbody"), class_="trials-list")
    return element(
        "section",
        element("h2", "Trials"),
        element("p", "Follow a link to replay a trial. A heading sorts by its column.", class_="key"),
        element("div", *filters, element("output", id="trials-count"), class_="filters", role="search"),
        element("noscript", element("p", "The list and the replays need JavaScript.", class_="alarm")),
        element("div", table, class_="wide"),
        element("button", id="trials-more", type="button", hidden="hidden"),
        id="trials",
    )


def trials_data(results: Results, served: bool) -> Iterator[Element]:
    """Data of the page's script, and the replays: those of unsuccessful trials first, drives before trees.

    A page that is served has no replays; it asks the server for them.
    """
    embedded = list(_fitting(results)) if results.replays is not None and not served else []
    content = {
        "served": served,
        "elsewhere": ELSEWHERE,
        "unrecorded": UNRECORDED,
        "entries": [{"name": name, "slug": results.slugs[name]} for name in results.entries],
        "methods": [{"name": name, "title": title} for name, title in results.methods.items()],
        "trials": [_trial(results, results.rows[key], n) for key, n in results.numbers.items() if key in results.rows],
    }
    yield script_data("data", content)
    for key, part in embedded:
        text = replay_part(results.replays, key, part)
        yield element("script", text, type="text/plain", id=f"{part}:{results.numbers[key]}")


def replay_part(replays: Replays | None, key: Key, part: str) -> str | None:
    """Text of the ``drive`` or the ``trees`` of a trial; None without.

    Raises:
        InputError: if the file of the replays cannot be read any more.
    """
    if replays is None or key not in replays:
        return None
    replay = replays.read(key)
    return replay.drive if part == "drive" else replay.trees


def _fitting(results: Results) -> Iterator[tuple[Key, str]]:
    """Parts of replays that fit into the page."""
    replays = results.replays
    assert replays is not None
    rows = [row for key, row in results.rows.items() if key in replays]
    rows.sort(key=lambda row: (row.outcome == "success", row.seed, results.numbers[row.key]))
    left = LIMIT
    for k, part in enumerate(("drive", "trees")):
        for row in rows:
            size = replays.sizes(row.key)[k]
            if 0 < size <= left:
                left -= size
                yield row.key, part


def _trial(results: Results, row: TrialRow, number: int) -> list[Any]:
    """Columns of a trial, in the order in which page.js takes them."""
    entry, method, seed = row.key
    entries, methods = list(results.entries), list(results.methods)
    cause = row.cause
    text = outcome_text(row.outcome, row.obstacle) + (f": {row.error}" if row.error else "")
    planning = [round(value, 1) for value in row.measured.planning_ms]
    stored = results.replays is not None and row.key in results.replays
    return [
        number, entries.index(entry), methods.index(method), seed, row.outcome, row.obstacle, text, row.t_s,
        row.min_clearance_m, row.contingencies, *((None, None) if cause is None else (cause.kind, cause.text)), stored,
        planning, results.command(row),
    ]  # fmt: skip
