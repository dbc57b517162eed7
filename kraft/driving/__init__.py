"""The robot while it drives: estimation, replanning, contingencies, control; the simulated world is not known here."""
