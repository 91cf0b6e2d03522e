"""Drift: how fast the position of a world leaves the truth, from rollouts of up to 1,000 steps under recorded actions.

The error of a frame grows from what the network of the uncertainty expects at the true place to what two random pictures of the
recording differ by (worlds/uncertainty.py: `drifts`). Four numbers are fitted, so that a few rollouts are enough.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
import torch

from ...core.state import State
from ...core.world import make_rng
from ...worlds.generator import Conditioning
from ...worlds.learned import LearnedWorld
from ...worlds.uncertainty import UncertaintyNetwork, UncertaintyProbe, input_maps, placed, situation_of
from ..recording import Recording
from .stress import observed, steps_ahead

LONGEST = 1000  # steps of a rollout
LOOKS = 64  # steps of it whose frames are compared
ROLLOUTS, FEWEST = 12, 2  # in all: where frames need not be drawn at every step, and where they must
BATCH, SHOWN = 6, 3  # rollouts at a time, and observed frames before them
PAIRS = 512  # of random pictures
FIT_STEPS = 600


class DriftFrames(NamedTuple):
    """N frames of rollouts: the way since evidence gone [N, len(GONE)], the error that is expected at the true place [N], the error
    [N], the step of the rollout [N] and the number of the rollout [N]."""

    gone: torch.Tensor
    expected: torch.Tensor
    error: torch.Tensor
    step: torch.Tensor
    rollout: torch.Tensor


def ceiling_of(recording: Recording, seed: int) -> float:
    """The mean absolute difference of two random pictures of the recording, intensity 0..1."""
    rows = np.random.default_rng([seed, 13]).choice(np.flatnonzero(recording.usable), (2, PAIRS))
    differences = [
        (recording.rgb(some[:1]).float() - recording.rgb(some[1:]).float()).abs().mean() / 255 for some in rows.T
    ]
    return float(torch.stack(differences).mean())


def drift_horizon(recording: Recording, frames: int) -> int:
    """Steps of the rollouts, for so many frames of the uncertainty's training: the longest that two tenths of its rows in a row
    allow."""
    ahead = steps_ahead(recording)
    typical = int(np.quantile(ahead[ahead > 0], 0.8)) if (ahead > 0).any() else 0
    return min(LONGEST, max(8, frames // 4), max(0, typical - SHOWN))


def drift_cost(world: LearnedWorld, recording: Recording, frames: int) -> int:
    """How many frames `drift_frames` draws."""
    horizon = drift_horizon(recording, frames)
    return ROLLOUTS * min(LOOKS, horizon) if leaps(world) else FEWEST * horizon


def leaps(world: LearnedWorld) -> bool:
    """Whether a frame can be drawn at a pose alone, without those before it."""
    return world.config.geometry and not world.config.moving


@torch.inference_mode()
def drift_frames(
    world: LearnedWorld,
    recording: Recording,
    horizon: int,
    *,
    rollouts: int | None = None,
    seed: int = 0,
    limit_s: float = 1e9,
) -> DriftFrames:
    """Frames of rollouts of `world`, which has an uncertainty, along recorded episodes; determined by the seed unless the time
    is over. rollouts: None for as many as the kind of world needs."""
    network, leaping, began = world.uncertainty, leaps(world), time.monotonic()
    assert isinstance(network, UncertaintyNetwork)
    seen: list[tuple[Conditioning, torch.Tensor]] = []
    dreamer = world.replaced(
        uncertainty=UncertaintyProbe(lambda conditioning, clean, _: seen.append((conditioning, clean)))
    )
    rng, parts = np.random.default_rng([seed, 14]), []
    rows_ahead = np.flatnonzero(steps_ahead(recording) >= SHOWN + horizon)
    whole = rollouts or (ROLLOUTS if leaping else FEWEST)
    looks = set(np.geomspace(1, horizon, LOOKS // 2).astype(int)) | set(np.linspace(1, horizon, LOOKS // 2).astype(int))
    for number, some in enumerate(np.split(rng.choice(rows_ahead, whole), range(BATCH, whole, BATCH))):
        chance = make_rng(int(rng.integers(2**62)))
        state = first = observed(dreamer, recording, some, SHOWN, chance)
        for step in range(1, horizon + 1):
            rows = some + SHOWN - 1 + step
            state = dreamer.imagine(state, recording.recorded_actions(dreamer.spec, rows - 1), chance)
            if step in looks:
                frame = _look(dreamer, state, first if leaping else None, chance)
                conditioning, clean = seen[-1]
                situation = situation_of(placed(state["gone"]), conditioning)
                expected = network.calibrated(network(input_maps(conditioning, clean), situation).mean((1, 2)))
                error = (frame - recording.rgb(rows).float()).abs().mean((1, 2, 3)) / 255
                which = torch.arange(len(some)) + number * BATCH
                parts.append(DriftFrames(state["gone"], expected, error, torch.full_like(which, step), which))
                seen.clear()
            if time.monotonic() - began > limit_s:
                break
    return DriftFrames(*map(torch.cat, zip(*parts)))


def _look(world: LearnedWorld, state: State, first: State | None, chance: torch.Generator) -> torch.Tensor:
    """The frame of a state, float [B, 3, H, W] in 0..255; drawn at its pose from what `first` knows, if that is given."""
    shown = state if first is None else world.observe({"pose": state["pose"]}, first, chance)
    return world.render(shown, ("rgb",))["rgb"].cpu().permute(0, 3, 1, 2).float()


def fit_drift(network: UncertaintyNetwork, frames: DriftFrames) -> None:
    """Sets the network's rates of drift: those under which the errors are likeliest, each exponential about its expectation."""
    rates = torch.tensor([-7.0, -3.0, -3.0, 0.0], requires_grad=True)  # logarithms
    learner = torch.optim.Adam([rates], 0.05)
    gone, base, error = (part.clone() for part in (frames.gone, frames.expected, frames.error))
    room = (network.ceiling.clone() - base).clamp_min(0)
    for _ in range(FIT_STEPS):
        hazard = (gone[:, :3] @ rates[:3].exp()).clamp_min(1e-9) ** rates[3].exp()
        expected = (base + room * (1 - torch.exp(-hazard))).clamp_min(1e-4)
        loss = (expected.log() + error / expected).mean()
        learner.zero_grad()
        loss.backward()
        learner.step()
    network.drift.copy_(rates.detach().exp())


def reliability(expected: torch.Tensor, error: torch.Tensor, groups: int = 10) -> list[float]:
    """How much the mean expected error of each of `groups` of equally many frames, ordered by what is expected, exceeds the mean
    error [groups]: 1 is right, 1.5 half as much again."""
    return [float(expected[part].mean() / error[part].mean()) for part in expected.argsort().tensor_split(groups)]
