"""Compilation of the kernels for a vehicle on this machine: once, before the identification is timed."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from kraft.logs.log import Part
from kraft.sysid.chains import whole_segment
from kraft.sysid.elimination import is_cached
from kraft.sysid.fast_graph import FastGraph
from kraft.sysid.initial_values import smooth_chains
from kraft.sysid.observation import noise_model
from kraft.sysid.parameters import parameters_of
from kraft.sysid.problem import assemble, starting_point
from kraft.sysid.settings import Noise, Settings
from ompl_ext.jit import cache_root
from ompl_ext.kernels.specialise import are_steps_cached
from ompl_ext.vehicle import Vehicle


def ensure_compiled(vehicle: Vehicle, reference: str, info: Callable[[str], None]) -> None:
    """Compile the steps of the model and the elimination of the graph, unless their machine code is cached.

    Args:
        vehicle: the vehicle with the model.
        reference: name or file of the vehicle as the user gave it.
        info: receives a message before and after the compilation.
    """
    if are_steps_cached(vehicle) and is_cached():
        return
    info(f"compiling the model of {reference} for identification on this machine: once, about 8 s ...")
    began = time.perf_counter()
    _exercise(vehicle)
    info(f"compiled in {time.perf_counter() - began:.0f} s; kept in {cache_root()}")


def _exercise(vehicle: Vehicle) -> None:
    """Make one step of the graph of a short drive: kernels compile at their first call."""
    settings = Settings()
    times = np.array([0.0, 0.1])
    part = Part(times[:1], np.zeros((1, len(vehicle.controls))), times, np.zeros((2, 3)))
    parameters = parameters_of(vehicle, settings, ())
    noise = noise_model(vehicle, settings, Noise(0.01, 0.01))
    problem = assemble([whole_segment(part, 0, settings.step)], 1, parameters, noise)
    graph = FastGraph(problem)
    graph.linearise(starting_point(problem, smooth_chains(problem.chains), parameters.nominal))
    graph.reduce(0.0)
    graph.moved(np.zeros(len(parameters.names)))
