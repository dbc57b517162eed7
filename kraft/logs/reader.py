"""Read logs: from files and folders to parts that system identification can use."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path

from kraft.errors import InputError
from kraft.logs.cleaning import clean
from kraft.logs.csv_table import read_csv
from kraft.logs.discover import Candidate, discover
from kraft.logs.guess import choose
from kraft.logs.log import Log, LogSet, Source
from kraft.logs.mapping import Mapping
from kraft.logs.table import Table

CONTROLS = ("throttle", "steering")


def read_logs(
    paths: str | Path | Iterable[str | Path],
    controls: Sequence[str] = CONTROLS,
    mapping: Mapping | None = None,
) -> LogSet:
    """Read every log in files and folders; a log that cannot be read is a problem of the set.

    Args:
        paths: files and folders, see ``docs/logs.md`` for what they may hold.
        controls: names of the vehicle's controls.
        mapping: what `load_mapping` returned, where the names of the columns say too little.

    Raises:
        InputError: if there is no log at all, or if none can be read; with every problem.
    """
    given = [paths] if isinstance(paths, str | Path) else list(paths)
    candidates, problems = discover([Path(path) for path in given], controls)
    logs = []
    for candidate in candidates:
        try:
            logs.append(read_log(candidate, controls, mapping or Mapping()))
        except InputError as error:
            problems += error.diagnostics
    if not logs:
        raise InputError(problems)
    return LogSet(tuple(logs), tuple(problems))


def read_log(candidate: Candidate, controls: Sequence[str], mapping: Mapping) -> Log:
    """Read one log.

    Raises:
        InputError: with everything that is wrong with it.
    """
    sources = []
    tables: list[Table] = []
    for path in candidate.files:
        content = path.read_bytes()
        sources.append(Source(str(path), hashlib.sha256(content).hexdigest()))
        tables.append(read_csv(path, content))
    choice = choose(tables, controls, mapping)
    parts, findings = clean(choice, controls, mapping)
    return Log(candidate.name, tuple(sources), tuple(controls), parts, findings, str(choice))
