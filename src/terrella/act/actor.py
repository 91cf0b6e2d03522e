"""Actor: a learned policy, a network from observations to actions, saved as a folder of JSON and safetensors."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar, final

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from ..core.errors import CheckpointError
from ..core.files import remedy_of, replacing, write_text
from ..core.spec import Spec
from ..core.world import Observation
from .actor_network import ActorConfig, ActorNetwork, check_seen
from .choices import Choices

KIND, VERSION = "actor", 1
POLICY_FILE, WEIGHTS_FILE = "policy.json", "weights.safetensors"
RUN_SUBFOLDER = "policy"  # of the folder of a training run
Module = TypeVar("Module", bound=nn.Module)
DAMAGE = OSError, SafetensorError, RuntimeError, LookupError, AttributeError, TypeError, ValueError


@final
class Actor:
    """A Policy without memory for the actions of `spec`; ActionError or ChannelError if the network is for others.

    greedy: it takes the most likely action, else it samples. card: facts for people.
    """

    def __init__(self, network: ActorNetwork, spec: Spec, greedy: bool = True, card: Mapping[str, Any] | None = None):
        network.config.check(spec)
        self.network, self.spec, self.greedy, self.card = network, spec, greedy, dict(card or {})

    @property
    def sees(self) -> tuple[str, ...]:
        """The channels to show it."""
        return tuple(name for name, _ in self.network.config.sees)

    def begin(self, batch: int, rng: torch.Generator) -> None:
        return None

    def act(self, observation: Observation, memory: None, rng: torch.Generator) -> tuple[torch.Tensor, None]:
        """The actions [B, *action.shape], on the network's device."""
        action, memory, _ = self.explore(observation, memory, rng)
        return action, memory

    def explore(
        self, observation: Observation, memory: None, rng: torch.Generator
    ) -> tuple[torch.Tensor, None, Choices]:
        """The same, and the choices behind the actions."""
        check_seen(self.network.config, observation)
        distribution = self.network(observation)
        samples = distribution.mode() if self.greedy else distribution.sample(rng)
        seen = {name: observation[name] for name in self.sees}
        return self.network.config.actions(samples, self.spec), None, Choices(seen, samples)

    def save(self, folder: str | Path) -> None:
        """Writes the folder, each file atomically; CheckpointError if it cannot be written."""
        description = {"kind": KIND, "version": VERSION, "config": asdict(self.network.config), "card": self.card}
        write_policy(folder, description, self.network)

    @staticmethod
    def load(folder: str | Path, spec: Spec, greedy: bool = True) -> Actor:
        """Loads a saved policy, from its folder or that of the training run. CheckpointError if it is missing or foreign,
        ActionError or ChannelError if `spec` has other actions or lacks a channel."""
        network, card = load_network(folder, KIND, VERSION, lambda config: ActorNetwork(ActorConfig(**config)))
        return Actor(network, spec, greedy, card)


def load_network(
    folder: str | Path, kind: str, version: int, make: Callable[[dict[str, Any]], Module]
) -> tuple[Module, dict[str, Any]]:
    """The network of a saved policy of this kind, built by `make(config)`, in evaluation mode, and the policy's card. The folder is
    its own or that of the training run. CheckpointError if it is missing, foreign or damaged."""
    folder = policy_folder(folder)
    saved = read_policy(folder)
    if saved.get("kind") == kind and saved.get("version") != version:
        raise CheckpointError(
            f"{folder} is a policy of another release (version {saved.get('version')}, and this one reads {version}); train it "
            "again."
        )
    if saved.get("kind") != kind:
        raise CheckpointError(f"{folder} is a policy of kind {saved.get('kind')!r}; expected kind '{kind}'.")
    try:
        network = make({name: _tuple(value) for name, value in saved["config"].items()})
        network.load_state_dict(load_file(folder / WEIGHTS_FILE))
    except DAMAGE as error:
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"{folder} is damaged or incomplete ({why}); copy or train it again.") from error
    return network.eval().requires_grad_(False), dict(saved.get("card") or {})


def write_policy(folder: str | Path, description: Mapping[str, Any], network: nn.Module) -> None:
    """Writes policy.json and the weights, each file atomically; CheckpointError if they cannot be written."""
    folder = Path(folder)
    weights = {name: value.detach().cpu().clone().contiguous() for name, value in network.state_dict().items()}
    try:
        with replacing(folder / WEIGHTS_FILE) as staged:
            save_file(weights, staged)
        write_text(folder / POLICY_FILE, json.dumps(description, indent=1) + "\n")
    except (OSError, SafetensorError) as error:
        raise CheckpointError(
            f"the policy cannot be written to {folder} ({error}); {remedy_of(error)}, or choose another folder."
        ) from error


def policy_folder(folder: str | Path) -> Path:
    """The folder of a policy: this one, or the one inside the folder of a training run."""
    inner = Path(folder) / RUN_SUBFOLDER
    return inner if (inner / POLICY_FILE).is_file() else Path(folder)


def read_policy(folder: str | Path) -> dict[str, Any]:
    """The content of policy.json; CheckpointError if it is missing or cannot be read."""
    try:
        saved = json.loads((Path(folder) / POLICY_FILE).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise CheckpointError(f"{folder} holds no {POLICY_FILE}: give the folder of a policy.") from None
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{folder}/{POLICY_FILE} cannot be read ({error}).") from error
    if not isinstance(saved, dict):
        raise CheckpointError(f"{folder}/{POLICY_FILE} does not describe a policy; copy it again.")
    return saved


def _tuple(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _tuple(inner) for name, inner in value.items()}
    return tuple(map(_tuple, value)) if isinstance(value, list) else value
