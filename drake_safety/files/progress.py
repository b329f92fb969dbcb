"""Progress of long computations: bars on a terminal, elsewhere a plain line every few seconds."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any, TypeVar

from rich import progress as columns
from rich.console import Console

StageProgress = Callable[[str, int, int], Any]
"""Called with the name of a stage, the number done and the number wanted."""

_Report = TypeVar("_Report", bound=Callable[..., Any])


@contextmanager
def open_stages(
    console: Console | None = None, *, period_s: float = 10.0
) -> Iterator[StageProgress]:
    """Shows stages while the block runs: bars on a terminal, else a line every `period_s` [s]."""
    console = console or Console(stderr=True)
    # A log file with forced colours is not a terminal.
    is_live = console.is_jupyter or (console.is_interactive and console.file.isatty())
    numbers = [
        columns.MofNCompleteColumn(),
        columns.TimeElapsedColumn(),
        columns.TextColumn("left"),
        columns.TimeRemainingColumn(),
    ]
    bars = columns.Progress(
        columns.TextColumn("{task.description:<34}", markup=False),
        columns.BarColumn(bar_width=30),
        *numbers,
        console=console,
        disable=not is_live,
        speed_estimate_period=24 * 3600.0,
    )
    tasks: dict[str, columns.TaskID] = {}
    is_over = threading.Event()

    def report(stage: str, done: int, total: int) -> None:
        if stage not in tasks:
            # Work of an earlier run does not predict the time left.
            tasks[stage] = bars.add_task(stage, total=total, completed=done)
        task = bars.tasks[tasks[stage]]
        was_finished = task.finished
        bars.update(task.id, completed=done, total=total)
        if task.finished and not was_finished:
            print_task(task)

    def print_task(task: columns.Task) -> None:
        if not is_live:
            words = f"{task.description}:", *(str(column(task)) for column in numbers)
            console.print(*words, highlight=False, markup=False, soft_wrap=True)

    def tick() -> None:
        while not is_over.wait(period_s):
            for task in bars.tasks:
                if not task.finished:
                    print_task(task)

    threading.Thread(target=tick, name="progress", daemon=True).start()
    with bars:
        try:
            yield report
        finally:
            is_over.set()


@contextmanager
def shown(
    progress: _Report | bool | None, of_stages: Callable[[StageProgress], _Report]
) -> Iterator[_Report | None]:
    """Yields the callback that `progress` stands for: itself, one that shows stages, or None."""
    with open_stages() if progress is True else nullcontext() as stages:
        yield of_stages(stages) if stages else None if isinstance(progress, bool) else progress


def ignore(*done: object) -> None:
    """A callback for a progress that nobody watches."""


def stage_of(progress: StageProgress | None, name: str) -> Callable[[float], None]:
    """Returns the callback of one stage, which takes the fraction done."""
    report = progress or ignore
    return lambda done: report(name, round(100 * done), 100)
