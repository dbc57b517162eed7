"""A state that no pose shows, such as the angle of a trailer: it neither spoils nor changes what is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kraft.recording.manoeuvres import Manoeuvre
from kraft.sysid.information import known_before
from kraft.sysid.interface import Noise
from ompl_ext import Footprint, Vehicle, cos, derivative, sin, tan
from ompl_ext.vehicle import ParameterRange

Values = tuple[float, ...]


@derivative
def tractor(x: Values, u: Values, p: Values) -> Values:
    """A tractor alone."""
    _, _, theta, v = x
    return v * cos(theta), v * sin(theta), v * tan(u[1]) / p[0], (u[0] - v) / p[1]


@derivative
def with_trailer(x: Values, u: Values, p: Values) -> Values:
    """The same with a trailer, whose angle grows astern."""
    _, _, theta, v, hitch = x
    turning = v * tan(u[1]) / p[0]
    return v * cos(theta), v * sin(theta), turning, (u[0] - v) / p[1], -v * sin(hitch) / 2.0 - turning


ALONE = Vehicle(
    name="tractor",
    derivative=tractor,
    state=("x", "y", "theta", "v"),
    controls={"speed": (-1.0, 2.0), "steering": (-0.6, 0.6)},
    parameters={"wheelbase": 1.2, "tau": 0.6},
    ranges={"wheelbase": ParameterRange(0.9, 1.5, 0.05), "tau": ParameterRange(0.2, 2.0, 0.15)},
    footprint=Footprint(4.0, 1.3, -0.8),
    top_speed=2.0,
)
HITCHED = replace(ALONE, name="hitched", derivative=with_trailer, state=(*ALONE.state, "hitch"))


def test_a_state_that_no_pose_shows_takes_nothing_from_the_information_of_a_drive() -> None:
    generator = np.random.Generator(np.random.PCG64(0))
    times = np.arange(0.0, 16.0, 2.0)
    drives = [Manoeuvre("any", times, generator.uniform((-1.0, -0.6), (2.0, 0.6), (8, 2)), 18.0) for _ in range(20)]
    alone, hitched = (
        known_before(vehicle, Noise(0.005, 0.02), 30.0).simulate(drives).information[:, :2, :2]
        for vehicle in (ALONE, HITCHED)
    )
    size = np.sqrt(np.einsum("nii->ni", alone))
    assert np.abs((hitched - alone) / (size[:, :, None] * size[:, None, :])).max() < 1e-5
