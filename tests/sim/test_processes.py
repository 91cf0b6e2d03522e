"""Environments that cannot be copied: several episodes in processes, each as it would be alone, and gone with their world."""

from __future__ import annotations

import os
import time

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.core import as_env, check_world, make_rng
from terrella.core.errors import StaleStateError, TerrellaError
from terrella.sim.gymnasium import GymnasiumWorld


def _made():
    """A walk by its own chance, whose state is an object; action 2 kills the process, 3 is a fault of the environment. Defined
    in here, it is sent to the processes whole: they need not find this file."""

    class Walker(gymnasium.Env):
        action_space, observation_space = spaces.Discrete(4), spaces.Box(-np.inf, np.inf, (2,), np.float64)
        metadata, render_mode = {"render_modes": ["rgb_array"], "render_fps": 10}, "rgb_array"

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.engine = iter(self.np_random.normal(size=1000).tolist())
            self.at = next(self.engine)
            return self.seen(), {}

        def step(self, action):
            if action == 2:
                os._exit(1)
            if action == 3:
                raise ValueError("the engine is off")
            self.at += next(self.engine) * (2 * int(action) - 1)
            return self.seen(), self.at, abs(self.at) > 4, False, {}

        def seen(self):
            return np.array([self.at, os.getpid()])

        def render(self):
            return np.full((4, 6, 3), int(abs(self.at) * 10), np.uint8)

    return Walker


walker = _made()


@pytest.fixture(scope="module")
def world():
    found = GymnasiumWorld(walker)
    yield found
    found.close()


def test_episodes_in_processes_are_those_that_the_environment_plays_alone(world):
    """With the same seeds, also after one has ended and begun anew in its place; and there are no more processes than episodes."""
    env, alone = as_env(world, 3), [walker() for _ in range(3)]
    observations, _ = env.reset(seed=5)
    chance = torch.Generator()
    chance.set_state(env._rng.get_state())

    def begin(single, chance=chance):
        return single.reset(seed=int(torch.randint(2**31 - 1, (1,), generator=chance)))[0][0]

    places = [begin(single, make_rng(5 + place)) for place, single in enumerate(alone)]
    ended, ends = [False] * 3, 0
    actions = np.random.default_rng(0)
    for step in range(60):
        assert observations[:, 0].tolist() == places, step
        given = actions.integers(0, 2, 3)
        observations, rewards, terminated, _, _ = env.step(given)
        if not all(ended):
            torch.randint(
                2**31 - 1, (3,), generator=chance
            )  # the chance of a step, which this environment does not use
        for number, single in enumerate(alone):
            if ended[number]:
                places[number], ended[number] = begin(single), False
                continue
            seen, reward, ended[number], _, _ = single.step(given[number])
            places[number] = seen[0]
            assert rewards[number] == np.float32(reward) and terminated[number] == ended[number]
            ends += ended[number]
        if step == 0:
            pids = set(observations[:, 1])
        assert set(observations[:, 1]) == pids and len(pids) == 3 and os.getpid() not in pids
        assert [int(picture[0, 0, 0]) for picture in env.render()] == [int(abs(place) * 10) for place in places]
    assert ends > 3


def test_the_laws_hold_and_what_is_past_is_stale(world):
    class Tame(walker):
        action_space = spaces.Discrete(2)

    tame = GymnasiumWorld(Tame)
    assert "batches" in check_world(tame)
    tame.close()
    rng = make_rng(0)
    first = world.start(2, rng)
    second = world.imagine(first, torch.tensor([0, 1]), rng)
    for verb in (lambda: world.render(first, ("rgb",)), lambda: world.imagine(second.at([0, 0]), torch.ones(2), rng)):
        with pytest.raises(StaleStateError, match="cannot go back or be forked"):
            verb()
    world.render(second, ("rgb", "reward"))


def test_a_crash_and_a_fault_are_one_sentence_and_a_reset_goes_on(world):
    env = as_env(world, 2)
    env.reset(seed=0)
    with pytest.raises(TerrellaError, match=r"^gym:Walker fails when it is stepped, .*ValueError: the engine is off"):
        env.step(np.array([0, 3]))
    env.reset(seed=0)
    with pytest.raises(TerrellaError, match="a process of gym:Walker crashed .*a reset starts"):
        env.step(np.array([2, 1]))
    env.reset(seed=0)
    env.step(np.array([0, 1]))


@pytest.mark.parametrize("how", ["close", pytest.param("forget", marks=pytest.mark.slow)])
def test_processes_end_with_their_world(how):
    world = GymnasiumWorld(walker)
    seen = world.render(world.start(2, make_rng(0)), ("observation",))["observation"]
    assert all(_lives(int(pid)) for pid in seen[:, 1])
    if how == "close":
        world.close()
    del world
    until = time.monotonic() + 10
    while any(_lives(int(pid)) for pid in seen[:, 1]) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(_lives(int(pid)) for pid in seen[:, 1])


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
