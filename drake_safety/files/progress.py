"""Progress of long computations: bars on a terminal, elsewhere a plain line every few seconds."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, Task, TaskID

LINE_PERIOD_S = 10.0
"""Longest time without a line where there are no bars [s]."""

StageProgress = Callable[[str, int, int], Any]
"""Called with the name of a stage, the number done and the number wanted."""

_Report = TypeVar("_Report", bound=Callable[..., Any])


class Stages:
    """Shows stages with the number done, the number wanted and the time left.

    Args:
        bars: Bars of the stages; where these are disabled, lines are printed.
        console: Where it prints.
    """

    def __init__(self, bars: Progress, console: Console):
        self._bars = bars
        self._console = console
        self._tasks: dict[str, TaskID] = {}
        self._first: dict[str, float] = {}

    def __call__(self, stage: str, done: float, total: float) -> None:
        """Updates a stage, created at the first call.

        Args:
            stage: Name of the stage.
            done: Number done.
            total: Number wanted.
        """
        if stage not in self._tasks:
            # What an earlier run has done says nothing about the time left.
            self._first[stage] = done
            self._tasks[stage] = self._bars.add_task(stage, total=total, completed=int(done))
        task_id = self._tasks[stage]
        was_finished = self._bars.tasks[task_id].finished
        self._bars.update(task_id, completed=done, total=total)
        task = self._bars.tasks[task_id]
        if self._bars.disable and task.finished and not was_finished:
            self._print(task)

    def report_share(self, stage: str, share: float) -> None:
        """Updates a stage of which a share is done.

        Args:
            stage: Name of the stage.
            share: The share, from 0 to 1.
        """
        self(stage, round(100 * share), 100)

    def print_lines(self) -> None:
        """Prints a line for each stage that is not finished."""
        unfinished = [task for task in self._bars.tasks if not task.finished]
        for task in unfinished:
            self._print(task)
        if not unfinished:
            what = self._bars.tasks[-1].description if self._bars.tasks else ""
            text = f"still working, after '{what}'" if what else "still working"
            self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def _print(self, task: Task) -> None:
        elapsed_s = task.elapsed or 0.0
        text = f"{task.description}: {task.completed:g}/{task.total:g}, {_clock(elapsed_s)}"
        done = task.completed - self._first[task.description]
        if not task.finished and done > 0 and task.remaining is not None:
            text += f", {_clock(elapsed_s * task.remaining / done)} left"
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)


def _clock(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))


@contextmanager
def open_stages(
    console: Console | None = None, *, period_s: float = LINE_PERIOD_S
) -> Iterator[Stages]:
    """Shows stages while the block runs: bars on a terminal and in a notebook, lines elsewhere.

    Args:
        console: Where it prints; standard error by default.
        period_s: Time between two lines [s].
    """
    import rich.console
    import rich.progress as columns

    console = console or rich.console.Console(stderr=True)
    # A log file that is told to have colours is no terminal either.
    is_live = console.is_jupyter or (console.is_interactive and console.file.isatty())
    bars = columns.Progress(
        columns.TextColumn("{task.description:<34}", markup=False),
        columns.BarColumn(bar_width=30),
        columns.MofNCompleteColumn(),
        columns.TimeElapsedColumn(),
        columns.TextColumn("left"),
        columns.TimeRemainingColumn(),
        console=console,
        disable=not is_live,
    )
    stages = Stages(bars, console)
    if is_live:
        with bars:
            yield stages
        return
    is_over = threading.Event()

    def tick() -> None:
        while not is_over.wait(period_s):
            stages.print_lines()

    ticking = threading.Thread(target=tick, name="progress", daemon=True)
    ticking.start()
    try:
        yield stages
    finally:
        is_over.set()
        ticking.join()


@contextmanager
def shown(
    progress: _Report | bool | None, of_stages: Callable[[Stages], _Report]
) -> Iterator[_Report | None]:
    """Yields the callback that an argument ``progress`` stands for.

    Args:
        progress: A callback, True to show the progress while the block runs, or None or False.
        of_stages: Makes the callback that shows it.
    """
    if not isinstance(progress, bool):
        yield progress
    elif not progress:
        yield None
    else:
        with open_stages() as stages:
            yield of_stages(stages)
