"""What the car has on board, and the watchdog that stops it without poses or messages.

The car tracks its newest message: a plan and, with `on_board: contingency`, a contingency after the end of its cycle.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from kraft.driving.messages import Commitment, Estimate, Reference, ReferenceKind
from kraft.driving.planner_settings import PlannerSettings
from kraft.driving.references import manoeuvre_reference
from kraft.driving.vehicle_model import VehicleModel, braking_control
from ompl_ext.arrays import Floats
from ompl_ext.query import Safety
from ompl_ext.times import SAME_TIME


class OnBoard:
    """Commitment that the car tracks, and the watchdog.

    The watchdog intervenes if the newest observation is too old, or if the car is on a plan and no message has arrived
    for longer than a cycle and the watchdog's time.  The car then brakes from its estimated state, with the wheels as
    they are, until a message arrives that was decided after that, with a recent observation.
    """

    def __init__(self, settings: PlannerSettings, safety: Safety, model: VehicleModel, commitment: Commitment) -> None:
        """Begin with the `commitment` of the replanner's `begin`; `safety` defines standstill."""
        self._limit = math.inf if settings.watchdog is None else settings.watchdog
        self._silence = settings.cycle + self._limit
        self._safety, self._model = safety, model
        self.commitment, self._arrived, self._stopped = commitment, math.inf, -math.inf
        self.stops = 0
        self.is_stopping = False

    def receive(self, commitment: Commitment, estimate: Estimate) -> None:
        """Take a message; a car that the watchdog stops refuses it if it is older than the stop, or poses are."""
        if self.is_stopping and (commitment.decided < self._stopped or self.is_blind(estimate)):
            return
        self.mirror(commitment, estimate.time)

    def mirror(self, commitment: Commitment, time: float) -> None:
        """Have on board what another computer of the car has on board since `time` (s)."""
        self.commitment, self._arrived, self.is_stopping = commitment, time, False

    @property
    def end(self) -> float:
        """Time at which what is on board ends, s."""
        following = self.commitment.contingency
        return self.commitment.reference.end if following is None else following.end

    def reference(self, estimate: Estimate) -> Reference:
        """Reference to track at the time of the estimate."""
        reference = self.commitment.reference_at(estimate.time)
        if self._must_stop(estimate, reference):
            self.stops += 1
            self.is_stopping, self._stopped = True, estimate.time
            reference = self._stop_from(estimate, reference)
            self.commitment = Commitment(reference, decided=estimate.time)
        return reference

    def stop(self, estimate: Estimate) -> None:
        """Stop the car for a reason of its own, as the watchdog does; later messages let it drive on."""
        reference = self.commitment.reference_at(estimate.time)
        self.is_stopping, self._stopped = True, estimate.time
        if not self._stops_already(estimate, reference):
            self.stops += 1
            self.commitment = Commitment(self._stop_from(estimate, reference), decided=estimate.time)

    def _stops_already(self, estimate: Estimate, reference: Reference) -> bool:
        """Whether the car brakes on a reference at the time of the estimate, or stands."""
        return reference.kind is ReferenceKind.CONTINGENCY and (
            reference.stop is None or estimate.time >= reference.stop.begin - SAME_TIME
        )

    def _must_stop(self, estimate: Estimate, reference: Reference) -> bool:
        if self._stops_already(estimate, reference):
            return False
        silent = reference.kind is ReferenceKind.PLAN and estimate.time - self._arrived > self._silence + SAME_TIME
        return silent or self.is_blind(estimate)

    def is_blind(self, estimate: Estimate) -> bool:
        """Whether the newest observation is too old; at time 0 the car knows where it stands."""
        return min(estimate.age, estimate.time) > self._limit + SAME_TIME

    def _stop_from(self, estimate: Estimate, reference: Reference) -> Reference:
        """Braking from the estimated state with the wheels as the reference has them now.

        Plans of a robot that may lose commands leave room for this at each moment of a cycle (`CommandLoss`).  They do
        not for other manoeuvres.
        """
        held, vehicle, safety = reference.control_at(estimate.time), self._model.present_vehicle, self._safety
        states, controls = [np.asarray(estimate.state, dtype=float)], list[Floats]()
        while not safety.is_resting(vehicle, states[-1]) and len(states) * safety.step <= safety.horizon:
            controls.append(braking_control(vehicle, states[-1], held))
            states.append(self._model.advance(states[-1], controls[-1], safety.step))
        times: Floats = estimate.time + safety.step * np.arange(len(states), dtype=float)
        straight = manoeuvre_reference(vehicle, 0, times, np.array(states))
        return replace(straight, controls=np.array(controls).reshape(straight.controls.shape))
