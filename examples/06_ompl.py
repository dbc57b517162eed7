"""DIRT in a program of OMPL's: an ordinary `SimpleSetup` on which any other planner can be set as well.

python examples/06_ompl.py
"""

import numpy as np
from ompl import control as oc

from kraft.vehicles.mushr import MUSHR
from ompl_ext import DIRT, Goal, Workspace, box, simple_setup


def main() -> None:
    """Plan with DIRT and with RRT."""
    workspace = Workspace(bounds=((0, 5), (0, 5)), obstacles=(box((2.5, 2.0), (1.0, 3.0)),))
    setup = simple_setup(MUSHR, workspace, start=np.array([0.5, 0.5, 0, 0]), goal=Goal((4.5, 0.5), 0.25))
    information = setup.getSpaceInformation()
    for planner in (DIRT(information, cycle=1.0), oc.RRT(information)):
        setup.clear()
        setup.setPlanner(planner)
        print(f"{planner.getName():6} {setup.solve(0.5)}, {setup.getSolutionPath().length():.2f} s")


if __name__ == "__main__":  # OMPL's objects end with a function, not with the interpreter
    main()
