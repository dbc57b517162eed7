"""Pairs of CSV files, with commands and with poses, that form a log by their names or those of their folders."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Final

from kraft.errors import Code, Diagnostic
from kraft.logs.names import COMMAND, POSE, parse

_FAMILY: Final = COMMAND | POSE
_SOURCES: Final = {
    *("pwm", "servo", "servos", "esc", "rc", "motor", "motors", "actuator", "actuators", "radio", "remote", "joy"),
    *("joystick", "teleop", "throttle", "steering", "mocap", "qualisys", "apriltag", "camera", "cam", "tracking"),
    *("tracked", "traj", "trajectory", "gps", "gnss", "slam", "lidar", "amcl", "localization", "localisation"),
}
"""Words for what commands or poses come from, which are usual in the names of files."""


def pair_files(commands: Sequence[Path], poses: Sequence[Path]) -> list[tuple[Path, Path]]:
    """Pair files with commands and files with poses that are of the same drive by their names.

    The only two files form a pair.  Of several, two do whose names are the same without the words that tell commands
    from poses, if no third file has that name too: first without all words for commands or poses, then without those
    that only the files of one kind have (`run_01_pwm` and `run_01_mocap`).
    """
    if len(commands) == len(poses) == 1:
        return [(commands[0], poses[0])]
    pairs = _equal(commands, poses, lambda path: tuple(word for word in _words(path) if word not in _FAMILY))
    paired = {path for pair in pairs for path in pair}
    own = {
        **dict.fromkeys(commands, _own_words(commands, poses)),
        **dict.fromkeys(poses, _own_words(poses, commands)),
    }
    return pairs + _equal(
        [path for path in commands if path not in paired],
        [path for path in poses if path not in paired],
        lambda path: tuple(word for word in _words(path) if word not in own[path]),
    )


def pair_across_folders(commands: Sequence[Path], poses: Sequence[Path]) -> list[tuple[Path, Path]]:
    """Pair files with commands and files with poses in folders beside each other (`cmd/run_01`, `mocap/run_01`).

    Two form a pair whose names, and those of their folders, are the same without the words for commands and poses and
    for what they come from, if no third file has these names too.  The name of each folder must have such a word: files
    of the same name in `run_1` and `run_2` are of different drives.
    """
    known = _FAMILY | _SOURCES

    def drive(path: Path) -> Hashable:
        return path.parent.parent, *(tuple(w for w in _words(each) if w not in known) for each in (path.parent, path))

    said = [path for path in (*commands, *poses) if known.intersection(_words(path.parent))]
    pairs = _equal([path for path in commands if path in said], [path for path in poses if path in said], drive)
    return [pair for pair in pairs if pair[0].parent != pair[1].parent]


def unpaired(folder: Path, commands: Sequence[Path], poses: Sequence[Path]) -> Diagnostic:
    """Problem of the files of a folder with commands alone and with poses alone that form no pairs."""
    count = f"{len(commands)} file{' has' if len(commands) == 1 else 's have'} commands and {len(poses)} "
    example = f"{commands[0].name}, {poses[0].name}"
    problem = f"{count}{'has' if len(poses) == 1 else 'have'} poses, but their names do not pair ({example}, ...)"
    expected = "expected names such as X_cmd.csv and X_pose.csv, X being the drive, or a folder for each drive"
    return Diagnostic(str(folder), problem, expected, code=Code.MISSING)


def _equal(commands: Sequence[Path], poses: Sequence[Path], key: Callable[[Path], Hashable]) -> list[tuple[Path, Path]]:
    """Pairs with the same key, which no third file has."""
    found: dict[Hashable, tuple[list[Path], list[Path]]] = {}
    for kind, paths in enumerate((commands, poses)):
        for path in paths:
            found.setdefault(key(path), ([], []))[kind].append(path)
    return [(a[0], b[0]) for a, b in found.values() if len(a) == len(b) == 1]


def _own_words(files: Sequence[Path], others: Sequence[Path]) -> set[str]:
    """Words that tell files of one kind from the others.

    They are in no name of the others.  Known words count wherever they are.  Without one, a word counts that all files
    have, if it is the only such word: one that only some have, or a number, may be that of the drive.
    """
    words = [set(_words(path)) for path in files]
    own = set().union(*words).difference(*(_words(path) for path in others))
    known = own & (_FAMILY | _SOURCES)
    if known or len(files) < 2:  # every word is in all names of a single file
        return known
    shared = {word for word in own.intersection(*words) if not word.isdigit()}
    return shared if len(shared) == 1 else set()


def _words(path: Path) -> tuple[str, ...]:
    return parse(path.stem).words
