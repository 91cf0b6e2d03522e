"""Actor: a learned policy. A network of what it sees gives the actions; it lies in a folder of JSON and safetensors."""

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
from ..core.files import replacing, write_text
from ..core.spec import Spec
from ..core.world import Observation
from .actor_network import ActorConfig, ActorNetwork, check_seen

KIND, VERSION = "actor", 1
POLICY_FILE, WEIGHTS_FILE = "policy.json", "weights.safetensors"
RUN = "policy"  # the folder of the policy in that of a training run
Module = TypeVar("Module", bound=nn.Module)
DAMAGE = OSError, SafetensorError, RuntimeError, LookupError, AttributeError, TypeError, ValueError


@final
class Actor:
    """A Policy without memory for the actions of `spec`; ActionError or ChannelError where the network is one for others.

    greedy: it takes the likeliest action each time; else it draws. card: facts for people.
    """

    def __init__(self, network: ActorNetwork, spec: Spec, greedy: bool = True, card: Mapping[str, Any] | None = None):
        network.config.check(spec)
        self.network, self.spec, self.greedy, self.card = network, spec, greedy, dict(card or {})

    @property
    def sees(self) -> tuple[str, ...]:
        """The channels that it must be shown."""
        return tuple(name for name, _ in self.network.config.sees)

    def begin(self, batch: int, rng: torch.Generator) -> None:
        return None

    def act(self, observation: Observation, memory: None, rng: torch.Generator) -> tuple[torch.Tensor, None]:
        """The actions [B, *action.shape], on the network's device."""
        check_seen(self.network.config, observation)
        distribution = self.network(observation)
        drawn = distribution.mode() if self.greedy else distribution.sample(rng)
        return self.network.config.actions(drawn, self.spec), None

    def save(self, folder: str | Path) -> None:
        """Writes the folder, each file whole; CheckpointError where it cannot be written."""
        told = {"kind": KIND, "version": VERSION, "config": asdict(self.network.config), "card": self.card}
        write_policy(folder, told, self.network)

    @staticmethod
    def load(folder: str | Path, spec: Spec, greedy: bool = True) -> Actor:
        """Reads what `save` wrote, from its folder or that of the training run. CheckpointError for what is missing or foreign,
        ActionError or ChannelError where `spec` has other actions or does not show what it sees."""
        make = lambda told: ActorNetwork(ActorConfig(**told))  # noqa: E731
        network, card = load_network(folder, KIND, VERSION, make)
        return Actor(network, spec, greedy, card)


def load_network(
    folder: str | Path, kind: str, version: int, make: Callable[[dict[str, Any]], Module]
) -> tuple[Module, dict[str, Any]]:
    """The network of a policy of this kind, which `make` makes of its config, ready to act; and its card. The folder is its own,
    or that of the training run. CheckpointError for what is missing, foreign or damaged."""
    folder = policy_folder(folder)
    told = read_policy(folder)
    if (told.get("kind"), told.get("version")) != (kind, version):
        raise CheckpointError(
            f"{folder} is a policy of kind {told.get('kind')!r}, version {told.get('version')}; this takes kind '{kind}', "
            f"version {version}."
        )
    try:
        network = make({name: _tuple(value) for name, value in told["config"].items()})
        network.load_state_dict(load_file(folder / WEIGHTS_FILE))
    except DAMAGE as error:
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"{folder} is damaged or incomplete ({why}); copy or train it again.") from error
    return network.eval().requires_grad_(False), dict(told.get("card") or {})


def write_policy(folder: str | Path, told: Mapping[str, Any], network: nn.Module) -> None:
    """policy.json and the weights, each file whole; CheckpointError where they cannot be written."""
    folder = Path(folder)
    weights = {name: value.detach().cpu().clone().contiguous() for name, value in network.state_dict().items()}
    try:
        with replacing(folder / WEIGHTS_FILE) as staged:
            save_file(weights, staged)
        write_text(folder / POLICY_FILE, json.dumps(told, indent=1) + "\n")
    except (OSError, SafetensorError) as error:
        raise CheckpointError(
            f"the policy cannot be written to {folder} ({error}); free some space, or choose another folder."
        ) from error


def policy_folder(folder: str | Path) -> Path:
    """The folder of a policy: the one that is named, or the one that a training run left in it."""
    inner = Path(folder) / RUN
    return inner if (inner / POLICY_FILE).is_file() else Path(folder)


def read_policy(folder: str | Path) -> dict[str, Any]:
    """What policy.json says; CheckpointError where there is none, or none that can be read."""
    try:
        told = json.loads((Path(folder) / POLICY_FILE).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise CheckpointError(f"{folder} holds no {POLICY_FILE}: it is no policy; give the folder of one.") from None
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{folder}/{POLICY_FILE} cannot be read ({error}).") from error
    if not isinstance(told, dict):
        raise CheckpointError(f"{folder}/{POLICY_FILE} describes no policy; copy it again.")
    return told


def _tuple(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _tuple(inner) for name, inner in value.items()}
    return tuple(map(_tuple, value)) if isinstance(value, list) else value
