"""Poses in the plane from what a stream has: x, y and a yaw, or x, y and an orientation."""

from __future__ import annotations

from typing import Final

import numpy as np

from kraft.logs import reports
from kraft.logs.findings import Findings
from kraft.logs.log import Array
from kraft.logs.samples import Samples

UPRIGHT: Final = 0.7
"""Cosine of the tilt beyond which a vehicle does not stand on its wheels."""


def planar(poses: Samples, findings: Findings) -> tuple[Samples, Array]:
    """Poses that have an orientation, and these as x, y and yaw, shape (n, 3).

    Raises:
        InputError: if none has.
    """
    if poses.stream.roles[2] == "yaw":
        return poses, poses.values
    none = np.linalg.norm(poses.values[:, 2:], axis=1) < 0.5  # trackers write zeros when they see nothing
    if none.all():
        columns = ", ".join(channel.column for channel in poses.stream.channels[2:])
        raise poses.refuse(f"{columns} are no orientation", "expected a quaternion of length 1", 0)
    reports.left_out("nan", poses, none, "have no orientation", findings)
    poses = poses.keep(~none)
    x, y, z, w = (poses.values[:, 2:] / np.linalg.norm(poses.values[:, 2:], axis=1, keepdims=True)).T
    if np.median(1 - 2 * (x * x + y * y)) < UPRIGHT:
        findings.add("tilted", 1, f"{poses.stream.table.name}: the vehicle does not stand upright; is z not up?")
    yaw = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return poses, np.column_stack([poses.values[:, :2], yaw])
