"""Imagination as a feed: a policy acts in a world, by the hundred episodes at once, and what came of it is the batch.

Where dreams begin: in states that a recording's rows lead to (`Recorded`), or in the world's own starts, each episode then going
on from batch to batch until it ends (`Continued`), which is how a simulator is practised in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import nn

from ..act.actor_network import ActorNetwork
from ..core.errors import ChannelError, DatasetError, ObservationError
from ..core.policy import Random
from ..core.rollouts import rollout
from ..core.spec import Spec
from ..core.state import State
from ..core.world import World, make_rng
from .growth import Growth
from .latent_validation import folded
from .recording import Recording
from .trainer import Now

MOST_STARTS = 8192  # states of a recording in which dreams begin
CONTEXT = 2  # rows before them that the world is shown
USUAL = 16, 32  # episodes and steps of random play that say how large numbers are, where there is no recording


@dataclass(frozen=True)
class Imagined:
    """T steps of B episodes. seen: [T + 1, B, ...] by channel; drawn [T, B, D], what the policy meant; reward [T, B]; goes_on
    [T, B]: how likely the episode is not over after the step; known [T, B]: False where the world no longer knew what came."""

    seen: Mapping[str, torch.Tensor]
    drawn: torch.Tensor
    reward: torch.Tensor
    goes_on: torch.Tensor
    known: torch.Tensor


class Starts(Protocol):
    """Where dreams begin, and what is kept of how they ended. `modules` are saved with the run."""

    @property
    def modules(self) -> Mapping[str, nn.Module]: ...
    def begin(self, now: Now) -> State: ...
    def end(self, state: State, steps: int, now: Now) -> None: ...
    def usual(self, channels: Sequence[str]) -> Mapping[str, torch.Tensor]: ...


class Recorded:
    """Each dream begins in one of `states`, drawn evenly, and ends with the batch."""

    def __init__(self, world: World, states: State, batch: int):
        self.world, self.states, self.batch = world, states, batch
        self.modules: dict[str, nn.Module] = {}

    def begin(self, now: Now) -> State:
        picked = now.rng.integers(self.states.batch, size=self.batch)
        return self.states.at(torch.from_numpy(picked).to(self.states.device))

    def end(self, state: State, steps: int, now: Now) -> None:
        pass

    def usual(self, channels: Sequence[str]) -> Mapping[str, torch.Tensor]:
        """What is seen in the states."""
        return self.world.render(self.states, channels)


class Continued:
    """Episodes begin where the world has them begin, and go on from batch to batch until they are over or `longest` steps long.
    They are kept as buffers, so that a run that was stopped goes on with them. Where states point into an arena, which no buffer
    holds, each batch begins anew and nothing is kept."""

    def __init__(self, world: World, batch: int, longest: int, seed: int):
        self.world, self.longest, self.seed = world, longest, seed
        state = world.start(batch, make_rng(seed))
        self.held = _Held(state, np.random.default_rng(seed).integers(longest, size=batch))
        self.anew = bool(state.arenas)
        self.modules = {} if self.anew else {"episodes": self.held}

    def begin(self, now: Now) -> State:
        if self.anew:
            return self.world.start(len(self.held.age), now.noise)
        state, over = self.held.state(), self.held.age >= self.longest
        if over.any():
            fresh = self.world.start(int(over.sum()), now.noise)
            state = state.put(over.nonzero()[:, 0].to(state.device), fresh)
            self.held.age[over] = 0
        return state

    def end(self, state: State, steps: int, now: Now) -> None:
        if self.anew:
            return
        over = self.world.render(state, ("done",))["done"] if "done" in self.world.spec.channels else None
        self.held.hold(state)
        self.held.age += steps
        if over is not None:
            self.held.age[over.to(self.held.age.device)] = self.longest

    def usual(self, channels: Sequence[str]) -> Mapping[str, torch.Tensor]:
        """What is seen in some episodes of random play."""
        batch, steps = USUAL
        rng = make_rng(self.seed)
        state = self.world.start(batch, rng)
        policy = Random(self.world.spec, (1, 8))
        seen = rollout(self.world, state, policy, rng, channels, steps).observations
        return {name: value.flatten(0, 1) for name, value in seen.items()}


class _Held(nn.Module):
    """A state's tensors and the ages of its episodes, as buffers."""

    age: torch.Tensor

    def __init__(self, state: State, age: np.ndarray):
        super().__init__()
        self.names = tuple(state)
        self.register_buffer("age", torch.from_numpy(age.astype(np.int64)))
        for number, name in enumerate(self.names):
            self.register_buffer(f"tensor{number}", state[name].clone())

    def state(self) -> State:
        return State({name: getattr(self, f"tensor{number}") for number, name in enumerate(self.names)})

    def hold(self, state: State) -> None:
        for number, name in enumerate(self.names):
            setattr(self, f"tensor{number}", state[name].detach().clone())


class Imagination:
    """A feed of what `network` does in `world` over `steps` steps from `starts`.

    gradients: whether they flow from what came of it to the actions. trust: the uncertainty from which the world no longer knows:
    a dream counts up to there. growth: how far the world's ranges have grown.
    """

    def __init__(
        self,
        world: World,
        network: ActorNetwork,
        starts: Starts,
        steps: int,
        gradients: bool,
        trust: float | None,
        growth: Growth | None = None,
    ):
        check_practised(world.spec)
        self.world, self.network, self.starts, self.steps = world, network, starts, steps
        self.gradients, self.trust, self.growth = gradients, trust, growth

    def batch(self, now: Now) -> Imagined:
        if self.growth is not None:
            self.growth.set()
        with nullcontext() if self.gradients else torch.no_grad():
            found, state = self._imagined(self.starts.begin(now), now)
        self.starts.end(state, self.steps, now)
        if self.growth is not None:
            self.growth.follow(found.reward)
        return found

    def state(self) -> dict:
        return {}

    def resume(self, state: Mapping) -> None:
        pass

    def _imagined(self, state: State, now: Now) -> tuple[Imagined, State]:
        world, config, spec = self.world, self.network.config, self.world.spec
        sees = tuple(name for name, _ in config.sees)
        told = [name for name in ("reward", "done", "done_probability") if name in spec.channels]
        told += ["uncertainty"] if self.trust is not None else []
        channels = tuple(dict.fromkeys((*sees, *told)))
        seen, drawn, brought = [dict(world.render(state, channels))], [], []
        for _ in range(self.steps):
            drawn.append(self.network(seen[-1]).sample(now.noise))
            state = world.imagine(state, config.actions(drawn[-1], spec).to(state.device), now.noise)
            seen.append(dict(world.render(state, channels)))
            brought.append(self._brought(seen[-1], now.device))
        reward, goes_on, known = (torch.stack(parts) for parts in zip(*brought))
        shown = {name: torch.stack([frame[name] for frame in seen]).to(now.device) for name in sees}
        return Imagined(shown, torch.stack(drawn), reward, goes_on, known), state

    def _brought(
        self, seen: Mapping[str, torch.Tensor], device: torch.device
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        reward = seen["reward"].to(device).float()
        goes_on, known = torch.ones_like(reward), torch.ones_like(reward, dtype=torch.bool)
        if "done_probability" in seen:
            goes_on = goes_on - seen["done_probability"].to(device)
        if "done" in seen:
            goes_on = goes_on * ~seen["done"].to(device)
        if self.trust is not None:
            known = seen["uncertainty"].to(device).detach() <= self.trust
        return reward, goes_on, known


def check_practised(spec: Spec) -> None:
    """ChannelError or ObservationError where nobody can practise in a world, by the hundred episodes and for a reward."""
    if "reward" not in spec.channels:
        raise ChannelError(
            f"{spec.name} has no channel 'reward', and practice is for a reward; record one and train the world on it, "
            "or give a simulated robot a task that has rewards (docs/robots.md: an MJCF file can name its task)."
        )
    if not spec.forkable:
        raise ObservationError(
            f"{spec.name} plays one episode at a time and cannot return to a state, so nobody can practise in it by the "
            "hundred: train a world on a recording of it (`terrella train latent`) and practise there."
        )


@torch.no_grad()
def recorded_starts(world: World, recording: Recording) -> State:
    """States to which rows of a recording lead, MOST_STARTS at most: with CONTEXT rows before them where there are as many, and
    the first of its episodes."""
    spec = world.spec
    wanted = (*spec.observes, *spec.may_observe)
    there = {"rgb"} if recording.cache.rgb is not None else set[str]()
    there |= {name for name, key in recording.cache.keys.items() if key in recording.cache.arrays}
    lacks = [name for name in spec.observes if name not in there]
    if lacks or not wanted:
        raise DatasetError(
            f"{recording.name} does not hold {', '.join(lacks) or 'anything'} that {spec.name} can be shown; give the recording "
            "that it was learned from, or leave --from out: then dreams begin at the world's own starts."
        )
    rows = recording.within(CONTEXT, 1, acted=True)
    first = np.intersect1d(recording.start, recording.within(0, 1, acted=True))
    if not len(first):
        raise DatasetError(f"no episode of {recording.name} can be dreamt on; record longer ones.")
    some = rows[:: max(1, -(-len(rows) // MOST_STARTS))]
    few = first[:: max(1, -(-4 * len(first) // max(len(some), 1)))] if len(some) else first
    parts = [
        folded(world, recording, part, context)
        for which, context in ((some, CONTEXT), (few, 0))
        for part in np.array_split(which, max(1, -(-len(which) // 512)))
        if len(part)
    ]
    return State.stack(parts)
