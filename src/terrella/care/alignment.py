"""Which shift of the actions best explains the motion: a test of recordings in which actions and rows slipped apart.

Motion i is what happened between rows i and i + 1. For each shift s, motion i is regressed (ridge, over half of the
stretches) on action i + s compared with what is known without it: the motion before, and the state; the gain is the share of
what is left unexplained there that the action explains on the other half. A sound recording gains most at 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

FARTHEST = 8  # rows; shifts looked at on either side
_STRETCH = 48  # rows that are judged together
_RIDGE = 1e-6
_FEWEST = 6  # stretches that must agree
_FEWEST_ROWS = 120  # in all of them
_LEAST_GAIN = 0.1  # of what is unexplained
_LEAST_CUT = 0.15  # by which the better shift must lower what stays unexplained
_AGREE = 0.75  # share of the stretches that prefer the better shift
_LAG_S = 0.35  # a body that is given positions follows them with such a delay


@dataclass(frozen=True)
class Run:
    """One episode: action float64 [T, A]; motion [T - 1, M], of what happened after each row; state [T, S], S may be 0."""

    action: np.ndarray
    motion: np.ndarray
    state: np.ndarray


@dataclass(frozen=True)
class Verdict:
    """gains: shift -> share of the motion left unexplained without actions that they explain; best: shift, 0 where sound."""

    best: int
    gains: dict[int, float]
    stretches: int
    agree: float
    follows: bool


def judge(runs: Sequence[Run], fps: float) -> Verdict | None:
    """None where the runs do not tell: too few, or nothing of the motion is explained by actions at any shift."""
    parts = _stretches(runs)
    if len(parts) < _FEWEST or sum(len(part.motion) - 2 * FARTHEST for part in parts) < _FEWEST_ROWS:
        return None
    with np.errstate(all="ignore"):
        left, base = _left(parts)  # [parts, shifts, targets], [parts, targets]
    total, total_base = left.sum(0), base.sum(0)
    most = (1 - total / np.maximum(total_base, 1e-12)).max(0)
    stated = most > max(_LEAST_GAIN, 0.5 * most.max(initial=0))  # what actions do not move would only blur the rest
    stated &= total_base > 1e-9 * sum(len(part.motion) for part in parts)
    if not stated.any():
        return None
    share = left[:, :, stated] / np.maximum(total_base[stated], 1e-12)  # each target counts alike
    gains = 1 - share.sum(0).mean(-1)
    shifts = range(-FARTHEST, FARTHEST + 1)
    best = int(np.argmax(gains))
    each = share.mean(-1)
    agree = float((each[:, best] < each[:, FARTHEST]).mean())
    found = best - FARTHEST
    with np.errstate(all="ignore"):
        follows = _follows(runs)
        reacts = not follows and _reacts(parts)
    lags = follows and -max(2, _LAG_S * fps) <= found < 0
    if not _clear(gains, best, agree) or lags or (reacts and found > 0):
        found = 0
    return Verdict(found, dict(zip(shifts, map(float, gains))), len(parts), agree, follows)


def _clear(gains: np.ndarray, best: int, agree: float) -> bool:
    none = FARTHEST
    if best == none or best in (0, len(gains) - 1):
        return False
    cut = (gains[best] - gains[none]) / max(1e-9, 1 - gains[none])
    return gains[best] >= _LEAST_GAIN and cut >= _LEAST_CUT and agree >= _AGREE


def _follows(runs: Sequence[Run]) -> bool:
    """Whether actions are positions that the state takes, at once or later: each number of them is like some number of it."""
    near = []
    moves = np.concatenate([run.action for run in runs]).std(0) > 1e-9
    for later in range(0, FARTHEST + 1, 2):
        action = np.concatenate([run.action[: len(run.action) - later] for run in runs])
        state = np.concatenate([run.state[later:] for run in runs])
        if not state.shape[1] or len(action) < 8:
            break
        match = np.corrcoef(action, state, rowvar=False)[: action.shape[1], action.shape[1] :]
        near.append(np.nan_to_num(match).max(1)[moves])
    return bool(near) and bool(moves.any()) and float(np.median(np.max(near, 0))) > 0.8


def _reacts(runs: Sequence[Run]) -> bool:
    """Whether actions are mostly computed from the state of their row: then they tell of motion that they did not cause."""
    if not runs[0].state.shape[1]:
        return False
    states = [np.hstack([state, np.ones((len(state), 1))]) for state in _standard([run.state for run in runs])]
    actions = _standard([run.action for run in runs])
    folds = [np.arange(len(runs)) % 2 == fold for fold in (0, 1)]
    left = sum(error.sum() for error in _errors(states, actions, folds))
    return left < 0.3 * sum((action**2).sum() for action in actions)


def _stretches(runs: Sequence[Run]) -> list[Run]:
    found = []
    for run in runs:
        rows = min(len(run.action), len(run.motion) + 1)
        pieces = max(1, round((rows - 2 * FARTHEST) / _STRETCH))
        edges = np.linspace(FARTHEST, rows - 1 - FARTHEST, pieces + 1).astype(int)
        for begin, end in zip(edges, edges[1:]):
            if end - begin >= 8:
                keep = slice(begin - FARTHEST, end + FARTHEST + 1)
                found.append(Run(run.action[keep], run.motion[begin - FARTHEST : end + FARTHEST], run.state[keep]))
    return found


def _left(parts: list[Run]) -> tuple[np.ndarray, np.ndarray]:
    """Squared error of each stretch and target: [parts, shifts, targets] with actions, [parts, targets] without."""
    far = FARTHEST
    actions = _standard([part.action for part in parts])
    states = _standard([part.state for part in parts])
    motions = _standard([_tamed(part.motion, parts) for part in parts])
    targets = [motion[far : len(motion) - far] for motion in motions]
    known = [
        np.hstack([motion[far - 1 : len(motion) - far - 1], state[far : far + len(target)], np.ones((len(target), 1))])
        for motion, state, target in zip(motions, states, targets)
    ]
    folds = [np.arange(len(parts)) % 2 == fold for fold in (0, 1)]
    base = np.stack(_errors(known, targets, folds))
    left = []
    for shift in range(-far, far + 1):
        inputs = [np.hstack([a[far + shift : far + shift + len(t)], k]) for a, k, t in zip(actions, known, targets)]
        left.append(np.stack(_errors(inputs, targets, folds)))
    return np.stack(left, 1), base


def _errors(inputs: list[np.ndarray], targets: list[np.ndarray], folds: list[np.ndarray]) -> list[np.ndarray]:
    """Squared error of each stretch, [targets] each, by a ridge regression over the other fold."""
    found: list[np.ndarray] = [np.zeros(0)] * len(inputs)
    for test in folds:
        x = np.concatenate([inputs[i] for i in np.flatnonzero(~test)])
        y = np.concatenate([targets[i] for i in np.flatnonzero(~test)])
        weights = np.linalg.solve(x.T @ x + _RIDGE * len(x) * np.eye(x.shape[1]), x.T @ y)
        for i in np.flatnonzero(test):
            found[i] = ((targets[i] - inputs[i] @ weights) ** 2).sum(0)
    return found


def _tamed(motion: np.ndarray, parts: list[Run]) -> np.ndarray:
    """Without leaps (a reset, an angle that wraps) that would outweigh all else."""
    every = np.concatenate([part.motion for part in parts])
    low, high = np.percentile(every, [1, 99], axis=0)
    return motion.clip(low - (high - low), high + (high - low))


def _standard(arrays: list[np.ndarray]) -> list[np.ndarray]:
    every = np.concatenate(arrays)
    if not every.shape[1]:
        return arrays
    spread = every.std(0)
    moves = spread > 1e-9 * (1 + np.abs(every).max(0))
    return [((array - every.mean(0)) / np.where(moves, spread, 1))[:, moves] for array in arrays]
