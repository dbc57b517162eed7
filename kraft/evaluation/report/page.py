"""HTML of the page: sweeps, an overview, then each entry with its methods, measures, trials and failures.

The overview shows how every method did in every entry and in all of them, and why trials failed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from importlib.resources import files
from typing import Final
from urllib.parse import quote
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from kraft.evaluation.journal import TrialRow, reason_of_failures, success_times
from kraft.evaluation.paper import PaperRow
from kraft.evaluation.report.elements import NO_VALUE, Content, document, element, hint, outcome_legend, stacked
from kraft.evaluation.report.entry import (
    CLEARANCE,
    floor_plan,
    outcomes_chart,
    time_axis,
    times_chart,
    trial_link,
    trial_text,
    trials_chart,
    trials_data,
    trials_section,
)
from kraft.evaluation.report.measures import Shown, measures_table
from kraft.evaluation.report.methods import methods
from kraft.evaluation.report.overview import causes, chip, overview, settings_of
from kraft.evaluation.report.results import VERSIONS, Results
from kraft.evaluation.report.sweeps import DESK, PHONE, TABLET, sweep_pictures, sweeps
from kraft.evaluation.summary import MANY, Result
from kraft.text import counted, decimals

LISTED: Final = 200  # unsuccessful trials of a scenario that are listed
SHORTEST_AXIS: Final = 0.1  # of times, s: with a start in the goal every time is 0
PAPERS: Final = {"desk": DESK, "tablet": TABLET, "phone": PHONE}  # the style sheet shows the picture that fits
SCRIPTS: Final = ("replay.js", "plots.js", "page.js")  # parts of one module, in this order
SAFE: Final = " !$'()*+,/:;=?@~"  # characters that need no escape in an address of data


def page(results: Results, *, served: bool = False) -> str:
    """Make the page; it needs no other file and no network.

    A page that is `served` asks the server of the results folder for replays instead of having them.
    """
    shown = Shown.of(results)
    sections = [_entry(results, name, shown) for name in results.entries]
    title = f"{results.title} | kraft eval"
    entries = element(
        "section", element("h2", "Entries"), _key(shown, results.summary.failed > 0), *sections, id="entries"
    )
    replay = ElementTree.fromstring(_part("replay.html"))
    script = element("script", *(_part(name) for name in SCRIPTS), type="module")
    parts = [
        overview(results), causes(results), methods(results), _sweeps(results), trials_section(), entries
    ]  # fmt: skip
    shown_parts = [part for part in parts if part is not None]
    return document(
        title, _part("style.css"), *_head(results), _contents(shown_parts), *shown_parts, _foot(), replay,
        scripts=[*trials_data(results, served), script],
    )  # fmt: skip


def _contents(parts: Sequence[Element]) -> Element:
    """Links to the sections of the page, which may be long."""
    titles = {part.get("id", ""): "".join(part.find("h2").itertext()) for part in parts}  # type: ignore[union-attr]
    links = [element("a", title, href=f"#{name}") for name, title in titles.items()]
    return element("nav", *links, class_="contents", aria_label="sections")


def _part(name: str) -> str:
    """Text of a file of this package."""
    return files("kraft.evaluation.report").joinpath(name).read_text(encoding="utf-8")


def _head(results: Results) -> Iterator[Content]:
    yield element("h1", results.title)
    missing = results.expected - len(results.rows)
    if missing:
        run = f"{missing} of {counted(results.expected, 'trial')} not run yet"
        text = f"{run}: this page is of those that were."
        yield element("p", text, class_="alarm")
    failed = results.summary.failed
    if failed:
        defects = sum(row.is_defect for row in results.rows.values())
        text = f"{counted(failed, 'trial')} failed, {reason_of_failures(failed, defects)}: none counts as a success."
        yield element("p", text, class_="alarm")
    for text in results.manifest.warnings:
        yield element("p", element("b", "Warning: "), text, class_="alarm warning")
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
    yield "versions", ", ".join(f"{name} {manifest.versions[name]}" for name in VERSIONS)


def _fact(name: str, value: str) -> Element:
    return element("div", element("dt", name), element("dd", value))


def _sweeps(results: Results) -> Element | None:
    """Pictures of the sweeps; None if no key is varied."""
    found = sweeps(results)
    if not found:
        return None
    keys = " and ".join([found[0].axis.key, *found[0].fixed])
    words = (
        f"Over {keys}. Bars are 95\u00a0% intervals: Wilson's of shares, Student's of mean times; a bar that leaves "
        "its panel has no cap there. The methods are set a little apart, so that equal ones can be seen."
    )
    figures = []
    drawings = {name: sweep_pictures(found, results.methods, paper) for name, paper in PAPERS.items()}
    for k, (sweep, drawing) in enumerate(zip(found, drawings["desk"], strict=True)):
        file = f"sweep-{k + 1}.svg" if len(found) > 1 else "sweep.svg"
        content = quote(ElementTree.tostring(drawing, encoding="unicode"), safe=SAFE)
        save = element("a", "save as SVG", href=f"data:image/svg+xml;charset=utf-8,{content}", download=file)
        fitting = [element("div", pictures[k], class_=f"sweep-{name}") for name, pictures in drawings.items()]
        figures.append(element("figure", *fitting, element("p", save, class_="save"), aria_label=sweep.name))
    return element(
        "section",
        element("h2", "Sweeps"),
        element("p", words, hint(" Point at a mark for its numbers."), class_="key"),
        *figures,
        class_="sweeps",
        id="sweeps",
    )


def _key(shown: Shown, failed: bool) -> Element:
    """Legend of the charts."""
    words = (
        *(
            "Below the bar of a method stands each trial, by seed",
            hint("; point at one to see how it ended, follow it to replay it"),
        ),
        *(". The bar has ", _stroke("ink"), " the 95\u00a0% Wilson interval of the success rate, and above it "),
        *(
            _stroke("paper"),
            " the paper's rate and its interval. p: exact McNemar test against KRAFT on the same seeds. ",
        ),
        *(
            "Times are of successful trials: ",
            _stroke("ink upright"),
            " their mean, ",
            element("i", class_="ring"),
            " the paper's, ",
        ),
        *(_stroke("bound upright"), " the lower bound, which is the shortest path at top speed. "),
        CLEARANCE,
    )
    deviation = (
        " Deviation: the largest distance of a point of the true car from where the committed prediction has it: ",
        *(_stroke("paper"), " its median, ", _stroke("collision"), " its 99\u00a0% quantile, "),
        *(_stroke("dashed"), " the mean clearance δ(v) that the method asked for."),
    )
    return element("p", *outcome_legend(failed), " ", *words, *(deviation if shown.deviations else ()), class_="key")


def _stroke(look: str) -> Element:
    """Sample of a line in a legend: its colour follows the page's."""
    return element("i", class_=f"stroke {look}")


def _entry(results: Results, name: str, shown: Shown) -> Element:
    """Section of an entry; one of many is closed, and opens when its anchor is followed."""
    cell = results.entries[name]
    every = results.summary.of_entry(name)
    mine = [result for result in every if result.trials]
    title, settings = cell.base or name, settings_of(cell)
    tables = [_table(results, name, mine), measures_table(shown, mine, name)] if mine else []
    blocks = [element("div", stacked(table), class_="wide") for table in tables if table is not None]
    if waiting := ", ".join(result.title for result in every if not result.trials):
        blocks.append(element("p", f"Not run yet: {waiting}.", class_="key"))
    # a window that is too narrow for all side by side has the picture below the first block, beside the others
    parts = (
        element("div", *some, class_=f"tables {place}")
        for some, place in ((blocks[:1], "first"), (blocks[1:], "others"))
    )
    content = [
        element("div", _picture(results, name), *parts, class_="scenario"),
        _unsuccessful(results, name),
    ]
    if len(results.entries) <= MANY:
        heading = element("h3", title, " ", element("span", settings, class_="settings") if settings else None)
        return element("section", heading, *content, id=results.slugs[name], class_="entry")
    heading = element("b", title, " ", element("span", settings, class_="settings") if settings else None)
    line = element("summary", heading, element("span", *(chip(result) for result in mine), class_="chips"))
    return element("details", line, element("div", *content, id=results.slugs[name]), class_="entry")


def _table(results: Results, name: str, mine: Sequence[Result]) -> Element:
    """Table of the outcomes and times of an entry."""
    times = [
        *success_times(results.of_cell(name)),
        *(r.paper.t_ex for r in mine if r.paper and r.paper.t_ex is not None),
    ]
    longest = 1.02 * max([*times, SHORTEST_AXIS])
    heading = [element("th", text) for text in ("method", "how trials ended", "succ / coll / timeout")]
    heading += [element("th", "time, s", time_axis(longest))]
    columns = ("mean,\u00a0s", "p", "contingencies", "clearance,\u00a0m", "planning,\u00a0ms")
    heading += [element("th", text, class_="number") for text in columns]
    rows = [_row(results, result, longest) for result in mine]
    return element("table", element("thead", element("tr", *heading)), *rows, aria_label=f"results in {name}")


def _picture(results: Results, name: str) -> Element:
    scenario = results.known.get(name)
    if scenario is None:
        words = "No picture: the scenario is not there any more, or another."
        return element("figure", element("figcaption", words), aria_label=f"scene of {name}")
    hits = Counter(row.obstacle for row in results.of_cell(name) if row.obstacle)
    unknown = scenario.truth.in_words()
    words = f"Not known to the planner: {', '.join(unknown)}." if unknown else "The planner knows this scene."
    most = hits.most_common(1)
    hit = f" Hit most: {most[0][0]}, {_times(most[0][1])}." if most else ""
    return element(
        "figure",
        floor_plan(scenario, hits),
        element("figcaption", words + hit),
        data_entry=results.slugs[name],
        aria_label=f"scene of {name}",
    )


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _row(results: Results, result: Result, longest: float) -> Element:
    rows = results.of_cell(result.entry, result.method)
    commands = {row.seed: results.command(row) for row in rows}
    paper = result.paper
    beside = f"paper {_ends(paper)}" if paper else None
    beside_time = f"paper {paper.t_ex:.1f}" if paper and paper.t_ex is not None else None
    low, high = result.interval
    counts = f"{_ends(result)}, {result.failed} failed" if result.failed else _ends(result)
    return element(
        "tr",
        element("th", result.title, scope="row"),
        element(
            "td",
            outcomes_chart(result),
            trials_chart(rows, results.manifest.seeds, commands, trial_link),
            class_="drawing",
        ),
        element("td", counts, element("small", f"{low:.0%} to\u00a0{high:.0%}"), _small(beside)),
        element("td", times_chart(result, rows, longest), class_="drawing"),
        element("td", decimals(result.t_ex, 2, NO_VALUE), _small(beside_time), class_="number"),
        element("td", f"{result.against.p:.2g}" if result.against else NO_VALUE, class_="number chance"),
        element("td", str(result.contingencies), _small(f"of {counted(result.cycles, 'cycle')}"), class_="number"),
        element("td", decimals(result.min_clearance, 3, NO_VALUE), element("small", "least"), class_="number"),
        element("td", *_planning_times(results, result), class_="number"),
    )


def _ends(counts: Result | PaperRow) -> str:
    """Numbers of successes, collisions and timeouts, which stay in one line."""
    return f"{counts.success} / {counts.collision} / {counts.timeout}".replace(" ", "\u00a0")


def _planning_times(results: Results, result: Result) -> Iterator[str | Element]:
    """Times of planning and, except in older evaluations, of the controller's commands."""
    yield decimals(result.planning_p50, 1, NO_VALUE)
    missed = f", {result.missed} missed" if results.summary.realtime else ""
    yield element("small", f"99\u00a0%:\u00a0{decimals(result.planning_p99, 1, NO_VALUE)}{missed}")
    yield element("small", f"first\u00a0plan {decimals(result.first_plan_p50, 1, NO_VALUE)}")
    if result.command_p50 is not None:
        late = f", {result.late_commands} late" if result.late_commands else ""
        yield element(
            "small", f"command\u00a0{result.command_p50:.2f}, 99\u00a0%:\u00a0{decimals(result.command_p99, 2)}{late}"
        )


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
    table = element("table", heading, *rows, aria_label=f"unsuccessful trials in {name}")
    wide = element("div", stacked(table), class_="wide")
    return element("details", title, wide, rest, class_="unsuccessful")


def _listed(results: Results, row: TrialRow) -> Element:
    command = results.command(row, video=f"{results.slugs[row.key[0]]}-{row.method}-{row.seed}.mp4")
    ended = trial_text(row).split(": ", 1)[1]
    return element(
        "tr",
        element("td", results.methods[row.method]),
        element("td", element("a", str(row.seed), href=trial_link(row.key)), class_="number"),
        element("td", element("i", class_=f"swatch {row.outcome}"), f" {ended}"),
        element("td", element("code", command)) if command else None,
    )


def _foot() -> Element:
    return element(
        "footer",
        "The trials are in trials.jsonl of the results folder, these numbers in summary.json, and what was run, as it "
        "was understood, with hashes and versions, in manifest.json.",
    )
