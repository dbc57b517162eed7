"""The command that installs an extra fits to where kraft was installed from."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest

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
    text = None if origin is None else json.dumps(origin)
    monkeypatch.setattr(provenance, "distribution", lambda _: SimpleNamespace(read_text=lambda _: text))
    assert provenance.install_command("mpc") == command
