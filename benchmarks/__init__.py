"""Measurements of the planner against its targets and against OMPL's own planners: `python -m benchmarks`."""
