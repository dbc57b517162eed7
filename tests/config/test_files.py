"""Writing a file whole or not at all, by kraft or by a library."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from support.diagnostics import raised

from kraft import files
from kraft.config import bundled
from kraft.errors import Code, InputError
from kraft.files import Replacement, path_from, write_whole
from kraft_cli.main import main
from kraft_cli.work.validate import check_file


def full_disk(_: int) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "plan.json"
    write_whole(path, b"before")
    monkeypatch.setattr(files.os, "fsync", full_disk)
    with pytest.raises(InputError, match=r"plan\.json: cannot be written: No space left on device"):
        write_whole(path, b"after")
    assert path.read_bytes() == b"before"
    assert [p.name for p in tmp_path.iterdir()] == ["plan.json"]


def test_a_library_writes_beside_the_file_that_it_replaces(tmp_path: Path) -> None:
    path = tmp_path / "new" / "film.mp4"
    with Replacement(path) as new:
        assert new.temporary.parent == path.parent
        assert not path.exists()
        new.temporary.write_bytes(b"film")
        new.commit()
    assert path.read_bytes() == b"film"
    assert list(path.parent.iterdir()) == [path]
    assert path.stat().st_mode & 0o777 == files.file_mode()


@pytest.mark.parametrize("error", [ValueError("a frame is missing"), KeyboardInterrupt()])
def test_an_error_of_the_library_leaves_what_was_there(error: BaseException, tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    write_whole(path, b"before")

    def interrupted_halfway() -> None:
        with Replacement(path) as new:
            new.temporary.write_bytes(b"half")
            raise error

    with pytest.raises(type(error)):
        interrupted_halfway()
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_broken_link_is_said_to_be_one(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").symlink_to("gone.yaml")
    (problem,) = raised(lambda: bundled.find("scenario", tmp_path / "scene.yaml"))
    assert (problem.file, problem.code) == (str(tmp_path / "scene.yaml"), Code.NOT_FOUND)
    assert "gone.yaml" in problem.problem
    assert "did you mean" not in problem.expected


def test_a_name_without_the_suffix_of_a_file_suggests_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lab.yaml").write_text("")
    (problem,) = raised(lambda: bundled.find("scenario", "lab"))
    assert problem.expected == "did you mean the file 'lab.yaml'?"


def test_a_file_in_the_way_of_a_folder_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot be written: .*/file is not a folder"):
        files.check_writable(tmp_path / "file" / "plan.json")
    with pytest.raises(InputError, match="cannot be written: "):
        write_whole(tmp_path / "file" / "plan.json", b"")


def test_a_path_in_a_file_has_no_folder_that_is_left_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("my/suites").mkdir(parents=True)
    Path("my/floor.yaml").write_text("nme: floor\n")
    Path("my/suites/s.yaml").write_text(
        "name: s\ndescription: d\nentries: [{name: a, scenario: ../floor.yaml}, {name: b, scenario: ../no.yaml}]\n"
    )
    Path("my/suites/m.yaml").write_text("name: m\ntitle: m\nbase: ../floor.yaml\n")
    Path("my/suites/v.yaml").write_text(f"base: {Path('..') / 'floor.yaml'}\n")
    found = [at for file in ("s", "m", "v") for at in _places(f"my/suites/{file}.yaml")]
    assert {at for at in found if "floor" in at} == {"my/floor.yaml"}


def _places(file: str) -> list[str]:
    return [problem.file for problem in check_file(file, lambda _: None).problems]


def test_a_path_through_a_link_keeps_its_way(tmp_path: Path) -> None:
    (tmp_path / "elsewhere" / "deep").mkdir(parents=True)
    (tmp_path / "my").mkdir()
    (tmp_path / "my" / "link").symlink_to(tmp_path / "elsewhere" / "deep")
    assert path_from(tmp_path / "my" / "link", "../floor.yaml") == tmp_path / "my" / "link" / ".." / "floor.yaml"
    assert path_from(tmp_path / "my", "../my/floor.yaml") == tmp_path / "my" / "floor.yaml"
    assert path_from(tmp_path, "a\0b") == tmp_path / "a\0b", "reported by who opens it"


def test_a_problem_of_a_scenario_is_printed_once_beside_the_suites_that_have_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("floor.yaml").write_text("nme: floor\n")
    for name in ("one", "two"):
        Path(f"{name}.yaml").write_text(f"name: {name}\ndescription: d\nentries: [{{name: a, scenario: floor.yaml}}]\n")
    assert main(["validate", "one.yaml", "two.yaml", "floor.yaml"]) == 2
    *problems, last = capsys.readouterr().err.splitlines()
    assert len(problems) == len(set(problems))
    assert last == f"{len(problems)} problems in 3 files"
