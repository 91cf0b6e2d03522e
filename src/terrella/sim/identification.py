"""System identification: the parameters of a randomised world under which it does what a real robot was seen to do."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..core.world import make_rng
from .randomised import DELAY, Distribution, Randomised
from .trials import PAST, Trials, fitted_simulator, placed

CANDIDATES, KEPT, ROUNDS = 48, 8, 12  # of the cross-entropy method (Rubinstein 1999)
WINDOWS, STEPS = 32, 8  # stretches of the trials, and steps of each, that candidates are held to
NARROW = 0.1  # of a range, either way, within which a policy then practises


@dataclass(frozen=True)
class Identified:
    """values: by parameter; error, nominal: of its steps and of the unchanged world's, in deviations of joints and speeds."""

    values: dict[str, float]
    error: float
    nominal: float

    def around(self, distributions: dict[str, Distribution]) -> dict[str, Distribution]:
        """Narrow ranges around what was found, within those that were searched."""
        found = {}
        for name, one in distributions.items():
            low, high = one.limits
            value, half = self.values[name], NARROW * (high - low)
            told = (
                ("constant", (value,))
                if name == DELAY
                else ("uniform", (max(low, value - half), min(high, value + half)))
            )
            found[name] = Distribution(*told)
        return found


@torch.no_grad()
def identify(world: Randomised, trials: Trials, seed: int) -> Identified:
    """Searches the ranges of the world by the cross-entropy method: what foretells stretches of the trials best."""
    rng, limits = make_rng(seed), [one.limits for one in world.distributions.values()]
    low, high = torch.tensor(limits, dtype=torch.float64).T
    rows = _windows(trials, rng)
    mean, spread = torch.full_like(low, 0.5), torch.full_like(low, 0.35)
    for _ in range(ROUNDS):
        noise = torch.randn(CANDIDATES, len(low), generator=rng, dtype=torch.float64)
        shares = (mean + spread * noise).clamp(0, 1)
        shares[0] = mean
        errors = _errors(world, trials, rows, low + shares * (high - low))
        best = shares[errors.argsort()[:KEPT]]
        mean, spread = best.mean(0), best.std(0).clamp_min(0.01)
    values = low + mean * (high - low)
    names = list(world.distributions)
    if DELAY in names:
        values[names.index(DELAY)].round_()
    nominal = world.nominal
    errors = _errors(world, trials, rows, torch.stack([values, nominal]))
    return Identified(dict(zip(names, values.tolist())), float(errors[0]), float(errors[1]))


def _windows(trials: Trials, rng: torch.Generator) -> torch.Tensor:
    """(episode, step) of stretches that are known to their end: [WINDOWS, 2]."""
    steps = min(STEPS, trials.known.shape[1])
    whole = trials.known.unfold(1, steps, 1).all(-1).nonzero()
    return whole[torch.randint(len(whole), (WINDOWS,), generator=rng)]


def _errors(world: Randomised, trials: Trials, rows: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """How far each candidate [C, n] is from the trials over the stretches: [C]."""
    count, (episode, first) = len(values), rows.repeat(len(values), 1).T
    each = values.repeat_interleave(len(rows), 0)
    state = world.drawn_as(world.start(len(each), make_rng(0)), each)
    past = trials.past()[episode, first]
    state = placed(world, state, past[:, -PAST:], trials.qpos[episode, first], trials.qvel[episode, first])
    body, error, rng = fitted_simulator(world).body, torch.zeros(len(each), dtype=torch.float64), make_rng(0)
    of_qpos, of_qvel = (seen[:, :-1][trials.known].std(0).clamp_min(1e-6) for seen in (trials.qpos, trials.qvel))
    steps = min(STEPS, trials.known.shape[1])
    for step in range(steps):
        state = world.imagine(state, trials.actions[episode, first + step], rng)
        away = (state["physics"][:, body.qpos] - trials.qpos[episode, first + step + 1]) / of_qpos
        speed = (state["physics"][:, body.qvel] - trials.qvel[episode, first + step + 1]) / of_qvel
        error += away.square().mean(1) + speed.square().mean(1)
    return (error / steps).view(count, -1).mean(1).sqrt()
