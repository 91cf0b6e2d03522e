"""AtariWorld: the console's own save states make values of states, and what is shown is the screen, made small."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from terrella.core import State, check_world, make_rng
from terrella.core.errors import TerrellaError

pytest.importorskip("ale_py", reason="Atari games need ale-py: pip install 'terrella[atari]'")
from terrella.sim.atari import AtariWorld


@pytest.fixture(scope="module")
def breakout():
    world = AtariWorld("ALE/Breakout-v5")
    yield world
    world.close()


def played(world, actions, seed=0):
    state, rng = world.start(1, make_rng(seed)), make_rng(1)
    for action in actions:
        state = world.imagine(state, torch.tensor([action]), rng)
    return state


def test_breakout_keeps_the_contract_as_values(breakout):
    assert breakout.spec.forkable
    assert {"states_are_values", "states_can_be_saved", "batches"} <= set(check_world(breakout, steps=6))


def test_a_saved_state_goes_on_as_the_console_would_have(breakout, tmp_path):
    """A branch left for a while, saved and loaded, and the same buttons pressed without leaving: the same screen and score."""
    serve, hands = [1, 1, 1], [2, 2, 3, 0, 0, 3, 3, 2] * 4
    straight = played(breakout, serve + hands)
    left = played(breakout, serve)
    left.save(tmp_path / "state")
    played(breakout, [3] * 30, seed=7)
    state = State.load(tmp_path / "state")
    for action in hands:
        state = breakout.imagine(state, torch.tensor([action]), make_rng(2))
    assert torch.equal(state["rgb"], straight["rgb"]) and torch.equal(state["lives"], straight["lives"])
    assert not torch.equal(state["rgb"], played(breakout, serve + hands[:-1])["rgb"])


@pytest.mark.slow
def test_losing_all_lives_is_told_and_ends_the_game(breakout):
    state, rng, lives = breakout.start(1, make_rng(3)), make_rng(0), []
    for step in range(600):
        state = breakout.imagine(state, torch.tensor([1 if step % 3 == 0 else 3]), rng)
        lives.append(float(state["lives"]))
        if state["done"]:
            break
    assert lives[0] == 5 and lives[-1] == 0 and bool(state["done"])
    assert set(np.diff(lives)) <= {0.0, -1.0}
    assert float(breakout.imagine(state, torch.tensor([1]), rng)["reward"]) == 0


def test_small_pictures_are_the_mean_of_the_screen():
    large, small = (AtariWorld("ALE/Pong-v5", size=size, forkable=False) for size in (None, (21, 16)))
    screen = played(large, [0] * 25)["rgb"][0].double()
    mean = screen.view(21, 10, 16, 10, 3).mean((1, 3))
    assert large.spec.channels["rgb"].shape == (210, 160, 3)
    assert (played(small, [0] * 25)["rgb"][0].double() - mean).abs().max() <= 1.01  # rounded twice


@pytest.mark.slow
def test_with_sticky_actions_states_are_tickets():
    world = AtariWorld("ALE/Breakout-v5", sticky=0.25)
    assert not world.spec.forkable
    assert "stale_states_are_refused" in check_world(world, steps=4)


def test_unknown_games_are_named():
    with pytest.raises(TerrellaError, match="NoSuchGame"):
        AtariWorld("ALE/NoSuchGame-v5")


@pytest.mark.parametrize(
    "setting",
    [
        {"size": (0, 64)},
        {"size": (64,)},
        {"frames": 0},
        {"sticky": 2.0},
        {"noops": -1},
        {"sticky": 0.5, "forkable": True},
    ],
)
def test_settings_that_cannot_be_are_refused(setting):
    with pytest.raises(TerrellaError):
        AtariWorld("ALE/Breakout-v5", **setting)
