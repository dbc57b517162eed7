"""Slope of the floor: how a camera that takes it as level sees it, and what a drive tells about it.

The slope is part of rho, the parameters that the online window identifies, beside the force that drives the vehicle.
Poses tell about it: on a slope a vehicle that drives steadily seems to become faster or slower with its place.  So does
the force, which is that of the slope, up to forces that come and go.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from kraft.driving.estimation.camera_model import CameraModel
from kraft.sysid.parameters import Parameters, ParameterSpec
from kraft.sysid.problem import ObservationModel
from kraft.vehicles import STEEPEST, felt_gravity
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.names import FORCE
from ompl_ext.vehicle import Vehicle

SLOPE: Final = ("floor_x", "floor_y")
"""Names of the slope of the floor in rho: rise per metre of floor along x and along y."""


def slope_deviations(vehicle: Vehicle) -> Floats:
    """Standard deviations (2,) of the floor's slope by the ranges of the force."""
    return np.array([vehicle.ranges[name].std for name in FORCE]) / felt_gravity(vehicle)


def shows_slope(vehicle: Vehicle) -> bool:
    """Whether a force that is estimated tells the slope: the vehicle states its share of gravity."""
    return vehicle.gravity_share is not None and not any(vehicle.ranges[name].is_known for name in FORCE)


def slope_specs(vehicle: Vehicle) -> list[ParameterSpec]:
    """The slope as auxiliary parameters, with the prior by the ranges of the force."""
    stds = slope_deviations(vehicle)
    return [
        ParameterSpec(name, 0.0, -STEEPEST, STEEPEST, float(std), "", "") for name, std in zip(SLOPE, stds, strict=True)
    ]


def possible(slope: Floats) -> Floats:
    """Slope of a floor (2,), at most `STEEPEST`, in the direction of an estimated one."""
    return slope * min(1.0, STEEPEST / max(float(np.linalg.norm(slope)), 1e-9))


class SlopingObservationModel(ObservationModel):
    """Poses of a vehicle on a floor of which rho has the slope, as a camera measures them that takes it as level."""

    def __init__(self, parameters: Parameters, camera: CameraModel) -> None:
        """Take rho as that of `parameters`."""
        super().__init__(parameters)
        self._camera = camera
        self._slope = [parameters.auxiliary_index(name) for name in SLOPE]
        self._pose = [parameters.vehicle.index(name) for name in ("x", "y", "theta")]

    def predict(self, states: Matrix, rho: Floats) -> Matrix:
        """Poses (n, 3) measured of states (n, nx)."""
        poses = super().predict(states, rho)
        poses[:] = self._camera.seen(poses, rho[self._slope])
        return poses

    def linearise(self, states: Matrix, rho: Floats) -> tuple[Matrix, Floats, Floats]:
        """Poses (n, 3) measured of states (n, nx), and their derivatives by state (n, 3, nx) and by rho (n, 3, np)."""
        poses, jacobians = self._camera.linearised(super().predict(states, rho), rho[self._slope])
        by_state, by_rho = np.zeros((len(states), 3, states.shape[1])), np.zeros((len(states), 3, len(rho)))
        by_state[:, :, self._pose], by_rho[:, :, self._slope] = jacobians[:, :, :3], jacobians[:, :, 3:]
        return poses, by_state, by_rho


def slope_told(
    parameters: Parameters, mean: Floats, covariance: Matrix, passing_force: Matrix
) -> tuple[Floats, Matrix]:
    """Mean (2,) and covariance (2, 2) of the slope, given those of rho, (np,) and (np, np), and that it is the force.

    The force is that of the slope up to `passing_force`, the covariance (2, 2) of forces that come and go.  It has the
    prior that the slope gives it then, in place of its own.
    """
    free = np.flatnonzero(parameters.free)
    force, slope = (np.searchsorted(free, [parameters.index(name) for name in names]) for names in (FORCE, SLOPE))
    difference = np.zeros((2, len(free)))  # of the force from that of the slope
    difference[range(2), force], difference[range(2), slope] = 1.0, felt_gravity(parameters.vehicle)
    weighed = difference.T @ np.linalg.inv(passing_force)
    prior = np.zeros(len(free))
    prior[force] = parameters.std[free][force] ** -2.0
    information = np.linalg.inv(covariance[np.ix_(free, free)]) - np.diag(prior) + weighed @ difference
    joined = np.asarray(np.linalg.inv(information), dtype=float)
    score = prior * (mean - parameters.nominal)[free] - weighed @ (difference @ mean[free])
    return (mean[free] + joined @ score)[slope], joined[np.ix_(slope, slope)]


class ConstantOfDrive:
    """Estimate of something that is the same in the whole drive, from windows that follow each other without overlap.

    Each window has the same prior, with mean 0.  What an update joins is the window and the result of the last update
    that ended before it, without the prior that both have.
    """

    def __init__(self, std: Floats) -> None:
        """`std` (n,) are the standard deviations of the prior."""
        self._prior = np.diag(std**-2.0)
        self._results: list[tuple[float, Matrix, Floats]] = []

    def update(self, begin: float, end: float, mean: Floats, covariance: Matrix) -> tuple[Floats, Matrix]:
        """Mean (n,) and covariance (n, n) after a window from `begin` to `end` (s) with its own mean and covariance."""
        information = np.asarray(np.linalg.inv(covariance), dtype=float)
        score = information @ mean
        while self._results and self._results[-1][0] >= end:  # the vehicle stands, or time was left out of the window
            self._results.pop()
        before = sum(result[0] <= begin for result in self._results)
        if before > 0:
            _, earlier, earlier_score = self._results[before - 1]
            information, score = information + earlier - self._prior, score + earlier_score
            del self._results[: before - 1]
        self._results.append((end, information, score))
        joined = np.asarray(np.linalg.inv(information), dtype=float)
        return joined @ score, joined
