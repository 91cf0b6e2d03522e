"""Drift: how fast the position of a world leaves the truth, from rollouts of up to 1,000 steps under recorded actions.

The error of a frame grows from what the network of the uncertainty expects at the true place to what two random pictures of the
recording differ by (worlds/uncertainty.py: `drifts`). Four numbers are fitted, so that a few rollouts are enough.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
import torch

from ...core.world import make_rng, without_end
from ...worlds.generator import Conditioning
from ...worlds.learned import LearnedWorld
from ...worlds.uncertainty import UncertaintyNetwork, UncertaintyProbe, input_maps, placed, situation_of
from ..recording import Recording

LONGEST = 1000  # steps of a rollout
LOOKS = 64  # steps of it whose frames are compared
ROLLOUTS, SHOWN = 4, 3  # and observed frames before each
PAIRS = 512  # of random pictures
FIT_STEPS, ALIKE = 300, 0.01  # and the weight with which rates are drawn to each other


class DriftFrames(NamedTuple):
    """N frames of rollouts: the way since evidence gone [N, len(GONE)], the error that is expected at the true place [N], the error
    [N] and the step of the rollout [N]."""

    gone: torch.Tensor
    expected: torch.Tensor
    error: torch.Tensor
    step: torch.Tensor


def ceiling_of(recording: Recording, seed: int) -> float:
    """The mean absolute difference of two random pictures of the recording, intensity 0..1."""
    rows = np.random.default_rng([seed, 13]).choice(np.flatnonzero(recording.usable), (2, PAIRS))
    differences = [
        (recording.rgb(some[:1]).float() - recording.rgb(some[1:]).float()).abs().mean() / 255 for some in rows.T
    ]
    return float(torch.stack(differences).mean())


def drift_horizon(recording: Recording, frames: int) -> int:
    """Steps of the rollouts, for the number of frames that an uncertainty is learned from: the longest that a fifth of the rows
    allow."""
    ahead = recording.steps_ahead()
    typical = int(np.quantile(ahead[ahead > 0], 0.8)) if (ahead > 0).any() else 0
    return min(LONGEST, max(8, frames // 4), max(0, typical - SHOWN))


@torch.inference_mode()
def drift_frames(
    world: LearnedWorld,
    recording: Recording,
    horizon: int,
    rollouts: int = ROLLOUTS,
    seed: int = 0,
    limit_s: float = 1e9,
    shown: int = SHOWN,
) -> DriftFrames:
    """Frames of rollouts of `world`, which has an uncertainty, along recorded episodes, after `shown` observed frames; determined
    by the seed, and by `limit_s` seconds after which they end."""
    network, began = world.uncertainty, time.monotonic()
    assert isinstance(network, UncertaintyNetwork)
    seen: list[torch.Tensor] = []

    def note(conditioning: Conditioning, clean: torch.Tensor, gone: torch.Tensor) -> None:
        answer = network(input_maps(conditioning, clean), situation_of(placed(gone), conditioning))
        seen.append(network.calibrated(answer.mean((1, 2))).cpu())

    dreamer = world.replaced(uncertainty=UncertaintyProbe(note))
    rng, parts, half = np.random.default_rng([seed, 14]), [], LOOKS // 2
    looks = {*np.geomspace(1, horizon, half).astype(int), *np.linspace(1, horizon, half).astype(int)}
    begins = rng.choice(np.flatnonzero(recording.steps_ahead() >= shown + horizon), rollouts)
    chance = make_rng(int(rng.integers(2**62)))
    state = dreamer.observe(recording.evidence(dreamer.config, begins), None, chance)
    for row in range(1, shown):
        state = dreamer.imagine(state, recording.recorded_actions(dreamer.spec, begins + row - 1), chance)
        state = dreamer.observe(recording.evidence(dreamer.config, begins + row), state, chance)
    for step in range(1, horizon + 1):
        rows = begins + shown - 1 + step
        state = dreamer.imagine(without_end(state), recording.recorded_actions(dreamer.spec, rows - 1), chance)
        drawn = dreamer.render(state, ("rgb",))["rgb"].cpu().permute(0, 3, 1, 2).float()
        if step in looks:
            error = (drawn - recording.rgb(rows).float()).abs().mean((1, 2, 3)) / 255
            gone = state["gone"].cpu()
            parts.append(DriftFrames(gone, seen[-1], error, torch.full_like(gone[:, 0], step)))
        seen.clear()
        if time.monotonic() - began > limit_s:
            break
    return DriftFrames(*map(torch.cat, zip(*parts)))


def fit_drift(network: UncertaintyNetwork, frames: DriftFrames) -> None:
    """Sets the network's rates of drift: those under which the errors are likeliest, each exponential about its expectation. Steps,
    metres and radians go together in rollouts: what the errors do not tell apart counts alike."""
    gone, base, error = frames.gone[:, :3].clone(), frames.expected.clone(), frames.error.clone()
    usual = gone.mean(0)
    gone, room = gone / usual.clamp_min(1e-6), (network.ceiling.clone() - base).clamp_min(0)
    rates = torch.zeros(4, requires_grad=True)  # logarithms, the last of the power
    learner = torch.optim.Adam([rates], 0.05)
    for _ in range(FIT_STEPS):
        hazard = (gone @ rates[:3].exp()).clamp_min(1e-9) ** rates[3].exp()
        expected = (base + room * (1 - torch.exp(-hazard))).clamp_min(1e-4)
        loss = (expected.log() + error / expected).mean() + ALIKE * rates[:3][usual > 0].var(correction=0)
        learner.zero_grad()
        loss.backward()
        learner.step()
    fitted = rates.detach().exp()
    network.drift.copy_(torch.cat([torch.where(usual > 0, fitted[:3] / usual.clamp_min(1e-6), 0.0), fitted[3:]]))


def reliability(expected: torch.Tensor, error: torch.Tensor, groups: int = 10) -> list[float]:
    """How much the mean expected error of each of `groups` of equally many frames, ordered by what is expected, exceeds the mean
    error [groups]: 1 is right, 1.5 half as much again."""
    return [float(expected[part].mean() / error[part].mean()) for part in expected.argsort().tensor_split(groups)]
