"""Worlds of a few lines whose best plans are known: a point mass, a grid with a wall, one that tells nothing, one of chance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from gymnasium import spaces

from terrella.core.arena import Arena
from terrella.core.spec import DONE, REWARD, Spec
from terrella.core.state import State

MOVES = torch.tensor([[0, 0], [0, 1], [0, -1], [1, 0], [-1, 0]])


class _Tiny:
    def __init__(self, **changes):
        self.spec = Spec(name=type(self).__name__, dt_s=0.1, **{**self.about, **changes})

    def observe(self, observation, prior, rng):
        return State({"at": observation["observation"].clone()})

    def render(self, state, channels):
        self.spec.check_channels(channels)
        return {name: self.shown(state, name) for name in channels}

    def shown(self, state, name):
        return {
            "observation": lambda: state["at"],
            "reward": lambda: -state["at"].float().abs().sum(1),
            "done": lambda: torch.zeros(state.batch, dtype=torch.bool),
            "uncertainty": lambda: state["at"][:, 0].abs() / 10,
        }[name]()


class Point(_Tiny):
    """A mass in the plane [-10, 10]^2 that moves by its action, up to 1 a step and axis; the reward is minus the way to 0."""

    about = {
        "action": spaces.Box(-1, 1, (2,), np.float32),
        "channels": {
            "observation": spaces.Box(-10, 10, (2,), np.float32),
            "reward": REWARD,
            "done": DONE,
            "uncertainty": spaces.Box(0, 1, (), np.float32),
        },
        "observes": ("observation",),
        "differentiable": True,
    }
    wind = 0.0

    def start(self, batch, rng):
        return State({"at": torch.stack([torch.rand(2, generator=rng) * 10 - 5 for _ in range(batch)])})

    def imagine(self, state, action, rng):
        self.spec.check_action(action, state.batch)
        blown = (
            [torch.randn(2, generator=rng) * self.wind for _ in range(state.batch)] if self.wind else [torch.zeros(2)]
        )
        return State({"at": (state["at"] + action + torch.stack(blown)).clamp(-10, 10)})


class Windy(Point):
    """The same with chance."""

    wind = 0.3


class Perilous(Point):
    """An episode left of the middle may end at every step, and each step is as good as another."""

    def __init__(self):
        super().__init__()
        unit = spaces.Box(0, 1, (), np.float32)
        self.spec = replace(self.spec, channels={**self.spec.channels, "done_probability": unit})

    def shown(self, state, name):
        where = state["at"][:, 0]
        known = {"reward": torch.ones_like(where), "done_probability": 0.4 * torch.sigmoid(-3 * where)}
        return known[name] if name in known else super().shown(state, name)


class Broken(Point):
    """Knows no reward."""

    def shown(self, state, name):
        return torch.full((state.batch,), torch.nan) if name == "reward" else super().shown(state, name)


class Recalls(Point):
    """Pays for being where its episode began, which it keeps in an arena."""

    def __init__(self):
        super().__init__()
        self.arena = Arena({"home": (torch.float32, (2,))})

    def start(self, batch, rng):
        at = super().start(batch, rng)["at"]
        return State({"at": at, "rows": self.arena.keep({"home": at})[:, None]}, {"rows": self.arena})

    def imagine(self, state, action, rng):
        return state.replace(at=super().imagine(state, action, rng)["at"])

    def shown(self, state, name):
        home = self.arena.read("home")[state["rows"][:, 0]]
        return -(state["at"] - home).abs().sum(1) if name == "reward" else super().shown(state, name)


class Grid(_Tiny):
    """A grid of 9 x 9 with a wall at column 4 and a gate in row 8: moves are stay, right, left, down, up."""

    about = {
        "action": spaces.Discrete(5),
        "channels": {"observation": spaces.Box(0, 8, (2,), np.int64), "reward": REWARD, "done": DONE},
        "observes": ("observation",),
    }

    def start(self, batch, rng):
        return State({"at": torch.zeros(batch, 2, dtype=torch.int64)})

    def imagine(self, state, action, rng):
        self.spec.check_action(action, state.batch)
        after = (state["at"] + MOVES[action]).clamp(0, 8)
        walled = (after[:, 1] == 4) & (after[:, 0] != 8)
        return State({"at": torch.where(walled[:, None], state["at"], after)})
