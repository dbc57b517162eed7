"""Identify a car from logs, test the parameters on logs that were not used, and plan with them.

kraft record --runs 8 --out logs
python examples/04_identify.py logs
"""

import sys

import kraft
from kraft.sysid import prediction_errors
from kraft.vehicles.config import load_vehicle_config

if len(sys.argv) != 2:
    sys.exit("usage: python examples/04_identify.py LOGS, as kraft record --out LOGS writes them")
config = load_vehicle_config("mushr-lag")
logs = kraft.read_logs(sys.argv[1]).logs
used, unseen = logs[::2], logs[1::2]
found = kraft.identify("mushr-lag", used)

for name, p in found.parameters.items():
    print(f"{name:10} {p.value:8.4f} {p.unit:4} 95 % interval {p.ci95[0]:.4f} to {p.ci95[1]:.4f}")
for warning in found.warnings:
    print("warning:", warning)
for name, values in (("before", config.values), ("identified", found.values)):
    errors = prediction_errors(config, unseen, values).position
    print(f"{name:10}", "  ".join(f"{100 * error:.1f} cm after {t:g} s" for t, error in errors.items()))

own = {name: value for name, value in found.values.items() if name in config.values}
vehicle = kraft.load_vehicle("mushr-lag", parameters=own)
print(f"plan with it: {kraft.plan('turns', vehicle, iterations=2000).plan.cost:.2f} s")
