"""Domain randomisation: a World around a World, whose episodes draw masses, friction, delay, light, … at random."""

import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from ..core import chance
from ..core.errors import TerrellaError
from ..core.similar import did_you_mean
from ..core.spec import Spec, dtype_of, kind_of, neutral_action
from ..core.state import State
from ..core.world import World
from .wrapper import WorldWrapper

PARAMETERS = "parameters"  # the channel of an episode's values
DELAY, BACKLASH, NOISE, MAX_DELAY = "delay", "backlash", "noise.", 50
_HELD, _SEEDS = "randomised.", "randomised.seeds"
_DRAW, _SENSED = 101, 131  # streams of random numbers
# kind -> how many numbers it takes, 0 for any
KINDS = {"uniform": 2, "loguniform": 2, "normal": 2, "choice": 0, "constant": 1}


@dataclass(frozen=True)
class Distribution:
    """uniform (low, high), loguniform (low, high), normal (mean, standard deviation; cut at three of them), choice (values), or
    constant (value)."""

    kind: str
    numbers: tuple[float, ...]

    @property
    def limits(self) -> tuple[float, float]:
        """(lowest, highest) value that can be drawn."""
        if self.kind == "normal":
            mean, deviation = self.numbers
            return mean - 3 * deviation, mean + 3 * deviation
        return min(self.numbers), max(self.numbers)

    def draw(self, seeds: torch.Tensor, stream: int) -> torch.Tensor:
        """float64 [B], one for each seed."""
        low, high = self.limits
        if self.kind == "normal":
            mean, deviation = self.numbers
            return (mean + deviation * chance.normal(seeds, (), stream).double()).clamp(low, high)
        even = chance.uniform(seeds, (), stream).double()
        if self.kind == "choice":
            return torch.tensor(self.numbers, dtype=torch.float64)[(even * len(self.numbers)).long()]
        if self.kind == "loguniform":
            return (math.log(low) + (math.log(high) - math.log(low)) * even).exp()
        return low + (high - low) * even


def read(file: str | Path) -> dict[str, Distribution]:
    """The distributions in a TOML or JSON file, as in

        friction = {uniform = [0.4, 1.25]}
        "mass.trunk" = {uniform = [0.8, 1.3]}
        delay = {choice = [0, 1, 2]}
        "noise.observation" = {constant = 0.02}

    TerrellaError where the file cannot be read."""
    file = Path(file)
    try:
        text = file.read_text(encoding="utf-8")
        table = json.loads(text) if file.suffix == ".json" else tomllib.loads(text)
    except OSError as error:
        raise TerrellaError(
            f"{file} cannot be read ({error.strerror}); give a TOML or JSON file of distributions."
        ) from error
    except ValueError as error:
        raise TerrellaError(f"{file} is not TOML or JSON: {error}.") from error
    if not isinstance(table, dict):
        raise TerrellaError(
            f"{file} must have one distribution per parameter, as in friction = {{uniform = [0.4, 1.25]}}."
        )
    return {name: _distribution(name, one) for name, one in _flat(table)}


def _flat(table: Mapping, before: str = "") -> list[tuple[str, Any]]:
    """(name, value) pairs: both [mass] trunk = … and mass.trunk = … are "mass.trunk"."""
    flat = []
    for name, value in table.items():
        inner = (
            isinstance(value, dict)
            and not set(value) & set(KINDS)
            and all(isinstance(one, dict | int | float) for one in value.values())
        )
        flat += _flat(value, f"{before}{name}.") if inner and value else [(before + name, value)]
    return flat


def _distribution(name: str, value: Any) -> Distribution:
    if isinstance(value, int | float) and not isinstance(value, bool):
        value = {"constant": value}
    if not isinstance(value, dict) or len(value) != 1 or next(iter(value)) not in KINDS:
        raise TerrellaError(f"'{name}' is one of {', '.join(KINDS)}, as in {{uniform = [0.8, 1.2]}}; got {value}.")
    kind, given = next(iter(value.items()))
    given = given if isinstance(given, list) else [given]
    plain = all(isinstance(one, int | float) and not isinstance(one, bool) and math.isfinite(one) for one in given)
    count = KINDS[kind]
    if not given or not plain or (count and len(given) != count):
        raise TerrellaError(f"'{name}': {kind} takes {count or 'one or more'} numbers; got {given}.")
    ordered = kind not in ("uniform", "loguniform") or given[0] <= given[1]
    if not ordered or (kind == "loguniform" and given[0] <= 0) or (kind == "normal" and given[1] < 0):
        raise TerrellaError(
            f"'{name}': {kind} of {given} is not a range; give the lower number first, above 0 for loguniform."
        )
    return Distribution(kind, tuple(float(one) for one in given))


class Randomised(WorldWrapper[World]):
    """`Randomised(world, {"friction": Distribution("uniform", (0.4, 1.25))})`: every episode draws its own parameters.

    Parameters of a world with `parameters`, `varying(names)` and `adjusted(state, values)`, such as MujocoWorld; and of every
    forkable world:
      delay          steps by which actions come late, an integer up to 50
      backlash       play of the axes in units of the action: the executed action follows only when the commanded one leaves it
      noise.CHANNEL  standard deviation of Gaussian noise on a float channel; it changes the observation, not the state
    scale: from 0 (nominal values) to 1 (as drawn); may be changed between episodes.

    The channel `parameters` shows the drawn values, in the order of spec.card["randomised"]. TerrellaError for an unknown
    parameter or an unsafe range.
    """

    def __init__(self, world: World, distributions: Mapping[str, Distribution], scale: float = 1.0):
        spec = world.spec
        if not spec.forkable or PARAMETERS in spec.channels:
            raise TerrellaError(f"{spec.name} cannot be randomised: it is not forkable, or it is randomised already.")
        if not distributions:
            raise TerrellaError("the file has no distribution; add one, as in friction = {uniform = [0.4, 1.25]}.")
        known: Mapping[str, Any] = getattr(world, "parameters", {})
        _check(spec, known, distributions)
        self.distributions = dict(distributions)
        self._own = [name for name in distributions if name in known]
        adjustable: Any = world
        self.world: World = adjustable.varying(self._own) if self._own else world
        self._noisy = [name.removeprefix(NOISE) for name in distributions if name.startswith(NOISE)]
        late = distributions.get(DELAY)
        self._max_delay = int(late.limits[1]) if late else 0
        if not 0 <= scale <= 1:
            raise TerrellaError(f"the scale of a randomisation is from 0 to 1; got {scale:g}.")
        self.scale = scale
        nominal = [known[name].nominal if name in known else 0.0 for name in distributions]
        self.nominal = torch.tensor(nominal, dtype=torch.float64)
        names = tuple(distributions)
        ranges = {name: {one.kind: list(one.numbers)} for name, one in distributions.items()}
        shown = spaces.Box(-np.inf, np.inf, (len(names),), np.float32)
        self.spec = replace(
            self.world.spec,
            channels={**spec.channels, PARAMETERS: shown},
            card={**self.world.spec.card, "randomised": ranges},
            differentiable=False,
        )

    def start(self, batch: int, rng: torch.Generator) -> State:
        return self._randomised(self.world.start(batch, rng), rng)

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        state = self.world.observe(observation, prior, rng)
        return self._randomised(state, rng) if prior is None else state.replace(**_held(prior))

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        action, held = self.spec.check_action(action, state.batch), _held(state)
        if self._max_delay:
            queue = torch.cat([state[f"{_HELD}queue"], action[:, None]], 1)
            late = self._value(state, DELAY).round().long()
            action, held[f"{_HELD}queue"] = queue[torch.arange(state.batch), self._max_delay - late], queue[:, 1:]
        if BACKLASH in self.distributions:
            play = self._value(state, BACKLASH).view(-1, *[1] * (action.ndim - 1)).to(action.dtype) / 2
            action = held[f"{_HELD}followed"] = state[f"{_HELD}followed"].clamp(action - play, action + play)
        if self._noisy:
            held[_SEEDS] = chance.seeds(state.batch, rng)
        return self.world.imagine(state, action, rng).replace(**held)

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        seen = dict(self.world.render(state, [name for name in channels if name != PARAMETERS]))
        for name in self._noisy:
            if name in seen:
                noise = chance.normal(state[_SEEDS], seen[name].shape[1:], _SENSED + self._noisy.index(name))
                size = self._value(state, NOISE + name).view(-1, *[1] * (noise.ndim - 1))
                seen[name] = (seen[name] + size.float() * noise).to(seen[name].dtype)
        if PARAMETERS in channels:
            seen[PARAMETERS] = state[f"{_HELD}drawn"].float()
        return {name: seen[name] for name in channels}

    def with_parameters(self, state: State, drawn: torch.Tensor) -> State:
        """The state with these values [B, n] of the parameters, in their order, and with idle delayed actions."""
        names, rest = list(self.distributions), torch.from_numpy(neutral_action(self.spec))
        if self._own:
            adjustable: Any = self.world
            state = adjustable.adjusted(state, drawn[:, [names.index(name) for name in self._own]])
        held = {f"{_HELD}drawn": drawn}
        if BACKLASH in self.distributions:
            held[f"{_HELD}followed"] = rest.expand(state.batch, *rest.shape).clone()
        if self._max_delay:
            held[f"{_HELD}queue"] = rest.expand(state.batch, self._max_delay, *rest.shape).clone()
        return state.replace(**held)

    def _randomised(self, state: State, rng: torch.Generator) -> State:
        """The state with newly drawn parameters."""
        seeds = chance.seeds(state.batch, rng)
        drawn = torch.stack([one.draw(seeds, _DRAW + at) for at, one in enumerate(self.distributions.values())], 1)
        drawn = self.nominal + self.scale * (drawn - self.nominal)
        return self.with_parameters(state, drawn).replace(**{_SEEDS: seeds})

    def _value(self, state: State, name: str) -> torch.Tensor:
        return state[f"{_HELD}drawn"][:, list(self.distributions).index(name)]


def _held(state: State) -> dict[str, torch.Tensor]:
    return {name: state[name] for name in state if name.startswith(_HELD)}


def _check(spec: Spec, known: Mapping[str, Any], distributions: Mapping[str, Distribution]) -> None:
    """TerrellaError for a parameter that cannot be randomised, or not so far."""
    for name, one in distributions.items():
        low, high = one.limits
        if name == DELAY:
            whole = one.kind in ("choice", "constant") and all(number == int(number) for number in one.numbers)
            if not whole or low < 0 or high > MAX_DELAY:
                raise TerrellaError(f"'{DELAY}' is a choice of whole steps from 0 to {MAX_DELAY}; got {one.numbers}.")
        elif name == BACKLASH:
            if dtype_of(spec.action).kind != "f" or low < 0:
                raise TerrellaError(
                    f"'{BACKLASH}' is 0 or more, of actions that are axes; {spec.name} takes {spec.action}."
                )
        elif name.startswith(NOISE):
            channel = name.removeprefix(NOISE)
            spec.check_channels((channel,))
            if dtype_of(spec.channels[channel]).kind != "f" or kind_of(channel) in ("pose", "reward") or low < 0:
                raise TerrellaError(
                    f"'{name}': noise has a standard deviation of 0 or more, on a float channel other than pose and reward."
                )
        elif name in known:
            safe = known[name]
            if low < safe.low or high > safe.high:
                raise TerrellaError(
                    f"'{name}' of {spec.name} cannot be randomised safely from {low:g} to {high:g}: it is stable within "
                    f"{safe.low:g} to {safe.high:g} {safe.unit}."
                )
        else:
            others = (DELAY, BACKLASH, *(f"{NOISE}{channel}" for channel in spec.channels), *known)
            plain = [other for other in known if not other.startswith("mass.")]
            own = f" {', '.join(plain)}, mass.BODY," if plain else ""
            raise TerrellaError(
                f"{spec.name} has no parameter '{name}'{did_you_mean(name, others) or '.'} "
                f"There are{own} {DELAY}, {BACKLASH} and {NOISE}CHANNEL."
            )
