"""The paper's claims as paired tests: replanning, long horizons, feedback and safety each help."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import geometric_mean
from typing import Final, TypeAlias

from kraft.errors import Code, InputError
from kraft.evaluation.report.results import RecordedCell, Results
from kraft.evaluation.statistics import PairedDifference, paired_difference, ratio_interval


@dataclass(frozen=True)
class Claim:
    """A part helps: a method does better than another one, from which it differs in this part alone."""

    part: str
    method: str
    reference: str

    @property
    def methods(self) -> tuple[str, str]:
        """The method, then the other one."""
        return self.method, self.reference


REPLANNING: Final = "replanning"
LONG_HORIZONS: Final = "long horizons"
FEEDBACK: Final = "feedback"
SAFETY: Final = "safety"
PAPER: Final = (
    Claim(REPLANNING, "kraft", "oneshot-kinodynamic"),
    Claim(REPLANNING, "replanner-openloop", "oneshot-openloop"),
    Claim(LONG_HORIZONS, "kraft-mppi", "mppi"),
    Claim(LONG_HORIZONS, "kraft-nmpc", "nmpc"),
    Claim(FEEDBACK, "kraft", "replanner-openloop"),
    Claim(FEEDBACK, "oneshot-kinodynamic", "oneshot-openloop"),
    Claim(SAFETY, "conservative-kraft", "kraft"),
    Claim(SAFETY, "cons-replanner-openloop", "replanner-openloop"),
    Claim(SAFETY, "adaptive-kraft", "adaptive-no-contingency"),
)
"""The paper's claims, each with the pairs of methods that test it."""

HEADING: Final = (
    "what helps", "method", "instead of", "pairs", "successes, points (95 %)", "gained / lost", "p",
    "collisions, points (95 %)", "fewer / more", "p", "time, ratio (95 %)", "verdict",
)  # fmt: skip


@dataclass(frozen=True)
class Trial:
    """How a trial ended; `time` is that of a success, s."""

    success: bool
    collision: bool
    time: float | None = None


Trials: TypeAlias = Mapping[tuple[str, str, int], Trial]
"""Trials of a method by the suite (empty without one) with what was set in it, by entry, and by seed."""


@dataclass(frozen=True)
class Comparison:
    """A claim on the trials that both of its methods have.

    Attributes:
        success, collision: differences of the shares, method minus reference, judged over entries as times are.
        entries: number of entries with pairs that both finished successfully.
        ratio: geometric mean over these entries of the method's mean time over the reference's; None without entries.
        ratio_interval: its 95 % interval over entries, since the seeds of one entry are alike.
    """

    claim: Claim
    success: PairedDifference
    collision: PairedDifference
    entries: int
    ratio: float | None
    ratio_interval: tuple[float, float] | None

    @property
    def verdict(self) -> str:
        """What is shown of successes, collisions and times; intervals and tests are not adjusted for their number."""
        found = []
        for name, difference in (("successes", self.success), ("collisions", self.collision)):
            if difference.shown:
                found.append(f"{'more' if difference.shown > 0 else 'fewer'} {name}")
        if self.ratio_interval is not None and (self.ratio_interval[0] > 1.0 or self.ratio_interval[1] < 1.0):
            found.append("slower" if self.ratio_interval[0] > 1.0 else "faster")
        return ", ".join(found) or "no difference shown"


def compare(claim: Claim, mine: Trials, theirs: Trials) -> Comparison | None:
    """Compare the methods of a claim on the entries and seeds that both have; None if there are none."""
    common = sorted(mine.keys() & theirs.keys())
    if not common:
        return None
    one, other = _entry_times(mine, theirs, common)
    entries = [key[:2] for key in common]
    return Comparison(
        claim,
        paired_difference([mine[key].success for key in common], [theirs[key].success for key in common], entries),
        paired_difference([mine[key].collision for key in common], [theirs[key].collision for key in common], entries),
        len(one),
        geometric_mean(a / b for a, b in zip(one, other, strict=True)) if one else None,
        ratio_interval(one, other),
    )


def _entry_times(mine: Trials, theirs: Trials, keys: Sequence[tuple[str, str, int]]) -> tuple[list[float], list[float]]:
    """Mean times (s) of both methods in each entry, over the pairs in which both succeeded."""
    times: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for key in keys:
        one, other = mine[key].time, theirs[key].time
        if one is not None and other is not None:
            times.setdefault(key[:2], []).append((one, other))
    means = [tuple(sum(column) / len(pairs) for column in zip(*pairs, strict=True)) for pairs in times.values()]
    return [one for one, _ in means], [other for _, other in means]


def trials_of(found: Sequence[Results], method: str) -> Trials:
    """Trials of a method in results folders; a trial that failed by a defect is no success.

    Trials of the same scene are other ones if its content, keys that are set, the vehicle or the clock differ.

    Raises:
        InputError: if two folders have the same trial.
    """
    trials: dict[tuple[str, str, int], Trial] = {}
    for each in found:
        for entry, cell in each.entries.items() if method in each.methods else ():
            for row in each.of_cell(entry, method):
                key = _conditions(each, cell), entry, row.seed
                if key in trials:
                    problem = f"seed {row.seed} of {method} in {entry} is in two of them"
                    raise InputError.of("results folders", problem, "expected each trial once", Code.DUPLICATE)
                trials[key] = Trial(row.outcome == "success", row.outcome == "collision", row.success_time)
    return trials


def _conditions(found: Results, cell: RecordedCell) -> str:
    """Suite, what was set, and hash of the scenario of an entry, in this order; equal for trials that may be paired."""
    arguments, manifest = found.manifest.arguments, found.manifest
    parts = [str(arguments.get("suite") or ""), *(f"{key}={cell.set[key]}" for key in sorted(cell.set))]
    parts += [f"vehicle {arguments['vehicle']}"] if arguments.get("vehicle") else []
    return " ".join([*parts, *(["realtime"] if manifest.realtime else []), manifest.scenarios[cell.name].sha256])


def comparisons(found: Sequence[Results]) -> list[Comparison]:
    """The paper's claims, as far as the results folders have both methods."""
    compared = (compare(claim, *(trials_of(found, method) for method in claim.methods)) for claim in PAPER)
    return [each for each in compared if each is not None]


def table(compared: Sequence[Comparison], titles: Mapping[str, str]) -> list[list[str]]:
    """Table of comparisons; `titles` has the names of methods that are shown."""
    rows = [list(HEADING)]
    for each in compared:
        success, collision = each.success, each.collision
        time = "-" if each.ratio is None else f"{each.ratio:.3f}"
        if each.ratio_interval is not None:
            time += " ({:.3f} to {:.3f})".format(*each.ratio_interval)
        rows.append([
            each.claim.part, *(titles.get(name, name) for name in each.claim.methods),
            str(success.pairs), _points(success), f"{success.gained} / {success.lost}", f"{success.p:.2g}",
            _points(collision), f"{collision.lost} / {collision.gained}", f"{collision.p:.2g}", time, each.verdict,
        ])  # fmt: skip
    return rows


def _points(found: PairedDifference) -> str:
    low, high = found.interval
    return f"{100 * found.difference:+.1f} ({100 * low:+.1f} to {100 * high:+.1f})"
