"""DIRT with retainment and SAFETY, as an OMPL planner plugin and as a solver without OMPL.

    from ompl_ext import DIRT, Goal, Workspace, box, simple_setup

A name is imported when it is first used: `import ompl_ext` loads neither numba nor OMPL.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from ompl_ext.obstacles import Workspace as Workspace
    from ompl_ext.obstacles import box as box
    from ompl_ext.planner import DIRT as DIRT
    from ompl_ext.query import Goal as Goal
    from ompl_ext.query import Safety as Safety
    from ompl_ext.query import Settings as Settings
    from ompl_ext.solver import DirtSolver as DirtSolver
    from ompl_ext.system import simple_setup as simple_setup
    from ompl_ext.trigonometry import atan as atan
    from ompl_ext.trigonometry import cos as cos
    from ompl_ext.trigonometry import sin as sin
    from ompl_ext.trigonometry import tan as tan
    from ompl_ext.validity import SafetyValidityChecker as SafetyValidityChecker
    from ompl_ext.vehicle import Footprint as Footprint
    from ompl_ext.vehicle import Vehicle as Vehicle
    from ompl_ext.vehicle import derivative as derivative
    from ompl_ext.verification import verify as verify

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "obstacles": ["Workspace", "box"],
        "planner": ["DIRT"],
        "query": ["Goal", "Safety", "Settings"],
        "solver": ["DirtSolver"],
        "system": ["simple_setup"],
        "trigonometry": ["atan", "cos", "sin", "tan"],
        "validity": ["SafetyValidityChecker"],
        "vehicle": ["Footprint", "Vehicle", "derivative"],
        "verification": ["verify"],
    },
)
