"""Check that the camera of a scenario sees the robot, before anything drives."""

from __future__ import annotations

from kraft.scenario import Scenario


def check_view(scenario: Scenario) -> None:
    """Check that a camera whose frames are rendered sees the marker at the start; the others see it everywhere.

    Raises:
        InputError: at `sensing.camera`.
    """
    if scenario.sensing.preset == "rendered":
        from kraft.simulation.floor_frame import FloorFrame  # loads the simulator
        from kraft.simulation.rendered_camera import check_sees

        check_sees(scenario, FloorFrame.of(scenario.truth.tilt))
