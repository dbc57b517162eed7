"""State validity, exact clearance and SAFETY (Algorithm 2) for OMPL planners."""

from __future__ import annotations

import numpy as np
from ompl import base as ob
from ompl import control as oc

from ompl_ext.arrays import Floats
from ompl_ext.obstacles import Workspace
from ompl_ext.plan import Contingency
from ompl_ext.query import Safety, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle


class SafetyValidityChecker(ob.StateValidityChecker):
    """Validity checker of a compiled vehicle on a real-vector state space of the vehicle's components in their order.

    `isValid` and `clearance` are exact (FCL decides where the clearance field cannot), so that any OMPL planner can use
    them; `safety` is Algorithm 2.
    """

    def __init__(
        self, si: oc.SpaceInformation, vehicle: Vehicle, workspace: Workspace, safety: Safety | None = None
    ) -> None:
        super().__init__(si)
        self.vehicle, self.workspace, self.safety_settings = vehicle, workspace, safety or Safety()
        self._solver = DirtSolver(vehicle, workspace, None, self.safety_settings, Settings(), capacity=1)
        self._pose_indices = tuple(vehicle.index(name) for name in ("x", "y", "theta"))
        self._limits = [tuple(pair) for pair in self._solver.problem.limits.tolist()]

    def isValid(self, state: ob.State) -> bool:  # noqa: N802 (OMPL's name)
        """Whether the state is within the vehicle's and the workspace's limits and its footprint is free."""
        for k, (low, high) in enumerate(self._limits):
            if not low <= state[k] <= high:
                return False
        pose = self._pose(state)
        return self._solver.pose_slack(*pose) > 0.0 or not self._solver.exact.collides(*pose)

    def clearance(self, state: ob.State) -> float:
        """Exact distance between the footprint and the nearest obstacle (m); 0 in contact."""
        return self._solver.exact.distance(*self._pose(state))

    def delta(self, state: ob.State) -> float:
        """Clearance (m) that SAFETY requires at the state's speed where the cycle ends."""
        rest, safety = self.vehicle.rest_indices, self.safety_settings
        speed = state[rest[0]] if rest else 0.0
        return float(safety.clearance(np.array([speed]), np.array([safety.cycle]))[0])

    def safety(self, state: ob.State) -> Contingency | None:
        """SAFETY (Alg. 2): the first contingency manoeuvre that keeps delta(v) until standstill, or None.

        The result has the manoeuvre's name, trajectory and least slack.
        """
        return self.safety_from(self._array(state))

    def safety_from(self, state: Floats, after: float = 0.0) -> Contingency | None:
        """SAFETY of a state as an array (nx,); the contingency's times begin at `after` s."""
        return self._solver.contingency(state, after)

    def _array(self, state: ob.State) -> Floats:
        return np.array([state[k] for k in range(len(self._limits))])

    def _pose(self, state: ob.State) -> tuple[float, float, float]:
        x, y, theta = self._pose_indices
        return state[x], state[y], state[theta] if theta >= 0 else 0.0
