"""Every World of the house, simulated, recorded and learned, against the contract."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

import terrella
from terrella.core import check_world
from terrella.sim.gymnasium import GymnasiumConfig, GymnasiumWorld
from terrella.sim.replay import ReplayWorld

from ..robot import Robot

BUNDLED = Path(terrella.__file__).parent / "bundled" / "doom-maze"


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1", "MountainCar-v0", "FrozenLake-v1"])
def test_gymnasium_environments_that_can_be_copied(name):
    pytest.importorskip("pygame", reason="drawing needs pygame: pip install 'gymnasium[classic-control]'")
    world = GymnasiumWorld(name)
    assert world.spec.forkable and "rgb" in world.spec.channels
    assert "states_are_values" in check_world(world, steps=30)
    world.close()


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1"])
def test_gymnasium_environments_as_tickets(name):
    assert "stale_states_are_refused" in check_world(
        GymnasiumWorld(name, GymnasiumConfig(rgb=False, forkable=False)), steps=30
    )


def test_a_recorded_episode():
    rng = np.random.default_rng(0)
    pose = rng.normal(size=(9, 7)).astype(np.float32)
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    channels = {
        "rgb": rng.integers(0, 256, (9, 6, 8, 3), dtype=np.uint8),
        "depth": rng.uniform(0, 60, (9, 6, 8)).astype(np.float16),
        "pose": pose,
        "reward": rng.normal(size=9).astype(np.float32),
    }
    check_world(ReplayWorld(channels, np.zeros((8, 6)), spaces.MultiBinary(6), 1 / 35), steps=12)


def test_the_real_game():
    pytest.importorskip("vizdoom", reason="ViZDoom is not installed: pip install vizdoom")
    from terrella.sim.doom import Doom

    game = Doom()
    assert "stale_states_are_refused" in check_world(game, steps=5)
    game.close()


def test_the_bundled_learned_world():
    if not BUNDLED.exists():
        pytest.skip("the learned world doom-maze is not bundled yet: src/terrella/bundled/doom-maze is absent")
    world = terrella.load("doom-maze")
    assert "states_are_values" in check_world(world, steps=3)


def test_a_robot_with_two_cameras_and_axes():
    assert "a_batch_equals_its_singles" in check_world(Robot(), steps=20)
