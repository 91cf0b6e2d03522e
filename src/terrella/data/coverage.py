"""Coverage: how much can be learned from a recording: how often its pictures change, which actions have an effect."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from PIL import Image

from .dataset import Dataset
from .format import ACTION

_SIDE = 16  # side of the small pictures that are compared, pixels
_SHIFTS = 200  # random time shifts of the actions, which give the null distribution
_LEAST_ROWS = 20  # least rows of an action that is tested


@dataclass(frozen=True)
class Coverage:
    """Figures over a sample of rows: whole stretches from all over the recording."""

    frames: int = 0  # rows in the sample
    changed: float = 0.0  # share of them that differ from the row before, by more than 8 grey levels in any pixel
    changed_much: float = 0.0  # share of them that do so in more than one pixel of a hundred
    places: int = 0  # number of different small pictures (16 x 16 pixels, 8 levels of each colour)
    shown: dict[str, bool] = field(default_factory=dict)
    """Action -> whether the change of the picture after it differs from that after other actions, beyond chance."""
    rare: tuple[str, ...] = ()  # actions that are too rare to be tested

    def facts(self) -> dict[str, object]:
        """The figures as JSON values, for people."""
        shown = [name for name, does in self.shown.items() if does]
        return {
            "frames_that_change": round(self.changed, 3),
            "frames_that_change_much": round(self.changed_much, 3),
            "places": f"{self.places:,} in {self.frames:,} frames",
            "actions_with_a_clear_effect": f"{len(shown)} of {len(self.shown) + len(self.rare)}: {', '.join(shown) or 'none'}",
        }

    def warnings(self) -> list[str]:
        """[] or one sentence, with the reasons why little can be learned from the recording."""
        reasons = []
        if self.frames < 2:
            return ["the recording has fewer than two pictures, and worlds are learned from pictures."]
        if self.changed < 0.1:
            reasons.append(f"only {self.changed:.0%} of the frames differ from the one before")
        if self.places < 10:
            reasons.append(f"only {self.places} different places were seen")
        if self.shown and not any(self.shown.values()):
            reasons.append(
                f"no action's effect stands out from chance in the {self.frames:,} frames looked at, of {len(self.shown)} "
                "actions: they do little, or each was taken too seldom"
            )
        more = "play it yourself (--human), record more --frames, and `terrella data merge` both"
        return [f"this recording may teach little: {'; '.join(reasons)}; {more}."] if reasons else []


def measure_coverage(dataset: Dataset, most: int = 4000) -> Coverage:
    """The coverage of a recording, from up to `most` rows in stretches of up to 250."""
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
    movements = [part[follows[1:]] for part in _movements(pictures)]
    taken = np.concatenate(actions)[:-1][follows[1:]]
    shown, rare = _shown(movements, _groups(dataset, taken)) if acts else ({}, ())
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
    groups = {}
    for at, name in enumerate(list(dataset.action_names)[: taken.shape[1]]):
        column = taken[:, at]
        rest = np.median(column)
        if set(np.unique(column)) <= {0, 1}:
            groups[name] = column > 0.5
        else:
            groups |= {f"{name} {sign}": part for sign, part in (("-", column < rest), ("+", column > rest))}
    return groups


def _movements(pictures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Features [T - 1, F] of the change between small pictures [T, n, n, 3]: (local: the change of brightness of each block, and
    its size; global: sums of Lucas and Kanade's optical flow, first moments of the change, and its total size)."""
    apart, grey = pictures[1:] - pictures[:-1], pictures[:-1].mean(3)
    steps, side = len(apart), pictures.shape[1]
    coarse = apart.reshape(steps, side // 2, 2, side // 2, 2, 3).mean((2, 4)).reshape(steps, -1)
    slopes, change = np.gradient(grey, axis=(1, 2)), apart.mean(3)
    flows = [(change * slope).sum((1, 2)) / (np.square(slope).sum((1, 2)) + 1) for slope in slopes]
    where = np.linspace(-1, 1, side)
    moments = [(change * where).sum((1, 2)), (change * where[:, None]).sum((1, 2))]
    whole = np.stack([*flows, *moments, np.abs(change).sum((1, 2)), *apart.mean((1, 2)).T], 1)
    return np.concatenate([coarse, np.abs(coarse)], 1), whole


def _shown(movements: Sequence[np.ndarray], groups: dict[str, np.ndarray]) -> tuple[dict[str, bool], tuple[str, ...]]:
    """(action -> whether it has an effect, actions that are too rare): an effect is a mean change further from the overall mean
    than for any random time shift of the same actions. A shift keeps the time for which actions are held."""
    kinds = [part - part.mean(0) for part in movements]
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
