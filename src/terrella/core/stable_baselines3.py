"""as_sb3: any World as a vector environment of Stable-Baselines3."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from .env import WorldEnv
from .errors import TerrellaError
from .world import World


class WorldVecEnv(VecEnv):
    """`num_envs` parallel episodes of `world`; arguments as in WorldEnv. Closing it leaves the world open.

    Pictures are channels first, single numbers have one axis, choices count from 0. A new episode starts in the step in
    which one ends: infos[i]["terminal_observation"] is the last observation of the old one, and
    infos[i]["TimeLimit.truncated"] says whether it was truncated.
    """

    def __init__(
        self,
        world: World,
        num_envs: int = 1,
        max_steps: float | None = None,
        observation: str | Sequence[str] | None = None,
        seed: int = 0,
    ):
        self.env = WorldEnv(world, num_envs, max_steps, observation, seed, AutoresetMode.SAME_STEP)
        self.render_mode, self.metadata = self.env.render_mode, self.env.metadata
        action = self.env.single_action_space
        self._first = int(action.start) if isinstance(action, spaces.Discrete) else 0
        self._actions = np.zeros(0)
        shown = self.env.single_observation_space
        several = isinstance(shown, spaces.Dict)
        seen = spaces.Dict({k: _space(v) for k, v in shown.items()}) if several else _space(shown)
        super().__init__(num_envs, seen, spaces.Discrete(action.n) if isinstance(action, spaces.Discrete) else action)

    def reset(self):
        seen, _ = self.env.reset(seed=None if None in self._seeds else self._seeds)
        self._reset_seeds()
        return _map(_arranged, seen)

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self):
        seen, rewards, terminated, truncated, more = self.env.step(self._actions + self._first)
        infos: list[dict] = [{} for _ in range(self.num_envs)]
        for place in np.flatnonzero(terminated | truncated).tolist():
            last = _map(lambda one: _arranged(one[None])[0], more["final_obs"][place])
            cut = bool(truncated[place] and not terminated[place])
            infos[place] = {"terminal_observation": last, "TimeLimit.truncated": cut}
        return _map(_arranged, seen), rewards.astype(np.float32), terminated | truncated, infos

    def close(self) -> None:
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self.env.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices=None) -> list[Any]:
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices=None) -> None:
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *method_args, indices=None, **method_kwargs) -> list[Any]:
        raise TerrellaError(f"{self.env.world.spec.name} has no '{method_name}': its episodes are a batch of a World.")

    def env_is_wrapped(self, wrapper_class, indices=None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


def _map(change, seen):
    return {name: change(array) for name, array in seen.items()} if isinstance(seen, dict) else change(seen)


def _arranged(array: np.ndarray) -> np.ndarray:
    """Pictures [B, H, W, 3] -> [B, 3, H, W]; numbers [B] -> [B, 1]."""
    if array.dtype == np.uint8 and array.ndim == 4:
        return np.ascontiguousarray(array.transpose(0, 3, 1, 2))
    return array[:, None] if array.ndim == 1 else array


def _space(space: spaces.Space) -> spaces.Space:
    """The space of arranged arrays."""
    if not isinstance(space, spaces.Box):
        return space
    low, high = (_arranged(limit[None])[0] for limit in (space.low, space.high))
    return spaces.Box(low, high, dtype=space.dtype.type)  # pyright: ignore[reportArgumentType, reportOptionalMemberAccess]
