"""Corrected: a simulator with a learned residual, which corrects each step by the difference from a real robot, so that few
episodes suffice (residual physics, Zeng et al. 2019; neural-augmented simulation, Golemo et al. 2018). Backlash is an input as a
bank of play operators (the Prandtl-Ishlinskii model of hysteresis), a memory too long to be learned from few episodes."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import nn

from ..core.state import State
from ..core.world import make_rng
from .mujoco_world import MujocoWorld
from .trials import PAST, PLAYS, Trials, idle_actions, play_operators, with_joints
from .wrapper import WorldWrapper

MEMBERS, HIDDEN = 4, 64
_PAST = "corrected.past"


class Residual(nn.Module):
    """The difference [B, nq + nv] of qpos and qvel between the robot and the simulator after a step, from joints, speeds and the
    last actions: the mean of an ensemble, clamped to the range of its training targets."""

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
        """The prediction of each member, in units of the targets' RMS: [members, B, out]."""
        scaled = ((inputs - self.mean) / self.scale).clamp(-5, 5)
        return torch.stack([member(scaled) for member in self.members])

    def correction(self, inputs: torch.Tensor) -> torch.Tensor:
        return (self(inputs).mean(0) * self.unit).clamp(self.low, self.high)

    def fit_scales(self, inputs: torch.Tensor, targets: torch.Tensor) -> None:
        """Sets the scales of inputs and outputs from training data."""
        self.mean.copy_(inputs.mean(0))
        self.scale.copy_(inputs.std(0).clamp_min(1e-3))
        self.unit.copy_(targets.square().mean(0).sqrt().clamp_min(1e-6))
        self.low.copy_(targets.amin(0))
        self.high.copy_(targets.amax(0))


def inputs_of(qpos: torch.Tensor, qvel: torch.Tensor, drives: torch.Tensor) -> torch.Tensor:
    """The inputs of a Residual from qpos [B, n], qvel [B, n] and the last drives [B, PAST + 1, 1 + PLAYS, nu], the newest last."""
    return torch.cat([qpos, qpos.cos(), qpos.sin(), qvel, drives.flatten(1)], 1).float()


@torch.no_grad()
def residual_targets(world: MujocoWorld, trials: Trials) -> tuple[torch.Tensor, torch.Tensor]:
    """Inputs [R, ...] and targets [R, nq + nv] of a Residual: each real step minus the simulator's."""
    valid = trials.valid.flatten()
    drives, actions = trials.drives().flatten(0, 1)[valid], trials.actions.flatten(0, 1)[valid]
    (qpos, qvel), (qpos1, qvel1) = (
        (trials.qpos[:, part].flatten(0, 1)[valid], trials.qvel[:, part].flatten(0, 1)[valid])
        for part in (slice(None, -1), slice(1, None))
    )
    state = with_joints(world, world.start(len(qpos), make_rng(0)), actions[:, None][:, :0], qpos, qvel)
    physics = world.imagine(state, actions, make_rng(0))["physics"]
    difference = [qpos1 - physics[:, world.layout.qpos], qvel1 - physics[:, world.layout.qvel]]
    return inputs_of(qpos, qvel, drives), torch.cat(difference, 1).float()


class Corrected(WorldWrapper[MujocoWorld]):
    """`Corrected(world, residual)`: the world with corrected steps. Its state also holds the last drives."""

    def __init__(self, world: MujocoWorld, residual: Residual):
        self.world, self.residual = world, residual.eval().requires_grad_(False)
        self.spec = replace(
            world.spec, name=f"{world.spec.name} corrected", card={**world.spec.card, "corrected": True}
        )

    def start(self, batch: int, rng: torch.Generator) -> State:
        before = idle_actions(self.spec, batch)[:, None, None].repeat(1, PAST, 1 + len(PLAYS), 1)
        return self.world.start(batch, rng).replace(**{_PAST: before})

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        if prior is not None and not observation:
            return prior
        self.world.observe(observation, None, rng)  # raises on an observation: a simulator accepts none
        return self.start(1, rng)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        stepped, layout = self.world.imagine(state, action, rng), self.world.layout
        now = play_operators(self.spec.check_action(action, state.batch), state[_PAST][:, -1])
        drives = torch.cat([state[_PAST], now[:, None]], 1)
        before, after = state["physics"], stepped["physics"]
        change = self.residual.correction(inputs_of(before[:, layout.qpos], before[:, layout.qvel], drives))
        change = torch.where(state["done"][:, None], 0.0, change)
        qpos, qvel = change.tensor_split([len(layout.home)], 1)
        corrected = self.world.with_joints(state, stepped, after[:, layout.qpos] + qpos, after[:, layout.qvel] + qvel)
        return corrected.replace(**{_PAST: drives[:, 1:]})

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        return self.world.render(state, channels)
