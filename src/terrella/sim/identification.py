"""System identification: the parameters of a randomised world under which it reproduces a robot's trials best."""

from dataclasses import dataclass

import torch

from ..core.world import make_rng
from .randomised import DELAY, Distribution, Randomised
from .trials import PAST, Trials, fitted_simulator, with_joints

CANDIDATES, ELITES, ROUNDS = 48, 8, 12  # of the cross-entropy method (Rubinstein 1999)
WINDOWS, STEPS = 32, 8  # number and length of the stretches of trials that candidates are compared with
MARGIN = 0.1  # of a range, to each side of the result, for training a policy


@dataclass(frozen=True)
class Identified:
    """The result of an identification."""

    values: dict[str, float]  # by parameter
    error: float  # of the simulated joints and speeds, in standard deviations
    nominal: float  # the same error of the nominal world

    def around(self, distributions: dict[str, Distribution]) -> dict[str, Distribution]:
        """Narrow ranges around the result, within those that were searched."""
        narrow = {}
        for name, one in distributions.items():
            low, high = one.limits
            value, half = self.values[name], MARGIN * (high - low)
            uniform = Distribution("uniform", (max(low, value - half), min(high, value + half)))
            narrow[name] = Distribution("constant", (value,)) if name == DELAY else uniform
        return narrow


@torch.no_grad()
def identify(world: Randomised, trials: Trials, seed: int) -> Identified:
    """Searches the ranges of the world by the cross-entropy method for the smallest error over stretches of the trials."""
    rng, limits = make_rng(seed), [one.limits for one in world.distributions.values()]
    low, high = torch.tensor(limits, dtype=torch.float64).T
    rows = _windows(trials, rng)
    mean, spread = torch.full_like(low, 0.5), torch.full_like(low, 0.35)
    for _ in range(ROUNDS):
        noise = torch.randn(CANDIDATES, len(low), generator=rng, dtype=torch.float64)
        shares = (mean + spread * noise).clamp(0, 1)
        shares[0] = mean
        errors = _errors(world, trials, rows, low + shares * (high - low))
        best = shares[errors.argsort()[:ELITES]]
        mean, spread = best.mean(0), best.std(0).clamp_min(0.01)
    values = low + mean * (high - low)
    names = list(world.distributions)
    if DELAY in names:
        values[names.index(DELAY)].round_()
    errors = _errors(world, trials, rows, torch.stack([values, world.nominal]))
    return Identified(dict(zip(names, values.tolist())), float(errors[0]), float(errors[1]))


def _windows(trials: Trials, rng: torch.Generator) -> torch.Tensor:
    """(episode, first step) of random stretches that are valid to their end: [WINDOWS, 2]."""
    steps = min(STEPS, trials.valid.shape[1])
    whole = trials.valid.unfold(1, steps, 1).all(-1).nonzero()
    return whole[torch.randint(len(whole), (WINDOWS,), generator=rng)]


def _errors(world: Randomised, trials: Trials, rows: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """The error [C] of each candidate [C, n] over the stretches, in standard deviations of the trials."""
    count, (episode, first) = len(values), rows.repeat(len(values), 1).T
    each = values.repeat_interleave(len(rows), 0)
    state = world.with_parameters(world.start(len(each), make_rng(0)), each)
    past = trials.past()[episode, first]
    state = with_joints(world, state, past[:, -PAST:], trials.qpos[episode, first], trials.qvel[episode, first])
    layout, error, rng = fitted_simulator(world).layout, torch.zeros(len(each), dtype=torch.float64), make_rng(0)
    of_qpos, of_qvel = (seen[:, :-1][trials.valid].std(0).clamp_min(1e-6) for seen in (trials.qpos, trials.qvel))
    steps = min(STEPS, trials.valid.shape[1])
    for step in range(steps):
        state = world.imagine(state, trials.actions[episode, first + step], rng)
        joints = (state["physics"][:, layout.qpos] - trials.qpos[episode, first + step + 1]) / of_qpos
        speeds = (state["physics"][:, layout.qvel] - trials.qvel[episode, first + step + 1]) / of_qvel
        error += joints.square().mean(1) + speeds.square().mean(1)
    return (error / steps).view(count, -1).mean(1).sqrt()
