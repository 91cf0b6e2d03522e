"""as_env: any World as a Gymnasium vector environment."""

from collections.abc import Sequence

import numpy as np
import torch
from gymnasium import spaces
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
                    "observation" where the world has it, else "rgb".
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
            observation = "observation" if "observation" in spec.channels else "rgb"
        self._single = isinstance(observation, str)
        self._names = (observation,) if isinstance(observation, str) else tuple(observation)
        spec.check_channels(self._names)
        more = [name for name in ("reward", "done") if name in spec.channels]
        self._asked = tuple(dict.fromkeys((*self._names, *more)))
        self.world, self.num_envs, self.max_steps = world, num_envs, max_steps
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
        self._rng = make_rng(seed)
        self._state: State | None = None
        self._steps = np.zeros(num_envs, np.int64)
        self._ended = np.zeros(num_envs, np.bool_)

    @property
    def state(self) -> State:
        """The state of the world; batch entry i is environment i."""
        if self._state is None:
            raise TerrellaError("the environment has not begun: call reset() first.")
        return self._state

    @torch.no_grad()
    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Starts new episodes in all environments, or in those of options["reset_mask"]; `seed` seeds all randomness again."""
        super().reset(seed=seed)
        if seed is not None:
            self._rng = make_rng(seed)
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, np.bool_))
        valid = isinstance(mask, np.ndarray) and mask.shape == (self.num_envs,) and mask.dtype == np.bool_
        if not valid or not mask.any():
            raise TerrellaError(f"options['reset_mask'] is a numpy array of {self.num_envs} booleans, not all False.")
        self._restart(None if mask.all() else self.state, mask)
        return self._observations(self._look()), {}

    @torch.no_grad()
    def step(self, actions):
        """Observations, rewards (float64), terminated, truncated, infos; arrays lead with num_envs."""
        state, actions = self.state, torch.as_tensor(np.asarray(actions))
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

    def _restart(self, state: State | None, mask: np.ndarray) -> None:
        """Replaces the entries `mask` of `state` by new episodes; `state` may be None where the mask is all True."""
        fresh = self.world.start(int(mask.sum()), self._rng)
        self._state = fresh if mask.all() else state.put(torch.from_numpy(np.flatnonzero(mask)), fresh)
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
