"""The simulated world: MuJoCo, and all that the planner does not know. The only room that reads `Scenario.truth`."""

from kraft.simulation.collision import Collision
from kraft.simulation.world import World

__all__ = ["Collision", "World"]
