"""Atari games (ale-py) with the usual preprocessing: frame skip, small pictures, exact copies of the console's state."""

from collections.abc import Sequence

import ale_py
import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils.seeding import np_random

from ..core.errors import TerrellaError
from .gymnasium import Adapter, GymnasiumConfig, GymnasiumWorld, check_size
from .observation_channels import resized
from .snapshot import NotCopyable

FRAMES_PER_SECOND = 60


class AtariWorld(GymnasiumWorld):
    """`AtariWorld("ALE/Breakout-v5")`: one step is `frames` frames of the console (Mnih et al. 2015).

    size: (height, width) of rgb, area-averaged from 210x160 (None: as it is); frames: frame skip, the picture is the maximum of
    the last two frames, because sprites flicker; sticky: probability that a frame repeats the last action (Machado et al. 2018),
    0: deterministic and forkable; noops: an episode starts after 1 to `noops` random no-op frames.

    Channels: rgb uint8 [B, H, W, 3]; reward, the points of the step; done, at game over; lives float32 [B]."""

    def __init__(
        self,
        game: str,
        *,
        size: tuple[int, int] | None = (64, 64),
        frames: int = 4,
        sticky: float = 0.0,
        noops: int = 30,
        forkable: bool | None = None,
        repeat: int = 1,
    ):
        if not (0 <= sticky <= 1 and 1 <= frames <= 60 and noops >= 0):
            raise TerrellaError(
                f"sticky={sticky} must be a probability, frames={frames} from 1 to 60, noops={noops} 0 or more."
            )
        if forkable and sticky:
            raise TerrellaError(
                f"with sticky={sticky} the game draws its own random numbers: its states cannot be forked."
            )
        screen = check_size(size)

        def build() -> gymnasium.Env:
            return _Screen(_make(game, sticky), screen, frames, noops, sticky)

        names = tuple(_make(game, sticky).unwrapped.get_action_meanings())  # pyright: ignore[reportAttributeAccessIssue]
        config = GymnasiumConfig(
            dt_s=frames / FRAMES_PER_SECOND,
            forkable=forkable if sticky == 0 else False,
            snapshots=_Savestates,
            info_channels=("lives",),
            name=f"gym:{game}" if repeat == 1 else f"gym:{game}@{repeat}",
            repeat=repeat,
            adapter=Adapter(action_names=names),
        )
        super().__init__(build, config)


def _make(game: str, sticky: float) -> gymnasium.Env:
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)  # its greeting would mix with our output
    gymnasium.register_envs(ale_py)
    try:
        return gymnasium.make(
            game,
            obs_type="ram",  # the screen is fetched only when needed
            frameskip=1,
            repeat_action_probability=sticky,
            max_episode_steps=-1,
            disable_env_checker=True,
        )
    except (gymnasium.error.Error, TypeError) as error:
        raise TerrellaError(f"Gymnasium cannot make '{game}': {error}") from error


class _Screen(gymnasium.Wrapper):
    """Frame skip, no-op starts and small pictures."""

    def __init__(self, env: gymnasium.Env, size: tuple[int, int] | None, frames: int, noops: int, sticky: float):
        super().__init__(env)
        self.sticky, self.loaded = sticky, False
        self.ale = _ale(env)
        self.size = size or tuple(self.ale.getScreenDims())
        self.frames, self.noops = frames, noops
        self.observation_space = spaces.Box(0, 255, (*self.size, 3), np.uint8)

    def reset(self, *, seed=None, options=None):
        if self.sticky or not self.loaded:
            self.env.reset(seed=seed, options=options)
            self.loaded = True
        elif seed is not None:  # a full reset reloads the game, 0.2 s, for a seed that is not used
            self.unwrapped.np_random, _ = np_random(seed)
        self.ale.reset_game()
        info: dict = {"lives": self.ale.lives()}
        for _ in range(int(self.unwrapped.np_random.integers(1, self.noops + 1)) if self.noops else 0):
            *_, over, _, info = self.env.step(0)
            if over:
                self.ale.reset_game()
        return resized(self.ale.getScreenRGB(), self.size), info

    def step(self, action):
        total, screens = 0.0, []
        terminated = truncated = False
        info: dict = {}
        for frame in range(self.frames):
            _, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            if frame >= self.frames - 2 or terminated or truncated:
                screens.append(self.ale.getScreenRGB())
            if terminated or truncated:
                break
        return resized(np.maximum.reduce(screens), self.size), total, terminated, truncated, info


class _Savestates:
    """The console's own save states instead of `Snapshots`, with the same methods."""

    def __init__(self, env: gymnasium.Env):
        self._width = len(self._bytes(env))

    def take(self, env: gymnasium.Env) -> tuple[list[float], list[int]]:
        state = self._bytes(env)
        if len(state) != self._width:
            raise NotCopyable("its save states differ in length")
        return [], list(state)

    def put(self, env: gymnasium.Env, numbers: Sequence[float], kinds: Sequence[int]) -> None:
        state = ale_py._ale_py.ALEState.__new__(ale_py._ale_py.ALEState)  # pyright: ignore[reportAttributeAccessIssue]
        state.__setstate__(bytes(kinds))
        _ale(env).restoreState(state)

    @staticmethod
    def _bytes(env: gymnasium.Env) -> bytes:
        return _ale(env).cloneState().__getstate__()  # pyright: ignore[reportReturnType]


def _ale(env: gymnasium.Env) -> ale_py.ALEInterface:
    return env.unwrapped.ale  # pyright: ignore[reportAttributeAccessIssue]
