"""Names of the planners of `kraft plan`, with their descriptions."""

from __future__ import annotations

from typing import Final

PLANNERS: Final[dict[str, str]] = {
    "dirt": "Dominance-Informed Region Tree: asymptotically optimal and anytime, with retainment and SAFETY",
    "sst": "Stable Sparse Tree: asymptotically near-optimal and anytime, with the propagation and the checks of dirt",
    "rrt": "OMPL's Rapidly-exploring Random Tree",
    "est": "OMPL's Expansive Space Trees",
    "kpiece1": "OMPL's Kinodynamic Planning by Interior-Exterior Cell Exploration",
}
