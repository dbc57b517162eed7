"""Tables of the documentation from results folders: docs/results.md, and the table of the README.

    python -m benchmarks.results RESULTS... [--benchmarks FILE] [--out FILE] [--readme FILE]

Each RESULTS is a folder of `kraft eval`, FILE of --benchmarks the `results.json` of `python -m benchmarks`. The table
of the README, between its two marks, has the entries of the first folder, and the methods of all folders with these.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap

from benchmarks import claims as paired
from benchmarks.claims import Claim
from benchmarks.parallel import interval
from kraft.errors import Code, InputError, KraftError
from kraft.evaluation.experiment import METHODS
from kraft.evaluation.report.results import Results, read_results
from kraft.evaluation.statistics import SIGNIFICANT, fisher_p, holm
from kraft.evaluation.summary import MANY, Result
from kraft.evaluation.table import markdown
from kraft.files import write_whole
from kraft.text import counted, decimals
from kraft_cli.work.evaluate import EvalRequest, eval_command

KIND = re.compile(r"(?P<kind>[a-z]+)-\d{3,}")
"""Name of an entry of `kraft generate`."""
BEGIN, END = "<!-- results: written by python -m benchmarks.results -->", "<!-- end of results -->"
HEADING = """# Results

Written by `python -m benchmarks.results` from results folders of `kraft eval`; every section has the command that
repeats it. Cells have the number of successes and of collisions ("hit"); the other trials reached the time limit. In
brackets is the mean time of the successful trials. Intervals are Wilson's, 95 %; those over all entries hold for other
seeds of these entries, not for other worlds. Mean times over all entries compare only methods that succeed in the same
entries.
"""
MEASURES = (
    "All measures ([what the columns hold](eval.md#the-tables)). `delta` of a method with a fixed clearance "
    "(Conservative KRAFT, Cons. Replanner + OpenLoop, Filtered KRAFT) only says how often that was enough; a measured "
    "bound [promises](eval.md#what-was-promised) that it is."
)
PAPER_HEADING = "## Successes beside the paper's"
CLAIMS_HEADING = """## What the paper claims

Replanning, long horizons, feedback and safety each help: the methods of a row differ in this part
([and in what else](peers.md#the-papers-claims)), and are compared on the trials that both have, paired by scenario and
seed. The seeds of one entry are alike, so entries are what intervals and tests count. Differences are in points (method
minus *instead of*) with Student's 95 % interval over entries and the p-value of the exact sign-flip test over entries.
Times are of pairs in which both succeeded: the geometric mean over the entries of the ratio of mean times, with
Student's 95 % interval of its logarithm over entries. The verdict states what an interval excludes, of successes
and collisions if p is below 0.05 too; the intervals are not adjusted for their number.
"""
CLAIMS_TEXT = (
    "What the paper claims, on the trials of this evaluation that both methods have. p is that of the exact sign-flip "
    "test over entries. It cannot be less than *least p*: 2 / 2^k if the methods differ in k entries, so that five or "
    "fewer are never below 0.05, however large the differences. [All evaluations together](#what-the-paper-claims) "
    "have more entries."
)
BENCHMARKS = "Values are medians, those with a target of the worst the worst sample."
CLAIMS = (
    Claim("feedback", "oneshot-kinodynamic", "oneshot-openloop"),
    Claim("feedback that knows the dynamics", "oneshot-kinodynamic", "oneshot-geometric"),
    Claim("replanning", "kraft", "oneshot-kinodynamic"),
    Claim("feedback while replanning", "kraft", "replanner-openloop"),
    Claim("safety, without feedback", "cons-replanner-openloop", "replanner-openloop"),
    Claim("safety, with feedback", "conservative-kraft", "kraft"),
)


def main(arguments: list[str] | None = None) -> int:
    """Write the documents; 2 if a folder cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.results", description=__doc__.splitlines()[0])
    parser.add_argument("results", nargs="+", type=Path, metavar="RESULTS", help="results folders of kraft eval")
    parser.add_argument("--benchmarks", type=Path, metavar="FILE", help="results.json of python -m benchmarks")
    parser.add_argument("--out", type=Path, default=Path("docs/results.md"), metavar="FILE", help="(%(default)s)")
    parser.add_argument("--readme", type=Path, metavar="FILE", help="replace the table between the marks in it")
    given = parser.parse_args(arguments)
    try:
        found = [read_results(folder) for folder in given.results]
        readme = None if given.readme is None else with_table(given.readme, found)
        write_whole(given.out, document(found, given.benchmarks).encode())
        if readme is not None:
            write_whole(given.readme, readme.encode())
    except KraftError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def document(found: Sequence[Results], benchmarks: Path | None = None) -> str:
    """Content of docs/results.md."""
    titles = headings(found)
    parts = [HEADING, *map(section, found, titles), *differences(found), *claims_section(found)]
    if benchmarks is not None:
        parts.append(benchmark_section(json.loads(benchmarks.read_text(encoding="utf-8"))))
    return "\n".join(parts)


def headings(found: Sequence[Results]) -> list[str]:
    """Headings of the sections of results folders; those of the same scenarios name their methods, too."""
    names = [str(each.manifest.arguments.get("suite") or ", ".join(each.entries)) for each in found]
    names = [Path(name).parent.name if name.endswith("suite.yaml") else name for name in names]
    return [
        f"{name}: {', '.join(each.methods)}" if names.count(name) > 1 else name
        for name, each in zip(names, found, strict=True)
    ]


def section(found: Results, title: str) -> str:
    """Section of a results folder."""
    manifest = found.manifest
    missing = found.expected - len(found.rows)
    first, last = manifest.seeds[0], manifest.seeds[-1]
    seeds = f"seed {first}" if first == last else f"seeds {first} to {last}"
    facts = [f"{found.title}, {seeds}, {manifest.began[:10]}"]
    facts += [f"{missing} trials not run"] if missing else []
    facts += [f"score: {label}" for label in dict.fromkeys(r.scoring.label for r in found.summary.results if r.scoring)]
    lines = [f"## {title}", "", f"    {command(found)}", "", "; ".join(facts) + ".", ""]
    if len(found.entries) <= MANY:
        lines += [*method_table([found]), "", *wrap(MEASURES, 120), "", markdown(found.summary)]
    lines += ["", *totals(found), *kinds(found), *failing(found), *claims(found), ""]
    return "\n".join(lines)


def command(found: Results) -> str:
    """Command that repeats an evaluation; of absolute paths the last two parts."""
    arguments = found.manifest.arguments
    request = EvalRequest(
        tuple(map(_short, arguments.get("scenarios") or ())),
        _short(arguments["suite"]) if arguments.get("suite") else None,
        tuple(arguments.get("settings") or ()),
        tuple(arguments.get("vary") or ()),
        arguments.get("trials"),
        ",".join(map(_short, arguments.get("methods") or ())) or None,
        _short(arguments["vehicle"]) if arguments.get("vehicle") else None,
        arguments.get("seed"),
        realtime=bool(arguments.get("realtime")),
    )
    return eval_command(request)


def _short(reference: str) -> str:
    """Name, relative path, or the last two parts of an absolute path, which holds on one machine alone."""
    path = Path(reference)
    return str(Path(*path.parts[-2:])) if path.is_absolute() else reference


def method_table(found: Sequence[Results]) -> list[str]:
    """Table with a row for each method, the paper's first, and a column for each entry of the first folder."""
    entries, rows = found[0].summary.entries, list[tuple[int, list[str]]]()
    for each in found:
        by_cell = each.summary.by_cell
        if each.summary.entries == entries:
            for method, title in each.methods.items():
                place = METHODS.index(method) if method in METHODS else len(METHODS)
                rows.append((place, [title, *(cell(by_cell[entry, method]) for entry in entries)]))
    rows.sort(key=lambda row: row[0])
    return _markdown([["", *(entry.capitalize() for entry in entries)], *(row for _, row in rows)])


def cell(result: Result) -> str:
    """Successes, collisions, mean time and score of a method in an entry."""
    found = [f"{result.success} ({result.t_ex:.1f} s)" if result.t_ex is not None else f"{result.success}"]
    found += [f"{result.collision} hit"] if result.collision else []
    found += [f"{result.failed} failed"] if result.failed else []
    found += [f"score {result.score:.3f}"] if result.score is not None else []
    return ", ".join(found)


def totals(found: Results) -> list[str]:
    """Table of each method over all entries."""
    rows = [["all entries", "success", "95 % interval", "collision", "95 % interval", "mean time, s"]]
    for method, title in found.methods.items():
        mine = found.summary.of_method(method)
        trials, success = sum(r.trials for r in mine), sum(r.success for r in mine)
        collision = sum(r.collision for r in mine)
        time = sum(r.t_ex * r.success for r in mine if r.t_ex is not None) / success if success else None
        rows.append([
            title, f"{success} of {trials}", interval(success, trials), str(collision), interval(collision, trials),
            decimals(time, 2),
        ])  # fmt: skip
    return [*_markdown(rows), ""]


def kinds(found: Results) -> list[str]:
    """Table of the kinds of worlds of `kraft generate`, the one with the most failures first; none of other entries."""
    named = {entry: KIND.fullmatch(entry) for entry in found.entries}
    of_kind: dict[str, list[str]] = {}
    for entry, match in named.items():
        if match is None:
            return []
        of_kind.setdefault(match["kind"], []).append(entry)
    rows = {}
    for kind, entries in of_kind.items():
        cells = [_of(found, entries, method) for method in found.methods]
        rows[kind, len(entries)] = (-sum(map(_failures, cells)), [_counts(each) for each in cells])
    order = sorted(rows.items(), key=lambda item: item[1][0])
    heading = ["kind of world", "worlds", *found.methods.values()]
    table = [heading, *([kind, str(worlds), *cells] for (kind, worlds), (_, cells) in order)]
    return ["Successes by kind of world, then collisions and timeouts if there are any:", "", *_markdown(table), ""]


def failing(found: Results) -> list[str]:
    """Table of the entries of a large suite in which a trial failed, the one with the most failures first."""
    if len(found.entries) <= MANY:
        return []
    rows = []
    for entry in found.entries:
        cells = [_of(found, [entry], method) for method in found.methods]
        if failures := sum(map(_failures, cells)):
            rows.append((-failures, [entry, *(_counts(each) if _failures(each) else "" for each in cells)]))
    rows.sort(key=lambda row: row[0])
    others = len(found.entries) - len(rows)
    if not rows:
        return [f"No trial failed in any of the {others} entries.", ""]
    text = f"Entries with a failed trial, an empty cell has none; in the other {others} entries every trial succeeded:"
    return [text, "", *_markdown([["", *found.methods.values()], *(cells for _, cells in rows)]), ""]


def _of(found: Results, entries: Sequence[str], method: str) -> list[Result]:
    """Results of a method in some entries."""
    by_cell = found.summary.by_cell
    return [by_cell[entry, method] for entry in entries if (entry, method) in by_cell]


def _failures(results: Sequence[Result]) -> int:
    return sum(result.trials - result.success for result in results)


def _counts(results: Sequence[Result]) -> str:
    """Successes of all trials, and how many of the others were what."""
    if not results:
        return "not run"
    success, trials, collision, timeout, failed = (
        sum(getattr(result, name) for result in results)
        for name in ("success", "trials", "collision", "timeout", "failed")
    )
    found = [f"{success} of {trials}", *([f"{collision} hit"] if collision else [])]
    found += [counted(timeout, "timeout")] if timeout else []
    return ", ".join([*found, *([f"{failed} failed"] if failed else [])])


def differences(found: Sequence[Results]) -> list[str]:
    """Section about the rows that the paper has, in all folders, with those marked whose success rate differs from it.

    Entries are in the order of the folders, the methods of an entry in that of the paper.
    """
    results = [(result, result.paper) for each in found for result in each.summary.results]
    rows = [(result, paper) for result, paper in results if paper is not None and result.trials]
    if not rows:
        return []
    entries = list(dict.fromkeys(result.entry for result, _ in rows))
    rows.sort(key=lambda row: (entries.index(row[0].entry), METHODS.index(row[0].method)))
    tests = [fisher_p((result.success, result.trials), (paper.success, paper.trials)) for result, paper in rows]
    table = [["", "", "found", "95 % interval", "paper", "95 % interval", "p", ""]]
    for (result, paper), p, adjusted in zip(rows, tests, holm(tests), strict=True):
        higher = result.success * paper.trials > paper.success * result.trials
        verdict = "" if adjusted >= SIGNIFICANT else "higher here" if higher else "lower here"
        table.append([
            result.entry, result.title,
            f"{result.success} of {result.trials}", interval(result.success, result.trials),
            f"{paper.success} of {paper.trials}", interval(paper.success, paper.trials), f"{p:.2g}", verdict,
        ])  # fmt: skip
    text = (
        f"All rows that the paper has; [why they differ](hardness.md#differences-from-the-paper). p is that of "
        f"Fisher's exact test (two-sided). The last column has what differs with p below {SIGNIFICANT:g} after Holm's "
        f"adjustment for the number of rows of this table, {len(rows)}."
    )
    return ["\n".join([PAPER_HEADING, "", *wrap(text, 120), "", *_markdown(table), ""])]


def claims_section(found: Sequence[Results]) -> list[str]:
    """Section about the paper's claims, over all folders together; none if no folder has methods for them."""
    compared = paired.comparisons(found)
    if not compared:
        return []
    titles = {method: title for each in found for method, title in each.methods.items()}
    return ["\n".join([CLAIMS_HEADING, *_markdown(paired.table(compared, titles)), ""])]


def claims(found: Results) -> list[str]:
    """Table of the paper's claims, over all entries, on the trials that both methods have."""
    rows = [["what helps", "method", "instead of", "successes", "gained / lost", "p", "least p"]]
    for claim in CLAIMS:
        if not found.methods.keys() >= set(claim.methods):
            continue
        compared = paired.compare(claim, *(paired.trials_of([found], name) for name in claim.methods))
        if compared is None:
            continue
        test = compared.success
        counts = "{} : {} of {}".format(*test.counts, test.pairs)
        names, changed = [found.methods[name] for name in claim.methods], f"{test.gained} / {test.lost}"
        rows.append([claim.part, *names, counts, changed, f"{test.p:.2g}", f"{test.least_p:.2g}"])
    if len(rows) == 1:
        return []
    return [*wrap(CLAIMS_TEXT, 120), "", *_markdown(rows), ""]


def benchmark_section(content: dict[str, object]) -> str:
    """Tables of `python -m benchmarks`: all quantities, topic by topic."""
    topics = content["topics"]
    assert isinstance(topics, dict), "python -m benchmarks writes topics"
    lines = ["## Benchmarks", "", "    python -m benchmarks", "", BENCHMARKS, ""]
    for topic, found in topics.items():
        rows = [["quantity", "value", "unit", "samples", "target", ""]]
        for row in found["rows"]:
            met = {True: "met", False: "missed", None: ""}[row["met"]]
            target = row["target"] or ""
            judged = row["worst" if target.startswith("worst ") else "median"]
            value = "none" if judged is None else f"{judged:.4g}"
            rows.append([row["quantity"], value, row["unit"], str(len(row["samples"])), target, met])
        lines += [f"**{topic}**", "", *_markdown(rows), ""]
        for table in found["tables"].values():
            lines += [*_markdown(table), ""]
    return "\n".join(lines)


def with_table(readme: Path, found: Sequence[Results]) -> str:
    """Content of the README with the table between the marks replaced.

    Raises:
        InputError: if the marks are not there, in this order.
    """
    text = readme.read_text(encoding="utf-8")
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise InputError.of(str(readme), "has no marks of the table", f"expected {BEGIN} and {END}", Code.MISSING)
    return "\n".join([before + begin, *method_table(found), end + after])


def _markdown(rows: Sequence[Sequence[str]]) -> list[str]:
    """Table in Markdown; the first row is the heading."""
    ruled = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    return [f"| {' | '.join(row)} |" for row in ruled]


if __name__ == "__main__":
    sys.exit(main())
