"""Policies by name: random, idle, plan:samples=16, constant:0.5, a user's MODULE:NAME; NAME@0.3 adds 30% random actions."""

import importlib
import inspect
import os
import runpy
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from ..core.errors import ActionError, TerrellaError
from ..core.policy import Constant, Idle, Policy, Random, Reactive, observed_channels
from ..core.similar import did_you_mean
from ..core.spec import AXES, BUTTONS, Spec, cuts_plans, shape_of
from ..core.world import Observation, World
from .belief import load_learned_policy
from .driver import driver_of
from .explorer import Explorer
from .goal_network import KIND, GoalActor
from .lerobot_policy import kind_of_policy
from .planning import Cost, Planner, SearchConfig, negative_reward, within_measured_trust
from .planning.searches import Kind
from .teacher import teacher_of

POLICY_NAMES = (
    "random, idle, explorer, constant:VALUE, plan or plan:samples=16,horizon=12, driver or driver:QUALITY (of 0 to 1, where a "
    "world has a route), teacher or teacher:NOISE (where a world has a scripted expert, as mujoco:table), the folder of a "
    "learned policy (ours or LeRobot's), MODULE:NAME or FILE.py:NAME of your own; NAME@0.3 replaces three actions in ten by "
    "random ones"
)
_DEFAULTS = {field.name: field.default for field in fields(SearchConfig)}
_SETTINGS = {name: type(value) if isinstance(value, str | int) else float for name, value in _DEFAULTS.items()}


class NoisyPolicy:
    """Another policy with each action replaced by a random one with a probability (epsilon-greedy): so one policy gives many of
    different quality."""

    def __init__(self, policy: Policy, probability: float, spec: Spec):
        self.policy, self.probability, self.spec = policy, probability, spec
        self.sees = observed_channels(policy, spec)

    def begin(self, batch: int, rng: torch.Generator) -> Any:
        return self.policy.begin(batch, rng)

    def act(self, observation: Observation, memory: Any, rng: torch.Generator) -> tuple[torch.Tensor, Any]:
        action, memory = self.policy.act(observation, memory, rng)
        noise = self.spec.sample_action(len(action), rng)
        action = torch.as_tensor(action).to(noise)
        replaced = torch.rand(len(action), generator=rng) < self.probability
        return torch.where(replaced.view(-1, *[1] * (action.ndim - 1)), noise, action), memory


Within = Callable[[World, SearchConfig], SearchConfig]


def policy_of(
    name: str,
    spec: Spec,
    world: World | None = None,
    cost: Cost | None = None,
    within: Within = within_measured_trust,
) -> Policy:
    """The policy of a name (POLICY_NAMES) for the actions and channels of `spec`. world: the one in which `plan` plans. cost: of
    `plan`, by default negative reward. within: shortens its plans to what the world is trusted for. TerrellaError for an unknown
    name."""
    text, at, share = name.rpartition("@")
    if not at or Path(name).is_dir():
        return _without_noise(name, spec, world, cost, within)
    try:
        probability = float(share)
    except ValueError:
        probability = -1.0
    if not 0 <= probability <= 1:
        raise TerrellaError(f"'{name}': give a probability of 0 to 1 after the @, as in {text or 'idle'}@0.3.")
    return NoisyPolicy(_without_noise(text, spec, world, cost, within), probability, spec)


def proposal_policy(name: str, world: World) -> Policy:
    """A policy, by name, whose plans a search in `world` evaluates as well; a goal-conditioned one gets the search's goal."""
    if Path(name).is_dir() and kind_of_policy(name) == KIND:
        return GoalActor.load(name, world.spec, varied=True)
    return policy_of(name, world.spec, world)


def _without_noise(name: str, spec: Spec, world: World | None, cost: Cost | None, within: Within) -> Policy:
    head, colon, rest = name.partition(":")
    simple: dict[str, Callable[[Spec], Policy]] = {"random": Random, "idle": Idle, "explorer": Explorer}
    if head in simple:
        if colon:
            raise TerrellaError(f"'{name}': {head} takes no settings.")
        return simple[head](spec)
    if head == "constant":
        return Constant(_action(rest, spec))
    if head in ("driver", "teacher"):
        return (driver_of if head == "driver" else teacher_of)(rest, spec)
    if head == "plan":
        return _planner(name, rest, world, cost, within)
    if colon:
        return _own(name, spec)
    if Path(name).is_dir():
        return load_learned_policy(name, spec, world, cost)
    hint = did_you_mean(name, [*simple, "constant", "plan", "driver", "teacher"]) or "."
    raise TerrellaError(f"there is no policy '{name}'{hint} There are: {POLICY_NAMES}.")


def _action(text: str, spec: Spec) -> torch.Tensor:
    """One action, from its name or its numbers."""
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
                f"'constant:{text}' is not an action of {spec.name}: give {count} number{'s'[: count != 1]}{names}."
            )
    try:
        return spec.check_action(torch.as_tensor(np.reshape(value, (1, *shape))), 1)[0]
    except ActionError as error:
        raise TerrellaError(f"'constant:{text}': {error}") from error


def _planner(name: str, text: str, world: World | None, cost: Cost | None, within: Within) -> Planner:
    """A planner over the world, by settings as in plan:samples=16,horizon=12."""
    if world is None:
        raise TerrellaError(f"'{name}' needs a world to plan in.")
    given: dict[str, Any] = {}
    for word in filter(None, text.split(",")):
        key, _, value = word.partition("=")
        key = key.strip().replace("-", "_")
        if key not in _SETTINGS:
            hint = did_you_mean(key, _SETTINGS) or "."
            raise TerrellaError(f"'{name}': there is no setting '{key}'{hint} There are: {', '.join(_SETTINGS)}.")
        try:
            given[key] = _SETTINGS[key](value)
        except ValueError as error:
            raise TerrellaError(
                f"'{name}': {key} takes {'a whole number' if _SETTINGS[key] is int else 'a number'}."
            ) from error
    if given.get("search", "icem") not in get_args(Kind):
        raise TerrellaError(f"'{name}': there is no search '{given['search']}'; there are {', '.join(get_args(Kind))}.")
    levels = world.spec.card.get("uncertainty")
    declares = "uncertainty" in world.spec.channels and cuts_plans(world.spec)
    trust = levels.get("invents") if isinstance(levels, dict) and declares else None
    cost = negative_reward(world.spec) if cost is None else cost
    search = within(world, SearchConfig(**given).filled())
    return Planner(world, cost, replace(search, trust=trust if search.trust is None else search.trust))


def _own(name: str, spec: Spec) -> Policy:
    """A user's policy: MODULE:NAME or FILE.py:NAME of a Policy, a function (observation, rng) -> actions, or a function of a Spec
    that returns either."""
    value: Any = _load(name)
    for _ in range(2):
        if isinstance(value, Policy) and not isinstance(value, type):
            return value
        make: Callable[..., Any] | None = value if callable(value) else None
        if make is None:
            break
        try:
            required = _required_arguments(make)
            if required == 2 and not isinstance(value, type):
                return Reactive(make)
            value = make(spec) if required == 1 else make()
        except TerrellaError:
            raise
        except Exception as error:
            raise TerrellaError(f"{name} fails when it is made: {type(error).__name__}: {error}") from error
    raise TerrellaError(
        f"{name} is not a policy: give an object with begin(batch, rng) and act(observation, memory, rng), a function "
        "(observation, rng) -> actions, or a function of a Spec that returns one of these."
    )


def _required_arguments(function: Callable) -> int:
    plain = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    parameters = inspect.signature(function).parameters.values()
    return sum(one.kind in plain and one.default is one.empty for one in parameters)


def _load(name: str) -> Any:
    """The object that a module, or a Python file, defines under the name after the colon."""
    source, _, attribute = name.rpartition(":")
    try:
        if source.endswith(".py"):
            if not Path(source).is_file():
                raise TerrellaError(f"there is no file {source} to take the policy '{attribute}' from.")
            defined = runpy.run_path(source)
        else:
            if os.getcwd() not in sys.path:
                sys.path.insert(0, os.getcwd())  # as `python -m` does
            defined = vars(importlib.import_module(source))
    except TerrellaError:
        raise
    except ModuleNotFoundError as error:
        if error.name and source.startswith(error.name):
            raise TerrellaError(
                f"there is no policy '{name}', and no Python module '{source}'. There are: {POLICY_NAMES}."
            ) from error
        raise TerrellaError(f"{source} needs the package '{error.name}', which is not installed.") from error
    except Exception as error:
        raise TerrellaError(f"{source} fails when it is read: {type(error).__name__}: {error}") from error
    if attribute not in defined:
        mine = [one for one in defined if not one.startswith("_")]
        raise TerrellaError(f"{source} has no '{attribute}'{did_you_mean(attribute, mine) or '.'}")
    return defined[attribute]
