"""The command that installs an extra fits to where kraft was installed from."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from support.paths import ROOT

from kraft import provenance

COMMIT = "0123456789abcdef"


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        (None, "pip install 'kraft[mpc]'"),
        ({"url": "file:///home/me/kraft", "dir_info": {"editable": True}}, "pip install -e '/home/me/kraft[mpc]'"),
        ({"url": "file:///my%20home/kraft", "dir_info": {}}, "pip install '/my home/kraft[mpc]'"),
        ({"url": "file:///x/kraft.whl", "archive_info": {}}, "pip install 'kraft[mpc] @ file:///x/kraft.whl'"),
        (
            {"url": "https://host/kraft.git", "vcs_info": {"vcs": "git", "commit_id": COMMIT}},
            f"pip install 'kraft[mpc] @ git+https://host/kraft.git@{COMMIT}'",
        ),
    ],
)
def test_an_extra_is_installed_from_where_kraft_came(
    origin: dict[str, object] | None, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed_from(None if origin is None else json.dumps(origin), monkeypatch)
    assert provenance.install_command("mpc") == command


@pytest.mark.parametrize("editable", [False, True])
def test_an_extra_of_a_clone_is_installed_with_its_constraints(
    editable: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "constraints.txt").touch()
    installed_from(json.dumps({"url": tmp_path.as_uri(), "dir_info": {"editable": editable}}), monkeypatch)
    option = "-e " if editable else ""
    assert provenance.install_command("mpc") == f"pip install -c {tmp_path}/constraints.txt {option}'{tmp_path}[mpc]'"


def test_pages_install_extras_with_the_command_of_the_readme() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), ROOT / "benchmarks" / "README.md"]
    found = [line for page in pages for line in re.findall(r"^.*pip install.*\[\w.*$", page.read_text(), re.MULTILINE)]
    assert len(found) > 5
    assert [line for line in found if "pip install -c constraints.txt " not in line] == []


def installed_from(origin: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let kraft have been installed from there: the content of its direct_url.json."""
    monkeypatch.setattr(provenance, "distribution", lambda _: SimpleNamespace(read_text=lambda _: origin))
