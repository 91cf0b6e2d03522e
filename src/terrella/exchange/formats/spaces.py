"""Gymnasium spaces as JSON, as Minari spells it, and the arrays and texts that they flatten into."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from ...core.errors import DatasetError
from ...core.instruction import TASK_NAMES
from ...data.source import Sensor
from .arrays import Array, Place, spelled
from .rows import stored_shape

_NO_ARRAYS = ("Sequence", "Graph", "OneOf", "Unknown")  # spaces whose values are not arrays of one shape
_MAX_DEPTH = 32


def leaves(space: object, role: str, where: str) -> dict[Place, Array | None]:
    """Place (keys of Dicts, indices of Tuples) -> array without rows, for each leaf of a space given as JSON; None for texts. What
    is no array of one shape (Sequence, Graph, …) is an array of objects, which `arrays.columns` names as left out."""
    try:
        return dict(_flat(space, ()))
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"the {role} space of {where} cannot be recorded as numbers ({error}).") from error


def _flat(space: Any, place: Place) -> Iterator[tuple[Place, Array | None]]:
    kind = space["type"]
    if len(place) > _MAX_DEPTH:
        raise ValueError("it nests too deep")
    if kind in ("Dict", "Tuple"):
        parts = space["subspaces"]
        for key, part in parts.items() if kind == "Dict" else enumerate(parts):
            yield from _flat(part, (*place, str(key) if kind == "Dict" else key))
    elif kind == "Text":
        yield place, None
    elif kind in _NO_ARRAYS and place:
        yield place, Array((), np.dtype(object))
    else:
        shape, dtype = _shape_of(kind, space)
        yield place, Array((0, *shape), np.dtype(dtype))


def is_instruction(place: Place) -> bool:
    """Whether a text at this place is an instruction, by its name."""
    return str(place[-1]).lower() in TASK_NAMES


def split_texts(texts: Mapping[Place, Sequence[str]], task: str = "") -> tuple[str, dict[str, list[str]]]:
    """(a take's task, its other texts). The task is the text that stays the same for the whole take: of several the one that
    is named mission, task, …"""
    constant = {place: values[0] for place, values in texts.items() if len(set(values)) == 1}
    named = [text for place, text in constant.items() if text and is_instruction(place)]
    only = [text for text in constant.values() if text]
    task = task or (named[0] if named else only[0] if len(only) == 1 else "")
    kept = {place: list(values) for place, values in texts.items() if constant.get(place) != task}
    return task, {spelled(place): values for place, values in kept.items()}


def _shape_of(kind: str, space) -> tuple[tuple[int, ...], str]:
    if kind == "Box":
        return tuple(int(n) for n in space["shape"]), space["dtype"]
    if kind == "Discrete":
        return (), "int64"
    if kind == "MultiDiscrete":
        return np.shape(space["nvec"]), space.get("dtype", "int64")
    if kind == "MultiBinary":
        return tuple(np.atleast_1d(space["n"]).tolist()), "int8"
    raise ValueError(f"spaces of type {kind} are unknown")


def to_json(space: spaces.Space) -> dict:
    """The space as Minari writes it, except that constant bounds become one number."""
    if isinstance(space, spaces.Dict):
        return {"type": "Dict", "subspaces": {str(key): to_json(part) for key, part in space.spaces.items()}}
    if isinstance(space, spaces.Tuple):
        return {"type": "Tuple", "subspaces": [to_json(part) for part in space.spaces]}
    if isinstance(space, spaces.Box):
        bounds = {"low": _bound(space.low), "high": _bound(space.high)}
        return {"type": "Box", "dtype": str(space.dtype), "shape": list(space.shape), **bounds}
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "dtype": "int64", "start": int(space.start), "n": int(space.n)}
    if isinstance(space, spaces.MultiDiscrete):
        start = np.asarray(space.start).tolist()
        return {"type": "MultiDiscrete", "dtype": str(space.dtype), "nvec": space.nvec.tolist(), "start": start}
    if isinstance(space, spaces.MultiBinary):
        return {"type": "MultiBinary", "n": space.n if isinstance(space.n, int) else list(space.n)}
    if isinstance(space, spaces.Text):
        low, high = space.min_length, space.max_length
        return {"type": "Text", "max_length": high, "min_length": low, "charset": space.characters}
    if getattr(space.dtype, "kind", "") == "U":  # as MiniGrid's missions, which are no Text
        return {"type": "Text", "max_length": 1 << 16, "min_length": 0, "charset": ""}
    name = type(space).__name__
    return {"type": name if name in _NO_ARRAYS else "Unknown"}


def compact(space):
    """A space as JSON with constant bounds as one number; infinities become text."""
    if isinstance(space, dict):
        if space.get("type") == "Box":
            lists = {key: space[key] for key in ("low", "high") if isinstance(space.get(key), list)}
            return {**space, **{key: _bound(np.asarray(value)) for key, value in lists.items()}}
        return {key: compact(value) for key, value in space.items()}
    return [compact(part) for part in space] if isinstance(space, list) else space


def expanded(space):
    """The inverse of `compact`: bounds as nested lists, as Minari reads them."""
    if isinstance(space, dict):
        if space.get("type") == "Box":
            shape = tuple(space["shape"])
            bounds = {key: _spread(space[key], shape, space["dtype"]) for key in ("low", "high")}
            return {**space, **bounds}
        return {key: expanded(value) for key, value in space.items()}
    return [expanded(part) for part in space] if isinstance(space, list) else space


def _spread(bound, shape: tuple[int, ...], dtype: str) -> list:
    whole = np.dtype(dtype).kind in "iub"  # float64 would lose the last digits of an int64
    return np.broadcast_to(np.array(bound, dtype=object if whole else np.float64), shape).tolist()


def _bound(values: np.ndarray):
    first = values.flat[0] if values.size else 0
    same = values.size and bool((values == first).all())
    bound = (first.item() if isinstance(first, np.generic) else first) if same else values.tolist()
    return _no_infinity(bound)


def _no_infinity(value):
    if isinstance(value, list):
        return [_no_infinity(part) for part in value]
    return str(value) if isinstance(value, float) and not np.isfinite(value) else value


def box(sensor: Sensor) -> dict:
    """The space of a sensor of which nothing else is known: everything that its dtype can hold."""
    dtype = np.dtype(sensor.dtype)
    if dtype.kind == "f":
        low, high = "-inf", "inf"
    else:
        low, high = (0, 1) if dtype.kind == "b" else (int(np.iinfo(dtype).min), int(np.iinfo(dtype).max))
    return {"type": "Box", "dtype": dtype.name, "shape": list(stored_shape(sensor)), "low": low, "high": high}
