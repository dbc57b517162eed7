"""Messages of ``-v``: inputs of a command, and the duration of each stage."""

from __future__ import annotations

import time

from kraft.text import MessageSink
from ompl_ext.kernels.specialise import is_cached, vehicle_cache_folder
from ompl_ext.vehicle import Vehicle


class StageTimer:
    """Reports the duration of each stage of a command, from the construction on."""

    def __init__(self, detail: MessageSink) -> None:
        self.detail = detail
        self._began = time.perf_counter()

    def report(self, what: str) -> None:
        """Report the duration since the last stage, whose work was `what`."""
        now = time.perf_counter()
        self.detail(f"{what} in {now - self._began:.3f} s")
        self._began = now


def vehicle_details(vehicle: Vehicle) -> list[str]:
    """Lines with parameters, footprint and kernels of a vehicle; to be called before its kernels are compiled."""
    values = ", ".join(f"{name} {value:g}" for name, value in vehicle.parameters.items()) or "no parameters"
    shape = vehicle.footprint
    size = f"{shape.length:g} m x {shape.width:g} m, its centre at {shape.offset:g} m"
    kernels = "read from" if is_cached(vehicle) else "compiled into"
    return [
        f"vehicle {vehicle.name}: {values}",
        f"footprint {size}; top speed {vehicle.top_speed:g} m/s",
        f"kernels {kernels} {vehicle_cache_folder(vehicle)}",
    ]
