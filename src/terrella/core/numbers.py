"""A single number in any of the forms in which environments give one, and seeds."""

from typing import Any

import numpy as np

from .errors import TerrellaError


def single_number(value: Any, what: str) -> float:
    """The number in a Python number, an array or tensor of one entry, or a list of one; TerrellaError, which names `what`, for
    anything else."""
    if isinstance(value, float | int | np.number | np.bool_):
        return float(value)
    try:
        array = np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
        if array.size == 1 and array.dtype.kind in "biufO":
            return float(array.item())
    except (TypeError, ValueError):
        array = np.asarray(None)
    form = f"an array of shape {array.shape}" if array.ndim else f"{value!r:.80}"
    raise TerrellaError(f"{what} is {form}, and one number is needed: wrap the environment so that it gives one.")


def check_seed(seed: int) -> None:
    """TerrellaError for a seed below 0."""
    if seed < 0:
        raise TerrellaError(f"--seed is 0 or more; got {seed}.")
