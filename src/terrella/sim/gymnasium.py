"""Any Gymnasium environment as a World; where its state can be copied exactly, it forks, batches and plans."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from PIL import Image

from ..core.errors import ObservationError, StaleStateError, TerrellaError
from ..core.spec import DONE, REWARD, Camera, Spec
from ..core.state import State
from ..core.world import make_rng
from .processes import MOST, Processes
from .snapshot import NotCopyable, Snapshots

_KNOWN_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)
_TRIALS, _TRIAL_STEPS = 3, 40


@dataclass(frozen=True)
class Channel:
    """A channel that an environment can show: `read(env)` gives one value [*space.shape] of the environment as it now stands."""

    read: Callable[[gymnasium.Env], np.ndarray | float]
    space: spaces.Space
    unit: str = ""


@dataclass(frozen=True)
class Adapter:
    """What an environment has beyond Gymnasium's own words, so that a world with depth and poses can be learned of it.

        class MyGame(gymnasium.Env):
            terrella = Adapter(
                channels={
                    "depth": Channel(lambda env: env.depth_buffer(), spaces.Box(0, 100, (96, 128), np.float32), "m"),
                    "pose": Channel(lambda env: env.camera_pose(), POSE, POSE_UNIT),
                },
                cameras={"rgb": Camera((0.5, 0.67, 0.5, 0.5), (96, 128))},
            )

    channels: name -> Channel. depth: metres along the optical axis; pose: x, y, z in metres and quaternion w, x, y, z of
              T_world_cam, world z up, camera x forward, y left, z up; "rgb.wrist" and the like are further cameras.
    cameras:  picture channel -> Camera.
    action_names, action_units, action_mode, action_frame, keys: as in Spec.
    """

    channels: Mapping[str, Channel] = field(default_factory=dict)
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    action_names: tuple[str, ...] = ()
    action_units: tuple[str, ...] = ()
    action_mode: str = ""
    action_frame: str = ""
    keys: Mapping[str, list[float]] | None = None


class GymnasiumWorld:
    """`GymnasiumWorld("CartPole-v1")`, or a function that builds an environment.

    env:      an id, which is made without its time limit (that is Spec.max_episode_steps, which `as_env` keeps),
              or a function that returns a new environment each time it is called.
    rgb:      also show `rgb`, where the environment draws itself with render_mode="rgb_array". Where its observation is
              a picture already (uint8 [H, W, 3]), that is `rgb`, and takes the place of `observation`.
    size:     (height, width) to which rgb is area-averaged; None leaves it as it is drawn.
    info_channels: numbers of the environment's `info` that become channels, float32 [B]: ("lives",).
    forkable: None finds out: an environment whose Python state is plain numbers is copied between two instances on
              trial, and only if every step agrees bit for bit are its states values. False makes states tickets for
              the present, and several episodes at once run in processes, each with an environment of its own.
    snapshots: what copies the environment's state, by default sim/snapshot.py.
    name:     for the spec, where the environment's own says too little.
    adapter:  further channels (depth, pose, more cameras) and what actions mean; by default the attribute `terrella` of
              the environment, where it has one.
    dt_s:     seconds in a step; by default the environment's own `dt` or `tau`, else one over its frames per second.
    options:  handed to gymnasium.make.

    Channels: observation [B, *shape], reward float32 [B], done bool [B] (terminated, or truncated by the environment
    itself; then the state's `truncated` says so), rgb uint8 [B, H, W, 3]. After `done` the world stands still with reward 0.
    Chance comes from `rng`: at `start`, and where states are values at each `imagine` too.
    Raises TerrellaError for unknown ids and for Dict or Tuple spaces.
    """

    def __init__(
        self,
        env: str | Callable[[], gymnasium.Env],
        *,
        rgb: bool = True,
        size: tuple[int, int] | None = None,
        info_channels: Sequence[str] = (),
        forkable: bool | None = None,
        snapshots: Callable[[gymnasium.Env], Any] | None = None,
        dt_s: float | None = None,
        name: str = "",
        adapter: Adapter | None = None,
        **options,
    ):
        self._lock = threading.Lock()  # one environment serves all episodes, so only one may move at a time
        self._env, found = _build(env, rgb, options)
        name, self._size, self._info = name or found, check_size(size), tuple(info_channels)
        for space in (self._env.observation_space, self._env.action_space):
            if not isinstance(space, _KNOWN_SPACES):
                raise TerrellaError(
                    f"{name} has the space {space}; wrap it so that it is one array (FlattenObservation)."
                )
        self._pictured = rgb and _is_picture(self._env.observation_space)
        self._env.reset(seed=0)
        self._snapshots, self._viewer = None, self._env
        if forkable is not False:
            twin, _ = _build(env, rgb, options)
            self._snapshots, why = _try_copying(self._env, twin, snapshots or Snapshots)
            if self._snapshots is not None:
                self._viewer = twin
            else:
                twin.close()
                if forkable:
                    raise TerrellaError(f"{name} cannot be copied ({why}); leave out forkable=True.")
        self._ticket = 0
        self._processes: Processes | None = None
        same = {
            "rgb": rgb,
            "size": size,
            "info_channels": info_channels,
            "dt_s": dt_s,
            "name": name,
            "adapter": adapter,
        }
        self._another = partial(GymnasiumWorld, env, forkable=False, **same, **options)
        self._env.reset(seed=0)
        self._adapter = adapter or getattr(self._env.unwrapped, "terrella", None) or Adapter()
        limit = self._env.spec.max_episode_steps if self._env.spec else None
        if isinstance(env, str) and "max_episode_steps" not in options:
            limit = gymnasium.registry[self._env.spec.id].max_episode_steps
        self.spec = self._describe(name, dt_s, rgb, limit)

    def start(self, batch: int, rng: torch.Generator) -> State:
        """`batch` resets of the environment, seeded from `rng`."""
        if batch < 1 or (self.spec.max_batch and batch > self.spec.max_batch):
            raise TerrellaError(
                f"{self.spec.name} starts a batch of 1 to {self.spec.max_batch or 'any number'}; got {batch}."
            )
        with self._lock:
            if self._snapshots is None and batch > 1 and self._processes is None:
                self._processes = Processes(self.spec.name, self._another)
            if self._processes is not None:
                return self._processes.start(_seeds(batch, rng))
            return self._state([self.begin(seed) for seed in _seeds(batch, rng)])

    def begin(self, seed: int) -> dict[str, np.ndarray]:
        """Resets the one environment: what is seen of it."""
        observation, info = self._env.reset(seed=seed)
        return self._row(observation, 0.0, False, False, info)

    def move(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Steps the one environment: what is seen of it."""
        return self._row(*self._env.step(action))

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """A simulator cannot be put into a state from what is seen of it: gives the prior, or a start."""
        if observation:
            raise ObservationError(f"{self.spec.name} is a simulator and takes no evidence; pass an empty mapping.")
        return prior if prior is not None else self.start(1, rng)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One step of the environment for each batch entry; entries that are done stand still with reward 0."""
        self._check(state)
        actions = self.spec.check_action(action, state.batch).cpu().numpy()
        with self._lock:
            seeds, rows = _seeds(state.batch, rng), []
            if self._processes is not None:
                return self._processes.imagine(state, actions)
            done = state["done"].tolist()
            for entry, seed in enumerate(seeds):
                if done[entry]:
                    still = {name: tensor[entry].numpy() for name, tensor in state.items()}
                    rows.append({**still, "reward": np.float32(0)})
                    continue
                if self._snapshots is not None:
                    self._snapshots.put(self._env, state["numbers"][entry].tolist(), state["kinds"][entry].tolist())
                    _reseed(self._env, seed)
                rows.append(self.move(actions[entry]))
            return self._state(rows)

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        self._check(state)
        if self._processes is not None:
            with self._lock:
                return self._processes.render(state, channels)
        return {name: state[name] if name in state else self._read(name, state) for name in channels}

    def close(self) -> None:
        self._env.close()
        self._viewer.close()
        if self._processes is not None:
            self._processes.close()

    def _row(self, observation, reward, terminated, truncated, info: Mapping) -> dict[str, np.ndarray]:
        space = self._env.observation_space
        seen = np.array(observation, dtype=space.dtype).reshape(space.shape)
        row = {
            **({"rgb": resized(seen, self._size)} if self._pictured else {"observation": seen}),
            "reward": np.float32(reward),
            "done": np.bool_(terminated or truncated),
            "truncated": np.bool_(truncated and not terminated),
            **{name: np.float32(info[name]) for name in self._info},
        }
        if self._snapshots is not None:
            try:
                numbers, kinds = self._snapshots.take(self._env)
            except NotCopyable as error:
                message = (
                    f"{self.spec.name} turned out to hold what cannot be copied: {error}; open it with forkable=False."
                )
                raise TerrellaError(message) from error
            row["numbers"], row["kinds"] = np.array(numbers, np.float64), np.array(kinds, np.uint8)
        return row

    def _state(self, rows: list[dict[str, np.ndarray]]) -> State:
        tensors = {name: torch.from_numpy(np.stack([row[name] for row in rows])) for name in rows[0]}
        if self._snapshots is None:
            self._ticket += 1
            tensors["ticket"] = torch.tensor([self._ticket])
        return State(tensors)

    def _check(self, state: State) -> None:
        if self._processes is not None:
            if "episode" not in state:
                raise StaleStateError(f"{self.spec.name} plays in processes since this state; start again.")
        elif self._snapshots is None:
            if "ticket" not in state or state.batch != 1 or int(state["ticket"][0]) != self._ticket:
                raise StaleStateError(
                    f"{self.spec.name} has moved on since this state and cannot go back (forkable=False)."
                )
        elif "numbers" not in state or state["numbers"].shape[1:] != self._width:
            raise TerrellaError(f"this is not a state of {self.spec.name}: {state}.")

    def _read(self, name: str, state: State) -> torch.Tensor:
        """A channel that is made when it is asked for: what the environment draws, or what its adapter reads off it."""
        with self._lock:
            found = []
            for entry in range(state.batch):
                if self._snapshots is not None:
                    self._snapshots.put(self._viewer, state["numbers"][entry].tolist(), state["kinds"][entry].tolist())
                found.append(self.look(name))
        return torch.from_numpy(np.stack(found))

    def look(self, name: str) -> np.ndarray:
        """One channel of the environment as it now stands."""
        space, channel = self.spec.channels[name], self._adapter.channels.get(name)
        drawn = np.asarray(self._viewer.render() if channel is None else channel.read(self._viewer.unwrapped))
        seen = np.array(resized(drawn, self._size) if channel is None else drawn, space.dtype)
        if seen.shape != space.shape:
            raise TerrellaError(f"{self.spec.name} gave '{name}' of shape {seen.shape}; its space is {space}.")
        return seen

    def _describe(self, name: str, dt_s: float | None, rgb: bool, limit: int | None) -> Spec:
        channels = {} if self._pictured else {"observation": self._env.observation_space}
        channels |= {"reward": REWARD, "done": DONE}
        channels |= {name: spaces.Box(-np.inf, np.inf, (), np.float32) for name in self._info}
        drawn = (
            self._env.observation_space.shape[:2] if self._pictured else _picture_size(self._viewer) if rgb else None
        )
        if drawn is not None:
            channels["rgb"] = spaces.Box(0, 255, (*(self._size or drawn), 3), np.uint8)
        if self._snapshots is not None:
            self._width = (len(self._snapshots.take(self._env)[0]),)
        more = self._adapter
        channels |= {name: channel.space for name, channel in more.channels.items()}
        return Spec(
            name=name,
            action=self._env.action_space,
            channels=channels,
            observes=(),
            dt_s=dt_s or _step_seconds(self._env),
            units={name: channel.unit for name, channel in more.channels.items() if channel.unit},
            cameras=more.cameras,
            action_names=more.action_names,
            action_units=more.action_units,
            action_mode=more.action_mode,
            action_frame=more.action_frame,
            keys=more.keys if more.keys is not None else _arrow_keys(self._env.action_space),
            forkable=self._snapshots is not None,
            max_batch=None if self._snapshots is not None else MOST,
            max_episode_steps=limit,
            card={"what": f"the Gymnasium environment {name.removeprefix('gym:')}", "kind": "simulator"},
        )


def _build(env: str | Callable[[], gymnasium.Env], rgb: bool, options: dict) -> tuple[gymnasium.Env, str]:
    if callable(env):
        built = env()
        return built, f"gym:{built.spec.id if built.spec else type(built.unwrapped).__name__}"
    options = {"max_episode_steps": -1, "disable_env_checker": True, **options}
    try:
        built = gymnasium.make(env, **options)
        if rgb and "rgb_array" in (built.metadata.get("render_modes") or ()):
            built.close()
            built = gymnasium.make(env, render_mode="rgb_array", **options)
        return built, f"gym:{env}"
    except (gymnasium.error.Error, ImportError, TypeError) as error:
        raise TerrellaError(f"Gymnasium cannot make '{env}': {error}") from error


def _seeds(count: int, rng: torch.Generator) -> list[int]:
    return torch.randint(2**31 - 1, (count,), generator=rng, device=rng.device).tolist()


def _reseed(env: gymnasium.Env, seed: int) -> None:
    """Sets PCG64's 128 bits directly: a tenth of the cost of a new generator, and it is done at every step."""
    bits = env.unwrapped.np_random.bit_generator
    if not isinstance(bits, np.random.PCG64):
        raise NotCopyable(f"its random generator is a {type(bits).__name__}")
    spread = {"state": seed * 0x9E3779B97F4A7C15F39CC0605CEDC835 % 2**128, "inc": 0xDA3E39CB94B95BDB}
    bits.state = {"bit_generator": "PCG64", "state": spread, "has_uint32": 0, "uinteger": 0}  # pyright: ignore[reportAttributeAccessIssue]


def _try_copying(env: gymnasium.Env, twin: gymnasium.Env, copier: Callable) -> tuple[Any, str]:
    """Snapshots, if `twin`, put before every step to where `env` is, lives the same life; else None and why not."""
    actions = Spec("trial", env.action_space, {}, (), 1.0)
    rng = make_rng(0)
    try:
        snapshots = copier(env)
        for seed in range(_TRIALS):
            env.reset(seed=seed)
            for action in actions.sample_action(_TRIAL_STEPS, rng).numpy():
                twin.reset(seed=seed + _TRIALS)  # a detour, so that what the snapshot misses cannot agree by chance
                twin.step(action)
                snapshots.put(twin, *snapshots.take(env))
                lives = []
                for each in (env, twin):
                    _reseed(each, seed)
                    seen, reward, terminated, truncated, _ = each.step(action)
                    lives.append((np.asarray(seen).tobytes(), reward, terminated, truncated, snapshots.take(each)))
                if lives[0] != lives[1]:
                    return None, "a copy of it does not live the same life"
                if terminated or truncated:
                    break
    except NotCopyable as error:
        return None, str(error)
    return snapshots, ""


def check_size(size: tuple[int, int] | None) -> tuple[int, int] | None:
    """The size of a picture, if it can be one; else TerrellaError."""
    if size is None:
        return None
    sound = len(size) == 2 and all(int(side) == side and 1 <= side <= 4096 for side in size)
    if not sound:
        raise TerrellaError(f"a picture of {tuple(size)} pixels cannot be: size is (height, width), 1 to 4096 each.")
    return int(size[0]), int(size[1])


def _is_picture(space: gymnasium.Space) -> bool:
    return isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(space.shape) == 3 and space.shape[2] == 3


def resized(picture: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
    """uint8 [H, W, 3] -> uint8 [*size, 3], each pixel the mean of the area that it covers."""
    if size is None or picture.shape[:2] == tuple(size):
        return picture
    return np.asarray(Image.fromarray(picture).resize((size[1], size[0]), Image.Resampling.BOX))


def _picture_size(env: gymnasium.Env) -> tuple[int, int] | None:
    """(height, width) of the picture that a freshly reset environment draws, or None."""
    if env.render_mode != "rgb_array":
        return None
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # its greeting would go to stdout, among our results
    try:
        picture = env.render()
    except gymnasium.error.DependencyNotInstalled:
        return None
    if not isinstance(picture, np.ndarray) or picture.ndim != 3 or picture.shape[2] != 3:
        return None
    return picture.shape[0], picture.shape[1]


def _step_seconds(env: gymnasium.Env) -> float:
    for name in ("dt", "tau"):
        seconds = getattr(env.unwrapped, name, None)
        if isinstance(seconds, float) and 0 < seconds < math.inf:
            return seconds
    return 1 / (env.metadata.get("render_fps") or 1)


def _arrow_keys(action: gymnasium.Space) -> dict[str, list[float]]:
    """Left and right as the first and the last choice, or as the ends of the first axis; of several axes, up and down are
    the ends of the second, or, where that knows no backwards (a throttle), up is the second and down the third (a brake)."""
    if isinstance(action, spaces.Discrete):
        return {"ArrowLeft": [float(action.start)], "ArrowRight": [float(action.start + action.n - 1)]}
    if not (isinstance(action, spaces.Box) and len(action.shape) == 1 and action.is_bounded()):
        return {}

    def only(axis: int, value: float) -> list[float]:
        return [float(value) if place == axis else 0.0 for place in range(action.shape[0])]

    keys = {"ArrowLeft": only(0, action.low[0]), "ArrowRight": only(0, action.high[0])}
    if action.shape[0] > 1:
        back = 1 if action.low[1] < 0 else 2
        keys["ArrowUp"] = only(1, action.high[1])
        if back < action.shape[0]:
            keys["ArrowDown"] = only(back, action.low[1] if back == 1 else action.high[back])
    rest = np.zeros(action.shape)
    return keys if bool((action.low <= rest).all() and (rest <= action.high).all()) else {}
