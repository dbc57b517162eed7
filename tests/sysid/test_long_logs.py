"""Long logs: the search takes samples of them, and the last fit all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import qmc, rankdata
from support.cars import TRUTH, car, drive

from kraft.errors import InputError
from kraft.logs.log import Log
from kraft.sysid import Settings
from kraft.sysid.checks import _ranks
from kraft.sysid.initial_values import _halton
from kraft.sysid.log_motion import motions
from kraft.sysid.model_choice import _sampled
from kraft.sysid.structure import StructureSearch
from kraft.sysid.structure_choice import Structure
from kraft.sysid.terms import Searched, identify_terms
from kraft.sysid.windows import evenly
from kraft.vehicles.config import load_vehicle_config

MOST = 9


@pytest.fixture(scope="module")
def logs() -> list[Log]:
    return [drive(car(), seed, 20.0) for seed in range(5)]


def takes_the_same_terms(found: Searched, alike: Structure, own: StructureSearch) -> Searched:
    return found._replace(best=alike, trials=[*found.trials, alike])


def search(logs: list[Log], most: int) -> StructureSearch:
    return StructureSearch(load_vehicle_config("car"), logs, Settings(auxiliary="none"), lambda *_: None, None, most)


def test_the_search_uses_some_windows_of_every_log_and_the_last_fit_all_of_them(logs: list[Log]) -> None:
    some, every = search(logs, MOST), search(logs, 10**6)
    assert len(some.windows.segments) == MOST < len(every.windows.segments)
    assert {s.log for s in some.windows.segments} == set(range(len(logs)))
    assert np.array_equal(np.unique(some.windows.fold), np.arange(some.windows.folds))
    assert some.windows.poses.shape[0] == some.windows.first.poses.shape[0] == len(some.windows.h) == MOST
    structure = some.full()
    fitted, final = some.in_all_windows(structure)
    assert (fitted.terms, fitted.optimum.converged) == (structure.terms, True)
    assert len(fitted.graph.windows.segments) == len(final.windows.segments) == len(every.windows.segments)
    assert some.in_all_windows(structure)[1] is not some
    assert every.in_all_windows(fitted) == (fitted, every)


def test_parameters_are_those_of_all_windows(logs: list[Log], monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings(auxiliary="none")
    whole = identify_terms(load_vehicle_config("car"), logs, settings).identification
    monkeypatch.setattr(StructureSearch.__init__, "__defaults__", (None, 20))  # instead of `SEARCHED_WINDOWS`
    few = identify_terms(load_vehicle_config("car"), logs, settings).identification
    assert len(few.without_log) == len(logs)
    for name in ("a_drive", "damping", "steer"):
        assert few.values[name] == pytest.approx(whole.values[name], rel=0.02)


def test_the_simpler_model_is_fitted_to_all_windows_by_its_own_search(
    logs: list[Log], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(StructureSearch.__init__, "__defaults__", (None, 20))
    monkeypatch.setattr("kraft.sysid.terms.simplified", takes_the_same_terms)
    lags, none = (load_vehicle_config(name) for name in ("car-lag", "car"))
    found = identify_terms(lags, logs, Settings(), simpler=none)
    assert found.vehicle is none
    assert found.identification.values["a_drive"] == pytest.approx(TRUTH["a_drive"], rel=0.02)
    assert not {"tau_steer", "tau_yaw"} & found.identification.parameters.keys()


def test_logs_without_a_window_of_four_poses_are_refused(logs: list[Log]) -> None:
    (part,) = logs[0].parts
    rare = replace(part, pose_times=part.pose_times[::5].copy(), poses=part.poses[::5].copy())
    settings = Settings(horizon=0.5)
    with pytest.raises(InputError, match=r"no window of 0\.5 s with four poses"):
        identify_terms(load_vehicle_config("car"), [replace(logs[0], parts=(rare,))], settings)


def test_items_are_taken_evenly() -> None:
    assert evenly(range(5), 5) == evenly(range(5), 9) == [0, 1, 2, 3, 4]
    assert evenly(range(101), 3) == [0, 50, 100]


@pytest.mark.parametrize("seconds", [5.0, 19.0, 100.0])
def test_a_sample_of_a_log_is_as_long_as_asked_and_from_all_of_it(logs: list[Log], seconds: float) -> None:
    (part,) = logs[0].parts
    twice = replace(logs[0], parts=(part, replace(part, pose_times=part.pose_times[:100], poses=part.poses[:100])))
    sample = _sampled(twice, seconds)
    assert sum(p.duration for p in sample.parts) == pytest.approx(min(seconds, twice.duration), abs=0.2)
    middle = [0.5 * (p.pose_times[0] + p.pose_times[-1]) for p in sample.parts]
    assert np.mean(middle[:-1]) == pytest.approx(0.5 * part.duration, abs=0.2)


def test_a_part_is_smoothed_once(logs: list[Log]) -> None:
    first, again = motions(logs), motions(logs)
    assert all(a.times is b.times for a, b in zip(first, again, strict=True))
    assert np.array_equal(first[0].speed, again[0].speed)


def test_points_and_ranks_are_those_of_scipy() -> None:
    for dimensions in (1, 4, 28):
        assert np.array_equal(_halton(dimensions, 128), qmc.Halton(dimensions, scramble=False).random(128))
    values = np.random.default_rng(0).integers(0, 9, 60).astype(float)
    assert np.array_equal(_ranks(values), rankdata(values))
