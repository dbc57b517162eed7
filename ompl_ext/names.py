"""What a name is, and names of parameters that have the same meaning in every vehicle."""

from __future__ import annotations

from typing import Final

SYMBOL: Final = "[A-Za-z_][A-Za-z0-9_]*"
"""Pattern of the names of state components, controls and parameters, as files and options state them."""
FORCE: Final = ("a_x", "a_y")
"""Parameters that are the acceleration by a force along x and y, m/s^2, as on a slope."""
