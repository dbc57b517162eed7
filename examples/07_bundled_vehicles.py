"""Make the numbers of the bundled MuSHR cars: record training logs in simulation, and identify each model from them.

    python examples/07_bundled_vehicles.py --out identified            # logs, vehicle files and pages in a new folder
    python examples/07_bundled_vehicles.py --out identified --write    # and the bundled vehicle files anew

It does what these commands do, for each of the models:

    kraft record --runs 40 --out identified/logs
    kraft sysid identified/logs --model mushr --extras none --out identified/mushr.yaml --plot identified/mushr.png

The bundled model also decides where in the hall a run begins, so that new numbers may move a run, and that a number's
last digits: write once more, until nothing changes.
"""

from __future__ import annotations

import argparse
import sys
from itertools import takewhile
from pathlib import Path

from kraft.config import bundled
from kraft.files import write_whole
from kraft.sysid.vehicle_file import identification_record, vehicle_text
from kraft.vehicles.config import load_vehicle_config
from kraft_cli.work.record import RecordRequest, record_logs
from kraft_cli.work.sysid import SysidResult, run_sysid
from kraft_cli.work.sysid_report import parameter_table, prediction_table
from kraft_cli.work.sysid_request import SysidRequest

MODELS = ("mushr", "mushr-lag", "mushr-drive")


def say(text: str) -> None:
    """Tell how it goes."""
    print(text, file=sys.stderr)


def identified(model: str, logs: Path, folder: Path) -> SysidResult:
    """Identify one model; without extra parameters, because a planner knows the model's own alone."""
    out, plot = folder / f"{model}.yaml", folder / f"{model}.png"
    return run_sysid(SysidRequest((logs,), model, out=out, plot=plot, extras="none"), say, say)


def bundle(result: SysidResult) -> Path:
    """Write the bundled vehicle file anew: its comments, name, description, bounds and priors stay."""
    path = bundled.folder("vehicle") / f"{result.request.model}.yaml"
    before = load_vehicle_config(path)
    header = list(takewhile(lambda line: line.startswith("#"), path.read_text(encoding="utf-8").splitlines()))
    record = identification_record(result.request.model, result.identification, result.split, result.evaluation)
    text = vehicle_text(
        path.parent,
        before.name,
        before.description,
        header,
        result.base,
        result.identification.parameters,
        record,
        tighten=False,
    )
    write_whole(path, text.encode())
    return path


def show(result: SysidResult) -> None:
    """Print what came out."""
    print(f"{result.request.model}:")
    for heading, rows in (parameter_table(result), prediction_table(result)):
        widths = [max(map(len, column)) for column in zip(heading, *rows, strict=True)]
        for row in (heading, *rows):
            print("   ", "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    for warning in result.identification.warnings:
        print("    warning:", warning)


def main() -> int:
    """Record, identify, show, and write if asked to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="new folder for logs, vehicle files and pages")
    parser.add_argument("--runs", type=int, default=40, help="number of logs, 20 s each")
    parser.add_argument("--seed", type=int, default=0, help="seed of the logs")
    parser.add_argument("--write", action="store_true", help="write the bundled vehicle files anew")
    asked = parser.parse_args()
    logs = asked.out / "logs"
    record_logs(RecordRequest("training", logs, asked.runs, asked.seed), say)
    results = [identified(model, logs, asked.out) for model in MODELS]
    for result in results:
        show(result)
    doubtful = [result.request.model for result in results if result.objections]
    if doubtful:
        say(f"not identified: {', '.join(doubtful)}; nothing is bundled")
        return 1
    for result in results if asked.write else ():
        print("wrote", bundle(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
