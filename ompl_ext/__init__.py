"""DIRT with retainment and SAFETY as an OMPL planner plugin."""
