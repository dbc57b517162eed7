"""Names of parameters that have the same meaning in every vehicle."""

from __future__ import annotations

from typing import Final

FORCE: Final = ("a_x", "a_y")
"""Parameters that are the acceleration by a force along x and y, m/s^2, as on a slope."""
