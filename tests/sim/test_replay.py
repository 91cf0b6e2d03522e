"""Replay: the recorded frames in their order whatever the action, and a stand-still at the end."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from terrella.core import State, make_rng, rollout
from terrella.core.errors import ActionError, ObservationError, TerrellaError
from terrella.sim.replay import ReplayWorld

STEPS = 6
ACTION = spaces.MultiBinary(2)


def episode(**more) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "rgb": rng.integers(0, 256, (STEPS + 1, 4, 6, 3), dtype=np.uint8),
        "depth": rng.uniform(0, 9, (STEPS + 1, 2, 3)).astype(np.float16),
        "reward": np.arange(STEPS + 1, dtype=np.float64),
        **more,
    }


def film(**more) -> ReplayWorld:
    return ReplayWorld(episode(**more), np.zeros((STEPS, 2)), ACTION, 1 / 35)


@given(seed=st.integers(0, 2**31))
def test_the_recording_comes_back_whatever_the_action(seed):
    world, rng = film(), make_rng(seed)
    actions = torch.stack([world.spec.sample_action(2, rng) for _ in range(STEPS)])
    rolled = rollout(world, world.start(2, rng), actions, rng, ("rgb", "depth", "reward"))
    for name, recorded in episode().items():
        shown = rolled.observations[name]
        assert torch.equal(shown[:, 0], shown[:, 1])
        assert np.array_equal(shown[:, 0].numpy(), recorded.astype(shown.numpy().dtype))


def test_the_end_is_done_and_stays_without_reward():
    world, rng = film(), make_rng(0)
    rolled = rollout(world, world.start(1, rng), torch.zeros(STEPS + 3, 1, 2), rng, ("rgb", "reward", "done"))
    assert rolled.observations["done"][:, 0].tolist() == [False] * STEPS + [True] * 4
    assert rolled.observations["reward"][:, 0].tolist() == [0, 1, 2, 3, 4, 5, 6, 0, 0, 0]
    assert torch.equal(rolled.observations["rgb"][-1], rolled.observations["rgb"][STEPS])


def test_a_recorded_end_is_not_left():
    done = np.zeros(STEPS + 1, bool)
    done[3] = True
    world, rng = film(done=done), make_rng(0)
    rolled = rollout(world, world.start(1, rng), torch.zeros(STEPS, 1, 2), rng, ("reward", "done"))
    assert rolled.observations["done"][:, 0].tolist() == [False] * 3 + [True] * 4
    assert rolled.observations["reward"][:, 0].tolist() == [0, 1, 2, 3, 0, 0, 0]


def test_batch_entries_may_stand_at_different_frames():
    world, rng = film(), make_rng(0)
    first = world.start(1, rng)
    second = world.imagine(first, torch.zeros(1, 2), rng)
    both = world.render(State.stack([second, first]), ("rgb",))["rgb"]
    assert np.array_equal(both, episode()["rgb"][[1, 0]])


def test_arrays_tensors_and_memory_maps_are_shown_alike(tmp_path):
    arrays = episode()
    for name, array in arrays.items():
        np.save(tmp_path / f"{name}.npy", array)
    mapped = {name: np.load(tmp_path / f"{name}.npy", mmap_mode="r") for name in arrays}
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    shown = []
    for channels in (arrays, mapped, tensors):
        world, rng = ReplayWorld(channels, np.zeros((STEPS, 2)), ACTION, 0.1), make_rng(0)
        state = world.imagine(world.start(2, rng), torch.zeros(2, 2), rng)
        shown.append(world.render(state, tuple(world.spec.channels)))
        shown[-1]["rgb"].zero_()  # what is handed out is not the recording
        assert world.render(state, ("rgb",))["rgb"].any()
    assert all(torch.equal(shown[0][name], other[name]) for other in shown for name in other)
    assert {name: space.dtype for name, space in world.spec.channels.items()} == {
        "rgb": np.uint8,
        "depth": np.float32,
        "reward": np.float32,
        "done": np.bool_,
    }


def test_bad_requests_are_answered_in_one_sentence():
    with pytest.raises(TerrellaError, match="6 actions has 7 frames"):
        film(reward=np.zeros(STEPS))
    with pytest.raises(TerrellaError, match="frames in each channel"):
        ReplayWorld({}, np.zeros(0), ACTION, 0.1)
    world, rng = film(), make_rng(0)
    with pytest.raises(ActionError):
        world.imagine(world.start(1, rng), torch.zeros(1, 3), rng)
    with pytest.raises(ObservationError):
        world.observe({"rgb": torch.zeros(1)}, None, rng)
