"""Plan a scene, check what the plan promises, and draw it.

python examples/01_plan.py
"""

from pathlib import Path

import kraft
from kraft.plot import plot_plan

scenario, vehicle = kraft.load_scenario("turns"), kraft.load_vehicle("mushr")
result = kraft.plan(scenario, vehicle, iterations=5000, seed=1)

print(f"{result.plan.cost:.2f} s to the goal, found in {1000 * result.progress.seconds:.0f} ms")
print(f"clearance {result.verification.min_clearance:.3f} m, exact")
print(f"contingency at the end of the first cycle: {result.plan.contingency.manoeuvre}")
for duration, control in zip(result.plan.durations, result.plan.controls, strict=True):
    print(f"  {duration:.2f} s", dict(zip(vehicle.controls, control.round(3).tolist(), strict=True)))

plot_plan(Path("turns.png"), scenario, vehicle, result.plan, result.tree)
