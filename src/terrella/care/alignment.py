"""Which shift of the actions best explains the motion: finds recordings whose actions stand in the wrong rows.

Motion i is what happened between rows i and i + 1. A baseline predicts motion i by ridge regression from the motion before
and the state. For each shift s, a second regression takes action i + s as well. Both are fitted on one half of the
stretches and tested on the other. The gain of s is the share of the baseline's squared error that the action removes. In
a correct recording shift 0 has the largest gain.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

FARTHEST = 8  # largest shift that is tried, rows
_STRETCH = 48  # rows of a stretch
_RIDGE = 1e-6
_FEWEST = 6  # stretches that a verdict needs
_FEWEST_ROWS = 120  # rows that a verdict needs
_LEAST_GAIN = 0.1  # least gain of the better shift
_LEAST_CUT = 0.15  # share by which the better shift must lower the remaining error
_AGREE = 0.75  # share of the stretches that must prefer the better shift
_LAG_S = 0.35  # delay, in seconds, with which a body follows position commands


@dataclass(frozen=True)
class EpisodeMotion:
    """One episode: action float64 [T, A]; motion [T - 1, M] after each row; state [T, S], where S may be 0."""

    action: np.ndarray
    motion: np.ndarray
    state: np.ndarray


@dataclass(frozen=True)
class AlignmentVerdict:
    """The result of the test."""

    best: int  # shift that explains the motion best, rows; 0 where no other is clearly better
    gains: dict[int, float]  # shift -> gain
    stretches: int  # stretches tested
    agree: float  # share of them that prefer `best`
    follows: bool  # whether actions are positions that the state follows


def judge_alignment(runs: Sequence[EpisodeMotion], fps: float) -> AlignmentVerdict | None:
    """Tests the episodes; None where they are too few, or no shift of the actions explains any motion."""
    parts = _stretches(runs)
    if len(parts) < _FEWEST or sum(len(part.motion) - 2 * FARTHEST for part in parts) < _FEWEST_ROWS:
        return None
    with np.errstate(all="ignore"):
        left, base = _left(parts)  # [parts, shifts, targets], [parts, targets]
    total, total_base = left.sum(0), base.sum(0)
    most = (1 - total / np.maximum(total_base, 1e-12)).max(0)
    stated = most > max(_LEAST_GAIN, 0.5 * most.max(initial=0))  # targets that no action moves would only add noise
    stated &= total_base > 1e-9 * sum(len(part.motion) for part in parts)
    if not stated.any():
        return None
    share = left[:, :, stated] / np.maximum(total_base[stated], 1e-12)  # each target has the same weight
    gains = 1 - share.sum(0).mean(-1)
    shifts = range(-FARTHEST, FARTHEST + 1)
    best = int(np.argmax(gains))
    each = share.mean(-1)
    agree = float((each[:, best] < each[:, FARTHEST]).mean())
    shift = best - FARTHEST
    with np.errstate(all="ignore"):
        follows = _follows(runs)
        reacts = not follows and _reacts(parts)
    lags = follows and -max(2, _LAG_S * fps) <= shift < 0
    if not _clear(gains, best, agree) or lags or (reacts and shift > 0):
        shift = 0
    return AlignmentVerdict(shift, dict(zip(shifts, map(float, gains))), len(parts), agree, follows)


def _clear(gains: np.ndarray, best: int, agree: float) -> bool:
    if best in (FARTHEST, 0, len(gains) - 1):
        return False
    cut = (gains[best] - gains[FARTHEST]) / max(1e-9, 1 - gains[FARTHEST])
    return gains[best] >= _LEAST_GAIN and cut >= _LEAST_CUT and agree >= _AGREE


def _follows(runs: Sequence[EpisodeMotion]) -> bool:
    """Whether actions are positions that the state takes now or later: each correlates with some number of the state."""
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


def _reacts(runs: Sequence[EpisodeMotion]) -> bool:
    """Whether actions are mostly a function of the state in their row; then they predict motion that they did not cause."""
    if not runs[0].state.shape[1]:
        return False
    states = [np.hstack([state, np.ones((len(state), 1))]) for state in _standard([run.state for run in runs])]
    actions = _standard([run.action for run in runs])
    left = sum(error.sum() for error in _errors(states, actions))
    return left < 0.3 * sum((action**2).sum() for action in actions)


def _stretches(runs: Sequence[EpisodeMotion]) -> list[EpisodeMotion]:
    stretches = []
    for run in runs:
        rows = min(len(run.action), len(run.motion) + 1)
        pieces = max(1, round((rows - 2 * FARTHEST) / _STRETCH))
        edges = np.linspace(FARTHEST, rows - 1 - FARTHEST, pieces + 1).astype(int)
        for begin, end in zip(edges, edges[1:]):
            if end - begin >= 8:
                keep = slice(begin - FARTHEST, end + FARTHEST + 1)
                motion = run.motion[begin - FARTHEST : end + FARTHEST]
                stretches.append(EpisodeMotion(run.action[keep], motion, run.state[keep]))
    return stretches


def _left(parts: list[EpisodeMotion]) -> tuple[np.ndarray, np.ndarray]:
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
    base = np.stack(_errors(known, targets))
    left = []
    for shift in range(-far, far + 1):
        inputs = [np.hstack([a[far + shift : far + shift + len(t)], k]) for a, k, t in zip(actions, known, targets)]
        left.append(np.stack(_errors(inputs, targets)))
    return np.stack(left, 1), base


def _errors(inputs: list[np.ndarray], targets: list[np.ndarray]) -> list[np.ndarray]:
    """Squared error of each stretch, [targets] each, by a ridge regression over the other fold."""
    errors: list[np.ndarray] = [np.zeros(0)] * len(inputs)
    for fold in (0, 1):
        test = np.arange(len(inputs)) % 2 == fold
        x = np.concatenate([inputs[i] for i in np.flatnonzero(~test)])
        y = np.concatenate([targets[i] for i in np.flatnonzero(~test)])
        weights = np.linalg.solve(x.T @ x + _RIDGE * len(x) * np.eye(x.shape[1]), x.T @ y)
        for i in np.flatnonzero(test):
            errors[i] = ((targets[i] - inputs[i] @ weights) ** 2).sum(0)
    return errors


def _tamed(motion: np.ndarray, parts: list[EpisodeMotion]) -> np.ndarray:
    """Clips jumps (a reset, an angle that wraps), which would dominate the regression."""
    low, high = np.percentile(np.concatenate([part.motion for part in parts]), [1, 99], axis=0)
    return motion.clip(low - (high - low), high + (high - low))


def _standard(arrays: list[np.ndarray]) -> list[np.ndarray]:
    every = np.concatenate(arrays)
    if not every.shape[1]:
        return arrays
    spread = every.std(0)
    moves = spread > 1e-9 * (1 + np.abs(every).max(0))
    return [((array - every.mean(0)) / np.where(moves, spread, 1))[:, moves] for array in arrays]
