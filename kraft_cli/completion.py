"""Completion of names by the shell; nothing that takes long is imported for it, because the shell waits.

``kraft --install-completion`` installs it.  The shell then runs kraft with `VARIABLE` set, and `complete` answers.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal

if TYPE_CHECKING:
    from kraft.config import bundled

Completer: TypeAlias = Callable[[str], list[str]]
"""Returns the words that begin as an incomplete one."""

VARIABLE: Final = "_KRAFT_COMPLETE"
"""Environment variable in which the shell asks for the completion of its command line."""


def complete(program: Any, terminal: Terminal, instruction: str) -> ExitStatus:
    """Print how the command line may continue; `instruction` is the value of `VARIABLE`."""
    from typer.completion import shell_complete

    return ExitStatus(shell_complete(program, {"obj": terminal}, "kraft", VARIABLE, instruction))


def words(*known: str) -> Completer:
    """Completer of some words."""

    def matching(incomplete: str) -> list[str]:
        return [word for word in known if word.startswith(incomplete)]

    return matching


def names(kind: bundled.Kind, *others: str) -> Completer:
    """Completer of the names of bundled files, and of other words that are allowed in their place."""

    def matching(incomplete: str) -> list[str]:
        from kraft.config import bundled

        return words(*bundled.names(kind), *others)(incomplete)

    return matching


def names_or_files(*kinds: bundled.Kind) -> Completer:
    """Completer of the names of bundled files of several kinds, and of the files beside them in the working directory.

    Without a name there are no words: the shell then completes files itself, also in other folders.
    """

    def matching(incomplete: str) -> list[str]:
        found = [name for kind in kinds for name in names(kind)(incomplete)]
        files = [path.name + "/" * path.is_dir() for path in sorted(Path().glob("[!.]*"))] if found else []
        return list(dict.fromkeys([*found, *words(*files)(incomplete)]))

    return matching


def comma_separated(completer: Completer) -> Completer:
    """Completer of the last one of several words with commas between them; none is proposed twice."""

    def matching(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",")
        return [f"{before}{comma}{word}" for word in completer(last) if word not in before.split(",")]

    return matching


def planners(incomplete: str) -> list[str]:
    """Complete the name of a planner."""
    from kraft.scenario.planners import PLANNERS

    return words(*PLANNERS)(incomplete)


scenarios: Final = names("scenario")
methods: Final = names("method")
vehicles: Final = names("vehicle")
suites: Final = names("suite")
robots: Final = names("robot")
checked: Final = names_or_files("scenario", "method", "vehicle", "robot", "suite")
WORLDS: Final = ("corridor", "rooms", "rows", "posts", "maze", "clutter", "track", "mixed")
"""Kinds of random worlds: those of `kraft.worlds.generate`, which takes long to import."""
worlds: Final = words(*WORLDS)
