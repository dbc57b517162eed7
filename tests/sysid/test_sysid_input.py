"""What a program may pass to the identification wrongly, or in another form than usual."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from kraft.config import bundled
from kraft.errors import InputError
from kraft.logs.reader import read_logs
from kraft.sysid import Settings, identify
from kraft.sysid.data import screen_logs
from kraft.sysid.selection import check_settings
from kraft.vehicles.config import load_vehicle_config


@pytest.mark.parametrize(
    ("settings", "argument"),
    [
        (Settings(horizon=0.0), "settings"),
        (Settings(clock_offset=-1.0), "settings"),
        (Settings(iterations=0), "iterations"),
        (Settings(iterations=1.5), "iterations"),  # type: ignore[arg-type]
        (Settings(robust="x"), "settings"),  # type: ignore[arg-type]
        (Settings(values={"L": "1"}), "values"),  # type: ignore[dict-item]
        (Settings(auxiliary=["nothing"]), "auxiliary"),  # type: ignore[arg-type]
    ],
)
def test_settings_of_a_wrong_value_or_type_are_refused(settings: Settings, argument: str) -> None:
    with pytest.raises(InputError) as caught:
        check_settings(load_vehicle_config("mushr"), settings)
    assert [(each.file, each.argument) for each in caught.value.diagnostics] == [(argument, True)]


def test_lists_of_names_are_taken_as_tuples() -> None:
    settings = Settings(frozen=["L"], auxiliary=["delay"])  # type: ignore[arg-type]
    assert settings == Settings(frozen=("L",), auxiliary=("delay",))


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        (lambda: identify(3, ()), "vehicle"),  # type: ignore[arg-type]
        (lambda: identify("mushr", "logs"), "logs"),  # type: ignore[arg-type]
        (lambda: identify("mushr", ["run_01"]), "logs"),  # type: ignore[list-item]
        (lambda: identify("mushr", (), {"step": 0.1}), "settings"),  # type: ignore[arg-type]
        (lambda: Settings(frozen="L"), "frozen"),  # type: ignore[arg-type]
        (lambda: Settings(noise=0.01), "noise"),  # type: ignore[arg-type]
    ],
)
def test_what_is_of_another_type_is_refused_by_its_name(call: Callable[[], object], argument: str) -> None:
    with pytest.raises(TypeError, match=f"^{argument}: expected"):
        call()


def test_a_vehicle_may_be_the_path_of_its_file() -> None:
    with pytest.raises(InputError, match="there are none"):  # the vehicle is loaded before the logs are looked at
        identify(bundled.find("vehicle", "mushr"), ())


def test_a_copy_of_a_log_does_not_count_as_another_drive(tmp_path: Path) -> None:
    drive = "".join(f"{0.05 * k},{0.03 * k},0,0,0.5,0.1\n" for k in range(60))
    (tmp_path / "a.csv").write_text(f"t,x,y,yaw,throttle,steering\n{drive}")
    (tmp_path / "b.csv").write_text(f"t,x,y,yaw,throttle,steering\n{drive}\n")
    (tmp_path / "a copy.csv").write_bytes((tmp_path / "a.csv").read_bytes())
    screened = screen_logs(read_logs(tmp_path).logs)
    assert len(screened.logs) == 2
    (problem,) = screened.problems
    assert {problem.file, problem.problem.removeprefix("has the same files as ")} == {"a", "a copy"}
