"""Logs of a real car are read completely. They are not part of the package; without them these tests are skipped."""

from __future__ import annotations

import numpy as np
import pytest
from support.logs import REAL_LOGS, needs_real_logs

from kraft.logs.reader import read_logs

pytestmark = needs_real_logs


def test_all_runs_of_the_f1tenth_are_read_without_loss() -> None:
    found = read_logs(REAL_LOGS)
    assert found.problems == ()
    assert len(found.logs) == 41
    for log in found.logs:
        (part,) = log.parts
        assert log.findings == ()
        assert part.poses.shape == (121, 3)
        assert part.commands.shape == (121, 2)
        assert part.duration == pytest.approx(3.0)


def test_the_command_is_taken_and_not_the_measured_speed() -> None:
    for log in read_logs(REAL_LOGS).logs:
        assert "throttle from 'cmd_speed', steering from 'cmd_steer' (rad)" in log.guess
        assert np.abs(log.parts[0].commands[:, 1]).max() <= 0.2
