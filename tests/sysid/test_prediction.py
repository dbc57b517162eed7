"""Errors of open-loop predictions: of those that diverge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from support.sysid import fake_evaluation, fake_identification, fake_log, fake_windows

from kraft.sysid import prediction
from kraft.sysid.acceptance import PredictionPair, objections
from kraft.sysid.data import LogSplit
from kraft.sysid.prediction import predict_windows
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
