"""Coverage: what a recording has to teach: how often the picture changes, which actions show, how many places it saw."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from PIL import Image

from .dataset import Dataset
from .format import ACTION

_SIDE = 16  # of the small pictures that are compared
_SHIFTS = 200  # of the actions against the pictures: what chance would make of them
_LEAST_ROWS = 20  # of an action, to be judged


@dataclass(frozen=True)
class Coverage:
    """Of the rows looked at, whole stretches from all over the recording.

    frames:  how many were looked at.
    changed, changed_much: the share of them that differ from the one before (by more than 8 grey levels anywhere), and of
             those that do so in more than one pixel of a hundred.
    places:  different small pictures (16 x 16, 8 levels of each colour) among them.
    shown:   action -> whether what follows it differs from what follows others, more than chance would have it; actions that
             were taken too seldom to tell are absent.
    rare:    those actions.
    """

    frames: int = 0
    changed: float = 0.0
    changed_much: float = 0.0
    places: int = 0
    shown: dict[str, bool] = field(default_factory=dict)
    rare: tuple[str, ...] = ()

    def facts(self) -> dict[str, object]:
        shown = [name for name, does in self.shown.items() if does]
        return {
            "frames_that_change": round(self.changed, 3),
            "frames_that_change_much": round(self.changed_much, 3),
            "places": f"{self.places:,} in {self.frames:,} frames",
            "actions_with_a_clear_effect": f"{len(shown)} of {len(self.shown) + len(self.rare)}: {', '.join(shown) or 'none'}",
        }

    def warnings(self) -> list[str]:
        """A sentence for each reason why little can be learned of the recording."""
        found = []
        if self.frames < 2:
            return ["the recording has no pictures to compare, and worlds are learned from pictures."]
        if self.changed < 0.1:
            found.append(f"only {self.changed:.0%} of the frames differ from the one before")
        if self.places < 10:
            found.append(f"only {self.places} different places were seen")
        if self.shown and not any(self.shown.values()):
            found.append("no action is clearly seen to do anything: what follows looks alike whichever is taken")
        more = "play it yourself (--human), record more --frames, and `terrella data merge` both"
        return [f"this recording teaches little: {'; '.join(found)}; {more}."] if found else []


def coverage(dataset: Dataset, most: int = 4000) -> Coverage:
    """Looks at up to `most` rows of a recording, in stretches of up to 250."""
    small, actions, starts, changed, much = [], [], [], 0, 0
    if dataset.rgb_key is None or dataset.length < 2:
        return Coverage()
    acts = ACTION in dataset.features
    for number, first, count in _stretches(dataset, most):
        chosen = dataset.episode(number, [ACTION])[ACTION][first : first + count] if acts else np.zeros((count, 1))
        before = None
        for at, picture in enumerate(dataset.frames(number, first=first, count=count)):
            if before is not None:
                apart = np.abs(picture.astype(np.int16) - before).max(2) > 8
                changed, much = changed + bool(apart.any()), much + bool(apart.mean() > 0.01)
            starts.append(at == 0)
            before = picture
            small.append(np.asarray(Image.fromarray(picture).resize((_SIDE, _SIDE), Image.Resampling.BOX)))
        actions.append(chosen)
    pictures, follows = np.stack(small).astype(np.float32), ~np.array(starts)
    places = {zlib.crc32((one // 32).astype(np.uint8).tobytes()) for one in pictures}
    steps = max(1, int(follows.sum()))
    moved = [part[follows[1:]] for part in _movements(pictures)]
    taken = np.concatenate(actions)[:-1][follows[1:]]
    shown, rare = _shown(moved, _groups(dataset, taken)) if acts else ({}, ())
    return Coverage(len(small), changed / steps, much / steps, len(places), shown, rare)


def _stretches(dataset: Dataset, most: int) -> list[tuple[int, int, int]]:
    """(episode, first row, rows) from all over the recording."""
    pieces = [
        (number, first, min(250, episode.length - first))
        for number, episode in enumerate(dataset.episodes)
        for first in range(0, episode.length - 1, 250)
    ]
    wanted = max(1, min(len(pieces), most // max(1, sum(count for *_, count in pieces) // len(pieces))))
    return [pieces[at * len(pieces) // wanted] for at in range(wanted)]


def _groups(dataset: Dataset, taken: np.ndarray) -> dict[str, np.ndarray]:
    """name -> bool [rows] where an action was taken: each choice, each button, both ends of each axis."""
    world, names = dataset.world, list(dataset.world.get("action_names") or dataset.action_names)
    if world.get("discrete") and taken.shape[1] == 1:
        low = int((world.get("action_low") or [0])[0])
        high = int((world.get("action_high") or [taken.max()])[0])
        named = len(names) == high - low + 1
        return {names[at - low] if named else str(at): taken[:, 0] == at for at in range(low, high + 1)}
    found = {}
    for at, name in enumerate(list(dataset.action_names)[: taken.shape[1]]):
        column = taken[:, at]
        rest = np.median(column)
        if set(np.unique(column)) <= {0, 1}:
            found[name] = column > 0.5
        else:
            found |= {f"{name} {sign}": part for sign, part in (("-", column < rest), ("+", column > rest))}
    return found


def _movements(pictures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What happened between small pictures [T, n, n, 3]: what brightened where, and by how much; and, wherever it was, which way
    all that moved went (the sums of Lucas and Kanade's method, and of first moments) and how much changed: [T - 1, features]."""
    apart, grey = pictures[1:] - pictures[:-1], pictures[:-1].mean(3)
    steps, side = len(apart), pictures.shape[1]
    coarse = apart.reshape(steps, side // 2, 2, side // 2, 2, 3).mean((2, 4)).reshape(steps, -1)
    slopes, change = np.gradient(grey, axis=(1, 2)), apart.mean(3)
    flows = [(change * slope).sum((1, 2)) / (np.square(slope).sum((1, 2)) + 1) for slope in slopes]
    where = np.linspace(-1, 1, side)
    moments = [(change * where).sum((1, 2)), (change * where[:, None]).sum((1, 2))]
    whole = np.stack([*flows, *moments, np.abs(change).sum((1, 2)), *apart.mean((1, 2)).T], 1)
    return np.concatenate([coarse, np.abs(coarse)], 1), whole


def _shown(moved: Sequence[np.ndarray], groups: dict[str, np.ndarray]) -> tuple[dict[str, bool], tuple[str, ...]]:
    """Which actions have an effect: whether the mean of some kind of movement after one is further from that after all than when
    the same actions are shifted in time, which keeps how long each is held."""
    kinds = [part - part.mean(0) for part in moved]
    kinds = [(part / (part.std(0) + 1e-2)).astype(np.float32) for part in kinds]
    shown, rare, count = {}, [], len(kinds[0])
    rng = np.random.default_rng(0)
    shifts = rng.integers(count // 10 + 1, max(count - count // 10, count // 10 + 2), _SHIFTS) if count else []
    for name, where in groups.items():
        if where.sum() < _LEAST_ROWS or (~where).sum() < _LEAST_ROWS:
            rare.append(name)
            continue
        rows = np.stack([where, *(np.roll(where, shift) for shift in shifts)]).astype(np.float32)
        apart = [np.square(rows @ part / where.sum()).sum(1) for part in kinds]
        shown[name] = any(bool(one[0] > 1.3 * one[1:].max()) for one in apart)
    return shown, tuple(rare)
