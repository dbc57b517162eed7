"""Logs that `kraft record` wrote of a vehicle with other controls than the one to identify."""

from __future__ import annotations

import json
from collections.abc import Sequence

from kraft.errors import Code, Diagnostic
from kraft.logs.discover import LogFiles
from kraft.sysid.base_vehicle import MANIFEST


def recorded_with_other_controls(candidates: Sequence[LogFiles], controls: Sequence[str]) -> Diagnostic | None:
    """The problem that all logs are recorded ones of vehicles with other controls; None if they are not."""
    found = [_recorded(candidate, controls) for candidate in candidates]
    if not found or any(each is None for each in found):
        return None
    models = list(dict.fromkeys(each for each in found if each is not None))
    driven, model = models[0]
    problem = f"is the first of {len(found)} logs" if len(found) > 1 else "is a log"
    expected = (
        f"expected --model {model}, the vehicle that drove" if model else "expected --model, the vehicle that drove"
    )
    return Diagnostic(
        str(candidates[0].place),
        f"{problem} with the controls {driven}; the vehicle to identify has {', '.join(controls)}",
        expected if len(models) == 1 else "expected logs of one vehicle, which --model names",
        code=Code.MISMATCH,
    )


def _recorded(candidate: LogFiles, controls: Sequence[str]) -> tuple[str, str] | None:
    """Controls and vehicle, as named when it was recorded, of a log; None of other logs, or if it has the controls."""
    try:
        manifest = json.loads((candidate.place / MANIFEST).read_text(encoding="utf-8"))
        heading = (candidate.place / "commands.csv").read_text(encoding="utf-8").splitlines()[0]
        reference = manifest["arguments"].get("vehicle", "")
    except (OSError, ValueError, RecursionError, KeyError, IndexError, TypeError, AttributeError):
        return None  # another program wrote it
    names = [name for name in heading.split(",") if name != "t"]
    return None if set(controls) <= set(names) else (", ".join(names), str(reference))
