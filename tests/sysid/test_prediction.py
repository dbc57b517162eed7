"""Errors of open-loop predictions: of those that diverge, and of few poses a second or short logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from support.sysid import fake_evaluation, fake_identification, fake_log, fake_windows

from kraft.errors import Code, InputError
from kraft.logs.log import Log, Part
from kraft.sysid import prediction
from kraft.sysid.acceptance import PredictionPair, objections
from kraft.sysid.data import LogSplit
from kraft.sysid.interface import Settings
from kraft.sysid.prediction import Window, pieces_of, predict_windows, window_errors
from kraft.sysid.vehicle_file import identification_record
from kraft.vehicles.load import load_vehicle

LOGS = tuple(fake_log(f"run_{k}", 0.1 * k) for k in range(1, 5))


@pytest.mark.parametrize("far", [np.nan, np.inf, 1e12])
def test_initial_values_that_diverge_are_worse_than_those_that_predict_well_and_have_numbers(
    far: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverging(pieces: Sequence[prediction.Piece], *_: object) -> list[np.ndarray]:
        return [np.full((each.ahead.stop - each.ahead.start, 3), far) for each in pieces]

    monkeypatch.setattr(prediction, "_with_states", diverging)
    split, held_out = LogSplit(LOGS[:3], LOGS[3:], ""), LOGS[3:]
    initial = predict_windows(load_vehicle("mushr"), held_out)
    unseen = PredictionPair(fake_windows(held_out, 0.01), initial, fake_windows(held_out, 0.2))
    assert 1e5 < unseen.initial_errors.overall_position < 1e6
    result, evaluation = fake_identification(LOGS[:3]), replace(fake_evaluation(split), held_out=unseen)
    assert objections(result, evaluation) == ()
    record = identification_record("mushr", result, split, evaluation)
    assert record.held_out_before is not None
    assert record.held_out_before.overall_position == pytest.approx(unseen.initial_errors.overall_position)


def test_the_pose_at_which_a_window_begins_is_no_prediction() -> None:
    """Poses 1.4 s apart: that at the beginning is nearer to 1 s than their distance."""
    times = np.array([0.0, 1.4, 2.8])
    predicted = np.column_stack([0.1 * times, np.zeros(3), np.zeros(3)])
    errors = window_errors([Window("log", times, np.zeros((3, 3)), predicted)])
    assert errors.position[1.0] == pytest.approx(0.14)


@pytest.mark.parametrize(("apart", "poses", "problem"), [(0.1, 8, "shorter than a second"), (1.6, 60, "three poses")])
def test_logs_that_cannot_be_predicted_are_refused_with_the_reason(apart: float, poses: int, problem: str) -> None:
    times = apart * np.arange(poses)
    part = Part(times[:1], np.array([[0.5, 0.0]]), times, np.column_stack([0.5 * times, 0.0 * times, 0.0 * times]))
    with pytest.raises(InputError) as caught:
        pieces_of([Log("log", (), ("throttle", "steering"), (part,))], Settings())
    (found,) = caught.value.diagnostics
    assert (found.code, problem in found.problem) == (Code.DATA, True)
