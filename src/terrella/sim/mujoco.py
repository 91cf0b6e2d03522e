"""Snapshots of MuJoCo environments of Gymnasium, which make them forkable."""

# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence

import gymnasium
import mujoco
import numpy as np

from .snapshot import Snapshots

_WHOLE = mujoco.mjtState.mjSTATE_INTEGRATION  # everything that the next step depends on, with the solver's warm start


class MujocoSnapshots(Snapshots):
    """The attributes of `Snapshots`, and MuJoCo's integration state. Derived quantities (body poses) are computed on restore."""

    ignored = Snapshots.ignored | {"model", "data", "mujoco_renderer", "_ezpickle_args", "_ezpickle_kwargs"}

    def __init__(self, env: gymnasium.Env):
        self._size = mujoco.mj_stateSize(env.unwrapped.model, _WHOLE)
        super().__init__(env)

    def take(self, env: gymnasium.Env) -> tuple[list[float], list[int]]:
        numbers, kinds = super().take(env)
        state, bare = np.empty(self._size), env.unwrapped
        mujoco.mj_getState(bare.model, bare.data, state, _WHOLE)
        return [*numbers, *state.tolist()], kinds

    def put(self, env: gymnasium.Env, numbers: Sequence[float], kinds: Sequence[int]) -> None:
        super().put(env, numbers[: -self._size], kinds)
        bare, state = env.unwrapped, np.array(numbers[-self._size :])
        model, data = bare.model, bare.data
        mujoco.mj_setState(model, data, state, _WHOLE)
        mujoco.mj_forward(model, data)
        mujoco.mj_setState(model, data, state, _WHOLE)  # mj_forward has changed it
