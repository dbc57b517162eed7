"""Compare methods over many trials, with intervals.

python examples/03_compare.py
"""

import kraft
from kraft.evaluation import markdown

if __name__ == "__main__":  # worker processes import this file
    found = kraft.evaluate(["turns"], ["oneshot-geometric", "kraft"], trials=3, seed=1000)
    print(markdown(found.summary))
    for row in found.rows:
        if row.outcome != "success":
            print(f"{row.scenario}, {row.method}, seed {row.seed}: {row.outcome} after {row.t_s:.2f} s")
