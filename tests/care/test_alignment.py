"""The right shift of the actions is found, and a recording whose body merely follows slowly is left in peace."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from corridor import BUTTONS, Corridor, keys
from layouts import layout_of
from sweeps import sweep

from terrella.care import doctor
from terrella.care.alignment import EpisodeMotion, judge_alignment
from terrella.core import make_rng
from terrella.data import Recorder

FPS, ROWS = 20, 140
Body = Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]


def _held(rng: np.random.Generator, rows: int) -> np.ndarray:
    return np.repeat(rng.integers(0, 2, (ROWS // rows + 2, 4)), rows, 0)[:ROWS].astype(float)


def _smooth(rng: np.random.Generator) -> np.ndarray:
    window = np.hanning(25) / np.hanning(25).sum()
    noise = rng.normal(size=(ROWS + 50, 3))
    return np.stack([np.convolve(noise[:, i], window, "same") for i in range(3)], 1)[25 : 25 + ROWS] * 5


def _driven(action: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return action, np.cumsum(motion, 0) - motion  # the state of a row is before its motion


def _noise(rng):
    action = rng.normal(size=(ROWS, 2))
    return _driven(action, action + 0.3 * rng.normal(size=action.shape))


def _keys(rng):
    action = _held(rng, 5)
    return _driven(action, action[:, ::2] - action[:, 1::2] + 0.1 * rng.normal(size=(ROWS, 2)))


def _heavy(rng):
    """Keys push a mass with friction, so that motion lags behind them."""
    action, speed, motion = _held(rng, 5), np.zeros(2), []
    for row in action[:, ::2] - action[:, 1::2]:
        speed = 0.85 * speed + 0.15 * row
        motion.append(speed)
    return _driven(action, np.array(motion) + 0.01 * rng.normal(size=(ROWS, 2)))


def _follows(rng, late: int, gain: float):
    """Actions are positions; the state goes there by `gain` of the way in each row, from `late` rows later on."""
    action, state = _smooth(rng), np.zeros((ROWS + 1, 3))
    state[0] = action[0]
    for i in range(ROWS):
        state[i + 1] = state[i] + gain * (action[max(0, i - late)] - state[i])
    return action, (state + 0.002 * rng.normal(size=state.shape))[:ROWS]


def _reacts(rng):
    """A controller holds a body that is pushed about: its actions tell of motion that they did not cause."""
    state, action = np.zeros((ROWS + 1, 2)), np.zeros((ROWS, 2))
    for i in range(ROWS):
        action[i] = -0.5 * state[i] + 0.05 * rng.normal(size=2)
        state[i + 1] = state[i] + action[i] + 0.3 * rng.normal(size=2)
    return action, state[:ROWS]


def _unmoved(rng):
    return rng.normal(size=(ROWS, 2)), rng.normal(size=(ROWS, 2)).cumsum(0)


DRIVEN: dict[str, Body] = {"noise": _noise, "keys": _keys, "heavy": _heavy}
SOUND: dict[str, Body] = {
    **DRIVEN,
    "at once": lambda rng: _follows(rng, 0, 0.9),
    "slowly": lambda rng: _follows(rng, 0, 0.2),
    "a row late": lambda rng: _follows(rng, 1, 0.5),
    "two rows late": lambda rng: _follows(rng, 2, 0.5),
    "two rows late and slowly": lambda rng: _follows(rng, 2, 0.2),
    "reacts": _reacts,
    "unmoved": _unmoved,
}


def _best(body: Body, shift: int, seed: int, episodes: int = 8) -> int:
    rng, runs = np.random.default_rng(seed), []
    for _ in range(episodes):
        action, state = body(rng)
        runs.append(EpisodeMotion(np.roll(action, shift, 0), np.diff(state, axis=0), state))
    verdict = judge_alignment(runs, FPS)
    return 0 if verdict is None else verdict.best


@pytest.mark.parametrize("name", SOUND)
def test_sound_recordings_raise_no_alarm(name):
    assert [_best(SOUND[name], 0, seed, episodes) for seed, episodes in enumerate((2, 3, 5, 8, 12))] == [0] * 5


@pytest.mark.parametrize("shift", sweep([-7, -3, -1, 1, 2, 7], -3, 1))
@pytest.mark.parametrize("name", DRIVEN)
def test_the_shift_is_found(name, shift):
    assert _best(DRIVEN[name], shift, abs(shift)) == shift


@pytest.mark.parametrize("shift", [1, 3, 5])
def test_positions_given_late_are_found(shift):
    assert _best(SOUND["at once"], shift, shift) == shift


def test_too_little_tells_nothing():
    rng = np.random.default_rng(0)
    assert judge_alignment([], FPS) is None
    assert (
        judge_alignment([EpisodeMotion(rng.normal(size=(5, 2)), rng.normal(size=(4, 2)), np.zeros((5, 0)))] * 20, FPS)
        is None
    )
    still = EpisodeMotion(np.ones((100, 2)), np.zeros((99, 2)), np.zeros((100, 2)))
    assert judge_alignment([still] * 10, FPS) is None


def _walked(root, shift: int, pose: bool) -> None:
    """A recording of walks through the corridor, its actions `shift` rows late."""
    world, rng = Corridor(), make_rng(1)
    with Recorder(root, layout_of(35, BUTTONS, rgb=(48, 64), pose=pose)) as recorder:
        for _ in range(6):
            state, memory, seen, done = world.start(1, rng), keys.begin(1, rng), [], []
            for _ in range(60):
                rendered = world.render(state, ["rgb", "pose"] if pose else ["rgb"])
                seen.append({name: array[0].numpy() for name, array in rendered.items()})
                action, memory = keys.act(rendered, memory, rng)
                done.append(action[0].numpy())
                state = world.imagine(state, action, rng)
            for observation, action in zip(seen, np.roll(np.array(done), shift, 0)):
                recorder.add(observation, action)
            recorder.end_episode()


@pytest.mark.parametrize("pose", [True, False], ids=["by the pose", "by the pictures"])
@pytest.mark.parametrize("shift", [0, 2, -3])
def test_a_recording_says_how_late_its_actions_are(tmp_path, shift, pose):
    _walked(tmp_path / "walked", shift, pose)
    faults = doctor(tmp_path / "walked")
    if not shift:
        assert faults == []
        return
    way = "later" if shift > 0 else "earlier"
    assert len(faults) == 1 and f"by the actions {abs(shift)} rows {way}: they explain" in faults[0].what
    assert "of the state" in faults[0].what if pose else "of observation.images.rgb" in faults[0].what
    assert faults[0].mend.startswith(f"move the actions {abs(shift)} rows {'up' if shift > 0 else 'down'}")
