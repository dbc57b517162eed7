"""Which logs files and folders hold: each once, and one that cannot be read is a problem of its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from support.logs import drive, located, problems_of, same_drive, wide_columns, write_pair, write_wide

from kraft.errors import Code, InputError
from kraft.logs.discover import LogFiles, without_repeated
from kraft.logs.pairing import pair_files
from kraft.logs.reader import read_logs

MADE = drive()
WIDE = wide_columns(np.arange(0.025, 5.9, 0.025), MADE)


def test_a_folder_without_logs_is_refused_with_what_it_holds(tmp_path: Path) -> None:
    assert problems_of(tmp_path) == [f"{tmp_path.name} not-found"]
    (tmp_path / "notes.md").write_text("x")
    assert problems_of(tmp_path) == [f"{tmp_path.name} not-found"]
    assert problems_of(tmp_path / "notes.md") == ["notes.md mismatch"]
    assert problems_of(tmp_path / "note.md") == ["note.md not-found"]


def test_one_bad_log_is_a_problem_and_the_rest_is_read(tmp_path: Path) -> None:
    write_wide(tmp_path / "b" / "good.csv")
    write_wide(tmp_path / "good.csv")
    (tmp_path / "bad.csv").write_text("t,x\n1,2\n")
    (tmp_path / "worse.bag").write_bytes(b"#ROSBAG V2.0\n")
    found = read_logs(tmp_path)
    assert [log.name for log in found.logs] == ["good", "b/good"]
    assert {Path(problem.file).name for problem in found.problems} == {"bad.csv", "worse.bag"}


def test_logs_of_the_same_name_are_told_apart(tmp_path: Path) -> None:
    write_wide(tmp_path / "a" / "log.csv")
    write_wide(tmp_path / "b" / "log.csv")
    names = [log.name for log in read_logs([tmp_path / "a" / "log.csv", tmp_path / "b" / "log.csv"]).logs]
    assert len(set(names)) == 2


@pytest.mark.parametrize("again", [".", "logs", "logs/run_2", "logs/run_2/poses.csv", "link"])
def test_a_log_that_is_found_again_counts_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, again: str) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("run_1", "run_2"):
        write_pair(tmp_path / "logs" / name, MADE)
    (tmp_path / "link").symlink_to(tmp_path / "logs" / "run_2")
    before = ["logs"] if again != "." else []
    found = read_logs([*before, again])
    assert len(found.logs) == len({log.name for log in found.logs}) == 2
    (problem,) = found.problems
    assert problem.code == Code.DUPLICATE
    assert ("1 other log" in problem.problem) == (again == "logs")


def test_a_part_of_a_log_is_not_counted_besides_the_whole_wherever_it_stands(tmp_path: Path) -> None:
    part = LogFiles("b", "bag", (tmp_path / "a" / "1.mcap",))
    whole = LogFiles("a", "bag", (tmp_path / "a",))
    other = LogFiles("c", "csv", (tmp_path / "c.csv",))
    (tmp_path / "a").mkdir()
    for name in ("0.mcap", "1.mcap", "metadata.yaml"):
        (tmp_path / "a" / name).touch()
    for found in ([part, whole, other], [whole, other, part]):
        kept, (said,) = without_repeated(found)
        assert kept == [whole, other]
        assert said.file == str(tmp_path / "a" / "1.mcap")
    assert without_repeated([whole, other]) == ([whole, other], [])


def test_files_that_are_given_again_make_one_log(tmp_path: Path) -> None:
    write_pair(tmp_path, MADE)
    commands, poses = tmp_path / "commands.csv", tmp_path / "poses.csv"
    for paths in ([commands, poses, commands, poses], [commands, commands, poses], [poses, tmp_path]):
        found = read_logs(paths)
        same_drive(found.logs[0], MADE)
        assert len(found.logs) == 1
        assert len(found.problems) == 1
    wide = write_wide(tmp_path / "other" / "wide.csv")
    found = read_logs([wide, wide, wide])
    assert [log.name for log in found.logs] == ["wide"]
    assert located(found.problems, wide.parent) == ["wide.csv duplicate"]


def test_the_truth_alone_is_refused(tmp_path: Path) -> None:
    write_pair(tmp_path, MADE)
    (tmp_path / "truth.csv").write_text("t,x,y\n0,1,2\n")
    assert problems_of(tmp_path / "truth.csv") == ["truth.csv mismatch"]
    found = read_logs(sorted(tmp_path.iterdir()))
    same_drive(found.logs[0], MADE)
    assert len(found.problems) == 1


def test_no_path_is_no_log() -> None:
    with pytest.raises(InputError) as error:
        read_logs([])
    assert located(error.value.diagnostics, Path()) == ["logs missing"]


def test_a_folder_that_cannot_be_read_is_a_problem_and_the_rest_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_wide(tmp_path / "logs" / "a.csv")
    (tmp_path / "logs" / "closed").mkdir()
    entries = Path.iterdir

    def refused(self: Path) -> Iterator[Path]:
        if self.name == "closed":
            raise PermissionError(13, "Permission denied")
        return entries(self)

    monkeypatch.setattr(Path, "iterdir", refused)
    found = read_logs(tmp_path / "logs")
    assert [log.name for log in found.logs] == ["a"]
    assert located(found.problems, tmp_path) == ["logs/closed unreadable"]


def test_logs_without_the_columns_may_be_named_by_any_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a.csv", "b.csv"):
        Path(name).write_text("p,q\n1,2\n")
    with pytest.raises(InputError) as error:
        read_logs([tmp_path / "a.csv", "b.csv"])
    assert {Path(d.file).name for d in error.value.diagnostics} == {"a.csv", "b.csv"}


@pytest.mark.parametrize(
    ("commands", "poses", "name"),
    [
        ("run_0{}_pwm", "run_0{}_mocap", "run_0{}"),
        ("cmd_{}", "vicon_{}", "cmd_{}"),
        ("run{}_pwm", "run{}_poses", "run{}"),
        ("run_{}", "run_{}_mocap", "run_{}"),
        ("drive_{}_kestrel", "drive_{}_magpie", "drive_{}"),
        ("2024-05-0{}_esc", "2024-05-0{}_odom", "2024-05-0{}"),
    ],
)
def test_files_pair_by_what_is_left_of_their_names_without_the_words_of_a_kind(
    tmp_path: Path, commands: str, poses: str, name: str
) -> None:
    made = [drive(turn=turn) for turn in (1.0, -0.5, 0.7)]
    for number, each in enumerate(made, 1):
        write_pair(tmp_path, each, f"{commands.format(number)}.csv", f"{poses.format(number)}.csv")
    found = read_logs(tmp_path)
    assert not found.problems
    assert [log.name for log in found.logs] == [name.format(number) for number in (1, 2, 3)]
    for log, each in zip(found.logs, made, strict=True):
        same_drive(log, each)


@pytest.mark.parametrize(
    ("commands", "poses", "pairs"),
    [
        (["a_1_pwm", "b_1_pwm"], ["a_1_mocap", "c_1_mocap"], ["a_1"]),  # b and c are of drives, not of kinds
        (["run_1_pwm", "run_2_pwm"], ["run_3_mocap", "run_4_mocap"], []),
        (["run_1_pwm", "run_2_pwm"], ["run_1_mocap", "run_1_vicon", "run_2_mocap"], ["run_2"]),
        (["a_kestrel", "a_b_kestrel"], ["a_magpie", "a_b_magpie"], ["a", "a_b"]),
        (["servo_cmd", "esc_cmd"], ["servo_pose", "esc_pose"], ["esc", "servo"]),  # as before usual words were known
        (["lab_monday_1", "lab_monday_2"], ["tuesday_1", "tuesday_2"], []),  # two words differ
    ],
)
def test_files_pair_only_if_no_other_may_be_meant(
    tmp_path: Path, commands: list[str], poses: list[str], pairs: list[str]
) -> None:
    found = pair_files([tmp_path / name for name in commands], [tmp_path / name for name in poses])
    assert sorted(path.name.rpartition("_")[0] for path, _ in found) == pairs
    assert all(a.name.rpartition("_")[0] == b.name.rpartition("_")[0] for a, b in found)


@pytest.mark.parametrize(
    ("commands", "poses", "name"),
    [
        ("cmd/run_01.csv", "mocap/run_01.csv", "run_01"),
        ("day/commands/a_cmd.csv", "day/poses/a.csv", "day/a"),
        ("a_cmd/log.csv", "a_vicon/log.csv", "a/log"),
    ],
)
def test_files_pair_across_folders_that_are_named_by_what_they_hold(
    tmp_path: Path, commands: str, poses: str, name: str
) -> None:
    root = tmp_path / "logs"
    write_pair(root, MADE, commands, poses)
    (log,) = read_logs(root).logs
    assert log.name == name
    same_drive(log, MADE)


def test_files_of_folders_that_are_named_by_drives_do_not_pair(tmp_path: Path) -> None:
    write_pair(tmp_path, MADE, "run_1/log.csv", "run_2/log.csv")  # the poses of one, the commands of the other are lost
    with pytest.raises(InputError):
        read_logs(tmp_path)


def test_files_that_do_not_pair_are_one_problem_of_their_folder(tmp_path: Path) -> None:
    for number in (1, 2, 3):
        write_pair(tmp_path / "logs", MADE, f"a{number}_cmd.csv", f"b{number}_pose.csv")
    assert problems_of(tmp_path / "logs") == ["logs missing"]
    write_pair(tmp_path / "logs", MADE, "good_cmd.csv", "good_pose.csv")
    found = read_logs(tmp_path / "logs")
    assert [log.sources[0].file for log in found.logs] == [str(tmp_path / "logs" / "good_cmd.csv")]
    (problem,) = found.problems
    assert problem.problem.startswith("3 files have commands and 3 have poses, but their names do not pair")


def write_across(root: Path, commands: Sequence[str], poses: Sequence[str]) -> None:
    """Write files with commands in `cmd` and with poses in `mocap`."""
    for command, pose in zip(commands, poses, strict=True):
        write_pair(root, MADE, f"cmd/{command}.csv", f"mocap/{pose}.csv")


def test_files_in_folders_for_each_kind_that_do_not_pair_are_one_problem(tmp_path: Path) -> None:
    write_across(tmp_path / "d", ["run_01", "run_02", "run_03"], ["take_01", "take_02", "take_03"])
    for paths in ([tmp_path / "d"], [tmp_path / "d" / "cmd", tmp_path / "d" / "mocap"]):
        with pytest.raises(InputError) as error:
            read_logs(paths)
        (problem,) = error.value.diagnostics
        assert problem.file == str(tmp_path / "d")
        assert problem.code == Code.MISSING
        assert problem.problem == (
            "3 files have commands and 3 have poses, but their names do not pair "
            "(cmd/run_01.csv, mocap/take_01.csv, ...)"
        )


def test_a_file_in_a_folder_for_its_kind_that_lacks_the_other_file_is_a_problem_and_the_rest_is_read(
    tmp_path: Path,
) -> None:
    write_across(tmp_path, ["run_1", "run_2", "run_3"], ["run_1", "run_2", "run_3"])
    (tmp_path / "mocap" / "run_2.csv").unlink()
    found = read_logs(tmp_path)
    assert [log.name for log in found.logs] == ["run_1", "run_3"]
    (problem,) = found.problems
    assert problem.problem == "1 file has commands, but no file with poses pairs with it by its name (cmd/run_2.csv)"


def test_two_folders_for_each_kind_that_are_given_pair_and_count_once(tmp_path: Path) -> None:
    write_across(tmp_path, ["run_1", "run_2"], ["run_1", "run_2"])
    commands, poses = tmp_path / "cmd", tmp_path / "mocap"
    found = read_logs([commands, poses])
    assert [log.name for log in found.logs] == ["run_1", "run_2"]
    assert not found.problems
    for again in ([commands, poses, commands], [tmp_path, commands]):
        found = read_logs(again)
        assert len(found.logs) == 2
        assert [problem.code for problem in found.problems] == [Code.DUPLICATE]


def test_files_with_commands_alone_in_a_folder_for_them_name_the_missing_columns(tmp_path: Path) -> None:
    write_across(tmp_path, ["run_1"], ["run_1"])
    with pytest.raises(InputError) as error:
        read_logs(tmp_path / "cmd")
    assert all("no column" in problem.problem for problem in error.value.diagnostics)
