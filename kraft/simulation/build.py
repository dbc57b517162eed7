"""From a scenario to a compiled MuJoCo model."""

from __future__ import annotations

import warnings
from typing import Any

import mujoco

from kraft.scenario import Scenario
from kraft.simulation import appearance
from kraft.simulation.car import GRAVITY, add_car
from kraft.simulation.car_looks import add_car_looks
from kraft.simulation.floor_frame import FloorFrame
from kraft.simulation.scene import add_scene


def build(scenario: Scenario, frame: FloorFrame, timestep: float) -> Any:
    """Compile the world of a scenario; returns a `mujoco.MjModel`."""
    spec = mujoco.MjSpec()
    spec.modelname = scenario.name
    spec.compiler.degree = False
    option = spec.option
    option.timestep = timestep
    option.gravity = [0.0, 0.0, -GRAVITY]
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    # a world that blows up must be an error, not silently its own start
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if scenario.truth.movable_boxes:
        option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP  # boxes that nobody has touched cost nothing
        # the car and each box share few rows: while it pushes, steps take up to a quarter less than with full matrices
        option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    else:
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND  # a single body needs no looking for groups
    appearance.add_materials(spec)
    appearance.add_light(spec, scenario)
    ground = add_scene(spec, scenario, frame)
    appearance.add_surroundings(spec, ground, scenario, frame)
    add_car_looks(spec, add_car(spec, scenario.truth.vehicle))
    with warnings.catch_warnings():  # a box that touches the car is awake from the start, as it should be
        warnings.filterwarnings("ignore", message=".*could be slept")
        return spec.compile()
