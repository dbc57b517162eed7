"""The controller of a drive: it holds a plan with its contingency and drives it on a clock.

It never waits for poses or for messages of the planner, and takes them when they are there; without them it drives the
plan that it has to its end and stops with the contingency, or the watchdog stops it.  If the planner's process ends it
does the same, and the process ends when the vehicle stands.  If this process itself sends no commands any more, the
brake guard (`kraft.robot.guard`) does so.
"""

from __future__ import annotations

import math
import threading
import time as clock
from collections import deque
from collections.abc import Sequence
from typing import Final

from kraft.driving.estimation.adaptive import Learned
from kraft.driving.messages import Commitment, Estimate, Observation, Reference, ReferenceKind
from kraft.errors import UserCodeError
from kraft.robot.arrival import Arrival
from kraft.robot.change_requests import ChangeRequests
from kraft.robot.decision_requests import DecisionRequests
from kraft.robot.drive_tables import DriveTables
from kraft.robot.guard import SILENCE
from kraft.robot.health import Health
from kraft.robot.inputs import Inputs
from kraft.robot.link import Link
from kraft.robot.newest_map import NewestMap
from kraft.robot.peers import PeerWatch
from kraft.robot.poses import Clocks
from kraft.robot.priority import shorten_collections
from kraft.robot.protocol import (
    Beat,
    DecisionRequest,
    DriveSpec,
    Ended,
    Guarded,
    Guarding,
    Halting,
    Mailbox,
    Planned,
    PlannerFailed,
    Reconnected,
    Sense,
    Status,
    StopOrder,
    TaskTaken,
)
from kraft.robot.task_inputs import TaskInputs
from kraft.robot.tracker import Tracker
from kraft.robot.transport import Transport
from kraft.scenario import OccupancyMap
from ompl_ext.arrays import Floats
from ompl_ext.times import SAME_TIME

LEAD_IN: Final = 0.6
"""Time between the order to begin and time 0 of the drive, s."""
LATE: Final = 0.003
"""Time after which a tick counts as late, s."""
STATUS_PERIOD: Final = 1.0
"""Time between two reports of the state, s."""
STOPPED: Final = 1.0
"""Time for which the vehicle is commanded to stand before the drive ends, s."""
STANDING: Final = 1.0
"""Time for which a vehicle that has stopped by itself stands before it drives on, s."""
HALTED: Final = 2.0
"""Time by the machine's clock for which the vehicle is commanded to stand before a drive without a clock ends, s."""
STOPPING_MAX: Final = 6.0
"""Longest time after what is on board has ended until a drive that is to end is over, s."""
PEERS_PERIOD: Final = 1.0
"""Time between two looks for a second publisher of commands, s."""
MAIL_TIME: Final = 0.005
"""Time in which the messages are there that the brake guard has sent during a pause, s."""
UNSENT: Final = 60
"""Number of messages from which on the brake guard counts as held up."""


class ControlLoop:
    """One drive of the controller."""

    def __init__(
        self, spec: DriveSpec, transport: Transport, inputs: Inputs, tasks: TaskInputs, mailbox: Mailbox,
        guard: Mailbox, tables: DriveTables, tracker: Tracker, health: Health,
    ) -> None:  # fmt: skip
        self._spec, self._transport, self._inputs, self._tasks = spec, transport, inputs, tasks
        self._mailbox, self._guard, self._tables, self._tracker = mailbox, guard, tables, tracker
        self._health = health
        self._on_board = tracker.on_board
        self.period, self._cycle = spec.period, 0
        self._requests = DecisionRequests(tracker.settings.cycle, tracker.settings.lead)
        self._planned: deque[Planned] = deque()
        self._observations: list[Observation] = []
        self._commands: list[tuple[float, Floats, Floats]] = []
        self._arrival, self._newest_map = Arrival(spec.task.goal, spec.vehicle), NewestMap(spec.vehicle)
        self._changes = ChangeRequests(tracker.settings.cycle, spec.task.goal)
        self._link = Link(transport, spec.robot.command.timeout)
        self._ending: tuple[str, str] | None = None
        self._stood = 0.0  # time for which the vehicle has stood at the end of a contingency, s
        self._late = self._missed = self._ticks = self._guarded = self._stops = 0
        self._worst_late = 0.0
        self._last_tick = -LEAD_IN
        self._ended_at = 0.0
        self._next_status = 0.0
        self._why = ""
        self._since_stop: float | None = None
        self._told: Commitment | None = None  # what the brake guard knows to be on board
        self._learned: Learned | None = None
        self._alive, self._is_unwritten, self._own_code = True, False, False

    def run(self) -> Ended:
        """Drive until the goal, the time limit, an order, or a fault that does not go away."""
        shorten_collections()
        # before the clock of the drive begins: it may wait for an answer of the network for seconds
        self._peers = PeerWatch(self._transport, self._spec.robot.command.topic)
        lead_in = round(1e9 * LEAD_IN)
        timebase = self._inputs.clock
        self._tracker.start(Clocks(timebase.stamp() + lead_in, timebase.now() + lead_in, self._inputs.latency))
        self._guard.send(Guarding(self._tracker.clocks))
        threading.Thread(target=self._watch_peers, name="peers", daemon=True).start()
        number = math.ceil(-LEAD_IN / self.period) + 1
        while True:
            due = number * self.period
            if self._sleep_until(due):
                now = self._now
                if self._tick(now, now - due):
                    break
            elif self._is_over_without_time():
                break
            number = max(number + 1, math.floor(self._now / self.period) + 1)
        return self._ended()

    def failed(self, failure: UserCodeError) -> Ended:
        """End because the user's code raised an error; the brake guard, which is not told of it, stops the vehicle."""
        self._own_code = True
        if self._ending is None:
            self._ending, self._ended_at = ("stopped", f"the brake guard stops the vehicle: {failure}"), self._now
        return self._ended()

    def _ended(self) -> Ended:
        """What the drive was, for the planner's process."""
        self._alive = False
        assert self._ending is not None, "only then it ends"
        outcome, reason = self._ending
        measures = {
            "ticks": self._ticks, "late_ticks": self._late, "worst_late_ms": 1000 * self._worst_late,
            "missed_commitments": self._missed, "guard_commands": self._guarded,
            "decision_ms": 1000 * self._requests.median_delay,
        }  # fmt: skip
        self._event(self._ended_at, f"{outcome}: {reason}" if reason else outcome)
        return Ended(
            outcome, reason, self._ended_at, measures, dict(self._tracker.poses.refused), self._stops, self._sensed(),
            self._tables.problem, self._own_code,
        )  # fmt: skip

    @property
    def _now(self) -> float:
        return self._tracker.now

    def _sleep_until(self, due: float) -> bool:
        """Sleep until a time of the drive (s); False if its clock stands or has gone back."""
        while not self._tracker.clock_trouble:
            left = due - self._now
            if left <= 0.0:
                return True
            clock.sleep(self._tracker.wall(left))
        return False

    def _is_over_without_time(self) -> bool:
        """Command the vehicle to stand as long as the clock of the drive does not go on; True if the drive is over."""
        tracker, began, why = self._tracker, clock.monotonic(), self._link.trouble or self._tracker.clock_trouble
        now, command = self._last_tick if tracker.clock_is_over else self._now, tracker.halt
        if now >= 0.0:
            if self._since_stop is None and self._ending is None:
                self._on_board.stop(tracker.estimate(now))
                self._stopped(now, why)
            self._command(now, command, tracker.estimate(now))
        self._tell_guard(now, command, ())
        while trouble := tracker.clock_trouble:
            self._look_at_link(now)
            self._take_messages(now)
            waited = clock.monotonic() - began
            if tracker.clock_is_over or waited > self._spec.robot.watchdog.give_up:
                self._end(now, "stopped", self._link.trouble or trouble)
            if self._ending is not None and waited >= HALTED:
                return True
            tracker.publish(now, command)
            if self._guard.unsent <= UNSENT:
                self._guard.send(Halting())
            clock.sleep(self.period)
        return False

    def _tick(self, now: float, late: float) -> bool:
        """One tick of the controller; True if the drive is over."""
        self._measure(late)
        self._hold_up(now)
        self._look_at_link(now)
        self._take_messages(now)
        observations = self._take_poses(now)
        self._take_task(now)
        self._health.tick(now, late, self._tracker.arrived)
        self._adopt(now)
        estimate = self._tracker.estimate(now)
        self._check_faults(now, estimate)
        command, reference = self._tracked(now, estimate)
        if self._on_board.is_stopping and self._since_stop is None and self._ending is None:
            self._stopped(now, self._why_blind(estimate))
        stands = reference.kind is ReferenceKind.CONTINGENCY and now >= reference.end
        self._stood = self._stood + self.period if stands else 0.0
        self._tracker.publish(now, command)
        self._command(now, command, estimate)
        self._tell_guard(now, command, observations)
        if now >= 0.0:
            self._tables.row(
                "steps", f"{now:.6f}", *map(float, estimate.state), *map(float, command), self._cycle,
                int(self._on_board.is_stopping), f"{estimate.age:.4f}", f"{late:.6f}",
                f"{self._now - now:.6f}",
            )  # fmt: skip
        self._request(now)
        self._report(now, estimate)
        return self._is_over(now, estimate)

    def _tracked(self, now: float, estimate: Estimate) -> tuple[Floats, Reference]:
        """Command (nu,) and the reference that it tracks; the vehicle stops at once if the user's command fails."""
        try:
            return self._tracker.command(now, estimate)
        except UserCodeError as error:
            self._fail(now, str(error))
            self._on_board.stop(estimate)  # whether or not the planner's process has ended
            return self._tracker.command(now, estimate)  # by the law of the other methods, as of every contingency

    def _fail(self, now: float, reason: str) -> None:
        """Stop the vehicle and end the drive because of an error of the user's code, and tell it."""
        self._own_code = True
        if self._ending is None:
            self._end(now, "stopped", reason)
            self._event(now, f"the vehicle is stopped at once: {reason}")

    def _look_at_link(self, now: float) -> None:
        """Note whether messages reach the robot, and tell if they do again."""
        if news := self._link.look():
            self._event(now, news)

    def _measure(self, late: float) -> None:
        self._ticks += 1
        self._late += late > LATE
        self._worst_late = max(self._worst_late, late)

    def _hold_up(self, now: float) -> None:
        """After a pause of this process: meanwhile the brake guard drove, or the robot's multiplexer stopped."""
        gap, timeout = now - self._last_tick, self._spec.robot.command.timeout
        if gap > self.period + SILENCE:
            clock.sleep(MAIL_TIME)
        driven = self._take_guarded(now)
        if gap > timeout + self.period:
            if not driven:
                halted = self._last_tick + timeout
                self._command(halted, self._tracker.halt, self._tracker.estimate(max(halted, 0.0)))
            self._on_board.stop(self._tracker.estimate(now))
            who = "the brake guard" if driven else "the robot's multiplexer"
            self._stopped(now, f"the controller was held up for {gap:.2f} s, {who} took over")
        self._last_tick = now

    def _take_guarded(self, now: float) -> int:
        """Take note of the commands that the brake guard sent, and tell their number."""
        count = 0
        for message in self._guard.take():
            if isinstance(message, Guarded):
                count += 1
                self._told = None  # it may have on board a stop of its own, from where the vehicle was then
                time = min(message.time, now)  # it may have sent one since this tick began
                if time > self._tracker.last_sent:
                    self._command(time, message.command, Estimate(time, self._tracker.estimate(time).state, 0.0))
            elif isinstance(message, Reconnected):
                self._peers.reconnected()
            elif isinstance(message, StopOrder):
                self._end(now, "stopped", message.reason)
        self._guarded += count
        return count

    def _tell_guard(self, now: float, command: Floats, observations: Sequence[Observation]) -> None:
        if self._guard.unsent > UNSENT:
            return  # it is held up itself; what it misses then it gets with the next commitment
        commitment = self._on_board.commitment
        new, self._told = None if commitment is self._told else commitment, commitment
        learned, self._learned = self._learned, None
        self._guard.send(Beat(now, command, tuple(observations), new, learned))

    def _take_messages(self, now: float) -> None:
        for message in self._mailbox.take():
            if isinstance(message, Planned):
                self._requests.answered(self._acts(now))
                self._changes.decided()
                self._planned.append(message)
            elif isinstance(message, TaskTaken):
                self._take_answer(now, message)
            elif isinstance(message, PlannerFailed):
                self._fail(now, message.reason)
            elif isinstance(message, StopOrder):
                self._end(now, "interrupted" if not self._mailbox.closed else "stopped", message.reason)

    def _take_poses(self, now: float) -> list[Observation]:
        found = self._tracker.take_poses(now)
        self._observations += found
        for each in found:
            self._tables.row("observations", *map(float, (each.time, each.arrival, each.x, each.y, each.theta)))
        return found

    def _acts(self, now: float) -> float:
        """Time at which a command that is sent now acts: plans begin at it, and are asked for and adopted by it."""
        return now + self._tracker.horizon

    def _adopt(self, now: float) -> None:
        """Take on board what the planner committed, when its cycle begins; what arrives later than that is lost."""
        while self._planned:
            planned = self._planned[0]
            if self._tracker.learn(planned.learned):
                self._learned = planned.learned
            cycle = planned.cycle
            if cycle.time > self._acts(now) + SAME_TIME:
                return
            self._planned.popleft()
            self._cycle = cycle.number
            if (late := self._acts(now) - cycle.time) > 1.5 * self.period:
                self._missed += 1
                self._health.decision(late=True)
                self._event(now, f"the commitment of cycle {cycle.number} came {late:.2f} s late")
                continue
            self._health.decision(late=False)
            is_unknown = self._newest_map.is_unknown_to(cycle.number)
            if is_unknown and (place := self._newest_map.in_the_way_of(cycle.commitment, self._acts(now))):
                self._event(now, f"the commitment of cycle {cycle.number} {_leads_into(place)}")
            elif self._may_drive(now):
                self._on_board.receive(cycle.commitment, self._tracker.estimate(now))
                if not self._on_board.is_stopping:
                    self._since_stop = None

    def _trouble(self, now: float) -> str:
        """Why the vehicle must not drive now; empty if it may."""
        inputs = self._inputs.trouble or self._tasks.trouble  # which are silent if the connection is lost
        return self._link.trouble or self._peers.foreign or inputs or self._health.trouble(now)

    def _may_drive(self, now: float) -> bool:
        """Whether a plan may be adopted: a vehicle that has stopped by itself stands before it drives on."""
        stands = self._since_stop is None or self._stood >= STANDING
        return self._ending is None and stands and not self._trouble(now)

    def _check_faults(self, now: float, estimate: Estimate) -> None:
        if now < 0.0 or not (trouble := self._trouble(now)):
            return
        if self._ending is not None and not self._on_board.is_stopping:  # the plan is driven on where the planner ended
            self._on_board.stop(estimate)
        elif self._ending is None and self._since_stop is None:
            self._on_board.stop(estimate)
            self._stopped(now, trouble)

    def _why_blind(self, estimate: Estimate) -> str:
        if self._tracker.poses.reason:
            return f"the watchdog stopped the vehicle: {self._tracker.poses.reason}"
        if self._on_board.is_blind(estimate):
            return f"the watchdog stopped the vehicle: no pose for {estimate.age:.2f} s"
        return "the watchdog stopped the vehicle: no message of the planner"

    def _command(self, time: float, command: Floats, estimate: Estimate) -> None:
        """Tell estimators and the model what the vehicle is commanded from `time` (s) on."""
        self._tracker.commanded(time, command)
        if time >= 0.0:
            self._commands.append((time, command, estimate.state))

    def _request(self, now: float) -> None:
        """Ask for the next commitment when it is due, unless the planner still works on the last one."""
        if self._mailbox.closed or self._ending is not None or not self._requests.is_due(self._acts(now)):
            return
        number = self._requests.ask(self._acts(now))
        self._mailbox.send(DecisionRequest(now, number, self._sensed(), self._on_board.commitment))

    def _take_task(self, now: float) -> None:
        """Hand the newest goal and map to the planner: it gets ready for them before it decides the next time."""
        goal, grid = self._tasks.take_goal(), self._tasks.take_map()
        if goal is not None:
            self._changes.take(goal)
        if problem := self._tasks.take_goal_problem():
            self._event(now, problem)
        if grid is not None:
            self._take_map(now, grid)
        if not self._mailbox.closed and (change := self._changes.next(self._newest_map, self._requests.following)):
            self._mailbox.send(change)

    def _take_map(self, now: float, grid: OccupancyMap) -> None:
        """Stop at once if a new map has something in the way of what is on board: the planner is not as quick."""
        estimate = self._tracker.estimate(now)
        self._newest_map.take(grid, estimate)
        place = self._newest_map.in_the_way_of(self._on_board.commitment, estimate.time)
        if place and not self._on_board.is_stopping:  # nor is it where the planner has ended: the plan is driven on
            self._on_board.stop(estimate)
            self._stopped(now, f"the way {_leads_into(place)}")

    def _take_answer(self, now: float, answer: TaskTaken) -> None:
        """Take over the goal that the planner has taken; it may have refused one."""
        news = self._changes.answered(answer)
        if answer.goal is not None:
            self._arrival.move(answer.goal)
        for text in news:
            self._event(now, text)

    def _sensed(self) -> Sense:
        """What was sensed since the last call."""
        sense = Sense(self._tracker.clocks.wall, tuple(self._observations), tuple(self._commands))
        self._observations, self._commands = [], []
        return sense

    def _report(self, now: float, estimate: Estimate) -> None:
        if now >= self._next_status and not self._mailbox.closed:
            self._next_status = now + STATUS_PERIOD
            self._mailbox.send(Status(now, estimate.age, self._late, self._missed))
            if self._tables.problem and not self._is_unwritten:
                self._is_unwritten = True
                self._event(now, f"the drive goes on, but {self._tables.problem}")

    def _is_over(self, now: float, estimate: Estimate) -> bool:
        if self._ending is None:
            self._look_for_end(now, estimate)
            return False
        since = max(self._ended_at, self._on_board.end)
        return min(self._stood, now - self._ended_at) >= STOPPED or now - since > STOPPING_MAX

    def _look_for_end(self, now: float, estimate: Estimate) -> None:
        watchdog = self._spec.robot.watchdog
        if self._arrival.look(estimate.state, self._changes.open_goals, may_count=now > 0.0):
            self._end(now, "success", "")
        elif wrong := self._tracker.response.trouble:  # which does not go away
            self._end(now, "stopped", wrong)
        elif now >= self._spec.timeout:
            self._end(now, "timeout", f"the goal was not reached in {self._spec.timeout:g} s")
        elif self._since_stop is not None and now - self._since_stop > watchdog.give_up:
            self._end(now, "stopped", self._trouble(now) or self._why)
        elif (waited := self._requests.waited(self._acts(now))) > watchdog.give_up:
            self._end(now, "stopped", f"the planner has not answered for {waited:.1f} s")
        elif min(estimate.age, now) > watchdog.give_up:
            self._end(now, "stopped", self._link.trouble or self._why_blind(estimate))

    def _end(self, now: float, outcome: str, reason: str) -> None:
        """Stop the vehicle, as `OnBoard.stop` does."""
        if self._ending is None:
            self._ending, self._ended_at = (outcome, self._link.explained(reason)), max(now, 0.0)
            self._stops = self._on_board.stops  # without the stop at the end
            if now >= 0.0 and not self._mailbox.closed:
                self._on_board.stop(self._tracker.estimate(now))

    def _stopped(self, now: float, why: str) -> None:
        """Note since when and why the vehicle stops by itself."""
        self._since_stop, self._why = now, why
        self._event(now, why)

    def _event(self, now: float, text: str) -> None:
        """Write what happened, and tell it."""
        self._tables.row("events", f"{now:.3f}", text)
        self._mailbox.send(Status(now, math.nan, self._late, self._missed, text))

    def _watch_peers(self) -> None:
        """Look for a second publisher of commands now and then."""
        while self._alive:
            clock.sleep(PEERS_PERIOD)
            self._peers.look()


def _leads_into(place: tuple[float, float]) -> str:
    return f"leads into the newest map at ({place[0]:.2f}, {place[1]:.2f})"
