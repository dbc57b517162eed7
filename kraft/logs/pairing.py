"""Pairs of CSV files, with commands and with poses, that form a log by their names or those of their folders."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Final

from kraft.errors import Code, Diagnostic
from kraft.logs.names import COMMAND, POSE, parse
from kraft.text import counted

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


def pair_across_folders(
    commands: Sequence[Path], poses: Sequence[Path]
) -> tuple[list[tuple[Path, Path]], dict[Path, tuple[list[Path], list[Path]]]]:
    """Pair files with commands and files with poses in folders beside each other (`cmd/run_01`, `mocap/run_01`).

    Two form a pair whose names, and those of their folders, are the same without the words for commands and poses and
    for what they come from, if no third file has these names too.  The name of each folder must have such a word: files
    of the same name in `run_1` and `run_2` are of different drives.

    Returns:
        The pairs, and by the folder around theirs the files of such folders that are in none, with commands and with
        poses, where there are both kinds of files.
    """
    known = _FAMILY | _SOURCES

    def drive(path: Path) -> Hashable:
        return path.parent.parent, *(tuple(w for w in _words(each) if w not in known) for each in (path.parent, path))

    said = tuple([path for path in kind if known.intersection(_words(path.parent))] for kind in (commands, poses))
    pairs = [pair for pair in _equal(said[0], said[1], drive) if pair[0].parent != pair[1].parent]
    paired = {path for pair in pairs for path in pair}
    with_commands, with_poses = ({path.parent.parent for path in kind} for kind in said)
    left: dict[Path, tuple[list[Path], list[Path]]] = {}
    for kind, paths in enumerate(said):
        for path in paths:
            if path not in paired and path.parent.parent in with_commands & with_poses:
                left.setdefault(path.parent.parent, ([], []))[kind].append(path)
    return pairs, left


def unpaired(folder: Path, commands: Sequence[Path], poses: Sequence[Path]) -> Diagnostic:
    """Problem of the files of a folder, or of folders in it, with commands alone and with poses alone without a pair.

    One of the two kinds may be empty.
    """
    kinds = [(what, paths) for what, paths in (("commands", commands), ("poses", poses)) if paths]
    (what, first), *second = kinds
    count = f"{counted(len(first), 'file')} {_have(first)} {what}"
    if second:
        count += f" and {len(poses)} {_have(poses)} poses"
        why = "their names do not pair"
    else:
        other = "poses" if what == "commands" else "commands"
        why = f"no file with {other} pairs with {'it by its name' if len(first) == 1 else 'them by their names'}"
    examples = ", ".join(paths[0].relative_to(folder).as_posix() for _, paths in kinds)
    more = ", ..." if second or len(first) > 1 else ""
    expected = "expected names such as X_cmd.csv and X_pose.csv, X being the drive, or a folder for each drive"
    if any(path.parent != folder for path in (*commands, *poses)):
        expected = "expected the same names in both folders, such as cmd/X.csv and mocap/X.csv, X being the drive"
    return Diagnostic(str(folder), f"{count}, but {why} ({examples}{more})", expected, code=Code.MISSING)


def _have(files: Sequence[Path]) -> str:
    return "has" if len(files) == 1 else "have"


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
