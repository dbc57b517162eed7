"""Warnings of a camera that is too far away for the poses that it measures."""

import pytest

from kraft.config import bundled
from kraft.scenario import load_scenario
from kraft.simulation.camera import PRESETS
from kraft.trial.warnings import far_camera


@pytest.mark.parametrize(
    ("camera", "place"),
    [
        ([6.5, 3.0, 5.0], "0.3 m at the start (8.1 m from the camera)"),
        ([13.0, 3.0, 5.0], "1.5 m at the start"),
        ([30.0, 0.0, 5.0], "goal"),
    ],
)
def test_a_camera_beyond_the_measured_errors_is_said_with_how_wrong_its_poses_are(
    camera: list[float], place: str
) -> None:
    given = {"sensing.camera": camera}
    assert place in far_camera(load_scenario("boxes", given))
    assert far_camera(load_scenario("boxes", {**given, "sensing.preset": "planar"})) == ""


def test_the_bundled_scenarios_have_a_camera_within_the_measured_errors() -> None:
    assert [far_camera(load_scenario(name)) for name in bundled.names("scenario")] == [""] * len(
        bundled.names("scenario")
    )


def test_the_error_of_a_position_is_that_of_the_drawn_poses_of_a_marker_that_moves() -> None:
    noise = PRESETS["single-tag"]
    near, far = noise.position_error(4.8, 0.0), noise.position_error(13.9, 1.22)
    assert near == pytest.approx(0.042, abs=0.003)  # 26.7 mm along and 28.4 mm across the line of sight, mean 10 mm
    assert far > 1.5


def test_the_camera_of_a_recording_is_judged_by_the_farthest_corner() -> None:
    hall = load_scenario("boxes", {"sensing.camera": [0.0, 0.0, 5.0]})
    assert "at the farthest corner" in far_camera(hall, anywhere=True)
    assert far_camera(load_scenario("training"), anywhere=True) == ""
