"""Policies by the names that people give them: random, idle, plan:samples=16, constant:0.5, a module's own; NAME@0.3 is one with
slips."""

from __future__ import annotations

import importlib
import inspect
import os
import runpy
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from ..core.errors import ActionError, TerrellaError
from ..core.policy import Constant, Idle, Policy, Random, Reactive, observed_channels
from ..core.spec import AXES, BUTTONS, Spec, shape_of
from ..core.world import Observation, World
from ..similar import did_you_mean
from .actor import policy_folder, read_policy
from .belief import load_learned_policy
from .explorer import Explorer
from .goal_network import KIND, GoalActor
from .planning import Cost, Planner, SearchConfig, negative_reward
from .planning.searches import Kind

KNOWN = (
    "random, idle, explorer, constant:VALUE, plan or plan:samples=16,horizon=12, the folder of a learned policy, MODULE:NAME or "
    "FILE.py:NAME of your own; NAME@0.3 does something random three times in ten"
)
_SETTINGS = {
    field.name: type(field.default) if isinstance(field.default, str | int) else float for field in fields(SearchConfig)
}


class NoisyPolicy:
    """Another policy whose actions are replaced by random ones, each with a probability; it is not told. So one policy becomes
    many of different worth."""

    def __init__(self, policy: Policy, probability: float, spec: Spec):
        self.policy, self.probability, self.spec = policy, probability, spec
        self.sees = observed_channels(policy, spec)

    def begin(self, batch: int, rng: torch.Generator) -> Any:
        return self.policy.begin(batch, rng)

    def act(self, observation: Observation, memory: Any, rng: torch.Generator) -> tuple[torch.Tensor, Any]:
        meant, memory = self.policy.act(observation, memory, rng)
        other = self.spec.sample_action(len(meant), rng)
        meant = torch.as_tensor(meant).to(other)
        slips = torch.rand(len(meant), generator=rng) < self.probability
        return torch.where(slips.view(-1, *[1] * (meant.ndim - 1)), other, meant), memory


def policy_of(name: str, spec: Spec, world: World | None = None, cost: Cost | None = None) -> Policy:
    """The policy of a name (KNOWN) for the actions and channels of `spec`. `world`: in which `plan` plans, for `cost`: by default
    for reward. TerrellaError, a sentence, where there is none."""
    text, at, share = name.rpartition("@")
    if not at or Path(name).is_dir():
        return _plain(name, spec, world, cost)
    try:
        probability = float(share)
    except ValueError:
        probability = -1.0
    if not 0 <= probability <= 1:
        raise TerrellaError(f"'{name}' slips with a probability of 0 to 1 after the @, as in {text or 'idle'}@0.3.")
    return NoisyPolicy(_plain(text, spec, world, cost), probability, spec)


def proposal_policy(name: str, world: World) -> Policy:
    """A policy whose plans a search in `world` tries as well, by its name; one for goals is told the search's own."""
    if Path(name).is_dir() and read_policy(policy_folder(name)).get("kind") == KIND:
        return GoalActor.load(name, world.spec, varied=True)
    return policy_of(name, world.spec, world)


def _plain(name: str, spec: Spec, world: World | None, cost: Cost | None) -> Policy:
    head, colon, rest = name.partition(":")
    simple: dict[str, Callable[[Spec], Policy]] = {"random": Random, "idle": Idle, "explorer": Explorer}
    if head in simple:
        if colon:
            raise TerrellaError(f"'{name}': {head} takes no settings.")
        return simple[head](spec)
    if head == "constant":
        return Constant(_action(rest, spec))
    if head == "plan":
        return _planner(name, rest, world, cost)
    if colon:
        return _own(name, spec)
    if Path(name).is_dir():
        return load_learned_policy(name, spec, world, cost)
    likest = did_you_mean(name, [*simple, "constant", "plan"]) or "."
    raise TerrellaError(f"there is no policy '{name}'{likest} There are: {KNOWN}.")


def _action(text: str, spec: Spec) -> torch.Tensor:
    """One action, by its name or its numbers."""
    named = {known.lower(): at for at, known in enumerate(spec.action_names)}
    shape, count = shape_of(spec.action), int(np.prod(shape_of(spec.action)))
    if text.lower() in named and (spec.action_mode == BUTTONS or shape == ()):
        low, at = spec.action_limits[0], named[text.lower()]
        value = low + at if shape == () else np.eye(count)[at]
    else:
        try:
            value = np.array([float(word) for word in text.split(",")])
        except ValueError:
            value = np.zeros(0)
        if value.size != count:
            names = f" (or one of {', '.join(spec.action_names)})" if named and spec.action_mode not in AXES else ""
            raise TerrellaError(
                f"'constant:{text}' is no action of {spec.name}: give {count} number{'s'[: count != 1]}{names}."
            )
    try:
        return spec.check_action(torch.as_tensor(np.reshape(value, (1, *shape))), 1)[0]
    except ActionError as error:
        raise TerrellaError(f"'constant:{text}': {error}") from error


def _planner(name: str, text: str, world: World | None, cost: Cost | None) -> Planner:
    """A planner over the world, by settings as in plan:samples=16,horizon=12."""
    if world is None:
        raise TerrellaError(f"'{name}' plans in a world, and none is given.")
    given: dict[str, Any] = {}
    for word in filter(None, text.split(",")):
        key, _, value = word.partition("=")
        key = key.strip().replace("-", "_")
        if key not in _SETTINGS:
            likest = did_you_mean(key, _SETTINGS) or "."
            raise TerrellaError(f"'{name}': there is no setting '{key}'{likest} There are: {', '.join(_SETTINGS)}.")
        try:
            given[key] = _SETTINGS[key](value)
        except ValueError as error:
            raise TerrellaError(
                f"'{name}': {key} takes {'a whole number' if _SETTINGS[key] is int else 'a number'}."
            ) from error
    if given.get("search", "icem") not in get_args(Kind):
        raise TerrellaError(f"'{name}': there is no search '{given['search']}'; there are {', '.join(get_args(Kind))}.")
    said = world.spec.card.get("uncertainty")
    invents = said.get("invents") if isinstance(said, dict) and "uncertainty" in world.spec.channels else None
    price = negative_reward(world.spec) if cost is None else cost
    return Planner(world, price, SearchConfig(**{"trust": invents, **given}))


def _own(name: str, spec: Spec) -> Policy:
    """A user's: MODULE:NAME or FILE.py:NAME of a Policy, of a function (observation, rng) -> actions, or of what makes either
    from a Spec."""
    found: Any = _found(name)
    for _ in range(2):
        if isinstance(found, Policy) and not isinstance(found, type):
            return found
        make: Callable[..., Any] | None = found if callable(found) else None
        if make is None:
            break
        try:
            needed = _needed(make)
            if needed == 2 and not isinstance(found, type):
                return Reactive(make)
            found = make(spec) if needed == 1 else make()
        except TerrellaError:
            raise
        except Exception as error:
            raise TerrellaError(f"{name} fails when it is made: {type(error).__name__}: {error}") from error
    raise TerrellaError(
        f"{name} is no policy: it takes begin(batch, rng) and act(observation, memory, rng), a function (observation, rng) -> "
        "actions, or a function of a Spec that returns such."
    )


def _needed(function: Callable) -> int:
    """How many arguments it cannot do without."""
    plain = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    told = inspect.signature(function).parameters.values()
    return sum(one.kind in plain and one.default is one.empty for one in told)


def _found(name: str) -> Any:
    """What a module, or a Python file, holds under the name after the colon."""
    source, _, attribute = name.rpartition(":")
    try:
        if source.endswith(".py"):
            if not Path(source).is_file():
                raise TerrellaError(f"there is no file {source} to take the policy '{attribute}' from.")
            held = runpy.run_path(source)
        else:
            if os.getcwd() not in sys.path:
                sys.path.insert(0, os.getcwd())  # as `python -m` does
            held = vars(importlib.import_module(source))
    except TerrellaError:
        raise
    except ModuleNotFoundError as error:
        if error.name and source.startswith(error.name):
            raise TerrellaError(
                f"there is no policy '{name}', and no Python module '{source}'. There are: {KNOWN}."
            ) from error
        raise TerrellaError(f"{source} needs the package '{error.name}', which is not installed.") from error
    except Exception as error:
        raise TerrellaError(f"{source} fails when it is read: {type(error).__name__}: {error}") from error
    if attribute not in held:
        mine = [one for one in held if not one.startswith("_")]
        raise TerrellaError(f"{source} has no '{attribute}'{did_you_mean(attribute, mine) or '.'}")
    return held[attribute]
