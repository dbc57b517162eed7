"""Drive one trial in simulation and look at every cycle: what was committed, why, and how far the estimate was off.

python examples/02_drive.py
"""

import math

import kraft

spec = kraft.TrialSpec.load("bump", "filtered-kraft", seed=4)
result = kraft.run_trial(spec)

for cycle in result.cycles:
    steps = [step for step in result.steps if step.cycle == cycle.number]
    errors = [math.hypot(step.pose[0] - step.estimate[0], step.pose[1] - step.estimate[1]) for step in steps]
    print(
        f"{cycle.time:5.1f} s  {cycle.kind:11}  {cycle.cost_to_goal:5.2f} s to the goal  "
        f"clearance {cycle.clearance:.3f} m  estimate off by {max(errors, default=0.0):.3f} m  {cycle.reason}"
    )
print(f"{result.outcome} after {result.time:.2f} s, nearest to an obstacle {result.min_clearance:.3f} m")
