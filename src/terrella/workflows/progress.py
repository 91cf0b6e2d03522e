"""The progress of long work: one line a call, with the time left; a bar where stderr is a terminal."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

LINE_EVERY_S = 15.0

# Every workflow takes one: it is called with a line of text.
Progress = Callable[[str], None]

# report(done, total, text="", left_s=None). A total of 0 is not known; without `left_s` the time left follows the pace so far.
Report = Callable[..., None]


def silent(line: str) -> None:
    """The progress that shows nothing."""


class Terminal:
    """The progress of the command line: lines on stderr, and a bar for each stage where that is a terminal."""

    def __call__(self, line: str) -> None:
        print(line, file=sys.stderr, flush=True)


@contextmanager
def stage(name: str, progress: Progress) -> Iterator[Report]:
    """Gives the `report` of one stage of work. The bar goes away cleanly, also when the body raises."""
    if not isinstance(progress, Terminal) or not sys.stderr.isatty():
        yield _lines(name, progress)
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bars
    from rich.table import Column

    rest = Column(ratio=1, no_wrap=True)  # the text has the width that the others leave
    whole = [Column(no_wrap=True, min_width=width) for width in (12, 4, 12)]
    columns = TextColumn("{task.description}"), BarColumn(12, table_column=whole[0])
    times = (
        TextColumn("{task.percentage:>3.0f}%", table_column=whole[1]),
        TextColumn("{task.fields[left]}", table_column=whole[2]),
    )
    text = TextColumn("{task.fields[text]}", table_column=rest)
    with Bars(*columns, *times, text, console=Console(stderr=True), expand=True) as bars:
        task = bars.add_task(name, total=None, text="", left="")

        def report(done: float, total: float, text: str = "", left_s: float | None = None) -> None:
            if (total or None) != bars.tasks[task].total or done < bars.tasks[task].completed:  # another part begins
                bars.reset(task, total=total or None)
            bars.update(task, completed=done, text=text)
            left_s = bars.tasks[task].time_remaining if left_s is None else left_s
            bars.update(task, left=_left(left_s) if left_s else "")

        yield report


def _lines(name: str, progress: Progress) -> Report:
    """A `report` that gives `progress` a line now and then, and one at the end."""
    began = last_line = time.monotonic()
    first = last_total = last_done = 0.0

    def report(done: float, total: float, text: str = "", left_s: float | None = None) -> None:
        nonlocal began, last_line, first, last_total, last_done
        now = time.monotonic()
        if total != last_total or done < last_done:  # another part begins, perhaps where an earlier run stopped
            began, first, last_total = now, done, total
        last_done = done
        if now - last_line < LINE_EVERY_S and (done < total or not total):
            return
        last_line = now
        if left_s is None and first < done < total:
            left_s = (total - done) * (now - began) / (done - first)
        left = _left(left_s) if left_s and done < total else ""
        share = f"{done / total:.0%}" if total else f"{done:g}"
        progress(" ".join(filter(None, [name, share, left, text])))

    return report


def _left(seconds: float) -> str:
    return f"{seconds / 60:.1f} min left"


def duration(seconds: float) -> str:
    """A time for people: 45 s, 2.5 min."""
    return f"{seconds / 60:.1f} min" if seconds >= 90 else f"{max(seconds, 0.0):.0f} s"


@contextmanager
def stopping_with(sentence: str) -> Iterator[None]:
    """A context in which Ctrl-C says this sentence, if nothing inside says more."""
    try:
        yield
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(str(stop) or sentence) from stop
