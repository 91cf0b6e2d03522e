"""Episodes of a robot as arrays, and simulators set to their states: the data of identification and correction."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..core.errors import TerrellaError
from ..core.policy import Policy, observed_channels
from ..core.rollouts import rollout
from ..core.spec import Spec, neutral_action
from ..core.state import State
from ..core.world import World, make_rng, without_end
from .mujoco_world import MujocoWorld
from .wrapper import unwrapped

PAST = 4  # previous actions of a step, which reveal a delay
PLAYS = (1 / 32, 1 / 16, 1 / 8, 1 / 4)  # widths of the play operators, in units of the action


@dataclass(frozen=True)
class Trials:
    """N episodes of T steps, float32, in the units of the model."""

    qpos: torch.Tensor  # [N, T + 1, nq]
    qvel: torch.Tensor  # [N, T + 1, nv]
    actions: torch.Tensor  # [N, T, nu]
    valid: torch.Tensor  # bool [N, T], False after the end of an episode
    idle: torch.Tensor  # [N, nu], stands for the actions before the first

    def __getitem__(self, episodes: slice) -> Trials:
        return Trials(**{name: value[episodes] for name, value in vars(self).items()})

    def joined_with(self, more: Trials) -> Trials:
        """The episodes of both, which must have the same number of steps."""
        return Trials(**{name: torch.cat([value, vars(more)[name]]) for name, value in vars(self).items()})

    def past(self) -> torch.Tensor:
        """The PAST actions before each step [N, T, PAST, nu], the newest last."""
        before = self.idle[:, None].repeat(1, PAST, 1)
        return torch.cat([before, self.actions], 1).unfold(1, PAST, 1)[:, :-1].movedim(-1, 2)

    def drives(self) -> torch.Tensor:
        """The drives of each step and of the PAST steps before it [N, T, PAST + 1, 1 + PLAYS, nu], the newest last."""
        drives = [self.idle[:, None].repeat(1, 1 + len(PLAYS), 1)] * PAST
        for step in range(self.actions.shape[1]):
            drives.append(play_operators(self.actions[:, step], drives[-1]))
        return torch.stack(drives, 1).unfold(1, PAST + 1, 1).movedim(-1, 2)


def play_operators(actions: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
    """The drives [B, 1 + PLAYS, nu] of a step: the actions [B, nu] and, for each width of PLAYS, the value that follows the
    action only when it leaves the play; `before` are the drives of the step before."""
    half = torch.tensor((0.0, *PLAYS))[:, None] / 2
    return before.clamp(actions[:, None] - half, actions[:, None] + half)


def collect(world: World, policy: Policy, episodes: int, seed: int) -> Trials:
    """`episodes` episodes of the policy in a world that shows qpos and qvel."""
    rng, shown = make_rng(seed), [*observed_channels(policy, world.spec), "qpos", "qvel", "done"]
    channels = tuple(dict.fromkeys(shown))
    steps = world.spec.max_episode_steps or 200
    result = rollout(world, world.start(episodes, rng), policy, rng, channels, steps)
    qpos, qvel, done = (result.observations[name].transpose(0, 1) for name in ("qpos", "qvel", "done"))
    return Trials(qpos, qvel, result.actions.transpose(0, 1).float(), ~done[:, :-1], idle_actions(world.spec, episodes))


def idle_actions(spec: Spec, count: int) -> torch.Tensor:
    """The idle action, `count` times: [count, nu]."""
    return torch.from_numpy(neutral_action(spec)).float().expand(count, -1)


def simulator_of(world: World) -> MujocoWorld:
    """The MuJoCo simulator inside all wrappers; TerrellaError where there is none."""
    simulator = unwrapped(world)
    if not isinstance(simulator, MujocoWorld):
        raise TerrellaError(f"{world.spec.name} is not a MuJoCo simulator; give mujoco:NAME or mujoco:FILE.xml.")
    return simulator


def fitted_simulator(world: World) -> MujocoWorld:
    """The simulator inside, to which models can be fitted; TerrellaError where its joints are not all hinges and slides."""
    simulator = simulator_of(world)
    if simulator.file.nq != simulator.file.nv:
        raise TerrellaError(
            f"{world.spec.name} has a free joint or a ball joint; a model can be fitted to hinges and slides only."
        )
    return simulator


def with_joints(world: World, state: State, past: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> State:
    """The state [B] with the joints at qpos and qvel, after the actions `past` [B, K, nu]."""
    rng = make_rng(0)
    for step in range(past.shape[1]):
        state = world.imagine(state, past[:, step], rng)
    held = dict(fitted_simulator(world).with_joints(state, state, qpos, qvel).items())
    return without_end(state.replace(**held))
