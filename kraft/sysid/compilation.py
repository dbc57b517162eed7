"""Compile what identification needs for this machine and a vehicle: once, before its clock runs."""

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


def ensure_compiled(vehicle: Vehicle, asked: str, say: Callable[[str], None]) -> None:
    """Compile the model's steps and the graph's elimination, unless they were; `say` is told before and after.

    Args:
        vehicle: whose model it is.
        asked: name or file that it was asked for by.
        say: is told.
    """
    if are_steps_cached(vehicle) and is_cached():
        return
    say(f"compiling the model of {asked} for identification on this machine: once, about 8 s ...")
    began = time.perf_counter()
    _exercise(vehicle)
    say(f"compiled in {time.perf_counter() - began:.0f} s; kept in {cache_root()}")


def _exercise(vehicle: Vehicle) -> None:
    """Make one step of a graph of a drive of a moment: kernels compile when they are first called."""
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
