"""Keys held in a browser to one action of a world."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from gymnasium import spaces

from ..core.spec import Spec


def action_of_keys(spec: Spec, held: Sequence[str]) -> torch.Tensor:
    """The action [1, *spec.action.shape] of the keys held, oldest first; codes the world does not know count as nothing.

    Buttons combine by element-wise maximum. An axis (Box) takes the held value that is furthest from rest, so that
    a negative direction is not lost to a zero; a choice (Discrete) is the key pressed last. With no key: zeros,
    brought into the space.
    """
    space = spec.action
    rows = [np.asarray(spec.keys[code], np.float64) for code in held if code in spec.keys]
    flat = np.zeros(int(np.prod(space.shape or ())) or 1)
    if rows and isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        flat = rows[-1]
    elif rows and isinstance(space, spaces.Box):
        table = np.stack(rows)
        table = table[np.argsort(-table.max(axis=1), kind="stable")]  # of two opposites, the positive
        flat = table[np.abs(table).argmax(axis=0), np.arange(table.shape[1])]
    elif rows:
        flat = np.max(rows, axis=0)
    action = flat.reshape(space.shape or ())
    if isinstance(space, spaces.Box):
        action = np.clip(action, space.low, space.high)
    elif isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        action = np.maximum(action, space.start)
    return torch.as_tensor(np.asarray(action, dtype=space.dtype))[None]
