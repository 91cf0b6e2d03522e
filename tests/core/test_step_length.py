"""The length of an environment's step: what it is stepped at, and what else it says of it."""

from __future__ import annotations

import re
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from terrella.core.errors import TerrellaError
from terrella.core.numbers import single_number
from terrella.core.step_length import step_length


class Env(gymnasium.Env):
    """`fps` is its frame rate; the other arguments become attributes; each step advances `clock` (a path) by `advance`."""

    action_space = observation_space = spaces.Discrete(2)

    def __init__(self, fps=None, clock="", advance=0.0, **attributes):
        self.metadata = {} if fps is None else {"render_fps": fps}
        self.clock, self.advance = clock, advance
        for name, value in attributes.items():
            setattr(self, name, value)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        if self.clock:
            *owner, name = self.clock.split(".")
            at = getattr(self, owner[0]) if owner else self
            setattr(at, name, getattr(at, name) + self.advance)
        return 0, 0.0, False, False, {}


class Substeps(Env):
    """Repeats something in each step, in a method of its own."""

    def step(self, action):
        self.simulate(3)
        return super().step(action)

    def simulate(self, count):
        for _ in range(count):
            self.action_space.contains(0)


def model(timestep: float) -> SimpleNamespace:
    return SimpleNamespace(opt=SimpleNamespace(timestep=timestep))


@pytest.mark.parametrize(
    ("env", "seconds", "says"),
    [
        (Substeps(10, dt=0.01), 0.1, "its render_fps; by its dt, a substep, it would be 100"),
        (Substeps(30, time_step=0.001), 1 / 30, "its render_fps; by its time_step, a substep, it would be 1000"),
        (Env(10, dt=0.02), 0.02, "its dt; by its render_fps it would be 10"),  # its step repeats nothing
        (Substeps(20, tau=np.float32(0.005)), 0.05, "its render_fps; by its tau, a substep, it would be 200"),
        (Env(30, dt=0.05), 0.05, "its dt; by its render_fps it would be 30"),  # as Pendulum: longer than a frame
        (Env(200, timestep=0.01), 0.01, "its timestep; by its render_fps it would be 200"),
        (
            Substeps(30, dt=0.02),
            0.02,
            "its dt; by its render_fps it would be 30",
        ),  # a frame is no whole number of these
        (Env(50, dt=0.02), 0.02, "its dt"),
        (Env(None, dt=1), 1.0, "its dt"),
        (Env(30, control_freq=20), 0.05, "its control_freq; by its render_fps it would be 30"),
        (
            Env(60, dt=1 / 240, CTRL_FREQ=48),
            1 / 48,
            "its CTRL_FREQ; by its dt it would be 240; by its render_fps it would be 60",
        ),
        (Env(100, control_timestep=lambda: 0.04), 0.04, "its control_timestep; by its render_fps it would be 100"),
        (Env(10, model=model(0.002)), 0.1, "its render_fps; by its model.opt.timestep, a substep, it would be 500"),
        (Env(67, model=model(0.003), frame_skip=5), 0.015, "its model.opt.timestep x frame_skip"),
        (Env(None, model=model(0.002), frame_skip=10), 0.02, "its model.opt.timestep x frame_skip"),
        (Env(10, dt=0.01, n_substeps=10), 0.1, "its dt x n_substeps"),
        (Env(10, dt=0.1, n_substeps=10), 0.1, "its dt"),  # which counts them already
        (Env(25, sim_dt=0.002, decimation=20), 0.04, "its sim_dt x decimation"),
        (Env("30"), 1 / 30, "its render_fps"),
        (Env(None, _timeStep=1 / 240, _actionRepeat=8), 1 / 30, "its _timeStep x _actionRepeat"),
        (Env(25, sim=SimpleNamespace(dt=0.04)), 0.04, "its sim.dt"),
        (Env("12.5 Hz"), 0.08, "its render_fps"),
        (Env("30000/1001"), 1001 / 30000, "its render_fps"),
        (Env("30/0"), None, "no rate is declared; its render_fps, '30/0', is no rate"),
        (
            Env(15, config={"policy_frequency": 5, "simulation_frequency": 15}),  # as highway-env
            0.2,
            "its config.policy_frequency; by its render_fps it would be 15",
        ),
        (Env(50, _env=SimpleNamespace(control_timestep=lambda: 0.02)), 0.02, "its _env.control_timestep"),  # as shimmy
        (Env(np.array([15])), 1 / 15, "its render_fps"),
        (Env("fast"), None, "no rate is declared; its render_fps, 'fast', is no rate"),
        (Env(0), None, "no rate is declared; its render_fps, 0, is no rate"),
        (Env(), None, "no rate is declared"),
        (
            Env(50, "data.time", 0.01, data=SimpleNamespace(time=0.0)),
            0.01,
            "its clock `data.time`; by its render_fps it would be 50",
        ),
        (Env(15, "time", 0.5, time=0.0), 0.5, "its clock `time`; by its render_fps it would be 15"),
        (Env(15, "time", 1, time=0), 1 / 15, "its render_fps"),  # a count of steps
        (Env(15, "time", 1.0, time=0.0), 1 / 15, "its render_fps"),
        (
            Env(15, "data.time", 0.0, data=SimpleNamespace(time=0.0)),
            1 / 15,
            "its render_fps",
        ),  # a clock that stands still
    ],
)
def test_a_step_lasts_what_the_environment_is_stepped_at(env, seconds, says):
    env.reset(seed=0)
    length, where = step_length(env)
    assert length == (None if seconds is None else pytest.approx(seconds, rel=1e-5))
    assert re.fullmatch(says, where.removesuffix("; --fps sets another")), where


def test_a_computed_dt_counts_its_substeps():
    class Robot(Env):
        dt = property(lambda self: self.model.opt.timestep * self.frame_skip)

    assert step_length(Robot(model=model(0.01), frame_skip=5)) == (0.05, "its dt")


def test_a_wrapper_that_holds_actions_makes_longer_steps():
    env = gymnasium.wrappers.MaxAndSkipObservation(gymnasium.make("CartPole-v1"), skip=3)
    assert step_length(env) == (pytest.approx(0.06), "its tau, held 3 times by a wrapper")
    env = gymnasium.wrappers.TimeLimit(gymnasium.wrappers.MaxAndSkipObservation(Env(30), skip=2), 9)
    assert step_length(env) == (pytest.approx(1 / 15), "its render_fps, held 2 times by a wrapper")


def test_an_environment_without_metadata_or_with_a_step_that_fails_has_a_length():
    env = Env(None, "time", 0.1, time=0.0)
    env.metadata = None
    env.step = lambda action: 1 / 0
    assert step_length(env) == (None, "no rate is declared")


@pytest.mark.parametrize("value", [2, 2.0, np.float32(2), np.array(2), np.array([2.0]), np.array([[2]]), [2], (2.0,)])
def test_one_number_in_any_form_is_that_number(value):
    assert single_number(value, "it") == 2.0


@pytest.mark.parametrize("value", [None, "much", [1, 2], np.zeros(0), {"a": 1}])
def test_what_is_not_one_number_is_named(value):
    with pytest.raises(TerrellaError, match="its reward is .*one number is needed"):
        single_number(value, "its reward")
