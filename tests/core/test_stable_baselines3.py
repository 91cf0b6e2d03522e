"""as_sb3: what Stable-Baselines3 asks of a VecEnv, over any World."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium import spaces

import terrella
from terrella import library
from terrella.core.errors import TerrellaError
from terrella.sim.gymnasium import GymnasiumConfig, GymnasiumWorld
from terrella.sim.replay import ReplayWorld

sb3 = pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is missing: pip install 'terrella[sb3]'")


@pytest.fixture
def film():
    """Five frames of 48x40 pictures whose numbers count them; choices are 1 and 2; done at the end."""
    frames = np.arange(5, dtype=np.float32)
    rgb = np.zeros((5, 48, 40, 3), np.uint8) + frames.astype(np.uint8)[:, None, None, None]
    channels = {"health": frames, "reward": frames, "rgb": rgb}
    given = {"health": spaces.Box(0, 5, (), np.float32)}
    return ReplayWorld(channels, np.ones(4), spaces.Discrete(2, start=1), 0.1, spaces_given=given)


def test_an_episode_that_ends_begins_anew_and_hands_over_its_last_observation(film):
    env = terrella.as_sb3(film, 2, observation=("rgb", "health"))
    assert env.observation_space["rgb"].shape == (3, 48, 40) and env.observation_space["health"].shape == (1,)
    assert env.action_space == spaces.Discrete(2)
    seen = env.reset()
    for step in range(1, 5):
        assert env.observation_space.contains({name: array[0] for name, array in seen.items()})
        seen, rewards, dones, infos = env.step(np.array([0, 1]))
        assert rewards.dtype == np.float32 and rewards.tolist() == [step, step] and dones.tolist() == [step == 4] * 2
    last = infos[1]["terminal_observation"]
    assert last["rgb"].shape == (3, 48, 40) and (last["rgb"] == 4).all() and last["health"].tolist() == [4.0]
    assert infos[0]["TimeLimit.truncated"] is False and (seen["rgb"] == 0).all()


def test_a_time_limit_is_a_truncation(film):
    env = terrella.as_sb3(film, 1, max_steps=2, observation="health")
    env.reset()
    ends = [env.step(np.array([0])) for _ in range(2)]
    assert [bool(end[2][0]) for end in ends] == [False, True] and ends[1][3][0]["TimeLimit.truncated"] is True
    assert ends[1][3][0]["terminal_observation"].tolist() == [2.0] and ends[1][0].tolist() == [[0.0]]


def test_its_algorithms_and_wrappers_run(film, tmp_path, monkeypatch):
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path))
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

    short = {"n_steps": 8, "batch_size": 16, "n_epochs": 1, "device": "cpu", "seed": 0}
    cart = VecNormalize(VecMonitor(terrella.as_sb3(GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False)), 4)))
    sb3.PPO("MlpPolicy", cart, **short).learn(64)
    sb3.PPO("CnnPolicy", terrella.as_sb3(film, 2), **short).learn(16)
    model = sb3.PPO("MultiInputPolicy", terrella.as_sb3(film, 2, observation=("rgb", "health")), **short).learn(16)
    mean, _ = evaluate_policy(model, VecMonitor(terrella.as_sb3(film, 2, observation=("rgb", "health"))), 4)
    assert mean == 1 + 2 + 3 + 4
    pendulum = terrella.as_sb3(GymnasiumWorld("Pendulum-v1", GymnasiumConfig(rgb=False)), 2)
    sb3.SAC("MlpPolicy", pendulum, learning_starts=4, batch_size=4, device="cpu").learn(12)


def test_the_seed_tells_the_story(film):
    env = terrella.as_sb3(GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False)), 2)
    env.seed(3)
    first = env.reset()
    assert not np.array_equal(first, env.reset())
    env.seed(3)
    assert np.array_equal(first, env.reset())
    images = terrella.as_sb3(film, 2)
    images.reset()
    assert [image.shape for image in images.get_images()] == [(48, 40, 3)] * 2
    with pytest.raises(TerrellaError, match="no 'ride'"):
        images.env_method("ride")


def test_without_it_one_sentence_says_how_to_get_it(film, monkeypatch):
    monkeypatch.setattr(library, "find_spec", lambda name: None)
    with pytest.raises(
        TerrellaError, match=r"Stable-Baselines3, which is not installed: pip install 'terrella\[sb3\]'"
    ):
        terrella.as_sb3(film)
