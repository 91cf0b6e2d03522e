"""Whether the actions of a recording stand in the right rows, judged by the motion of the body or of the pictures."""

from collections.abc import Iterator

import numpy as np

from ..core.errors import DatasetError
from ..data.channels import ACTION, POSE_NAMES
from ..data.dataset import Dataset
from ..data.format import ACTION_VALID, names_of
from .alignment import FARTHEST, AlignmentVerdict, EpisodeMotion, judge_alignment
from .film_checks import FilmFacts
from .row_checks import EpisodeRows, RowFacts
from .survey import Fault, Survey

_WIDEST = 64  # most numbers of a state or action that are used
_CHOICES = 32  # an action of one number with at most this many values is a choice
_PIXELS = 600_000_000  # most pixels of a camera that are decoded
_EDGE = 64  # pixels of the longer side to which pictures are reduced


def check_alignment(survey: Survey, rows: RowFacts, shown: FilmFacts) -> Iterator[Fault]:
    """A fault where the actions of another row explain the motion clearly better."""
    if ACTION not in survey.features:
        return
    seen = [one for one in rows.episodes.values() if ACTION in one.kept and one.rows > 2 * FARTHEST + 9]
    actions = _actions(seen)
    with np.errstate(all="ignore"):  # row_checks reports numbers that are not finite
        verdict = judge_alignment(_bodies(survey, seen, actions), survey.fps)
    what = "the state"
    if verdict is None:
        verdict, what = _of_pictures(survey, seen, actions, shown)
    if verdict is not None and verdict.best:
        yield Fault("data", None, _words(verdict, what), _mend(verdict.best))


def _words(verdict: AlignmentVerdict, what: str) -> str:
    best, gains = verdict.best, verdict.gains
    rows = f"{abs(best)} row{'s' * (abs(best) > 1)} {'later' if best > 0 else 'earlier'}"
    return (
        f"the motion of {what} is explained best by the actions {rows}: they explain {gains[best]:.0%} of what the motion "
        f"before does not, the actions of the same row {max(0.0, gains[0]):.0%} (true of {verdict.agree:.0%} of "
        f"{verdict.stretches} stretches)"
    )


def _mend(best: int) -> str:
    way = "up" if best > 0 else "down"
    return f"move the actions {abs(best)} row{'s' * (abs(best) > 1)} {way} in each episode, and check why the recorder was late"


def _actions(seen: list[EpisodeRows]) -> list[np.ndarray]:
    """The actions of each episode, [T, A]; a choice becomes one column a value."""
    actions = [np.concatenate(one.kept[ACTION])[:, :_WIDEST] for one in seen]
    if actions and actions[0].shape[1] == 1:
        values = np.unique(np.concatenate(actions))
        if 2 < len(values) <= _CHOICES and np.array_equal(values, np.round(values)):
            return [(action == values).astype(np.float64) for action in actions]
    return actions


# -- motion of the body ----------------------------------------------------------------------------------------------


def _bodies(survey: Survey, seen: list[EpisodeRows], actions: list[np.ndarray]) -> list[EpisodeMotion]:
    episodes = []
    for one, action in zip(seen, actions):
        states = {name: np.concatenate(parts) for name, parts in one.kept.items() if name not in (ACTION, ACTION_VALID)}
        if not states:
            return []
        state = np.hstack(list(states.values()))[:, :_WIDEST]
        motion = [np.diff(state, axis=0)]
        for name, values in states.items():
            if names_of(survey.features[name]) == POSE_NAMES:
                motion.append(_seen_from_the_body(values))
        episodes.append(_valid(one, EpisodeMotion(action, np.hstack(motion), state)))
    return [run for run in episodes if run is not None]


def _valid(one: EpisodeRows, run: EpisodeMotion) -> EpisodeMotion | None:
    """The episode up to its last valid action; None where numbers are not finite."""
    rows = len(run.action)
    if ACTION_VALID in one.kept:
        valid = np.flatnonzero(np.concatenate(one.kept[ACTION_VALID])[:, 0] > 0)
        rows = min(rows, int(valid[-1]) + 1 if len(valid) else 0)
    run = EpisodeMotion(run.action[:rows], run.motion[: max(0, rows - 1)], run.state[:rows])
    return run if all(np.isfinite(part).all() for part in (run.action, run.motion, run.state)) else None


def _seen_from_the_body(pose: np.ndarray) -> np.ndarray:
    """[T - 1, 6]: translation and rotation vector of each step, in the frame of the body before it."""
    position, w, vector = pose[:, :3], pose[:, 3:4], pose[:, 4:7]
    step, back = np.diff(position, axis=0), -vector[:-1]
    cross = 2 * np.cross(back, step)
    motion = step + w[:-1] * cross + np.cross(back, cross)
    turned = w[:-1] * vector[1:] + w[1:] * back + np.cross(back, vector[1:])
    sign = np.where(w[:-1] * w[1:] - (back * vector[1:]).sum(1, keepdims=True) < 0, -1, 1)
    return np.hstack([motion, 2 * sign * turned])


# -- motion of the pictures ------------------------------------------------------------------------------------------


def _of_pictures(
    survey: Survey, seen: list[EpisodeRows], actions: list[np.ndarray], shown: FilmFacts
) -> tuple[AlignmentVerdict | None, str]:
    try:
        dataset = Dataset(survey.root)
    except DatasetError:
        return None, ""
    for camera in dataset.cameras:
        height, width = dataset.features[camera]["shape"][:2]
        left, runs = _PIXELS // (height * width), []
        for one, action in zip(seen, actions):
            rows = min(len(action), left, 256)
            if one.number in shown.static or rows < 2 * FARTHEST + 9:
                continue
            try:
                motion = _flow(dataset, one.number, camera, rows)
            except DatasetError:
                continue
            left -= rows
            run = _valid(one, EpisodeMotion(action[:rows], motion, np.zeros((rows, 0))))
            runs += [run] if run is not None else []
        verdict = judge_alignment(runs, survey.fps)
        if verdict is not None:
            return verdict, camera
    return None, ""


def _flow(dataset: Dataset, number: int, camera: str, rows: int) -> np.ndarray:
    """[rows - 1, 6] of each step: shift (phase correlation), shift and growth (image gradient), and log of the mean change."""
    motion, before = [], None
    for picture, _ in zip(dataset.frames(number, camera), range(rows)):
        grey = _small(picture)
        if before is not None:
            motion.append([*_shift(before, grey), *_gradient(before, grey), np.log1p(np.abs(grey - before).mean())])
        before = grey
    return np.array(motion)


def _small(picture: np.ndarray) -> np.ndarray:
    """float64 [h, w], each side at most _EDGE pixels: block averages of the grey picture."""
    block = max(1, -(-max(picture.shape[:2]) // _EDGE))
    height, width = picture.shape[0] // block, picture.shape[1] // block
    return picture[: height * block, : width * block].mean(2).reshape(height, block, width, block).mean((1, 3))


def _shift(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """(down, right): pixels by which `a` must move to give `b`."""
    window = np.outer(np.hanning(a.shape[0]), np.hanning(a.shape[1]))
    product = np.fft.rfft2((b - b.mean()) * window) * np.conj(np.fft.rfft2((a - a.mean()) * window))
    peak = np.fft.irfft2(product / (np.abs(product) + 1e-3 * np.abs(product).max() + 1e-9), a.shape)
    at = np.unravel_index(int(peak.argmax()), peak.shape)
    return tuple(float(place - size if place > size // 2 else place) for place, size in zip(at, a.shape))  # pyright: ignore


def _gradient(a: np.ndarray, b: np.ndarray) -> tuple[float, float, float]:
    """(down, right, growth) of the small motion that explains the change from `a` to `b` best (Lucas and Kanade 1981)."""
    down, right = np.gradient((a + b) / 2)
    y, x = np.mgrid[-1 : 1 : complex(0, a.shape[0]), -1 : 1 : complex(0, a.shape[1])]
    sides = np.stack([down.ravel(), right.ravel(), (down * y + right * x).ravel()])
    solved = np.linalg.solve(sides @ sides.T + 1e-3 * np.eye(3) * (1 + a.size), -sides @ (b - a).ravel())
    return tuple(map(float, solved))  # pyright: ignore
