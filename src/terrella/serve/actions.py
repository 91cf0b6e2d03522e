"""The input of a page as actions of a world: keys that are held, and the axes of sticks, mouse and sliders."""

from collections.abc import Sequence

import numpy as np
import torch
from gymnasium import spaces

from ..core.spec import Spec, dtype_of, neutral_action

MAX_AXES = 64  # axes that a page shows; the others of an action stay at their neutral value
_UNLIMITED = 1e6  # a limit beyond this counts as no limit


def axes_of(spec: Spec) -> list[dict]:
    """Name, unit, low, high, neutral and whole (whole numbers only) of each axis of a Box, for the page's sliders. An axis without
    limits has the range of its keys, or -1 to 1."""
    space = spec.action
    if not isinstance(space, spaces.Box):
        return []
    rest, axes = neutral_action(spec).ravel(), []
    table = [np.abs(np.asarray(value, np.float64)) for value in spec.keys.values()]
    for at in range(min(rest.size, MAX_AXES)):
        reach = max([float(row[at]) for row in table], default=0.0) or 1.0
        low, high = float(space.low.flat[at]), float(space.high.flat[at])
        axes.append(
            {
                "name": spec.action_names[at] if at < len(spec.action_names) else f"axis {at + 1}",
                "unit": spec.action_units[at] if at < len(spec.action_units) else "",
                "low": low if abs(low) < _UNLIMITED else -reach,
                "high": high if abs(high) < _UNLIMITED else reach,
                "neutral": float(rest[at]),
                "whole": dtype_of(space).kind in "iu",
            }
        )
    return axes


def action_of(spec: Spec, held: Sequence[str] = (), axes: Sequence[float] = ()) -> torch.Tensor:
    """The action [1, *spec.action.shape] of the keys held, oldest first, and of the values of the axes, in their units, clipped.

    Buttons (MultiBinary) combine by element-wise maximum. A choice (Discrete, or each of a MultiDiscrete) is set by the last key
    pressed that has a value for it. An axis (Box) has the value given, or that of the held key which is furthest from neutral, so
    that a zero does not override a negative direction. Without input the action is neutral. Unknown keys are ignored."""
    space = spec.action
    rows = [np.asarray(spec.keys[code], np.float64) for code in [*held, *_together(spec, held)] if code in spec.keys]
    flat = neutral_action(spec).ravel().astype(np.float64)
    if isinstance(space, spaces.Box):
        given = np.asarray(axes, np.float64)[: flat.size]
        flat[: given.size] = given
        if rows:
            table = np.stack(rows)
            table = table[np.argsort(-table.max(axis=1), kind="stable")]  # of two opposites, the positive
            pressed = table[np.abs(table).argmax(axis=0), np.arange(table.shape[1])]
            flat = np.where(pressed != 0, pressed, flat)
        flat = np.clip(flat, space.low.ravel(), space.high.ravel())
        flat = flat.round() if dtype_of(space).kind in "iu" else flat
    elif isinstance(space, spaces.MultiDiscrete):
        rest = flat
        for row in rows:
            flat = np.where(row != rest, row, flat)
    elif rows:
        flat = np.max(rows, axis=0) if isinstance(space, spaces.MultiBinary) else rows[-1]
    return torch.as_tensor(np.asarray(flat.reshape(space.shape or ()), dtype_of(space)))[None]


def keys_of(spec: Spec, action: torch.Tensor) -> list[str]:
    """The keys that would give an action [1, *spec.action.shape], which the page highlights: the buttons that are down, the choices
    made, and of an axis the keys whose value is at most twice as large. Of two keys with the same value, the first."""
    flat, rest = action[0].cpu().numpy().ravel().astype(np.float64), neutral_action(spec).ravel()
    single = isinstance(spec.action, spaces.Box | spaces.MultiBinary)  # each part has keys of its own
    lit: dict[tuple[float, ...], str] = {}
    for code, value in spec.keys.items():
        row = np.asarray(value, np.float64)
        sets = row != (0 if single else rest)
        meant = (flat == row) if not isinstance(spec.action, spaces.Box) else flat * np.sign(row) >= 0.5 * np.abs(row)
        if sets.any() and meant[sets].all():
            lit.setdefault(tuple(value), code)
    return list(dict.fromkeys(part for code in lit.values() for part in code.split("+")))


def _together(spec: Spec, held: Sequence[str]) -> list[str]:
    """The combinations of keys ("ArrowUp+Space") that are held, longest last. Keys with the same value stand in for one another."""
    same = {tuple(action): code for code, action in reversed(list(spec.keys.items()))}
    down = {*held, *(same[tuple(spec.keys[code])] for code in held if code in spec.keys)}
    held_together = [code for code in spec.keys if "+" in code and down.issuperset(code.split("+"))]
    return sorted(held_together, key=lambda code: code.count("+"))
