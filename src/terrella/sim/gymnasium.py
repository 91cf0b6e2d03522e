"""Any Gymnasium environment as a World; where its state can be copied exactly, it forks, batches and plans."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Mapping, Sequence

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from ..core.errors import ObservationError, StaleStateError, TerrellaError
from ..core.spec import DONE, REWARD, Spec
from ..core.state import State
from ..core.world import make_rng
from .snapshot import NotCopyable, Snapshots

_KNOWN_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)
_TRIALS, _TRIAL_STEPS = 3, 40


class GymnasiumWorld:
    """`GymnasiumWorld("CartPole-v1")`, or a function that builds an environment.

    env:      an id, which is made without its time limit (that belongs to the training: `as_env(max_steps=...)`),
              or a function that returns a new environment each time it is called.
    rgb:      also show `rgb`, where the environment draws itself with render_mode="rgb_array".
    forkable: None finds out: an environment whose Python state is plain numbers is copied between two instances on
              trial, and only if every step agrees bit for bit are its states values. False makes states tickets for
              the present.
    dt_s:     seconds in a step; by default the environment's own `dt` or `tau`, else one over its frames per second.
    options:  handed to gymnasium.make.

    Channels: observation [B, *shape], reward float32 [B], done bool [B] (terminated, or truncated by the environment
    itself), rgb uint8 [B, H, W, 3]. After `done` the world stands still with reward 0. Chance comes from `rng`: at
    `start`, and where states are values at each `imagine` too.
    Raises TerrellaError for unknown ids and for Dict or Tuple spaces.
    """

    def __init__(
        self,
        env: str | Callable[[], gymnasium.Env],
        *,
        rgb: bool = True,
        forkable: bool | None = None,
        dt_s: float | None = None,
        **options,
    ):
        self._lock = threading.Lock()  # one environment serves all stories, so only one may move at a time
        self._env, name = _build(env, rgb, options)
        for space in (self._env.observation_space, self._env.action_space):
            if not isinstance(space, _KNOWN_SPACES):
                raise TerrellaError(
                    f"{name} has the space {space}; wrap it so that it is one array (FlattenObservation)."
                )
        self._env.reset(seed=0)
        self._snapshots, self._viewer = None, self._env
        if forkable is not False:
            twin, _ = _build(env, rgb, options)
            self._snapshots, why = _try_copying(self._env, twin)
            if self._snapshots is not None:
                self._viewer = twin
            else:
                twin.close()
                if forkable:
                    raise TerrellaError(f"{name} cannot be copied ({why}); leave out forkable=True.")
        self._ticket = 0
        self._env.reset(seed=0)
        self.spec = self._describe(name, dt_s, rgb)

    def start(self, batch: int, rng: torch.Generator) -> State:
        """`batch` resets of the environment, seeded from `rng`."""
        if batch < 1 or (self.spec.max_batch and batch > self.spec.max_batch):
            raise TerrellaError(
                f"{self.spec.name} starts a batch of 1 to {self.spec.max_batch or 'any number'}; got {batch}."
            )
        with self._lock:
            rows = []
            for seed in _seeds(batch, rng):
                observation, _ = self._env.reset(seed=seed)
                rows.append(self._row(observation, 0.0, False))
            return self._state(rows)

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """A simulator cannot be put into a state from what is seen of it: gives the prior, or a start."""
        if observation:
            raise ObservationError(f"{self.spec.name} is a simulator and takes no evidence; pass an empty mapping.")
        return prior if prior is not None else self.start(1, rng)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One step of the environment for each batch entry; entries that are done stand still with reward 0."""
        self._check(state)
        actions = self.spec.check_action(action, state.batch).cpu().numpy()
        done = state["done"].tolist()
        with self._lock:
            rows = []
            for entry, seed in enumerate(_seeds(state.batch, rng)):
                if done[entry]:
                    still = {name: tensor[entry].numpy() for name, tensor in state.items()}
                    rows.append({**still, "reward": np.float32(0)})
                    continue
                if self._snapshots is not None:
                    self._snapshots.put(self._env, state["numbers"][entry].tolist(), state["kinds"][entry].tolist())
                    _reseed(self._env, seed)
                seen, reward, terminated, truncated, _ = self._env.step(actions[entry])
                rows.append(self._row(seen, reward, terminated or truncated))
            return self._state(rows)

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        self._check(state)
        return {name: self._pictures(state) if name == "rgb" else state[name] for name in channels}

    def close(self) -> None:
        self._env.close()
        self._viewer.close()

    def _row(self, observation, reward, done) -> dict[str, np.ndarray]:
        space = self._env.observation_space
        row = {
            "observation": np.array(observation, dtype=space.dtype).reshape(space.shape),
            "reward": np.float32(reward),
            "done": np.bool_(done),
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
        if self._snapshots is None:
            if "ticket" not in state or state.batch != 1 or int(state["ticket"][0]) != self._ticket:
                raise StaleStateError(
                    f"{self.spec.name} has moved on since this state and cannot go back (forkable=False)."
                )
        elif "numbers" not in state or state["numbers"].shape[1:] != self._width:
            raise TerrellaError(f"this is not a state of {self.spec.name}: {state}.")

    def _pictures(self, state: State) -> torch.Tensor:
        with self._lock:
            frames = []
            for entry in range(state.batch):
                if self._snapshots is not None:
                    self._snapshots.put(self._viewer, state["numbers"][entry].tolist(), state["kinds"][entry].tolist())
                frames.append(np.array(self._viewer.render(), dtype=np.uint8))
        return torch.from_numpy(np.stack(frames))

    def _describe(self, name: str, dt_s: float | None, rgb: bool) -> Spec:
        channels = {
            "observation": self._env.observation_space,
            "reward": REWARD,
            "done": DONE,
        }
        size = _picture_size(self._viewer) if rgb else None
        if size is not None:
            channels["rgb"] = spaces.Box(0, 255, (*size, 3), np.uint8)
        if self._snapshots is not None:
            self._width = (len(self._snapshots.take(self._env)[0]),)
        return Spec(
            name=name,
            action=self._env.action_space,
            channels=channels,
            observes=(),
            dt_s=dt_s or _step_seconds(self._env),
            keys=_arrow_keys(self._env.action_space),
            forkable=self._snapshots is not None,
            max_batch=None if self._snapshots is not None else 1,
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


def _try_copying(env: gymnasium.Env, twin: gymnasium.Env) -> tuple[Snapshots | None, str]:
    """Snapshots, if `twin`, put before every step to where `env` is, lives the same life; else None and why not."""
    actions = Spec("trial", env.action_space, {}, (), 1.0)
    rng = make_rng(0)
    try:
        snapshots = Snapshots(env)
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
    """Left and right as the first and the last choice, or as the ends of the only axis."""
    if isinstance(action, spaces.Discrete):
        first, last = int(action.start), int(action.start + action.n - 1)
    elif isinstance(action, spaces.Box) and action.shape == (1,) and action.is_bounded():
        first, last = float(action.low[0]), float(action.high[0])
    else:
        return {}
    return {"ArrowLeft": [float(first)], "ArrowRight": [float(last)]}
