"""ImitationActor: a policy learned from demonstrations, with a history, chunks of actions and an instruction."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, final

import torch

from ..core import chance
from ..core.errors import ChannelError, CheckpointError
from ..core.instruction import bytes_to_text
from ..core.spec import Spec
from ..core.state import State
from ..core.world import Observation
from .actor import load_network, write_policy
from .actor_network import ActorConfig
from .choices import Choices
from .embodiment import EMBODIMENT, Embodiment, index_of
from .imitation_network import FLOW_STEPS, TEXT, ImitationConfig, ImitationNetwork
from .sentences import WORDS

KIND, VERSION = "imitation", 4
_STREAM, _EXPLORATION = 12, 13


@final
class ImitationActor:
    """A Policy for the actions of `spec`; ActionError or ChannelError if the network is for others.

    Its memory holds the features of the last observations and what is left of the chunk. Words of an instruction that it does not
    know are left out, with a warning that names them. std: None takes the likeliest choices and buttons; a number draws them, and
    adds noise of this deviation to axes, in half ranges.
    """

    def __init__(
        self, network: ImitationNetwork, spec: Spec, card: Mapping[str, Any] | None = None, std: float | None = None
    ):
        network.config.check(spec)
        self.network, self.spec, self.card, self.std = network, spec, dict(card or {}), std
        self._warned: set[str] = set()
        bodies = network.config.bodies
        self._body = torch.eye(len(bodies))[[index_of(bodies, spec)]] if bodies else None  # [1, bodies]
        width, own = network.config.action_width, network.config.width_of(spec)
        self._own = (torch.arange(width) < own).float()  # [action_width], 0 at numbers that this body does not have

    @property
    def sees(self) -> tuple[str, ...]:
        """The channels to show it."""
        return self.network.config.sees

    def begin(self, batch: int, rng: torch.Generator) -> State:
        config, width = self.network.config, self.network.config.action_width
        seen = (1, config.actor.hidden) if config.remember else (config.history, self.network.width)
        return State(
            {
                "features": torch.zeros(batch, *seen),  # of the last observations, or the memory of all
                "acted": torch.zeros(batch, config.window, width),
                "words": torch.zeros(batch, WORDS, dtype=torch.int64),  # of the instruction that is remembered
                "chunk": torch.zeros(batch, config.chunk, width),
                "taken": torch.full((batch,), -1),  # actions of the chunk that were taken; -1 at the start
                "waypoints": torch.zeros(batch, len(self.network.waypoints), len(self.network.mean)),
            }
        )

    def act(self, observation: Observation, memory: State, rng: torch.Generator) -> tuple[torch.Tensor, State]:
        """The actions [B, *action.shape], on the CPU."""
        action, after, _ = self.explore(observation, memory, rng)
        return action, after

    @torch.no_grad()
    def explore(
        self, observation: Observation, memory: State, rng: torch.Generator
    ) -> tuple[torch.Tensor, State, Choices | None]:
        """The same, and the choices of the chunks; None where all episodes are within a chunk."""
        network, config, batch = self.network, self.network.config, memory.batch
        if missing := [name for name in self.sees if name not in observation]:
            raise ChannelError(f"the policy sees {', '.join(missing)}, which the observation lacks.")
        if self._body is not None:
            observation = {**observation, EMBODIMENT: self._body.expand(batch, -1)}
        spoken, words = self._words(observation[TEXT]) if network.words is not None else (memory["words"], None)
        device, features = network.mean.device, network.features(observation, words)[:, None]
        if config.remember:
            same = (spoken == memory["words"]).all(1)[:, None]  # a new instruction begins without memory
            history, after = network.recall(features, (memory["features"][:, 0] * same).to(device))
            kept = after[:, None].cpu()
        else:
            first, features = (memory["taken"] < 0)[:, None, None], features.cpu()
            kept = history = torch.where(first, features, torch.cat([memory["features"][:, 1:], features], 1))
        begins = (memory["taken"] < 0) | (spoken != memory["words"]).any(1)  # an instruction
        waypoints, foreseen = memory["waypoints"], network.foreseen(history.to(device), words)
        if foreseen is not None:
            waypoints = torch.where(begins[:, None, None], foreseen.cpu(), waypoints)
        seeds = chance.seeds(batch, rng, torch.device("cpu"))
        noise = chance.normal(seeds, (config.chunk * config.action_width,), _STREAM)
        chunk, taken, choices = memory["chunk"], memory["taken"], None
        anew = begins | (taken >= config.execute)
        if anew.any():
            outcome = None if config.outcome is None else torch.full((batch,), config.outcome, device=device)
            seen = {"history": history.to(device), "acted": memory["acted"].to(device), "words": words}
            seen |= {"outcome": outcome, "waypoints": waypoints.to(device) if network.waypoints else None}
            out = network(*seen.values())
            if self.std is None:
                predicted = network.chunk(out, noise.to(device))
            else:
                steps = (FLOW_STEPS, config.chunk * config.action_width)
                more = self.std * chance.normal(seeds, steps, _EXPLORATION).to(device)
                drawn = network.draw(out, noise.to(device), more)
                choices = Choices({name: value for name, value in seen.items() if value is not None}, drawn)
                predicted = network.chunk_of(drawn)
            chunk, taken = torch.where(anew[:, None, None], predicted.cpu(), chunk), torch.where(anew, 0, taken)
        encoded = chunk[torch.arange(batch), taken]
        acted = torch.cat([memory["acted"][:, 1:], (encoded * self._own)[:, None]], 1)
        after = {"features": kept, "acted": acted, "words": spoken, "chunk": chunk, "taken": taken + 1}
        after["waypoints"] = waypoints
        return config.decode(encoded, self.spec), State(after), choices

    def unknown(self, text: str) -> tuple[str, ...]:
        """The words of an instruction that it does not know."""
        return self.network.words.unknown(text) if self.network.words is not None else ()

    def _words(self, padded: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The instructions as numbers [B, WORDS], and their features."""
        assert self.network.words is not None
        texts = [bytes_to_text(row.numpy()) for row in padded.cpu()]
        if new := [text for text in dict.fromkeys(texts) if text not in self._warned and self.unknown(text)]:
            self._warned.update(new)
            names = ", ".join(dict.fromkeys(f"'{word}'" for text in new for word in self.unknown(text)))
            warnings.warn(f"the policy does not know {names} and leaves that out of the instruction.", stacklevel=3)
        spoken = self.network.words.read(texts)
        return spoken, self.network.words(spoken.to(self.network.mean.device))

    @staticmethod
    def write(network: ImitationNetwork, folder: str | Path, card: Mapping[str, Any]) -> None:
        """Writes the folder of a policy, each file atomically; CheckpointError if it cannot be written."""
        description = {"kind": KIND, "version": VERSION, "config": asdict(network.config), "card": dict(card)}
        write_policy(folder, description, network)

    @staticmethod
    def load(folder: str | Path, spec: Spec) -> ImitationActor:
        """Loads a saved policy, from its folder or that of the training run. CheckpointError if it is missing or foreign,
        ActionError or ChannelError if `spec` has other actions or lacks a channel."""

        network, card = load_imitation_network(folder)
        if network.config.differences:
            raise CheckpointError(f"{folder} names the actions of clips (train inverse) and does not act.")
        return ImitationActor(network, spec, card)


def load_imitation_network(folder: str | Path) -> tuple[ImitationNetwork, dict[str, Any]]:
    """The network of a saved policy, and its card. CheckpointError if it is missing or foreign."""

    def make(config: dict[str, Any]) -> ImitationNetwork:
        bodies = tuple(Embodiment(**body) for body in config.get("bodies", ()))
        return ImitationNetwork(
            ImitationConfig(**{**config, "actor": ActorConfig(**config["actor"]), "bodies": bodies})
        )

    return load_network(folder, KIND, VERSION, make)


def load_network_of_one_body(folder: str | Path) -> tuple[ImitationNetwork, dict[str, Any]]:
    """The same; CheckpointError also for a policy of several bodies, for those who do not say which one acts."""
    network, card = load_imitation_network(folder)
    if bodies := network.config.bodies:
        names = " and ".join(body.name for body in bodies)
        raise CheckpointError(
            f"{folder} drives {names}; this takes a policy of one body: train it on that one's recordings."
        )
    return network, card
