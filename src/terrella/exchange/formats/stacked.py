"""Stacked arrays: [episodes, steps, ...], the shorter episodes padded at their end, laid out one after another.

Lengths, a mask of padding or the flags of ends say how long each episode is.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from ...core.errors import DatasetError
from . import arrays, flat, rows
from .arrays import Array, Place

_VALID = ("mask", "masks", "valid", "valids", "is_valid", "valid_mask", "attention_mask", "step_mask")
_PADDING = ("pad", "padding", "is_pad", "padding_mask", "pad_mask")
_LENGTHS = (*flat.LENGTHS, "lengths", "length", "seq_lengths", "seq_len", "episode_length", "num_steps")
LENGTHS = (flat.LENGTHS[0],)  # the place where the lengths are handed to flat.split


def split(stored: Mapping[Place, Array], where: str, whole: bool = False) -> flat.Episodes:
    """`flat.split` of flat or stacked arrays. DatasetError for flags [episodes, steps] that do not say where the episodes end."""
    shape = None if whole else _stack(stored)
    lengths = None if shape is None else _lengths(stored, shape, where)
    if shape is None:
        return flat.split(stored, where, whole)
    if lengths is None:
        episodes = flat.split(stored, where)
        return replace(episodes, notes=(*episodes.notes, *_unknown(stored, shape, where)))
    return flat.split(_laid_out(stored, shape, lengths), where)


def _laid_out(stored: Mapping[Place, Array], shape: tuple[int, int], lengths: np.ndarray) -> dict[Place, Array]:
    """Arrays with a row for each step, and the lengths as `LENGTHS`. Texts of episodes are repeated; what has neither a row
    for each step nor says the lengths is emptied, and so named as left out."""
    episodes, steps = shape
    begins = np.append(0, lengths.cumsum())
    owner = np.repeat(np.arange(episodes), lengths)
    rowwise: dict[Place, Array] = {LENGTHS: Array(lengths.shape, lengths.dtype, lambda a, b: lengths[a:b])}
    for place, array in stored.items():
        if array.shape[:2] == shape:
            if place[0] not in (*_VALID, *_PADDING):
                rowwise[place] = _rows_of(array, begins)
        elif array.shape[:2] == (episodes, steps + 1) and _role(str(place[0])) == rows.OBSERVATION:
            rowwise[place] = _rows_of(array, np.append(0, (lengths + 1).cumsum()))
        elif array.is_text and array.shape == (episodes,):
            rowwise[place] = replace(array, shape=owner.shape, read=_repeated(array, owner))
        elif place[0] not in _LENGTHS:
            rowwise[place] = Array((), array.dtype)
    return rowwise


def _repeated(array: Array, owner: np.ndarray) -> Callable[[int, int], np.ndarray]:
    return lambda start, stop: np.asarray(array.read(0, array.shape[0]))[owner[start:stop]]


def _stack(stored: Mapping[Place, Array]) -> tuple[int, int] | None:
    """Episodes and steps: the first two axes of the actions and of everything observed, or of the flags."""
    acted, observed, flags = (
        [array.shape for (head, *_), array in stored.items() if array.is_numeric and _role(str(head)) in roles]
        for roles in ((rows.ACTION,), (rows.OBSERVATION,), (rows.DONE, rows.TRUNCATED, "marks"))
    )
    lead = next((shape[:2] for shape in acted if len(shape) >= 3), None)
    beside = [shape[:2] for shape in (*flags, *(one for one in observed if len(one) > 2 or _says_lengths(stored, one)))]
    if lead is None and acted and len(acted[0]) == 2:  # one number an action
        lead = next((acted[0] for shape in beside if shape in (acted[0], (acted[0][0], acted[0][1] + 1))), None)
    if lead is None or lead[0] < 1 or lead[1] < 2:
        return None
    fits = (lead, (lead[0], lead[1] + 1))  # one more observation than actions
    return (lead[0], lead[1]) if {shape[:2] for shape in (*acted, *observed)} <= {*fits} else None


def _says_lengths(stored: Mapping[Place, Array], shape: tuple[int, ...]) -> bool:
    """Whether an array has the lengths of shape[0] episodes: numbers [E, T] may as well be a row for each step."""
    return any(place[0] in _LENGTHS and array.shape[:1] == shape[:1] for place, array in stored.items())


def _role(head: str) -> str | None:
    return "marks" if head in (*_VALID, *_PADDING, *flat.LAST, *flat.FIRST) else flat.NAMES.get(head)


def _lengths(stored: Mapping[Place, Array], shape: tuple[int, int], where: str) -> np.ndarray | None:
    """Steps of each episode, int64 [E]; None where nothing says them."""
    episodes, steps = shape
    marked = {str(place[0]): array for place, array in stored.items() if len(place) == 1 and array.is_numeric}
    for name in _LENGTHS:
        if name in marked and np.prod(marked[name].shape) == marked[name].shape[0] == episodes:
            lengths = np.nan_to_num(marked[name].read(0, episodes).reshape(-1)).astype(np.int64)
            if lengths.min() < 1 or lengths.max() > steps:
                raise DatasetError(
                    f"'{name}' in {where} does not fit its {steps} steps an episode; mend it, or drop it."
                )
            return lengths
    flags = {name: array for name, array in marked.items() if array.shape in (shape, (*shape, 1))}
    for name, is_padding in [*((one, False) for one in _VALID), *((one, True) for one in _PADDING)]:
        if name in flags:
            valid = (flags[name].read(0, episodes).reshape(shape) != 0) != is_padding
            if (valid[:, 1:] <= valid[:, :-1]).all() and valid[:, 0].all():
                return valid.sum(1)
    ends = np.zeros(shape, bool)
    marks_ends = [name for name in flags if _role(name) in (rows.DONE, rows.TRUNCATED) or name in flat.LAST]
    for name in marks_ends:
        ends |= np.nan_to_num(flags[name].read(0, episodes).reshape(shape)).astype(bool)
    if not marks_ends:
        return np.full(episodes, steps) if set(flags) & set(flat.FIRST) else None
    lengths = np.where(ends.any(1), ends.argmax(1) + 1, steps)
    if not _ends_once(stored, ends, lengths):
        has = f"[{episodes}, {steps}, ...] numbers, and one for each step is needed"
        raise DatasetError(
            f"'{marks_ends[0]}' in {where} has {has}: store episodes one after another, or add the array '{LENGTHS[0]}' with the "
            "steps of each."
        )
    return lengths


def _ends_once(stored: Mapping[Place, Array], ends: np.ndarray, lengths: np.ndarray) -> bool:
    """Whether each episode has nothing but padding after its end: flags that stay, or actions that are 0, nan or repeated. (Flags
    [steps, environments] of environments side by side end anywhere.)"""
    place = next(place for place in stored if _role(str(place[0])) == rows.ACTION)
    for episode, length in enumerate(lengths):
        if length == ends.shape[1] or ends[episode, length:].all():
            continue
        action = np.nan_to_num(np.asarray(stored[place].read(episode, episode + 1)[0], np.float64))
        rest = action[length:]
        if not ((rest == 0).all() or (rest == action[length - 1]).all()) or (
            ends.shape[1] == length + 1 and rest.any()
        ):
            return False
    return True


def _unknown(stored: Mapping[Place, Array], shape: tuple[int, int], where: str) -> list[str]:
    """A note on actions [E, T, A] of which nothing says how long the episodes are."""
    name = next(arrays.spelled(place) for place in stored if _role(str(place[0])) == rows.ACTION)
    return [
        f"'{name}' in {where} is [{shape[0]}, {shape[1]}, ...], read as {shape[0]} steps; if these are episodes of up to "
        f"{shape[1]} steps, add an array '{LENGTHS[0]}' with the steps of each."
    ]


def _rows_of(array: Array, begins: np.ndarray) -> Array:
    """A stacked array with the steps of all episodes one after another; episode e begins at row begins[e]."""

    def read(start: int, stop: int) -> np.ndarray:
        first, last = np.searchsorted(begins, [start, max(stop - 1, start)], side="right") - 1
        parts = [
            array.read(episode, episode + 1)[0, max(start - begins[episode], 0) : stop - begins[episode]]
            [: begins[episode + 1] - max(start, begins[episode])]
            for episode in range(first, min(last, len(begins) - 2) + 1)
        ]  # fmt: skip
        return np.concatenate(parts) if parts else np.empty((0, *array.shape[2:]), array.dtype)

    return Array((int(begins[-1]), *array.shape[2:]), array.dtype, read)
