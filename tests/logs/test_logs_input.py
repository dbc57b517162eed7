"""What a program may pass wrongly to `read_logs`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from kraft.errors import InputError
from kraft.logs.reader import read_logs


@pytest.mark.parametrize(
    ("named", "argument"),
    [
        ({"paths": [1]}, "paths"),
        ({"paths": b"logs"}, "paths"),
        ({"paths": "logs", "controls": "throttle"}, "controls"),
        ({"paths": "logs", "controls": ()}, "controls"),
        ({"paths": "logs", "mapping": "columns.yaml"}, "mapping"),
    ],
)
def test_what_is_of_another_type_is_refused_by_its_name(named: dict[str, Any], argument: str) -> None:
    with pytest.raises(TypeError, match=f"^{argument}: expected"):
        read_logs(**named)


@pytest.mark.parametrize("paths", ["", [""], np.array([""])])
def test_an_empty_name_is_not_the_working_directory(paths: Any) -> None:
    with pytest.raises(InputError, match="there is an empty name"):
        read_logs(paths)
