"""Runs kernels that release the GIL over the views of a batch, on several threads."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch

_POOL = ThreadPoolExecutor(os.cpu_count() or 1, "views")


def over_views(batch: int, work: Callable[[int, int], object]) -> None:
    """Calls work(first, last) for parts of range(batch), on as many threads as torch may use. `work` must not call this."""
    threads = min(torch.get_num_threads(), batch)
    bounds = [batch * part // max(threads, 1) for part in range(threads + 1)]
    others = [_POOL.submit(work, *part) for part in zip(bounds[1:], bounds[2:])]
    if batch:
        work(0, bounds[1])
    for other in others:
        other.result()


def each_view(kernel: Callable[..., object], views: Sequence[Any], *shared: Any) -> None:
    """Calls kernel(*view, *shared) for each view of arrays [B, ...], as `over_views` does."""

    def work(first: int, last: int) -> None:
        for view in range(first, last):
            kernel(*(part[view] for part in views), *shared)

    over_views(len(views[0]), work)


def arrays(*parts: torch.Tensor) -> list[Any]:
    """CPU tensors as contiguous NumPy arrays, for kernels."""
    return [part.detach().contiguous().numpy() for part in parts]
