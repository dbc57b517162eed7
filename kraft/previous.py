"""An earlier plan to start from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kraft.errors import InputError
from ompl_ext.arrays import Floats
from ompl_ext.plan import Plan
from ompl_ext.vehicle import Vehicle


@dataclass(frozen=True)
class Previous:
    """Planning begins where `plan` is predicted to be after `elapsed` s, and keeps what is left of it.

    `origin` is the file it was read from, for messages and for the record.
    """

    plan: Plan
    elapsed: float = 0.0
    origin: str = "<built in code>"

    @property
    def state(self) -> Floats:
        """The state that the plan predicts after `elapsed` s, shape (nx,)."""
        plan = self.plan
        return np.array([np.interp(self.elapsed, plan.times, column) for column in plan.trajectory.T])

    def check(self, vehicle: Vehicle) -> None:
        """Check that the plan is one of `vehicle` and not over.

        Raises:
            InputError: if it is not.
        """
        plan = self.plan
        sizes, wanted = (plan.trajectory.shape[1], plan.controls.shape[1]), (len(vehicle.state), len(vehicle.controls))
        if sizes != wanted:
            problem = f"the plan has {sizes[0]} state components and {sizes[1]} controls"
            expected = f"expected a plan of {vehicle.name}, which has {wanted[0]} and {wanted[1]}"
            raise InputError.of(self.origin, problem, expected)
        if not 0.0 <= self.elapsed < plan.cost:
            problem = f"the plan is over after {plan.cost:.6g} s, asked for is {self.elapsed:.6g} s"
            raise InputError.of(self.origin, problem, f"expected from 0 to less than {plan.cost:.6g} s")
