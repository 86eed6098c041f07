"""Progress of work, as a bar in a terminal and as lines in a log."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SAID_EVERY_S = 60.0
"""Longest time between two lines in a log, while items end."""


@contextmanager
def progress_of(description: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show a bar with rate and remaining time in a terminal; print a line to a log for every tenth and every minute."""
    # Every process of a run imports this module, but few show progress.
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), "{task.fields[rate]}")
    times = ("elapsed", TimeElapsedColumn(), "left", TimeRemainingColumn())
    progress = Progress(*columns, *times, console=console, disable=not console.is_terminal)
    printed_s = time.monotonic()
    with progress:
        task = progress.add_task(description, total=total, rate="")

        def advance(size: int) -> None:
            nonlocal printed_s
            state = progress.tasks[task]
            tenths = int(10 * state.completed / total)
            progress.advance(task, size)
            done = int(state.completed)
            rate = done / max(state.elapsed or 0.0, 1e-9)
            progress.update(task, rate=f"{rate:.3g}/s")
            due = int(10 * done / total) > tenths or time.monotonic() - printed_s >= SAID_EVERY_S
            if not console.is_terminal and due:
                printed_s = time.monotonic()
                left = (total - done) / rate
                console.print(f"{description}: {done}/{total}, {rate:.3g}/s, {left:.0f} s left", highlight=False)

        yield advance
