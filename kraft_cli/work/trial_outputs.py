"""Outputs of a trial beside its result: a video, a window, a picture of the whole run, a bag."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

from kraft.driving.messages import Cycle
from kraft.files import check_all
from kraft.text import MessageSink
from kraft.trial.measures import Step
from kraft.trial.result import TrialResult, TrialSpec

if TYPE_CHECKING:
    from kraft.simulation.true_world import TrueWorld
    from kraft.video.recorder import LiveView, VideoRecorder


@dataclass(frozen=True)
class OutputOptions:
    """Requested outputs: a video (.mp4, .webp), a window in real time, a picture (.png, .svg, .pdf), a bag (.mcap)."""

    video: Path | None = None
    view: bool = False
    plot: Path | None = None
    bag: Path | None = None

    def check(self) -> None:
        """Check before the drive that the outputs can be made.

        Raises:
            InputError: if a file name is wrong or cannot be written.
            MissingDependency: if no image can be rendered.
        """
        checks: list[Callable[[], object]] = []
        if self.plot is not None:
            from kraft.plot import check_picture

            checks.append(partial(check_picture, self.plot))
        if self.video is not None:
            from kraft.gl import check_video

            checks.append(partial(check_video, self.video))
        if self.bag is not None:
            from kraft.robot.bag import check_bag

            checks.append(partial(check_bag, self.bag))
        check_all(*checks)
        if self.view:
            from kraft.gl import check_view

            check_view()


NO_OUTPUT: Final = OutputOptions()


class TrialOutputs:
    """Callbacks of `run_trial` that make the outputs; at its exit windows close and unfinished files are removed."""

    def __init__(
        self,
        options: OutputOptions,
        spec: TrialSpec,
        on_cycle: Callable[[Cycle], None] | None = None,
        driver: str | None = None,
    ) -> None:
        """`driver` names another program that drives, of which neither plans nor estimates are drawn."""
        self._options, self._spec, self._on_cycle, self._driver = options, spec, on_cycle, driver
        self._stack = ExitStack()
        self._recorders: list[VideoRecorder | LiveView] = []
        self._world: TrueWorld | None = None

    def __enter__(self) -> Self:
        with ExitStack() as stack:  # if the second cannot be opened, the first is closed
            if self._options.video is not None:
                from kraft.video.recorder import VideoRecorder

                self._recorders.append(
                    stack.enter_context(VideoRecorder(self._options.video, self._spec, self._driver))
                )
            if self._options.view:
                from kraft.video.recorder import LiveView

                self._recorders.append(stack.enter_context(LiveView(self._spec, external=self._driver is not None)))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._stack.__exit__(kind, error, at)

    @property
    def keep_trees(self) -> bool:
        """Whether an output draws the planner's tree."""
        return bool(self._recorders) or self._options.bag is not None

    def on_cycle(self, cycle: Cycle) -> None:
        """Callback of `run_trial`."""
        if self._on_cycle is not None:
            self._on_cycle(cycle)
        for recorder in self._recorders:
            recorder.on_cycle(cycle)

    def on_step(self, world: TrueWorld, step: Step) -> None:
        """Callback of `run_trial`."""
        self._world = world
        for recorder in self._recorders:
            recorder.on_step(world, step)

    def finish(self, result: TrialResult, report: MessageSink) -> None:
        """Draw the video, show the end in the window, write the bag, draw the picture; `report` receives the progress.

        Raises:
            InputError: if a file cannot be written.
        """
        for recorder in self._recorders:
            recorder.finish(result, report)
        if self._options.bag is not None:
            from kraft.robot.bag import write_trial

            write_trial(self._options.bag, self._spec, result)
        if self._options.plot is not None:
            from kraft.plot.run import plot_run
            from kraft.simulation.appearance import hidden_features

            scenario = self._spec.scenario
            moved = None if self._world is None else self._world.movable_poses
            title = f"{scenario.name} · {self._spec.method.title}"
            plot_run(
                self._options.plot, scenario.task(), self._spec.vehicle, result,
                title=title, unknown=scenario.truth.in_words(), hidden=hidden_features(scenario, moved),
                has_plans=self._spec.method.planner.type != "geodesic",
            )  # fmt: skip
