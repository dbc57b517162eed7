"""Simulated world in MuJoCo with everything that the planner does not know."""

import os

from kraft.errors import MissingDependency

try:
    import mujoco  # noqa: F401 - reads MUJOCO_GL, and raises any of these if it cannot use the value
except (ImportError, OSError, RuntimeError, AttributeError) as error:
    advice = f"; unset MUJOCO_GL, which is {os.environ['MUJOCO_GL']}" if "MUJOCO_GL" in os.environ else ""
    raise MissingDependency(f"the simulator, MuJoCo, does not load: {error}{advice}") from None

from kraft.simulation.contacts import Collision
from kraft.simulation.world import World

__all__ = ["Collision", "World"]
