"""A goal-conditioned policy over latents: from the current latent, the goal and the steps to it, to the action (multi-step inverse
dynamics, learned with hindsight goals)."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

import torch
from torch import nn

from ..core.errors import ChannelError
from ..core.spec import Spec, shape_of
from ..core.world import Observation
from .actor import load_network, write_policy
from .actor_network import ActorConfig, mlp
from .distributions import ActionDistribution

KIND, VERSION = "goal-actor", 1
LATENT, GOAL = "latent", "goal.latent"
STEP_FACTORS = (0.4, 1.4)  # range of the factor on the steps to the goal, for varied plans


@dataclass(frozen=True)
class GoalConfig:
    """The size of a goal-conditioned policy."""

    latent: int  # width of the latent
    actor: ActorConfig  # the actions
    farthest: int = 50  # steps to a goal, at most
    hidden: int = 256  # width of both MLPs
    layers: int = 3  # of both MLPs

    @staticmethod
    def of(spec: Spec, farthest: int = 50, hidden: int = 256) -> GoalConfig:
        """For a world with the channel `latent`; ChannelError for others."""
        return GoalConfig(shape_of(latent_space(spec))[0], ActorConfig.of(spec, (LATENT,)), farthest, hidden)


def latent_space(spec: Spec) -> Any:
    """The space of the goals, that of the channel `latent`; ChannelError for a world without it."""
    if LATENT not in spec.channels:
        raise ChannelError(
            f"goals are latents, and {spec.name} has none (only {', '.join(spec.channels)}): `terrella train latent` "
            "learns a world with latents."
        )
    return spec.channels[LATENT]


class GoalNetwork(nn.Module):
    """Two MLPs: one for the action, one for the steps to the goal."""

    def __init__(self, config: GoalConfig):
        super().__init__()
        self.config = config
        both = 2 * config.latent
        self.act = mlp(both + 1, config.hidden, config.layers, config.actor.outputs, gain=0.1)
        self.far = mlp(both, config.hidden, config.layers, 1, gain=0.1)

    def forward(self, latent: torch.Tensor, goal: torch.Tensor, steps: torch.Tensor) -> ActionDistribution:
        """The distribution over actions from latents [N, D] that reach goals [N, D] in `steps` [N]."""
        share = steps.clamp(1, self.config.farthest).log() / math.log(self.config.farthest)
        return self.config.actor.distribution(self.act(torch.cat([latent, goal - latent, share[:, None]], 1)))

    def steps(self, latent: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        """The steps [N] to the goal at a quick pace, 1 to `farthest`."""
        return (self.share(latent, goal).clamp(0, 1) * math.log(self.config.farthest)).exp()

    def share(self, latent: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        """log(steps) / log(farthest) [N] as the network predicts it, not clamped to 0..1."""
        return self.far(torch.cat([latent, goal - latent], 1))[:, 0]


@final
class GoalActor:
    """A Policy that sees `latent` and `goal.latent`, for the actions of `spec`; ActionError or ChannelError for others.

    varied: each episode asks for the goal sooner or later than usual, so that a planner gets different plans to choose from.
    """

    sees = (LATENT, GOAL)

    def __init__(self, network: GoalNetwork, spec: Spec, varied: bool = False, card: dict | None = None):
        width = shape_of(latent_space(spec))[0]
        network.config.actor.check(spec)
        if width != network.config.latent:
            raise ChannelError(
                f"the policy is for latents of {network.config.latent} numbers; {spec.name} has {width}."
            )
        self.network, self.spec, self.varied, self.card = network, spec, varied, dict(card or {})

    def begin(self, batch: int, rng: torch.Generator) -> torch.Tensor:
        """The factor [B] on the steps to the goal."""
        low, high = STEP_FACTORS
        return low + (high - low) * torch.rand(batch, generator=rng) if self.varied else torch.ones(batch)

    @torch.no_grad()
    def act(
        self, observation: Observation, memory: torch.Tensor, rng: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        latent, goal = observation[LATENT], observation[GOAL]
        goal = goal.to(latent).expand(len(latent), -1)
        steps = self.network.steps(latent, goal) * memory.to(latent)
        return self.network.config.actor.actions(self.network(latent, goal, steps).mode(), self.spec), memory

    def save(self, folder: str | Path) -> None:
        """Writes the folder, each file atomically; CheckpointError if it cannot be written."""
        description = {"kind": KIND, "version": VERSION, "config": asdict(self.network.config), "card": self.card}
        write_policy(folder, description, self.network)

    @staticmethod
    def load(folder: str | Path, spec: Spec, varied: bool = False) -> GoalActor:
        """Loads a saved policy, from its folder or that of the training run. CheckpointError if it is damaged, ActionError or
        ChannelError if it does not fit the world of `spec`."""

        def make(config: dict[str, Any]) -> GoalNetwork:
            return GoalNetwork(GoalConfig(**{**config, "actor": ActorConfig(**config["actor"])}))

        network, card = load_network(folder, KIND, VERSION, make)
        return GoalActor(network, spec, varied, card)
