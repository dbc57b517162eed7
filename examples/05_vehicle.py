"""A skid-steered robot: commanded by the speeds of its two sides, which it follows with a lag.

kraft plan turns --vehicle examples/05_vehicle.py:VEHICLE
"""

from ompl_ext import Footprint, Vehicle, cos, derivative, sin


@derivative
def motion(x, u, p):
    """Speed and turning rate follow the two sides' commands."""
    _, _, theta, v, omega = x
    (left, right), (track, lag) = u, p
    dv, domega = (0.5 * (left + right) - v) / lag, ((right - left) / track - omega) / lag
    return v * cos(theta), v * sin(theta), omega, dv, domega


VEHICLE = Vehicle(
    name="skid-steer",
    derivative=motion,
    state=("x", "y", "theta", "v", "omega"),
    controls={"left": (-0.2, 0.6), "right": (-0.2, 0.6)},
    parameters={"track": 0.4, "lag": 0.3},
    rest=("v", "omega"),
    footprint=Footprint(length=0.5, width=0.36),
    top_speed=0.6,
)

if __name__ == "__main__":
    print(f"{VEHICLE.name} is planned with by: kraft plan turns --vehicle {__file__}:VEHICLE")
