"""Fits of terms that act with the square of their parameter, which logs do not show near 0."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.synthetic_logs import synthetic_logs
from kraft.sysid import Settings
from kraft.sysid.multistep import fit
from kraft.sysid.optimiser import RhoFactors
from kraft.sysid.structure import StructureSearch
from kraft.vehicles.config import load_vehicle_config

TRUTH = {"steer": 0.47, "a_drive": 4.0, "damping": 0.26, "delay": 0.12, "asymmetry": 0.2, "lever": -0.36}


def test_the_prior_of_a_term_that_logs_do_not_show_hinders_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without saturation and limit of the servo, their priors move both far: all steps had to be as short as theirs."""
    vehicle = load_vehicle_config("car-lag")
    off = {name: spec.neutral for name, spec in vehicle.parameters.items() if spec.neutral is not None}
    truth = {**off, **TRUTH}
    logs = synthetic_logs(vehicle, truth, range(5), seconds=8.0, noise=(0.003, 0.006), rate=20.0)
    search = StructureSearch(vehicle, logs, Settings(), lambda *_: None)
    search.growth = np.full(3, 0.0045)
    graph = search.graph(search.candidates)
    p = graph.problem.parameters
    first = {**truth, "delay": 0.0}
    start = graph.start(np.array([first.get(name, value) for name, value in zip(p.names, p.nominal, strict=True)]))
    assert fit(graph, start, 20).cost < 520.0
    monkeypatch.setattr(RhoFactors, "led_by_prior", np.zeros(len(p.names), dtype=bool))
    assert fit(graph, start, 20).cost > 1000.0
