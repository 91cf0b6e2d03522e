"""Corrected: a simulator and, around it, a learned model of how the real robot differs: each step is put right by what was seen.

A world model of few real episodes: the simulator says most, a small ensemble the rest (residual physics, Zeng et al. 2019;
neural-augmented simulation, Golemo et al. 2018). Play is told by a bank of play operators (Prandtl and Ishlinskii's model of
hysteresis): few episodes do not teach a network to remember so far back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import nn

from ..core.state import State
from ..core.world import make_rng
from .mujoco_world import MujocoWorld
from .trials import PAST, PLAYS, Trials, driven, idle, placed
from .wrapper import WorldWrapper

MEMBERS, HIDDEN = 4, 64
_PAST = "corrected.past"


class Residual(nn.Module):
    """What qpos and qvel [B, nq + nv] come to beyond the simulator's word, by joints, speeds and the last actions: the mean of an
    ensemble, within what was seen."""

    mean: torch.Tensor
    scale: torch.Tensor
    unit: torch.Tensor
    low: torch.Tensor
    high: torch.Tensor

    def __init__(self, joints: int, actions: int):
        super().__init__()
        width, out = 4 * joints + (PAST + 1) * (1 + len(PLAYS)) * actions, 2 * joints
        self.members = nn.ModuleList(
            nn.Sequential(
                nn.Linear(width, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, out)
            )
            for _ in range(MEMBERS)
        )
        for name, size, value in (("mean", width, 0.0), ("scale", width, 1.0), ("unit", out, 1.0)):
            self.register_buffer(name, torch.full((size,), value))
        for name in ("low", "high"):
            self.register_buffer(name, torch.zeros(out))

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Of each member, in units of what is usual: [members, B, out]."""
        scaled = ((inputs - self.mean) / self.scale).clamp(-5, 5)
        return torch.stack([member(scaled) for member in self.members])

    def found(self, inputs: torch.Tensor) -> torch.Tensor:
        return (self(inputs).mean(0) * self.unit).clamp(self.low, self.high)

    def settle(self, inputs: torch.Tensor, targets: torch.Tensor) -> None:
        """Tells it the size of what it will see and say."""
        self.mean.copy_(inputs.mean(0))
        self.scale.copy_(inputs.std(0).clamp_min(1e-3))
        self.unit.copy_(targets.square().mean(0).sqrt().clamp_min(1e-6))
        self.low.copy_(targets.amin(0))
        self.high.copy_(targets.amax(0))


def inputs_of(qpos: torch.Tensor, qvel: torch.Tensor, drives: torch.Tensor) -> torch.Tensor:
    """qpos [B, n], qvel [B, n] and the last drives [B, PAST + 1, 1 + PLAYS, nu], the newest last, as a Residual takes them."""
    return torch.cat([qpos, qpos.cos(), qpos.sin(), qvel, drives.flatten(1)], 1).float()


@torch.no_grad()
def residuals(world: MujocoWorld, trials: Trials) -> tuple[torch.Tensor, torch.Tensor]:
    """Inputs [R, ...] and targets [R, nq + nv] of a Residual: by how much each real step went beyond the simulator's."""
    known = trials.known.flatten()
    drives, actions = trials.drives().flatten(0, 1)[known], trials.actions.flatten(0, 1)[known]
    (qpos, qvel), (qpos1, qvel1) = (
        (trials.qpos[:, part].flatten(0, 1)[known], trials.qvel[:, part].flatten(0, 1)[known])
        for part in (slice(None, -1), slice(1, None))
    )
    state = placed(world, world.start(len(qpos), make_rng(0)), actions[:, None][:, :0], qpos, qvel)
    physics = world.imagine(state, actions, make_rng(0))["physics"]
    away = [qpos1 - physics[:, world.body.qpos], qvel1 - physics[:, world.body.qvel]]
    return inputs_of(qpos, qvel, drives), torch.cat(away, 1).float()


class Corrected(WorldWrapper[MujocoWorld]):
    """`Corrected(world, residual)`: the same world, each step of which is put right. Its state also holds the last drives."""

    def __init__(self, world: MujocoWorld, residual: Residual):
        self.world, self.residual = world, residual.eval().requires_grad_(False)
        self.spec = replace(
            world.spec, name=f"{world.spec.name} corrected", card={**world.spec.card, "corrected": True}
        )

    def start(self, batch: int, rng: torch.Generator) -> State:
        before = idle(self.spec, batch)[:, None, None].repeat(1, PAST, 1 + len(PLAYS), 1)
        return self.world.start(batch, rng).replace(**{_PAST: before})

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        return prior if prior is not None and not observation else self._first(observation, rng)

    def _first(self, observation: Mapping[str, torch.Tensor], rng: torch.Generator) -> State:
        self.world.observe(observation, None, rng)  # a simulator takes no evidence, and says so
        return self.start(1, rng)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        moved, body = self.world.imagine(state, action, rng), self.world.body
        now = driven(self.spec.check_action(action, state.batch), state[_PAST][:, -1])
        drives = torch.cat([state[_PAST], now[:, None]], 1)
        before, after = state["physics"], moved["physics"]
        more = self.residual.found(inputs_of(before[:, body.qpos], before[:, body.qvel], drives))
        more = torch.where(state["done"][:, None], 0.0, more)
        qpos, qvel = more.tensor_split([len(body.home)], 1)
        moved = self.world.replaced(state, moved, after[:, body.qpos] + qpos, after[:, body.qvel] + qvel)
        return moved.replace(**{_PAST: drives[:, 1:]})

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        return self.world.render(state, channels)
