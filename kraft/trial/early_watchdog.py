"""Warning of a watchdog that stops the car before the replanner would commit a verified contingency."""

from __future__ import annotations

from kraft.driving.method import Method


def early_watchdog(method: Method) -> str:
    """What to say of a watchdog that is not longer than the patience of the replanner; else empty.

    Such a method is stricter and may drive as well, so it is not refused: a robot's `pose_age` may also be shorter.
    """
    planner = method.planner
    if planner.mode != "replanning" or planner.watchdog is None or planner.watchdog > planner.patience:
        return ""
    return (
        f"{method.name} has planner.watchdog {planner.watchdog:g} s and planner.patience {planner.patience:g} s: "
        "without poses the watchdog brakes, which nothing verifies, before the replanner commits a verified "
        "contingency; choose a watchdog that is longer than the patience"
    )
