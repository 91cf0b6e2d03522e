"""as_env: any World as a Gymnasium vector environment."""

from collections.abc import Sequence

import numpy as np
import torch
from gymnasium import logger, spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from .errors import TerrellaError
from .state import State
from .world import World, make_rng


class WorldEnv(VectorEnv):
    """`as_env(world)`: `num_envs` parallel episodes of `world`. Arrays lead with num_envs. Closing it leaves the world open.

    max_steps:      steps after which an episode is truncated; None takes the world's limit (Spec.max_episode_steps),
                    math.inf sets none.
    observation:    one channel, whose arrays are the observations, or several, for a dictionary of arrays. None takes
                    "observation" where the world has it, else "rgb", else all channels but reward and done.
    seed:           of the first `reset()`; later resets without a seed continue its random numbers.
    autoreset_mode: as in Gymnasium. NEXT_STEP: the step after an end starts a new episode and ignores its action.
                    SAME_STEP: the last observation is infos["final_obs"], its infos are infos["final_info"].
                    DISABLED: call reset(options={"reset_mask": bool [num_envs]}).

    The reward is the channel `reward` (0 without one); `terminated` is the channel `done`. Where the state has a tensor
    `truncated` (bool [num_envs]), it says which of the done episodes were truncated instead.
    ChannelError for unknown channels; TerrellaError where the world cannot hold `num_envs` episodes.
    """

    def __init__(
        self,
        world: World,
        num_envs: int = 1,
        max_steps: float | None = None,
        observation: str | Sequence[str] | None = None,
        seed: int = 0,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
    ):
        spec = world.spec
        most, max_steps = spec.max_batch, spec.max_episode_steps if max_steps is None else max_steps
        if num_envs < 1 or (most is not None and num_envs > most):
            raise TerrellaError(f"{spec.name} holds 1 to {most or 'any number of'} episodes; num_envs is {num_envs}.")
        max_steps = np.inf if max_steps is None else max_steps
        if not max_steps >= 1:
            raise TerrellaError(f"max_steps is a number of steps from 1 on, or math.inf for no end; got {max_steps}.")
        if observation is None:
            rest = tuple(name for name in spec.channels if name not in ("reward", "done"))
            observation = next((name for name in ("observation", "rgb") if name in rest), rest)
        self._single = isinstance(observation, str)
        self._names = (observation,) if isinstance(observation, str) else tuple(observation)
        spec.check_channels(self._names)
        more = [name for name in ("reward", "done") if name in spec.channels]
        self._asked = tuple(dict.fromkeys((*self._names, *more)))
        self.world, self.num_envs, self.max_steps = world, num_envs, max_steps
        self._max_episode_steps = max_steps  # as TimeLimit calls it, for `call("_max_episode_steps")`
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        shown = {name: spec.channels[name] for name in self._names}
        self.single_observation_space = shown[self._names[0]] if self._single else spaces.Dict(shown)
        self.single_action_space = spec.action
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.render_mode = "rgb_array" if "rgb" in spec.channels else None
        self.metadata = {
            "render_modes": ["rgb_array"] if self.render_mode else [],
            "render_fps": max(1, round(1 / spec.dt_s)),
            "autoreset_mode": self.autoreset_mode,
        }
        self._rng, self._first_seed = make_rng(seed), seed
        self._state: State | None = None
        self._steps = np.zeros(num_envs, np.int64)
        self._ended = np.zeros(num_envs, np.bool_)

    @property
    def state(self) -> State:
        """The state of the world; batch entry i is environment i."""
        if self.closed:
            raise TerrellaError("the environment is closed: make another with as_env(world).")
        if self._state is None:
            raise TerrellaError("the environment has not begun: call reset() first.")
        return self._state

    @torch.no_grad()
    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: dict | None = None):
        """Starts new episodes in all environments, or in those of options["reset_mask"], a bool array [num_envs].

        seed: one for each environment, None for chance; the number n stands for n, n + 1, ... The start of an environment
              depends on its own seed alone. A reset of all environments with a seed for each seeds all later randomness, too.
        """
        rest = dict(options or {})
        mask = rest.pop("reset_mask", np.ones(self.num_envs, np.bool_))
        valid = isinstance(mask, np.ndarray) and mask.shape == (self.num_envs,) and mask.dtype == np.bool_
        if not valid or not mask.any():
            raise TerrellaError(f"options['reset_mask'] is a numpy array of {self.num_envs} booleans, not all False.")
        if rest:
            logger.warn(f"{self.world.spec.name} has no options {', '.join(map(str, rest))}; they are ignored.")
        before = None if mask.all() else self.state
        if before is None and self._state is None and seed is None:
            seed = self._first_seed
        seeds = self._seeds(seed)
        given = [one for one in seeds if one is not None]
        if before is None and len(given) == self.num_envs:
            super().reset(seed=given[0])
            self._rng = make_rng(int(np.random.SeedSequence(given).generate_state(1, np.uint64)[0] >> 1))
        self._restart(before, mask, seeds)
        return self._observations(self._look()), {}

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """A seed, or None, for each environment."""
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else int(seed) + place for place in range(self.num_envs)]
        else:
            seeds = np.atleast_1d(np.asarray(seed, object)).tolist()
        whole = all(one is None or (isinstance(one, int | np.integer) and 0 <= one < 2**63) for one in seeds)
        if len(seeds) != self.num_envs or not whole:
            raise TerrellaError(
                f"seed is a number from 0 on, or a list of one for each of {self.num_envs} environments; got {seed}."
            )
        return seeds

    @torch.no_grad()
    def step(self, actions):
        """Observations, rewards (float64), terminated, truncated, infos; arrays lead with num_envs."""
        state = self.state
        actions = actions if isinstance(actions, torch.Tensor) else torch.from_numpy(np.array(actions))
        fresh = self._ended.copy()
        if fresh.any() and self.autoreset_mode == AutoresetMode.DISABLED:
            raise TerrellaError(f"environments {np.flatnonzero(fresh).tolist()} have ended: reset them first.")
        self.world.spec.check_action(actions, self.num_envs)
        if not fresh.all():
            self._state = state = self.world.imagine(state, actions, self._rng)
        if fresh.any():
            self._restart(state, fresh)
        self._steps = np.where(fresh, 0, self._steps + 1)
        seen = self._look()
        nothing = np.zeros(self.num_envs)
        rewards = np.where(fresh, 0.0, seen["reward"].astype(np.float64)) if "reward" in seen else nothing
        done = seen["done"] & ~fresh if "done" in seen else np.zeros(self.num_envs, np.bool_)
        cut = done & self.state["truncated"].cpu().numpy() if "truncated" in self.state else np.zeros_like(done)
        terminated, truncated = done & ~cut, cut | (self._steps >= self.max_steps)
        self._ended = terminated | truncated
        observations, infos = self._observations(seen), {}
        if self._ended.any() and self.autoreset_mode == AutoresetMode.SAME_STEP:
            for place in np.flatnonzero(self._ended).tolist():
                self._add_info(infos, {"final_obs": self._entry(observations, place), "final_info": {}}, place)
            self._restart(self.state, self._ended.copy())
            observations = self._observations(self._look())
        return observations, rewards, terminated, truncated, infos

    @torch.no_grad()
    def render(self) -> tuple[np.ndarray, ...] | None:
        """One picture, uint8 [H, W, 3], for each environment; None for a world without `rgb`."""
        if self.render_mode is None:
            return None
        return tuple(np.array(frame) for frame in self.world.render(self.state, ("rgb",))["rgb"].cpu().numpy())

    def get_attr(self, name: str) -> tuple:
        """An attribute of the environments, once for each, as SyncVectorEnv has it."""
        return (getattr(self, name),) * self.num_envs

    def set_attr(self, name: str, values) -> None:
        """Sets an attribute of all environments; a list is one value for each, which must be alike."""
        several = values if isinstance(values, list | tuple) else [values]
        if any(one != several[0] for one in several):
            raise TerrellaError(f"the environments of a world share '{name}': give one value.")
        setattr(self, name, several[0])

    def call(self, name: str, *args, **kwargs) -> tuple:
        """The pictures of `render`, or an attribute, once for each environment, as SyncVectorEnv has it."""
        value = getattr(self, name)
        return value(*args, **kwargs) if name == "render" else self.get_attr(name)

    def close_extras(self, **kwargs) -> None:
        """Forgets the episodes; the world stays open."""
        self._state = None

    def _restart(self, state: State | None, mask: np.ndarray, seeds: Sequence[int | None] = ()) -> None:
        """Replaces the entries `mask` of `state` by new episodes; `state` may be None where the mask is all True."""
        places = np.flatnonzero(mask)
        seeded = {at: seed for at, place in enumerate(places.tolist()) if seeds and (seed := seeds[place]) is not None}
        if len(seeded) == len(places) and (self.world.spec.forkable or self.num_envs == 1):
            fresh = State.stack([self.world.start(1, make_rng(seed)) for seed in seeded.values()])
        else:
            fresh = self.world.start(len(places), self._rng)
            for at, seed in seeded.items():
                fresh = fresh.put(torch.tensor([at]), self.world.start(1, make_rng(seed)))
        self._state = fresh if mask.all() else state.put(torch.from_numpy(places), fresh)
        self._steps[mask], self._ended[mask] = 0, False

    def _look(self) -> dict[str, np.ndarray]:
        seen = self.world.render(self.state, self._asked)
        return {name: np.array(seen[name].cpu().numpy()) for name in self._asked}

    def _observations(self, seen: dict[str, np.ndarray]):
        return seen[self._names[0]] if self._single else {name: seen[name] for name in self._names}

    def _entry(self, observations, place: int):
        if self._single:
            return np.array(observations[place])
        return {name: np.array(array[place]) for name, array in observations.items()}


as_env = WorldEnv
