"""The planners a scenario or ``--planner`` can name."""

from __future__ import annotations

from typing import Final

PLANNERS: Final[dict[str, str]] = {
    "dirt": "Dominance-Informed Region Tree: asymptotically optimal and anytime, with retainment and SAFETY",
    "rrt": "OMPL's Rapidly-exploring Random Tree",
    "est": "OMPL's Expansive Space Trees",
    "kpiece1": "OMPL's Kinodynamic Planning by Interior-Exterior Cell Exploration",
}
