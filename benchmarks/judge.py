"""An independent judgement of a plan: its controls rolled out with the second model, every 5 mm asked of FCL."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.exact import Body
from benchmarks.models import Model, law_of, model_of, rk4
from benchmarks.random_scenes import RandomScene
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.plan import Contingency, Plan

MOTION = 0.005  # of any point of the body between two poses that are looked at (m), at most
SAME = 1e-6  # m, rad, m/s: two roll-outs of the same steps
TOLERANCE = 1e-9  # of distances (m)
FINER = 50  # steps that stand for the exact solution, within one of the planner's


@dataclass(frozen=True)
class Motion:
    """Samples (n + 1, nx) at `times` (n + 1,), the controls (n, nu) held between them."""

    times: Floats
    samples: Matrix
    controls: Matrix


@dataclass(frozen=True)
class Judgement:
    """What is wrong with a plan, each True if it is.

    Attributes:
        differs: the trajectory is not what the controls do.
        collides: FCL finds the footprint in collision.
        too_close: nearer than delta(v) in the first cycle.
        no_contingency: SAFETY is asked for, and there is none, or it is not what its manoeuvre does, or it ends moving.
        contingency_collides, contingency_too_close: as above, until standstill.
        exact_collides: in collision when the model is integrated exactly instead of in the planner's steps.
        integration_error: the largest distance between both (m).
    """

    differs: bool
    collides: bool
    too_close: bool
    no_contingency: bool
    contingency_collides: bool
    contingency_too_close: bool
    exact_collides: bool
    integration_error: float


def judge(query: RandomScene, start: Floats, plan: Plan) -> Judgement:
    """Judge a plan from `start` (nx,)."""
    model, body = model_of(query.vehicle), Body(query.solids, query.vehicle.footprint)
    motion = roll_out(query, model, start, plan)
    times, states = dense(model, motion, query.vehicle.footprint.reach)
    within = times <= query.safety.cycle + 1e-9
    exact = exactly(model, motion)
    stop = plan.contingency
    stopping = None if stop is None else braking(query, model, motion, stop)
    stop_states = motion.samples[:1] if stopping is None else dense(model, stopping, query.vehicle.footprint.reach)[1]
    return Judgement(
        differs=not same(motion.samples, plan.trajectory),
        collides=body.any_collision(states[:, :3]),
        too_close=bool(within.any()) and near(query, body, states[within]),
        no_contingency=query.safety.enabled and stopping is None,
        contingency_collides=stopping is not None and body.any_collision(stop_states[:, :3]),
        contingency_too_close=stopping is not None and near(query, body, stop_states),
        exact_collides=body.any_collision(exact[:, :3]),
        integration_error=float(np.abs(exact[::FINER, :2] - motion.samples[:, :2]).max()),
    )


def roll_out(query: RandomScene, model: Model, start: Floats, plan: Plan) -> Motion:
    """The steps that the planner takes, with the second model."""
    quantum, steps = query.settings.quantum, query.settings.steps
    times, samples, controls = [0.0], [np.asarray(start, dtype=float)], []
    for control, duration in zip(plan.controls, plan.durations, strict=True):
        count = max(1, round(duration / quantum)) if quantum > 0 else steps
        for _ in range(count):
            times.append(times[-1] + duration / count)
            samples.append(rk4(model, samples[-1][None], control[None], np.array([duration / count]))[0])
            controls.append(control)
    return Motion(np.array(times), np.array(samples), np.array(controls))


def braking(query: RandomScene, model: Model, motion: Motion, stop: Contingency) -> Motion | None:
    """The manoeuvre from where the plan leaves the cycle; None if it is not what the planner says or ends moving."""
    leaves = min(query.safety.cycle, float(motion.times[-1]))
    k = min(int(np.searchsorted(motion.times, leaves, side="right")) - 1, len(motion.controls) - 1)
    remaining = np.array([leaves - motion.times[k]])
    samples = [rk4(model, motion.samples[k][None], motion.controls[k][None], remaining)[0]]
    law, step, controls = law_of(query.vehicle, stop.manoeuvre), query.safety.step, []
    for _ in range(len(stop.states) - 1):
        controls.append(law(samples[-1]))
        samples.append(rk4(model, samples[-1][None], controls[-1][None], np.array([step]))[0])
    resting = np.abs(samples[-1][list(query.vehicle.rest_indices)]) <= query.safety.rest_speed + SAME
    if not same(np.array(samples), stop.states) or not resting.all():
        return None
    times = leaves + step * np.arange(len(samples), dtype=float)
    return Motion(times, np.array(samples), np.array(controls).reshape(-1, motion.controls.shape[1]))


def dense(model: Model, motion: Motion, reach: float) -> tuple[Floats, Matrix]:
    """Times and states so close to each other that no point of the body moves by more than `MOTION`."""
    pieces = 4
    while True:
        times, states = refined(model, motion, pieces)
        shift = np.hypot(*np.diff(states[:, :2], axis=0).T) + np.abs(np.diff(states[:, 2])) * reach
        if len(shift) == 0 or shift.max() <= MOTION:
            return times, states
        pieces *= 2


def refined(model: Model, motion: Motion, pieces: int) -> tuple[Floats, Matrix]:
    """Each of the planner's steps in `pieces` smaller ones, beginning anew at every sample."""
    h = np.diff(motion.times) / pieces
    columns = [motion.samples[:-1]]
    for _ in range(pieces - 1):
        columns.append(rk4(model, columns[-1], motion.controls, h))
    states = np.concatenate([np.stack(columns, axis=1).reshape(-1, motion.samples.shape[1]), motion.samples[-1:]])
    times = (motion.times[:-1, None] + h[:, None] * np.arange(pieces)).ravel()
    return np.append(times, motion.times[-1]), states


def exactly(model: Model, motion: Motion) -> Matrix:
    """States of the exact solution, `FINER` for each of the planner's steps."""
    states = [motion.samples[0][None]]
    for control, h in zip(motion.controls, np.diff(motion.times), strict=True):
        for _ in range(FINER):
            states.append(rk4(model, states[-1], control[None], np.array([h / FINER])))
    return np.concatenate(states)


def near(query: RandomScene, body: Body, states: Matrix) -> bool:
    """Whether any state is nearer to a solid than delta(v)."""
    speed = np.abs(states[:, query.vehicle.rest_indices[0]])
    delta = query.safety.delta + query.safety.delta_per_speed * speed
    return bool(np.any(body.distances(states[:, :3]) < delta - TOLERANCE))


def same(one: Matrix, other: Matrix) -> bool:
    """Whether two roll-outs are the same up to rounding."""
    return one.shape == other.shape and bool(np.all(np.abs(one - other) <= SAME))
