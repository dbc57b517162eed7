"""HTML of the page: an overview, then each scenario with its methods, trials and failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from importlib.resources import files
from typing import Final
from xml.etree.ElementTree import Element

from kraft.evaluation.ompl_log import file_name
from kraft.evaluation.report import charts
from kraft.evaluation.report.elements import Content, document, element
from kraft.evaluation.report.floor import floor_plan
from kraft.evaluation.report.results import Results
from kraft.evaluation.row import TrialRow
from kraft.evaluation.summary import Result
from kraft.text import counted, decimals

LISTED: Final = 200  # unsuccessful trials of a scenario that are listed
NO_VALUE: Final = "–"


def page(results: Results) -> str:
    """Make the page; it needs no other file and no network."""
    style = files("kraft.evaluation.report").joinpath("style.css").read_text(encoding="utf-8")
    sections = [_entry(results, name) for name in results.entries]
    title = f"{results.title} | kraft eval"
    return document(title, style, *_head(results), _overview(results), _key(), *sections, _foot())


def _head(results: Results) -> Iterator[Content]:
    yield element("h1", results.title)
    missing = results.expected - len(results.rows)
    if missing:
        run = f"{missing} of {counted(results.expected, 'trial')} not run yet"
        text = f"{run}: this page is of those that were."
        yield element("p", text, class_="alarm")
    failed = results.summary.failed
    if failed:
        text = f"{counted(failed, 'trial')} failed, which is a defect in kraft: none counts as a success."
        yield element("p", text, class_="alarm")
    yield element("dl", *(_fact(name, value) for name, value in _facts(results)), class_="facts")


def _facts(results: Results) -> Iterator[tuple[str, str]]:
    manifest, seeds = results.manifest, results.manifest.seeds
    yield "seeds", f"{seeds[0]} to {seeds[-1]}, the same for all methods" if len(seeds) > 1 else str(seeds[0])
    yield "planning", "by the clock: does not repeat" if results.summary.realtime else "by iterations: repeats"
    yield "models", ", ".join(manifest.vehicles)
    yield "begun", manifest.began.replace("T", " ").replace("+00:00", " UTC")
    if results.summary.wall:
        minutes, seconds = divmod(round(results.summary.wall), 60)
        yield "took", f"{minutes} min {seconds} s" if minutes else f"{seconds} s"
    yield "versions", ", ".join(f"{name} {manifest.versions[name]}" for name in ("kraft", "mujoco", "python"))


def _fact(name: str, value: str) -> Element:
    return element("div", element("dt", name), element("dd", value))


def _overview(results: Results) -> Element | None:
    """Table of successes of every method in every scenario."""
    names = list(results.entries)
    by_cell = {(result.entry, result.method): result for result in results.summary.results}
    heading = [element("th", element("a", name, href=f"#{name}")) for name in names]
    rows = [
        element("tr", element("th", title, scope="row"), *(_rate(by_cell.get((name, method))) for name in names))
        for method, title in results.methods.items()
    ]
    table = element("table", element("tr", element("th", "successes"), *heading), *rows, class_="overview")
    return element("section", element("div", table, class_="wide"))


def _rate(result: Result | None) -> Element:
    if result is None or not result.trials:
        return element("td", NO_VALUE)
    rate = result.success / result.trials
    paper = element("small", f"paper {result.paper.success} of {result.paper.trials}") if result.paper else None
    shade = f"background: rgb(0 158 115 / {0.55 * rate:.2f})"
    of = f" of {result.trials}"
    return element("td", element("b", str(result.success)), of, paper, style=shade)


def _key() -> Element:
    """Legend of the charts."""
    entries = [
        element("span", element("i", class_=f"swatch {name}"), f" {name}")
        for name in ("success", "timeout", "collision")
    ]
    words = (
        "Below a bar stands each trial, by seed; point at one to see how it ended and how to drive it again. "
        "Black: 95 % Wilson interval of the success rate. Blue above it: the paper's rate and its interval. "
        "p: exact McNemar test against KRAFT on the same seeds. Times are of successful trials: black their mean, "
        "the blue ring the paper's."
    )
    return element("p", *entries, " ", words, class_="key")


def _entry(results: Results, name: str) -> Element:
    mine = [result for result in results.summary.results if result.entry == name]
    durations = [row.t_s for row in results.of_cell(name) if row.outcome == "success" and row.t_s is not None]
    times = [*durations, *(r.paper.t_ex for r in mine if r.paper and r.paper.t_ex is not None)]
    longest = 1.02 * max(times, default=1.0)
    heading = [element("th", text) for text in ("method", "how trials ended", "succ / coll / timeout")]
    heading += [element("th", "time, s", charts.time_axis(longest))]
    columns = ("mean, s", "p", "contingencies", "clearance, m", "planning, ms")
    heading += [element("th", text, class_="number") for text in columns]
    rows = [_row(results, result, longest) for result in mine]
    table = element("table", element("tr", *heading), *rows)
    return element(
        "section",
        element("h2", name),
        element("div", _picture(results, name), element("div", table, class_="wide"), class_="scenario"),
        _unsuccessful(results, name),
        id=name,
    )


def _picture(results: Results, name: str) -> Element:
    scenario = results.known.get(name)
    if scenario is None:
        return element("figure", element("figcaption", "No picture: the scenario is not there any more, or another."))
    hits = Counter(row.obstacle for row in results.of_cell(name) if row.obstacle)
    unknown = scenario.truth.in_words()
    words = f"Not known to the planner: {', '.join(unknown)}." if unknown else "The planner knows this scene."
    most = hits.most_common(1)
    hit = f" Hit most: {most[0][0]}, {_times(most[0][1])}." if most else ""
    return element("figure", floor_plan(scenario, hits), element("figcaption", words + hit))


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _row(results: Results, result: Result, longest: float) -> Element:
    rows = results.of_cell(result.entry, result.method)
    commands = {row.seed: results.command(row) for row in rows}
    paper = result.paper
    beside = f"paper {paper.success} / {paper.collision} / {paper.timeout}" if paper else None
    beside_time = f"paper {paper.t_ex:.1f}" if paper and paper.t_ex is not None else None
    low, high = result.interval
    counts = f"{result.success} / {result.collision} / {result.timeout}"
    counts += f", {result.failed} failed" if result.failed else ""
    return element(
        "tr",
        element("th", result.title, scope="row"),
        element("td", charts.outcomes(result), charts.trials(rows, results.manifest.seeds, commands), class_="drawing"),
        element("td", counts, element("small", f"{low:.0%} to {high:.0%}"), _small(beside)),
        element("td", charts.times(result, rows, longest), class_="drawing"),
        element("td", decimals(result.t_ex, 2, NO_VALUE), _small(beside_time), class_="number"),
        element("td", f"{result.against.p:.2g}" if result.against else NO_VALUE, class_="number"),
        element("td", str(result.contingencies), _small(f"of {counted(result.cycles, 'cycle')}"), class_="number"),
        element("td", decimals(result.min_clearance, 3, NO_VALUE), element("small", "least"), class_="number"),
        element("td", decimals(result.planning_p50, 1, NO_VALUE), _slowest(results, result), class_="number"),
    )


def _slowest(results: Results, result: Result) -> Element:
    missed = f", {result.missed} missed" if results.summary.realtime else ""
    return element("small", f"99 %: {decimals(result.planning_p99, 1, NO_VALUE)}{missed}")


def _small(text: str | None) -> Element | None:
    return element("small", text) if text else None


def _unsuccessful(results: Results, name: str) -> Element | None:
    """Table of the unsuccessful trials, with the commands that film them where there are commands."""
    found = [row for row in results.of_cell(name) if row.outcome != "success"]
    if not found:
        return None
    counts = Counter(row.method for row in found)
    found.sort(key=lambda row: counts[row.method])  # the failures of methods that rarely fail first
    rows = [_listed(results, row) for row in found[:LISTED]]
    columns = ("method", "seed", "ended", "drive it again, and film it" if results.command_line else None)
    heading = element("tr", *(element("th", text) for text in columns if text))
    more = len(found) - LISTED
    rest = element("p", f"and {more} more, in trials.jsonl") if more > 0 else None
    title = element("summary", f"The {len(found) if len(found) > 1 else 'one'} that did not succeed")
    return element("details", title, element("div", element("table", heading, *rows), class_="wide"), rest)


def _listed(results: Results, row: TrialRow) -> Element:
    command = results.command(row, video=f"{file_name(row.key[0])}-{row.method}-{row.seed}.mp4")
    ended = charts.trial_text(row).split(": ", 1)[1]
    return element(
        "tr",
        element("td", results.methods[row.method]),
        element("td", str(row.seed), class_="number"),
        element("td", element("i", class_=f"swatch {row.outcome}"), f" {ended}"),
        element("td", element("code", command)) if command else None,
    )


def _foot() -> Element:
    return element(
        "footer",
        "The trials are in trials.jsonl of the results folder, these numbers in summary.json, and what was run, as it "
        "was understood, with hashes and versions, in manifest.json.",
    )
