"""Your own controller in the tables: pure pursuit tracks KRAFT's plans, beside the law of adaptive-kraft.

Coulter: Implementation of the pure pursuit path tracking algorithm, 1992.

python examples/09_controller.py
"""

import math

import kraft
from kraft.driving.messages import Estimate, Reference
from kraft.driving.vehicle_model import VehicleModel
from ompl_ext.arrays import Floats

WHEELBASE = 0.29  # m


class PurePursuit:
    """Steers along the arc to where the plan is a little later; the throttle makes up for what the car lags behind."""

    def __init__(self, model: VehicleModel, lookahead: float = 0.6, gain: float = 2.0) -> None:
        """`lookahead` is in seconds, `gain` is throttle per metre."""
        if tuple(model.vehicle.controls) != ("throttle", "steering"):
            raise ValueError(f"this law is for cars, and {model.vehicle.name} has other controls")
        self._model, self._lookahead, self._gain = model, lookahead, gain

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Throttle and steering angle for the estimate's time."""
        x, y, theta = estimate.state[self._model.pose]
        forward = math.cos(theta), math.sin(theta)
        ahead = reference.state_at(estimate.time + self._lookahead)[self._model.pose]
        dx, dy = ahead[0] - x, ahead[1] - y
        alpha = math.atan2(dy, dx) - theta
        control = reference.control_at(estimate.time)
        control[1] = math.atan2(2.0 * WHEELBASE * math.sin(alpha), max(math.hypot(dx, dy), 0.1))
        now = reference.state_at(estimate.time)[self._model.pose]
        control[0] += self._gain * ((now[0] - x) * forward[0] + (now[1] - y) * forward[1])
        return control  # kraft keeps it within the bounds


if __name__ == "__main__":
    base = kraft.load_method("adaptive-kraft")
    controller = {"kind": "code", "code": PurePursuit, "settings": {"lookahead": 0.6}}
    own = base.model_copy(update={"name": "pure-pursuit", "title": "KRAFT + pure pursuit", "controller": controller})
    found = kraft.evaluate(["turns"], ["adaptive-kraft", own], trials=2, seed=1000)
    for result in found.summary.results:
        print(f"{result.method}: {result.success} of {result.trials} in {result.t_ex:.1f} s on average")
