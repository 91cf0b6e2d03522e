"""Episodes of a robot as numbers, and simulators put where those episodes were: what identification and correction learn from."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..core.errors import TerrellaError
from ..core.policy import Policy, observed_channels
from ..core.rollouts import rollout
from ..core.spec import Spec, neutral_action
from ..core.state import State
from ..core.world import World, make_rng
from .mujoco_world import MujocoWorld
from .wrapper import unwrapped

PAST = 4  # actions before a row, which tell what is late
PLAYS = (1 / 32, 1 / 16, 1 / 8, 1 / 4)  # in units of actions: what a drive with so much play would follow


@dataclass(frozen=True)
class Trials:
    """N episodes of T steps. qpos [N, T + 1, nq], qvel [N, T + 1, nv], actions [N, T, nu]; known [N, T]: whether the step was
    made (an episode may end before the others); idle [N, nu]: what stands for actions before the first. Float32, in the units of
    the model."""

    qpos: torch.Tensor
    qvel: torch.Tensor
    actions: torch.Tensor
    known: torch.Tensor
    idle: torch.Tensor

    def __getitem__(self, episodes: slice) -> Trials:
        return Trials(**{name: value[episodes] for name, value in vars(self).items()})

    def and_then(self, more: Trials) -> Trials:
        """Those of both, of as many steps."""
        return Trials(**{name: torch.cat([value, vars(more)[name]]) for name, value in vars(self).items()})

    def past(self) -> torch.Tensor:
        """The PAST actions before each step [N, T, PAST, nu], the newest last."""
        return (
            torch.cat([self.idle[:, None].repeat(1, PAST, 1), self.actions], 1)
            .unfold(1, PAST, 1)[:, :-1]
            .movedim(-1, 2)
        )

    def drives(self) -> torch.Tensor:
        """The drives of each step and the PAST before it [N, T, PAST + 1, 1 + PLAYS, nu], the newest last."""
        drives = [self.idle[:, None].repeat(1, 1 + len(PLAYS), 1)] * PAST
        for step in range(self.actions.shape[1]):
            drives.append(driven(self.actions[:, step], drives[-1]))
        return torch.stack(drives, 1).unfold(1, PAST + 1, 1).movedim(-1, 2)


def driven(actions: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
    """The actions [B, nu] and, for each of PLAYS, what follows them only when they leave its play: [B, 1 + PLAYS, nu], of those a
    step before."""
    half = torch.tensor((0.0, *PLAYS))[:, None] / 2
    return before.clamp(actions[:, None] - half, actions[:, None] + half)


def collect(world: World, policy: Policy, episodes: int, seed: int) -> Trials:
    """What the policy does in `episodes` episodes of a world that shows qpos and qvel."""
    rng, shown = make_rng(seed), [*observed_channels(policy, world.spec), "qpos", "qvel", "done"]
    channels = tuple(dict.fromkeys(shown))
    steps = world.spec.max_episode_steps or 200
    rolled = rollout(world, world.start(episodes, rng), policy, rng, channels, steps)
    qpos, qvel, done = (rolled.observations[name].transpose(0, 1) for name in ("qpos", "qvel", "done"))
    return Trials(qpos, qvel, rolled.actions.transpose(0, 1).float(), ~done[:, :-1], idle(world.spec, episodes))


def idle(spec: Spec, count: int) -> torch.Tensor:
    """The idle action, `count` times: [count, nu]."""
    return torch.from_numpy(neutral_action(spec)).float().expand(count, -1)


def simulator_of(world: World) -> MujocoWorld:
    """The MuJoCo simulator inside all wrappers; TerrellaError where there is none."""
    simulator = unwrapped(world)
    if not isinstance(simulator, MujocoWorld):
        raise TerrellaError(f"{world.spec.name} is no simulator of MuJoCo; give mujoco:NAME or mujoco:FILE.xml.")
    return simulator


def fitted_simulator(world: World) -> MujocoWorld:
    """The simulator inside, to which models can be fitted; TerrellaError where its joints cannot be subtracted."""
    simulator = simulator_of(world)
    if simulator.file.nq != simulator.file.nv:
        raise TerrellaError(
            f"{world.spec.name} has a joint that moves freely or a ball; its model can be fitted to hinges and slides alone."
        )
    return simulator


def placed(world: World, state: State, past: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> State:
    """The state [B] with the joints at qpos and qvel, after the actions `past` [B, K, nu]."""
    rng = make_rng(0)
    for step in range(past.shape[1]):
        state = world.imagine(state, past[:, step], rng)
    held = dict(fitted_simulator(world).replaced(state, state, qpos, qvel).items())
    return state.replace(**{**held, "done": torch.zeros_like(held["done"])})
