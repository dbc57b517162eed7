"""Warning of a goal with a heading or limits, for a method that nothing guides to them."""

from __future__ import annotations

from kraft.driving.method import Method
from kraft.scenario import Task


def unguided_goal(task: Task, method: Method) -> str:
    """What to say of a goal's heading and limits that the cost-to-go of the method does not know; else empty."""
    planner, goal = method.planner, task.goal
    asked = [name for name, given in (("heading", goal.heading is not None), ("limits", bool(goal.limits))) if given]
    if planner.type != "geodesic" or planner.cost_to_go != "position" or not asked:
        return ""
    return (
        f"{method.name} goes by a cost-to-go of positions, which does not know the goal's {' and '.join(asked)}: it "
        "may stand at the goal's place until the time limit; methods with a tree, such as adaptive-kraft, plan for it "
        "(planner.type dirt or sst)"
    )
