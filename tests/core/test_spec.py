"""Spec: what it samples it accepts, what does not fit it refuses; rollouts; errors."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from terrella.core import Spec, errors, make_rng
from terrella.core.errors import ActionError, ChannelError

ACTIONS = [
    spaces.Discrete(3),
    spaces.Discrete(3, start=-1),
    spaces.MultiBinary(6),
    spaces.MultiBinary((2, 3)),
    spaces.MultiDiscrete([2, 5]),
    spaces.Box(-1, 1, (3,), np.float32),
    spaces.Box(np.array([-2.0, 0.0]), np.array([2.0, np.inf]), dtype=np.float64),
    spaces.Box(0, 255, (2, 2), np.uint8),
    spaces.Box(-1, 1, (), np.float32),
]
each_action = pytest.mark.parametrize("action", ACTIONS, ids=str)


def spec(action: spaces.Space) -> Spec:
    return Spec("a world", action, {"rgb": spaces.Box(0, 255, (2, 2, 3), np.uint8)}, (), 1.0)


@each_action
@given(seed=st.integers(0, 2**31), batch=st.integers(1, 5))
def test_a_sampled_action_is_an_action_and_comes_back_unchanged(action, seed, batch):
    sampled = spec(action).sample_action(batch, make_rng(seed))
    checked = spec(action).check_action(sampled, batch)
    assert torch.equal(checked, sampled) and checked.numpy().dtype == action.dtype
    assert all(action.contains(np.asarray(row)) for row in sampled.numpy())
    assert torch.equal(sampled, spec(action).sample_action(batch, make_rng(seed)))


@each_action
def test_every_corner_of_the_space_is_sampled(action):
    low, high = spec(action).action_limits
    many = spec(action).sample_action(4000, make_rng(0)).double().numpy()
    reach = 0.02 * (np.clip(high, -1e3, 1e3).astype(float) - np.clip(low, -1e3, 1e3).astype(float))
    assert (many.min(0) <= np.clip(low, -1e3, 1e3) + reach).all() and (
        many.max(0) >= np.clip(high, -1e3, 1e3) - reach
    ).all()


@each_action
def test_the_limits_are_actions_and_what_lies_beyond_is_not(action):
    world = spec(action)
    low, high = (torch.from_numpy(np.array(limit))[None] for limit in world.action_limits)
    world.check_action(low, 1)
    if torch.isfinite(high.double()).all():
        world.check_action(high, 1)
        for beyond in (high.double() + 1, low.double() - 1):
            with pytest.raises(ActionError, match="takes actions in"):
                world.check_action(beyond, 1)


@each_action
def test_wrong_shapes_and_junk_are_refused(action):
    world = spec(action)
    good = world.sample_action(1, make_rng(0))
    for junk in (good[None], good.repeat_interleave(2, 0), good[0], "forward", None, [[["?"]]], {"a": 1}):
        with pytest.raises(ActionError):
            world.check_action(junk, 1)
    for junk in (torch.full(good.shape, float("nan")), torch.full(good.shape, float("inf")), good + 1j):
        with pytest.raises(ActionError, match="finite"):
            world.check_action(junk, 1)


def test_numbers_of_other_types_are_taken_where_they_mean_the_same():
    buttons = spec(spaces.MultiBinary(2))
    for same in (
        [[1, 0]],
        np.array([[1.0, 0.0]]),
        torch.tensor([[True, False]]),
        torch.tensor([[1, 0]], dtype=torch.bfloat16),
    ):
        assert buttons.check_action(same, 1).tolist() == [[1, 0]]
    for other in ([[0.5, 0]], [[2, 0]], [[257, 0]], [[-1, 0]]):
        with pytest.raises(ActionError):
            buttons.check_action(other, 1)
    assert (
        spec(spaces.Box(-1, 1, (1,), np.float32)).check_action(torch.tensor([[1.0]], dtype=torch.float64), 1).dtype
        == torch.float32
    )


def test_a_checked_action_shares_no_memory_with_what_was_given():
    given_action = torch.zeros(1, 2)
    checked = spec(spaces.Box(-1, 1, (2,), np.float32)).check_action(given_action, 1)
    given_action += 1
    assert checked.abs().max() == 0


def test_an_unknown_kind_of_space_is_named():
    with pytest.raises(ActionError, match="must be a Box, Discrete"):
        spec(spaces.Text(3)).sample_action(1, make_rng(0))


def test_unknown_channels_are_answered_with_the_known():
    with pytest.raises(ChannelError, match="cannot render 'sound'; it has rgb"):
        spec(spaces.Discrete(2)).check_channels(["rgb", "sound"])


def test_every_error_of_ours_is_a_terrella_error_with_a_sentence():
    ours = [error for _, error in inspect.getmembers(errors, inspect.isclass) if error.__module__ == errors.__name__]
    assert len(ours) > 5
    for error in ours:
        assert issubclass(error, errors.TerrellaError) and error.__doc__.strip().endswith(".")
