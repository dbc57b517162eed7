"""First plan of a process: prints the milliseconds from `start` to the first solution, for a scene and a seed."""

from __future__ import annotations

import sys
import time

from benchmarks.scenes import scene


def main(name: str, seed: int) -> None:
    """Plan once, in a solver that has just been made."""
    query = scene(name)
    dirt = query.dirt()
    began = time.perf_counter()
    dirt.start(query.start, seed)
    dirt.grow(stop=lambda: bool(dirt.progress.history))
    print(1e3 * (time.perf_counter() - began))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
