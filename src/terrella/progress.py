"""Progress with the time left, on stderr: a bar on a terminal, now and then a line in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

LINE_EVERY_S = 15.0


@contextmanager
def shown(what: str) -> Iterator[Callable[..., None]]:
    """Gives `report(done, total, words, left_s)`; the bar goes away cleanly, also when the body raises.

    Without `left_s`, seconds that are left by better knowledge, the time left is that of the pace so far.
    """
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f}%")
        times = TimeElapsedColumn(), TextColumn("{task.fields[left]}")
        with Progress(*columns, *times, TextColumn("{task.fields[words]}"), console=Console(stderr=True)) as bar:
            task = bar.add_task(what, total=None, words="", left="")

            def report(done: float, total: float, words: str = "", left_s: float | None = None) -> None:
                if (total or None) != bar.tasks[task].total or done < bar.tasks[task].completed:  # another stage begins
                    bar.reset(task, total=total or None)
                bar.update(task, completed=done, words=words)
                left_s = bar.tasks[task].time_remaining if left_s is None else left_s
                bar.update(task, left=_left(left_s) if left_s else "")

            yield report
    else:
        yield _lines(what)


def _lines(what: str) -> Callable[..., None]:
    began = said = time.monotonic()
    first = of = last = 0.0

    def report(done: float, total: float, words: str = "", left_s: float | None = None) -> None:
        nonlocal began, said, first, of, last
        now = time.monotonic()
        if total != of or done < last:  # a stage begins; what an earlier run had done says nothing of this one's speed
            began, first, of = now, done, total
        last = done
        if now - said < LINE_EVERY_S and (done < total or not total):  # a total of 0 is not known
            return
        said = now
        if left_s is None and first < done < total:
            left_s = (total - done) * (now - began) / (done - first)
        left = _left(left_s) if left_s and done < total else ""
        share = f"{done / total:.0%}" if total else f"{done:g}"
        print(" ".join(filter(None, [what, share, left, words])), file=sys.stderr)

    return report


def _left(seconds: float) -> str:
    return f"{seconds / 60:.1f} min left"
