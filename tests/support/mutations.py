"""Damaged input files, and what the command line makes of them.

A mutation changes one or a few places of a valid file: a number becomes extreme, a key is removed, repeated or
misspelt, a value gets another type, bytes are flipped, the end is cut off.  Whatever the file, a command ends with an
exit code that is documented and never with a defect.
"""

from __future__ import annotations

import io
import random
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

from kraft.config import bundled
from kraft.errors import NegativeResult
from kraft_cli.main import main
from kraft_cli.terminal import Terminal
from support.logs import write_wide

DOCUMENTED = frozenset({0, 1, 2, 3})
"""Exit codes that a damaged file may lead to."""

NUMBERS = (
    "0", "-0.0", "-1", "1", "0.5", "2.5", "5e-324", "1e-308", "1e-12", "1e-9", "0.001", "1e-6", "0.02", "1.5", "3", "10", "100", "180", "1000", "10000", "-10000", "9999", "1e6", "1e9", "1e12", "1e38",
    "1e308", "-1e308", "1e999", "999999999999999999", "1" + "0" * 40, ".nan", ".inf", "-.inf", "NaN", "0x10", "012", "1_0",
)  # fmt: skip
VALUES = ("", "true", "null", "text", "''", "[]", "{}", "[1, 2]", "{a: 1}", "!!float 1", "*a", "&a 1", "~", '"\\ud800"')
SCENE = """name: scene
bounds: {x: [0, 4], y: [0, 4]}
obstacles:
  - {name: pillar, box: {center: [2, 2], size: [1, 0.5], yaw_deg: 10, height: 0.3}}
  - circle: {center: [3.5, 0.5], radius: 0.2}
  - polygon: {vertices: [[0.2, 3], [1, 3.2], [0.4, 3.8]]}
start: {x: 0.5, y: 0.5, heading_deg: 0, speed: 0.1}
goal: {center: [3, 3], radius: 0.3, heading_deg: 90, heading_tolerance_deg: 60}
vehicle: car.yaml
planning:
  planner: dirt
  cycle: 1.0
  edge_duration: [0.5, 1.0]
  integration_step: 0.1
  blossom: 32
  goal_bias: 0.05
  pruning: false
  polish: true
  safety: {delta: 0.01, delta_per_speed: 0.02, horizon: 10.0}
truth:
  floor_friction: 0.9
  friction_patches: [{x: [0, 1], y: [0, 1], friction: 0.1}]
  speed_bumps: [{center: [1, 1], size: [1, 0.2], height: 0.02, yaw_deg: 5}]
  movable_boxes: [{center: [1, 3], size: [0.3, 0.3, 0.2], mass: 1.0, yaw_deg: 3, friction: 0.4}]
  tilt: {angle: 0.05, uphill_deg: 90}
  vehicle: {drive_scale: 0.9, steering_scale: 1.1, steering_offset_deg: 1.0, mass_scale: 1.2}
  changes: [{time: 2.5, floor_friction: 0.3, vehicle: {drive_scale: 0.8, mass_scale: 1.1}}, {time: 4, floor_friction: 0.9}]
sensing: {preset: planar, camera: [1, 3, 5], rate_hz: 30, latency: 0.01, dropout: 0.02, noise_scale: 1.0}
trial: {timeout: 60, oneshot_timeout: 30}
"""
MAPPING = """commands:
  controls: {throttle: {column: throttle, scale: 1.0, zero: 0.0}, steering: steering}
  time: t
poses:
  x: x
  y: y
  yaw: {column: yaw, unit: rad}
  time: t
"""
SUITE = """name: suite
entries:
  - {name: first, scenario: turns, set: {planning.cycle: 1.0}}
  - {name: second, scenario: boxes, set: {goal.radius: 0.3}}
"""
ITERATIONS = "30"
NEAR = ("plan", "turns", "--set", "goal.center=[1.4, 0.6]")
"""A goal to which plans, and plan files, are short."""


@dataclass(frozen=True)
class Input:
    """A valid file and the command lines that read it, relative to a folder that has the other files."""

    kind: str
    file: str
    commands: tuple[tuple[str, ...], ...]


INPUTS = (
    Input("scenario", "scene.yaml", (("validate", "scene.yaml"), ("plan", "scene.yaml", "--iterations", ITERATIONS, "--json"), ("run", "scene.yaml"))),
    Input("vehicle", "car.yaml", (("validate", "car.yaml"), ("plan", "scene.yaml", "--iterations", ITERATIONS), ("run", "scene.yaml", "--vehicle", "car.yaml"))),
    Input("method", "method.yaml", (("validate", "method.yaml"), ("run", "turns", "--method", "method.yaml"))),
    Input("suite", "suite.yaml", (("validate", "suite.yaml"),)),
    Input("map", "map.yaml", (("validate", "map.yaml"), ("plan", "mapped.yaml", "--iterations", ITERATIONS))),
    Input("image", "map.pgm", (("validate", "map.yaml"), ("plan", "mapped.yaml", "--iterations", ITERATIONS))),
    Input("mapping", "mapping.yaml", (("validate", "mapping.yaml"), ("sysid", "logs", "--mapping", "mapping.yaml", "--model", "mushr"))),
    Input("plan", "plan.json", (("validate", "plan.json"), (*NEAR, "--from", "plan.json", "--after", "1", "--iterations", ITERATIONS))),
    Input("log", "logs/log.csv", (("sysid", "logs", "--json"),)),
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """How one command ended on one damaged file."""

    kind: str
    command: tuple[str, ...]
    content: bytes
    status: int
    err: str
    seconds: float

    @property
    def documented(self) -> bool:
        """Whether the exit code is one that a damaged file may lead to, and something was printed with it."""
        return self.status in DOCUMENTED and "Traceback" not in self.err and (self.status == 0 or bool(self.err))


def write_inputs(folder: Path) -> None:
    """Write every input file, valid, into a folder."""
    (folder / "scene.yaml").write_text(SCENE)
    (folder / "car.yaml").write_bytes((bundled.folder("vehicle") / "mushr.yaml").read_bytes())
    (folder / "method.yaml").write_bytes((bundled.folder("method") / "kraft.yaml").read_bytes())
    (folder / "suite.yaml").write_text(SUITE)
    (folder / "map.yaml").write_text(
        "image: map.pgm\nresolution: 0.5\norigin: [1.0, 2.0, 0.1]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    (folder / "map.pgm").write_bytes(b"P2\n# comment\n3 2\n255\n0 254 254\n254 205 254\n")
    mapped = SCENE.replace("  - circle:", "  - map: {file: map.yaml, height: 0.2}\n  - circle:")
    (folder / "mapped.yaml").write_text(mapped)
    (folder / "mapping.yaml").write_text(MAPPING)
    write_wide(folder / "logs" / "log.csv")
    assert run_command(folder, (*NEAR, "--iterations", "1000", "--out", ".")).status == 0


def run_command(folder: Path, command: Sequence[str], kind: str = "", content: bytes = b"") -> Outcome:
    """Run one command line in a folder; `kraft run` loads everything and ends before it drives."""

    def undriven(*_: object, **__: object) -> None:
        raise NegativeResult("not driven")

    terminal = Terminal(io.StringIO(), io.StringIO())
    began = time.perf_counter()
    with chdir(folder), patch("kraft.trial.trial.run_trial", undriven):
        status = main(list(command), terminal)
    assert isinstance(terminal.err, io.StringIO)
    return Outcome(kind, tuple(command), content, status, terminal.err.getvalue(), time.perf_counter() - began)


def outcomes(count: int, seed: int, kinds: Sequence[str] = ()) -> Iterator[Outcome]:
    """Damage files `count` times, by turns those of each kind, and run their commands."""
    generator = random.Random(seed)
    inputs = [each for each in INPUTS if not kinds or each.kind in kinds]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_inputs(folder)
        valid = {each.file: (folder / each.file).read_bytes() for each in INPUTS}
        for number in range(count):
            each = inputs[number % len(inputs)]
            content = mutated(valid[each.file], generator)
            (folder / each.file).write_bytes(content)
            for command in each.commands:
                yield run_command(folder, command, each.kind, content)
            (folder / each.file).write_bytes(valid[each.file])


def mutated(content: bytes, generator: random.Random) -> bytes:
    """A file with one to three mutations."""
    for _ in range(generator.choice((1, 1, 1, 1, 2, 3))):
        content = generator.choice(MUTATIONS)(content, generator)
    return content


def extreme_number(content: bytes, generator: random.Random) -> bytes:
    """Another number in place of one."""
    return _replaced(content, rb"(?<![\w.])-?[0-9]+(\.[0-9]+)?([eE][-+]?[0-9]+)?", NUMBERS, generator)


def other_type(content: bytes, generator: random.Random) -> bytes:
    """A value of another type in place of a number or a word after a colon."""
    return _replaced(content, rb"(?<=: )[\w.-]+", VALUES, generator)


def removed_line(content: bytes, generator: random.Random) -> bytes:
    """One line less."""
    lines = content.splitlines(keepends=True)
    if lines:
        del lines[generator.randrange(len(lines))]
    return b"".join(lines)


def removed_key(content: bytes, generator: random.Random) -> bytes:
    """One ``key: value`` of a mapping in braces less."""
    return _replaced(content, rb"\b\w+: [^,{}\[\]\n]+,? ?", ("",), generator)


def repeated_line(content: bytes, generator: random.Random) -> bytes:
    """One line twice."""
    lines = content.splitlines(keepends=True)
    if lines:
        k = generator.randrange(len(lines))
        lines.insert(k, lines[k])
    return b"".join(lines)


def swapped_lines(content: bytes, generator: random.Random) -> bytes:
    """Two lines in each other's place."""
    lines = content.splitlines(keepends=True)
    if len(lines) > 1:
        i, j = generator.sample(range(len(lines)), 2)
        lines[i], lines[j] = lines[j], lines[i]
    return b"".join(lines)


def misspelt_key(content: bytes, generator: random.Random) -> bytes:
    """One key with a letter less."""
    keys = list(re.finditer(rb"\w{3,}(?=\"?:)", content))
    if not keys:
        return content
    key = generator.choice(keys)
    at = generator.randrange(key.start(), key.end())
    return content[:at] + content[at + 1 :]


def flipped_bytes(content: bytes, generator: random.Random) -> bytes:
    """A few bits the other way."""
    damaged = bytearray(content)
    for _ in range(generator.randint(1, 4)):
        if damaged:
            damaged[generator.randrange(len(damaged))] ^= 1 << generator.randrange(8)
    return bytes(damaged)


def truncated(content: bytes, generator: random.Random) -> bytes:
    """The end cut off."""
    return content[: generator.randrange(len(content) + 1)]


MUTATIONS: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    extreme_number, extreme_number, extreme_number, other_type, removed_line, removed_key, repeated_line, swapped_lines,
    misspelt_key, flipped_bytes, truncated,
)  # fmt: skip


def _replaced(content: bytes, pattern: bytes, texts: Sequence[str], generator: random.Random) -> bytes:
    found = list(re.finditer(pattern, content))
    if not found:
        return content
    place = generator.choice(found)
    return content[: place.start()] + generator.choice(texts).encode() + content[place.end() :]
