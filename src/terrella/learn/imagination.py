"""Imagination as a feed: a policy acts in a batch of imagined episodes, and its rollouts are the training batch.

Rollouts begin in states that a recording leads to (`RecordedStarts`), or at the world's own starts, from which episodes continue
from batch to batch (`ContinuedEpisodes`); a simulator is practised in that way.
"""

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
from ..core.spec import Spec, trust_channel
from ..core.state import State
from ..core.world import World, make_rng
from .growth import Growth
from .latent_validation import state_at
from .recording import Recording
from .train_step import TrainStep

MOST_STARTS = 8192  # states of a recording in which rollouts begin
CONTEXT = 2  # rows before them that the world observes
SAMPLE = 16, 32  # episodes and steps of random play by which observations are scaled, where there is no recording


@dataclass(frozen=True)
class ImaginedRollouts:
    """T steps of B episodes. observations: [T + 1, B, ...] by channel; actions [T, B, D] as drawn from the policy's distribution;
    reward [T, B]; continues [T, B]: the probability that the episode is not over after the step; trusted [T, B]: whether the
    world's uncertainty is within the limit after the step."""

    observations: Mapping[str, torch.Tensor]
    actions: torch.Tensor
    reward: torch.Tensor
    continues: torch.Tensor
    trusted: torch.Tensor


class RolloutStarts(Protocol):
    """The states in which rollouts begin, `batch` at a time, which `shrink` lowers. `modules` are saved with the run."""

    @property
    def modules(self) -> Mapping[str, nn.Module]: ...
    @property
    def batch(self) -> int: ...
    def shrink(self, batch: int) -> None: ...
    def begin(self, now: TrainStep) -> State: ...
    def end(self, state: State, steps: int, now: TrainStep) -> None: ...
    def sample(self, channels: Sequence[str]) -> Mapping[str, torch.Tensor]: ...


class RecordedStarts:
    """Each rollout begins in one of `states`, drawn uniformly, and ends with the batch."""

    def __init__(self, world: World, states: State, batch: int):
        self.world, self.states, self.batch = world, states, batch
        self.modules: dict[str, nn.Module] = {}

    def shrink(self, batch: int) -> None:
        self.batch = batch

    def begin(self, now: TrainStep) -> State:
        picked = now.rng.integers(self.states.batch, size=self.batch)
        return self.states.at(torch.from_numpy(picked).to(self.states.device))

    def end(self, state: State, steps: int, now: TrainStep) -> None:
        pass

    def sample(self, channels: Sequence[str]) -> Mapping[str, torch.Tensor]:
        """Observations of the states."""
        return self.world.render(self.states, channels)


class ContinuedEpisodes:
    """Episodes begin at the world's own starts and continue from batch to batch until they end or are `longest` steps long. They
    are kept as buffers, so that a resumed run continues them. States that point into an arena cannot be kept in buffers: there
    each batch begins new episodes."""

    def __init__(self, world: World, batch: int, longest: int, seed: int):
        self.world, self.longest, self.seed = world, longest, seed
        state = world.start(batch, make_rng(seed))
        self.held = _Held(state, np.random.default_rng(seed).integers(longest, size=batch))
        self.anew = bool(state.arenas)
        self.modules = {} if self.anew else {"episodes": self.held}

    @property
    def batch(self) -> int:
        return len(self.held.age)

    def shrink(self, batch: int) -> None:
        self.held.shrink(batch)

    def begin(self, now: TrainStep) -> State:
        if self.anew:
            return self.world.start(self.batch, now.seeding)
        state, over = self.held.state(), self.held.age >= self.longest
        if state.device.type != "cpu":  # a whole batch begins anew, of which some are taken: nothing waits for how many
            fresh = self.world.start(len(over), now.seeding)
            self.held.age.masked_fill_(over, 0)
            return state.mixed(over, fresh)
        if over.any():
            fresh = self.world.start(int(over.sum()), now.seeding)
            state = state.put(over.nonzero()[:, 0].to(state.device), fresh)
            self.held.age[over] = 0
        return state

    def end(self, state: State, steps: int, now: TrainStep) -> None:
        if self.anew:
            return
        over = self.world.render(state, ("done",))["done"] if "done" in self.world.spec.channels else None
        self.held.hold(state)
        self.held.age += steps
        if over is not None:
            self.held.age.masked_fill_(over.to(self.held.age.device), self.longest)

    def sample(self, channels: Sequence[str]) -> Mapping[str, torch.Tensor]:
        """Observations of some episodes of random play."""
        batch, steps = SAMPLE
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
        self.register_buffer("age", torch.from_numpy(age.astype(np.int64)).to(state.device))
        for number, name in enumerate(self.names):
            self.register_buffer(f"tensor{number}", state[name].clone())

    def state(self) -> State:
        return State({name: getattr(self, f"tensor{number}") for number, name in enumerate(self.names)})

    def shrink(self, batch: int) -> None:
        """Keeps the first episodes alone."""
        for name, tensor in list(self.named_buffers()):
            setattr(self, name, tensor[:batch].clone())

    def hold(self, state: State) -> None:
        for number, name in enumerate(self.names):
            setattr(self, f"tensor{number}", state[name].detach().clone())


class Imagination:
    """A feed of rollouts of `network` in `world`, `steps` steps from `starts`.

    gradients: whether rewards and observations are differentiable by the actions. trust: the uncertainty up to which a rollout is
    used. growth: the curriculum of the world's randomisation ranges.
    """

    least = 1

    def __init__(
        self,
        world: World,
        network: ActorNetwork,
        starts: RolloutStarts,
        steps: int,
        gradients: bool,
        trust: float | None,
        growth: Growth | None = None,
    ):
        check_practised(world.spec)
        self.world, self.network, self.starts, self.steps = world, network, starts, steps
        self.gradients, self.trust, self.growth = gradients, trust, growth

    @property
    def size(self) -> int:
        """Episodes of a batch."""
        return self.starts.batch

    def resize(self, size: int) -> None:
        self.starts.shrink(min(size, self.size))

    def batch(self, now: TrainStep) -> ImaginedRollouts:
        if self.growth is not None:
            self.growth.set()
        with nullcontext() if self.gradients else torch.no_grad():
            rollouts, state = self._rollout(self.starts.begin(now), now)
        self.starts.end(state, self.steps, now)
        if self.growth is not None:
            self.growth.update(rollouts.reward)
        return rollouts

    def state(self) -> dict:
        return {}

    def resume(self, state: Mapping) -> None:
        pass

    def _rollout(self, state: State, now: TrainStep) -> tuple[ImaginedRollouts, State]:
        world, config, spec = self.world, self.network.config, self.world.spec
        observed = tuple(name for name, _ in config.sees)
        outcomes = [name for name in ("reward", "done", "done_probability") if name in spec.channels]
        outcomes += [trust_channel(spec)] if self.trust is not None else []
        channels = tuple(dict.fromkeys((*observed, *outcomes)))
        frames, actions, steps = [dict(world.render(state, channels))], [], []
        for _ in range(self.steps):
            actions.append(self.network(frames[-1]).sample(now.seeding))
            state = world.imagine(state, config.actions(actions[-1], spec).to(state.device), now.seeding)
            frames.append(dict(world.render(state, channels)))
            steps.append(self._outcome(frames[-1], now.device))
        reward, continues, trusted = (torch.stack(parts) for parts in zip(*steps))
        observations = {name: torch.stack([frame[name] for frame in frames]).to(now.device) for name in observed}
        return ImaginedRollouts(observations, torch.stack(actions), reward, continues, trusted), state

    def _outcome(
        self, frame: Mapping[str, torch.Tensor], device: torch.device
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Reward, continuation and trust [B] of one step."""
        reward = frame["reward"].to(device).float()
        continues, trusted = torch.ones_like(reward), torch.ones_like(reward, dtype=torch.bool)
        if "done_probability" in frame:
            continues = continues - frame["done_probability"].to(device)
        if "done" in frame:
            continues = continues * ~frame["done"].to(device)
        if self.trust is not None:
            trusted = frame[trust_channel(self.world.spec)].to(device).detach() <= self.trust
        return reward, continues, trusted


def check_practised(spec: Spec) -> None:
    """ChannelError or ObservationError for a world without a reward, or one that cannot imagine a batch of episodes."""
    if "reward" not in spec.channels:
        raise ChannelError(
            f"{spec.name} has no channel 'reward', and practice is for a reward; record one and train the world on it, "
            "or give a simulated robot a task that has rewards (docs/robots.md: an MJCF file can name its task)."
        )
    if not spec.forkable:
        raise ObservationError(
            f"{spec.name} plays one episode at a time and cannot return to a state, so no policy can practise in a batch of its "
            "episodes: train a world on a recording of it (`terrella train latent`) and practise there."
        )


@torch.no_grad()
def recorded_starts(world: World, recording: Recording) -> State:
    """At most MOST_STARTS states of a recording: of rows with CONTEXT rows before them, and of the first rows of episodes."""
    spec = world.spec
    wanted = (*spec.observes, *spec.may_observe)
    recorded = {name for name, key in recording.cache.keys.items() if key in recording.cache.arrays}
    recorded |= {"rgb"} if recording.cache.rgb is not None else set[str]()
    lacks = [name for name in spec.observes if name not in recorded]
    if lacks or not wanted:
        raise DatasetError(
            f"{recording.name} does not hold {', '.join(lacks) or 'anything'} that {spec.name} can observe; give the "
            "recording that it was learned from, or leave --from out: then rollouts begin at the world's own starts."
        )
    rows = recording.rows_within(CONTEXT, 1, acted=True)
    first = np.intersect1d(recording.start, recording.rows_within(0, 1, acted=True))
    if not len(first):
        raise DatasetError(f"no episode of {recording.name} is long enough for a rollout; record longer ones.")
    some = rows[:: max(1, -(-len(rows) // MOST_STARTS))]
    few = first[:: max(1, -(-4 * len(first) // max(len(some), 1)))] if len(some) else first
    parts = [
        state_at(world, recording, part, context)
        for which, context in ((some, CONTEXT), (few, 0))
        for part in np.array_split(which, max(1, -(-len(which) // 512)))
        if len(part)
    ]
    return State.stack(parts)
