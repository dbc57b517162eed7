"""How much to measure."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Effort:
    """Numbers of repetitions; the same code runs with all of them.

    Attributes:
        seeds: queries of each scene.
        repeats: rounds of a comparison; every round runs each of the things compared once.
        seconds: wall-clock time of one run in a comparison.
        nodes: size of the largest tree.
        cycles: queries in the search for leaks.
        processes: `kraft plan` processes.
        first_run: whether to compile all kernels anew, in an empty cache.
        scenes: random scenes.
        episodes: drives in the test of Theorem 1.
        jobs: processes that share the random scenes and trials; everything else runs alone.
        changes: trials with each change of the true car.
        estimated: drives in the test of Theorem 1 with an estimated deviation.
        again: further drives of each world in which one of these collides, with other seeds.
        estimates: drives in each kind of world in which the estimates are compared with the truth.
        arenas: random arenas and rooms of posts that are driven in.
        worlds: rooms of posts and tracks that fast robots drive in.
        headings: directions in which each scene's goal is arrived at.
        drives: drives of each scene as two processes.
        faults: drives with each fault.
        endurance: duration of the long drive over topics, s.
        method: method that drives where one is chosen.
        peer_trials: seeds of each row of the peers in each entry of the suites.
        peer_tuning: seeds of each setting of the peers in each entry in which they are tuned.
    """

    seeds: int
    repeats: int
    seconds: float
    nodes: int
    cycles: int
    processes: int
    first_run: bool
    scenes: int
    episodes: int
    jobs: int
    changes: int
    estimated: int
    again: int
    estimates: int
    arenas: int
    worlds: int
    headings: int
    drives: int
    faults: int
    endurance: float
    method: str = "adaptive-kraft"
    peer_trials: int = 1
    peer_tuning: int = 1


FULL = Effort(
    seeds=100,
    repeats=10,
    seconds=2.0,
    nodes=100_000,
    cycles=1000,
    processes=10,
    first_run=True,
    scenes=2000,
    episodes=2000,
    jobs=2,
    changes=100,
    estimated=10_000,
    again=6,
    estimates=40,
    arenas=100,
    worlds=120,
    headings=30,
    drives=10,
    faults=20,
    endurance=1800.0,
    peer_trials=10,
)
QUICK = Effort(
    seeds=20,
    repeats=3,
    seconds=0.5,
    nodes=100_000,
    cycles=100,
    processes=3,
    first_run=True,
    scenes=60,
    episodes=100,
    jobs=2,
    changes=4,
    estimated=40,
    again=6,
    estimates=3,
    arenas=4,
    worlds=12,
    headings=2,
    drives=1,
    faults=1,
    endurance=60.0,
)
SMOKE = Effort(
    seeds=1,
    repeats=1,
    seconds=0.02,
    nodes=3_000,
    cycles=3,
    processes=1,
    first_run=False,
    scenes=2,
    episodes=4,
    jobs=1,
    changes=1,
    estimated=2,
    again=1,
    estimates=1,
    arenas=1,
    worlds=1,
    headings=1,
    drives=1,
    faults=1,
    endurance=5.0,
)
