"""Episodes of a robot as numbers, and simulators put where those episodes were: what identification and correction learn from."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..core.errors import TerrellaError
from ..core.policy import Policy
from ..core.rollouts import rollout
from ..core.state import State
from ..core.world import World, make_rng
from .mujoco_world import MujocoWorld

PAST = 4  # actions before a row, which tell what is late or has play


@dataclass(frozen=True)
class Trials:
    """N episodes of T steps. qpos [N, T + 1, nq], qvel [N, T + 1, nv], actions [N, T, nu]; known [N, T]: whether the step was
    made (an episode may end before the others). Float32, in the units of the model."""

    qpos: torch.Tensor
    qvel: torch.Tensor
    actions: torch.Tensor
    known: torch.Tensor

    def first(self, count: int) -> Trials:
        return Trials(self.qpos[:count], self.qvel[:count], self.actions[:count], self.known[:count])

    def past(self) -> torch.Tensor:
        """The PAST actions before each step [N, T, PAST, nu], the newest last; zeros before the first."""
        none = torch.zeros_like(self.actions[:, :1]).repeat(1, PAST, 1)
        return torch.cat([none, self.actions], 1).unfold(1, PAST, 1)[:, :-1].movedim(-1, 2)


def collect(world: World, policy: Policy, episodes: int, seed: int) -> Trials:
    """What the policy does in `episodes` episodes of a world that shows qpos and qvel."""
    rng, shown = make_rng(seed), [*getattr(policy, "sees", ()), "qpos", "qvel", "done"]
    channels = tuple(dict.fromkeys(shown))
    steps = world.spec.max_episode_steps or 200
    found = rollout(world, world.start(episodes, rng), policy, rng, channels, steps)
    qpos, qvel, done = (found.observations[name].transpose(0, 1) for name in ("qpos", "qvel", "done"))
    return Trials(qpos, qvel, found.actions.transpose(0, 1).float(), ~done[:, :-1])


def inner(world: World) -> MujocoWorld:
    """The simulator inside; TerrellaError where there is none whose joints are numbers that can be subtracted."""
    found = getattr(world, "world", world)
    if not isinstance(found, MujocoWorld):
        raise TerrellaError(f"{world.spec.name} is no simulator of MuJoCo; give mujoco:NAME or mujoco:FILE.xml.")
    if found.file.nq != found.file.nv:
        raise TerrellaError(
            f"{world.spec.name} has a joint that moves freely or a ball; its model can be fitted to hinges and slides alone."
        )
    return found


def placed(world: World, state: State, past: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> State:
    """The state [B] with the joints at qpos and qvel, after the actions `past` [B, K, nu]."""
    rng = make_rng(0)
    for step in range(past.shape[1]):
        state = world.imagine(state, past[:, step], rng)
    held = dict(inner(world).replaced(state, state, qpos, qvel).items())
    return state.replace(**{**held, "done": torch.zeros_like(held["done"])})
