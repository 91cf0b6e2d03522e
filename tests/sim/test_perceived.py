"""Perceived worlds: what a policy sees follows the goal that was read off a picture; markers and distractors."""

from __future__ import annotations

from importlib.util import find_spec

import pytest
import torch

from terrella.core import make_rng
from terrella.core.errors import TerrellaError
from terrella.library import load

if find_spec("mujoco") is None:
    pytest.skip("mujoco is not installed: pip install 'terrella[mujoco]'", allow_module_level=True)

from terrella.sim.perceived import Perceived
from terrella.sim.randomised import Distribution, Randomised


@pytest.fixture(scope="module")
def arm():
    world = load("mujoco:arm", cameras=("view",), size=(32, 32))
    try:
        world.render(world.start(1, make_rng(0)), ("rgb",))
    except TerrellaError as error:
        pytest.skip(str(error))
    return world


def test_what_is_seen_follows_the_goal_that_was_read(arm):
    world = Perceived(arm, lambda shown: torch.full((len(shown), 2), 0.3))
    state, true = world.start(3, make_rng(1)), arm.start(3, make_rng(1))
    assert torch.equal(world.render(state, ("observation",))["observation"][:, -4:-2], torch.full((3, 2), 0.3))
    assert torch.equal(world.render(state, ("away",))["away"], arm.render(true, ("away",))["away"])
    after = world.imagine(state, torch.zeros(3, 2), make_rng(2))
    assert torch.equal(after["perceived.goal"], state["perceived.goal"])
    assert torch.equal(after["reward"], arm.imagine(true, torch.zeros(3, 2), make_rng(2))["reward"])


def test_a_world_without_pictures_or_goals_is_refused():
    with pytest.raises(TerrellaError, match="shows no 'rgb'"):
        Perceived(load("mujoco:arm", cameras=()), lambda shown: shown)


def test_the_goal_is_marked_where_it_is(arm):
    state = arm.start(2, make_rng(3))
    state = state.replace(marker=torch.tensor([[0.3, 0.0, 0.3], [-0.3, 0.0, 0.3]], dtype=torch.float64))
    red = (arm.render(state, ("rgb",))["rgb"].float() * torch.tensor([1.0, -1.0, -1.0])).sum(3).clamp_min(0)
    columns = red.sum(1) @ torch.arange(32.0) / red.sum((1, 2))
    assert columns[0] > 18 and columns[1] < 13


def test_distractors_are_drawn_and_the_same_again(arm):
    def shown(count: float) -> torch.Tensor:
        world = Randomised(arm, {"distractors": Distribution("constant", (count,))})
        return world.render(world.start(1, make_rng(4)), ("rgb",))["rgb"]

    assert torch.equal(shown(6.25), shown(6.25)) and not torch.equal(shown(6.25), shown(6.75))
    assert torch.equal(shown(0.0), arm.render(arm.start(1, make_rng(4)), ("rgb",))["rgb"])
