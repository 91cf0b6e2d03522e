"""A tiny world for tests: a painted panorama that the keys turn, with a flicker drawn from the generator."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from gymnasium import spaces

from terrella.core import Spec, State
from terrella.core.errors import ObservationError, StaleStateError, TerrellaError

BUTTONS = ("MOVE_FORWARD", "MOVE_BACKWARD", "MOVE_LEFT", "MOVE_RIGHT", "TURN_LEFT", "TURN_RIGHT")
KEYS = {
    "KeyW": 0, "KeyS": 1, "KeyA": 2, "KeyD": 3, "ArrowLeft": 4, "ArrowRight": 5, "ArrowUp": 0, "ArrowDown": 1,
}  # fmt: skip
PIXELS_PER_STEP = 2


class Panorama:
    """Turning left moves the picture right by PIXELS_PER_STEP columns a step; `length` steps make an episode."""

    def __init__(
        self, size: tuple[int, int] = (48, 64), forkable: bool = True, length: int = 10**9, dt_s: float = 1 / 50
    ):
        height, width = size
        self.size, self.length, self.breaks_at = size, length, None
        self.picture = torch.from_numpy(_paint(height, width * 6))
        self._ticket = 0
        self.spec = Spec(
            name="panorama" if forkable else "fixed-panorama",
            action=spaces.MultiBinary(6),
            channels={
                "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
                "pose": spaces.Box(-np.inf, np.inf, (7,), np.float32),
                "reward": spaces.Box(-np.inf, np.inf, (), np.float32),
                "done": spaces.Box(0, 1, (), np.bool_),
            },
            observes=("pose",),
            dt_s=dt_s,
            action_names=BUTTONS,
            keys={code: [float(index == at) for index in range(6)] for code, at in KEYS.items()},
            forkable=forkable,
            max_batch=None if forkable else 1,
            card={"what": "a painted landscape that turns", "kind": "test", "scores": {"psnr": 31.2}},
        )

    def start(self, batch: int, rng: torch.Generator) -> State:
        if batch < 1 or batch > (self.spec.max_batch or batch):
            raise TerrellaError(f"{self.spec.name} cannot start a batch of {batch}.")
        column = torch.randint(self.picture.shape[1], (batch,), generator=rng)
        zeros = torch.zeros(batch)
        state = State({"column": column, "age": zeros.long(), "flicker": zeros, "x": zeros, "walked": zeros})
        return self._ticketed(state)

    def observe(self, observation, prior, rng) -> State:
        if "pose" not in observation:
            raise ObservationError("a panorama needs `pose`.")
        pose = observation["pose"]
        yaw = 2 * torch.atan2(pose[:, 6], pose[:, 3])
        wide = self.picture.shape[1]
        column = (-yaw / (2 * math.pi) * wide).round().long() % wide
        zeros = torch.zeros(len(pose))
        return self._ticketed(
            State({"column": column, "age": zeros.long(), "flicker": zeros, "x": pose[:, 0], "walked": zeros})
        )

    def imagine(self, state: State, action, rng) -> State:
        action = self.spec.check_action(action, state.batch).float()
        self._check(state)
        if self.breaks_at is not None and int(state["age"][0]) >= self.breaks_at:
            raise RuntimeError("the paint is wet")
        turn = (action[:, 5] - action[:, 4]).long() * PIXELS_PER_STEP
        walk = action[:, 0] - action[:, 1]
        return self._ticketed(
            state.replace(
                column=(state["column"] + turn) % self.picture.shape[1],
                age=state["age"] + 1,
                flicker=torch.rand(state.batch, generator=rng),
                x=state["x"] + walk * 0.1,
                walked=walk,
            )
        )

    def render(self, state: State, channels):
        self.spec.check_channels(channels)
        self._check(state)
        return {name: self._channel(state, name) for name in channels}

    def _channel(self, state: State, name: str) -> torch.Tensor:
        if name == "reward":
            return state["walked"].float()
        if name == "done":
            return state["age"] >= self.length
        wide = self.picture.shape[1]
        if name == "pose":
            half = -state["column"].float() / wide * math.pi
            zero = torch.zeros_like(half)
            return torch.stack([state["x"].float(), zero, zero, half.cos(), zero, zero, half.sin()], 1)
        columns = (state["column"][:, None] + torch.arange(self.size[1])) % wide
        rgb = self.picture[:, columns].permute(1, 0, 2, 3).clone()
        rgb[:, :4, :4] = (state["flicker"] * 255).to(torch.uint8)[:, None, None, None]
        return rgb

    def _ticketed(self, state: State) -> State:
        if self.spec.forkable:
            return state
        self._ticket += 1
        return state.replace(ticket=torch.tensor([self._ticket]))

    def _check(self, state: State) -> None:
        if not self.spec.forkable and int(state["ticket"][0]) != self._ticket:
            raise StaleStateError(f"{self.spec.name} has moved on since this state.")


class SlowDream(Panorama):
    """A panorama under another name, to stand beside the truth."""

    def __init__(self, **options):
        super().__init__(**options)
        self.spec = replace(self.spec, name="dream-panorama")


def _paint(height: int, width: int) -> np.ndarray:
    """A night sky with an aurora over hills, closed in the round: uint8 [height, width, 3]."""
    rng = np.random.default_rng(4)
    angle = np.linspace(0, 2 * np.pi, width, endpoint=False)[None]
    up = np.linspace(1, 0, height)[:, None]

    def ripple(waves: int, fade: float) -> np.ndarray:
        parts = [np.sin(k * angle + rng.uniform(0, 6.28)) / k**fade for k in range(1, waves)]
        return sum(parts)

    sky = np.stack([10 + 14 * (1 - up), 14 + 22 * (1 - up), 34 + 40 * (1 - up)], -1) * np.ones((1, width, 1))
    centre, strength = 0.72 + 0.07 * ripple(7, 0.8), np.clip(0.6 + 0.5 * ripple(24, 0.6), 0, 1.4)
    veil = np.exp(-((up - centre).clip(0) ** 2) / 0.03 - ((centre - up).clip(0) ** 2) / 0.006) * strength
    sky += veil[..., None] * np.array([30, 120, 88]) + (veil**2)[..., None] * np.array([40, 4, 46])
    stars = rng.random((height, width)) > 0.994
    sky[stars] += rng.uniform(60, 190, (int(stars.sum()), 1))
    for far, (level, rough, colour) in enumerate([(0.36, 0.06, (24, 34, 52)), (0.22, 0.05, (13, 19, 30))]):
        ridge = level + rough * ripple(18 + 10 * far, 0.9)
        sky[np.broadcast_to(up < ridge, sky.shape[:2])] = colour
    for at in rng.integers(0, width, width // 12):
        row = height - 1 - rng.integers(1, max(2, height // 6))
        sky[row, at] = (250, 190, 110)
    return sky.clip(0, 255).astype(np.uint8)
