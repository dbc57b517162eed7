"""Parts of an entry of the page: charts in the rows of its table, the floor plan of its scenario, and its trials.

The charts are outcomes, trials by seed, and durations of the successful trials.  The floor plan shows what the planner
knows, what only the truth contains, and the number of collisions.  The trials are data for the page's script, the
replays that fit into the page, and the list with its filters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final
from urllib.parse import quote
from xml.etree.ElementTree import Element

import numpy as np

from kraft.evaluation.journal import Key, Replays, TrialRow
from kraft.evaluation.paper import PaperRow
from kraft.evaluation.report.elements import Content, element, number, script_data, svg
from kraft.evaluation.report.results import Results
from kraft.evaluation.statistics import wilson
from kraft.evaluation.summary import Result
from kraft.scenario import Box, Circle, Goal, Obstacle, OccupancyMap, Polygon, Scenario, Start, Truth
from kraft.scenario.truth import Tilt
from kraft.text import counted
from kraft.trial.result import outcome_text

WIDTH: Final = 190.0
PAPER, BAR = 9.0, 14.0  # heights of the line above the bar and of the bar
CELLS: Final = 42  # trials in a line of the strip
TIMES: Final = 150.0
EDGE: Final = 8.0  # margin left and right of the times, for dots and labels at the ends


def outcomes_chart(result: Result) -> Element:
    """Bar of the outcomes with Wilson's interval of the success rate; above it the paper's rate and interval."""
    parts: list[Element] = []
    left = 0.0
    for name, count in endings(result):
        width = WIDTH * count / result.trials
        share = element("title", f"{name}: {count} of {result.trials}")
        parts.append(element("rect", share, class_=name, x=left, y=PAPER, width=width, height=BAR))
        left += width
    if result.trials:
        title = f"95 % interval of the success rate: {result.interval[0]:.0%} to {result.interval[1]:.0%}"
        parts += _interval(result.interval, PAPER + BAR / 2, "interval", title)
    if result.paper:
        parts += _papers(result.paper)
    return svg(WIDTH, PAPER + BAR, *parts, class_="outcomes", aria_label="outcomes; the numbers stand beside them")


def endings(result: Result) -> list[tuple[str, int]]:
    """Outcomes that occurred, with their numbers of trials."""
    counts = {
        "success": result.success,
        "timeout": result.timeout,
        "collision": result.collision,
        "failed": result.failed,
    }
    return [(name, count) for name, count in counts.items() if count]


CLEARANCE: Final = (
    "The clearance is the smallest distance of the planner's footprint to an obstacle at the ticks of the controller; "
    "a collision is a contact of the simulated body at any time, so it may come with a clearance of some centimetres."
)
"""What a clearance on the page is."""


def trials_chart(
    rows: Sequence[TrialRow], seeds: range, commands: Mapping[int, str | None], link: Callable[[Key], str]
) -> Element:
    """Strip with a cell for each seed, empty before the trial is run.

    `commands` by seed repeat the trials, `link` gives the address of a trial's replay.
    """
    found = {row.seed: row for row in rows}
    step = WIDTH / min(max(len(seeds), 1), CELLS)
    side = min(step, 10.0)
    cells = []
    for place, seed in enumerate(seeds):
        x, y = (place % CELLS) * step, (place // CELLS) * side
        row = found.get(seed)
        text = f"{trial_text(row)}\n{commands[seed] or f'{row.scenario}, {row.method}'}" if row else None
        title = element("title", text or f"seed {seed}: not run yet")
        look = row.outcome if row else "missing"
        cell = element("rect", title, class_=look, x=x, y=y, width=step - 1.0, height=side - 1.0)
        if row is not None:
            cell = element("a", cell, href=link(row.key), tabindex="-1")  # the list has the same links
        cells.append(cell)
    return svg(
        WIDTH, side * -(-len(seeds) // CELLS), *cells, class_="trials", role="group", aria_label="trials by seed"
    )


def trial_text(row: TrialRow) -> str:
    """Seed, outcome and error of a trial, in words."""
    text = f"seed {row.seed}: {outcome_text(row.outcome, row.obstacle, row.t_s, digits=1)}"
    return text + (f": {row.error}" if row.error else "")


def times_chart(result: Result, rows: Sequence[TrialRow], longest: float) -> Element:
    """Durations of the successful trials as dots, their mean as a line, the paper's as a ring, the bound dashed."""
    dots = [
        element("circle", element("title", trial_text(row)), class_="time", cx=_at(time, longest), cy=12.0, r=3.0)
        for row in rows
        if (time := row.success_time) is not None
    ]
    base = [element("line", class_="base", x1=EDGE, x2=TIMES - EDGE, y1=12.0, y2=12.0)]
    if result.bound is not None and result.bound <= longest:
        x, title = _at(result.bound, longest), f"lower bound {result.bound:.2f} s: the shortest path at top speed"
        base.append(element("line", element("title", title), class_="bound", x1=x, x2=x, y1=1.0, y2=23.0))
    return svg(
        TIMES,
        24.0,
        *base,
        *dots,
        *_mean(result, longest),
        class_="times",
        aria_label="times of successes; their mean stands beside them",
    )


def time_axis(longest: float) -> Element:
    """Axis labels above a column of `times`, s."""
    step = next((s for s in (1, 2, 5, 10, 20, 50, 100, 200, 500) if longest / s <= 4), 1000)
    ticks = [step * k for k in range(int(longest // step) + 1)]
    labels = [element("text", f"{tick}", x=_at(tick, longest), y=10.0, class_="tick") for tick in ticks]
    return svg(TIMES, 13.0, *labels, class_="times", aria_hidden="true")


def _mean(result: Result, longest: float) -> Iterator[Element]:
    if result.t_ex is not None:
        x = _at(result.t_ex, longest)
        yield element("line", element("title", f"mean {result.t_ex:.2f} s"), class_="mean", x1=x, x2=x, y1=3.0, y2=21.0)
    if result.paper and result.paper.t_ex is not None:
        x = _at(result.paper.t_ex, longest)
        yield element(
            "circle", element("title", f"paper: {result.paper.t_ex:.2f} s"), class_="paper", cx=x, cy=12.0, r=4.0
        )


def _at(time: float, longest: float) -> float:
    return EDGE + (TIMES - 2 * EDGE) * time / longest


def _papers(paper: PaperRow) -> Iterator[Element]:
    interval = wilson(paper.success, paper.trials)
    title = f"paper: {paper.success} of {paper.trials}, 95 % interval {interval[0]:.0%} to {interval[1]:.0%}"
    yield from _interval(interval, PAPER / 2, "paper", title)
    rate = paper.success / paper.trials
    yield element("circle", element("title", title), class_="paper", cx=3.0 + (WIDTH - 6.0) * rate, cy=PAPER / 2, r=2.5)


def _interval(interval: tuple[float, float], y: float, look: str, title: str) -> Iterator[Element]:
    low, high = (0.75 + (WIDTH - 1.5) * end for end in interval)
    yield element("line", element("title", title), class_=look, x1=low, x2=high, y1=y, y2=y)
    for x in (low, high):
        yield element("line", class_=look, x1=x, x2=x, y1=y - 3.0, y2=y + 3.0)


LONGEST, WIDEST = 330.0, 200.0  # px
MARGIN: Final = 0.03  # of the longer side
CELLS_MAX: Final = 300  # cells of a map along its longer side; cells of finer maps are merged


def floor_plan(scenario: Scenario, hits: Mapping[str, int]) -> Element:
    """Draw a scenario with x to the right and y up.

    Args:
        scenario: the scenario.
        hits: number of collisions by obstacle; an obstacle is drawn in a deeper colour the more it has.
    """
    (x0, x1), (y0, y1) = scenario.bounds.x, scenario.bounds.y
    margin = MARGIN * max(x1 - x0, y1 - y0)
    width, height = x1 - x0 + 2 * margin, y1 - y0 + 2 * margin
    scale = min(WIDEST / width, LONGEST / height)
    most = max(hits.values(), default=1)
    things: list[Content] = [
        element("rect", class_="free", x=x0, y=y0, width=x1 - x0, height=y1 - y0),
        *_truth(scenario.truth),
        *(
            _obstacle(obstacle, label, hits.get(label, 0), most)
            for obstacle, label in zip(scenario.obstacles, scenario.obstacle_labels, strict=True)
        ),
        _goal(scenario.goal),
        _start(scenario.start, 0.02 * LONGEST / scale),
        _uphill(scenario.truth.tilt, ((x0 + x1) / 2, (y0 + y1) / 2), 0.12 * LONGEST / scale),
        *_numbers(scenario, hits, scale),
    ]
    # one unit is a metre inside this group, and y grows upwards
    place = f"scale({scale:.6g}) translate({number(margin - x0)} {number(margin + y1)}) scale(1 -1)"
    look = "floor landscape" if width > height else "floor"
    words = f"floor plan of {scenario.name}"
    return svg(width * scale, height * scale, element("g", *things, transform=place), class_=look, aria_label=words)


def _truth(truth: Truth) -> Iterator[Element]:
    for patch in truth.friction_patches:
        (x0, x1), (y0, y1) = patch.x, patch.y
        slippery = element("title", f"friction {patch.friction:g}")
        yield element("rect", slippery, class_="slippery", x=x0, y=y0, width=x1 - x0, height=y1 - y0)
    for bump in truth.speed_bumps:
        title = f"bump, {100 * bump.height:g} cm"
        yield _polygon(Box(bump.center, bump.size, bump.yaw).corners, "bump", title)
    for box in truth.movable_boxes:
        title = f"can be pushed, {box.mass:g} kg"
        yield _polygon(Box(box.center, box.size[:2], box.yaw).corners, "movable", title)


def _obstacle(obstacle: Obstacle, label: str, hits: int, most: int) -> Element:
    title = f"{label}: {counted(hits, 'collision')}"
    if isinstance(obstacle, OccupancyMap):
        found = _cells(obstacle, title)
    elif isinstance(obstacle, Circle):
        (x, y), r = obstacle.center, obstacle.radius
        found = element("circle", element("title", title), class_="obstacle", cx=x, cy=y, r=r)
    else:
        vertices = obstacle.vertices if isinstance(obstacle, Polygon) else obstacle.corners
        found = _polygon(vertices, "obstacle", title)
    if hits:
        found.set("class", "obstacle hit")
        found.set("style", f"fill-opacity: {0.25 + 0.75 * hits / most:.2f}")
    return found


def _numbers(scenario: Scenario, hits: Mapping[str, int], scale: float) -> Iterator[Element]:
    """Number of each obstacle without a name that was hit, by which rows and pages call it; `scale` is in px per m."""
    for index, (obstacle, label) in enumerate(zip(scenario.obstacles, scenario.obstacle_labels, strict=True)):
        if obstacle.name or label not in hits or isinstance(obstacle, OccupancyMap):
            continue
        x, y = obstacle.center if not isinstance(obstacle, Polygon) else np.mean(obstacle.vertices, axis=0)
        place = f"translate({x:.4g} {y:.4g}) scale({1 / scale:.4g} {-1 / scale:.4g})"
        yield element("text", str(index), class_="number", transform=place, dy="0.35em")


def _polygon(vertices: tuple[tuple[float, float], ...], look: str, title: str) -> Element:
    points = " ".join(f"{x:.4g},{y:.4g}" for x, y in vertices)
    return element("polygon", element("title", title), class_=look, points=points)


def _cells(cells: OccupancyMap, title: str) -> Element:
    """Occupied cells of a map as one path, with a rectangle for each run of cells in a row."""
    occupied, side = cells.occupied, cells.resolution
    merged = max(1, math.ceil(max(occupied.shape) / CELLS_MAX))
    if merged > 1:  # a merged cell is occupied if any of its cells is
        padded = np.pad(occupied, [(0, -size % merged) for size in occupied.shape])
        rows, columns = (size // merged for size in padded.shape)
        occupied = np.asarray(padded.reshape(rows, merged, columns, merged).any(axis=(1, 3)))
        side *= merged
    edges = np.diff(np.pad(occupied.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    begins, ends = np.argwhere(edges == 1), np.argwhere(edges == -1)
    runs = [
        f"M{column * side:.4g} {row * side:.4g}h{(end - column) * side:.4g}v{side:.4g}h{(column - end) * side:.4g}z"
        for (row, column), (_, end) in zip(begins, ends, strict=True)
    ]
    x, y, yaw = cells.origin
    place = f"translate({x:.6g} {y:.6g}) rotate({math.degrees(yaw):.6g})"
    return element("path", element("title", title), class_="obstacle cells", d="".join(runs), transform=place)


def _goal(goal: Goal) -> Element:
    x, y = goal.center
    return element("circle", element("title", "goal"), class_="goal", cx=x, cy=y, r=goal.radius)


def _start(start: Start, size: float) -> Element:
    """Arrowhead of length `size` (m) at the start, along its heading."""
    shape = f"{number(size)},0 {number(-size)},{number(0.7 * size)} {number(-size)},{number(-0.7 * size)}"
    place = f"translate({start.x:.6g} {start.y:.6g}) rotate({math.degrees(start.heading):.6g})"
    return element("polygon", element("title", "start"), class_="start", points=shape, transform=place)


def _uphill(tilt: Tilt | None, middle: tuple[float, float], length: float) -> Element | None:
    """Arrow that points uphill; None on a level floor."""
    if tilt is None:
        return None
    half, head = length / 2, length / 5
    tip = f"L{number(half)} 0"
    path = f"M{number(-half)} 0{tip}l{number(-head)} {number(head)}{tip}l{number(-head)} {number(-head)}"
    place = f"translate({middle[0]:.6g} {middle[1]:.6g}) rotate({math.degrees(tilt.uphill):.6g})"
    title = f"uphill, {math.degrees(tilt.slope):.3g} degrees"
    return element("path", element("title", title), class_="uphill", d=path, transform=place)


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
    parts = element("thead", element("tr")), element("tbody")
    table = element("table", *parts, class_="trials-list", aria_label="trials")
    return element(
        "section",
        element("h2", "Trials"),
        element("p", f"{CLEARANCE} Follow a link to replay a trial. A heading sorts by its column.", class_="key"),
        element(
            "div", *filters, element("output", id="trials-count"), class_="filters", role="search", aria_label="trials"
        ),
        element("p", id="trials-alarm", class_="alarm", role="alert", hidden="hidden"),
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
    text = outcome_text(row.outcome, row.obstacle)
    planning = [round(value, 1) for value in row.measured.planning_ms]
    stored = results.replays is not None and row.key in results.replays
    return [
        number, entries.index(entry), methods.index(method), seed, row.outcome, row.obstacle, text, row.t_s,
        row.min_clearance_m, row.contingencies, *(row.why or (None, None)), stored,
        planning, results.command(row),
    ]  # fmt: skip
