"""Any Gymnasium environment as a World; where its state can be copied exactly, it forks, batches and plans."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from ..core.errors import ObservationError, StaleStateError, TerrellaError
from ..core.spec import DONE, REWARD, Camera, Spec, kind_of
from ..core.state import State
from ..core.world import make_rng
from .environment_facts import EnvironmentFacts, facts_of
from .environment_loading import build, explained, picture_size
from .observation_channels import check_space, followed, parts_of, resized, space_of
from .processes import MOST, Processes
from .snapshot import NotCopyable, Snapshots

_TRIALS, _TRIAL_STEPS = 3, 40


@dataclass(frozen=True)
class Channel:
    """A channel that an environment can show: `read(env)` gives one value [*space.shape] of the environment as it now stands.
    `read` may be the way to it: "info.depth" (a key of `info`), "camera.pose" (attributes, methods too). Without a space,
    that of the first value."""

    read: Callable[[gymnasium.Env], np.ndarray | float] | str
    space: spaces.Space | None = None
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
    action_names, action_units, action_mode, action_frame, keys, idle: as in Spec; what is left out, the environment is asked.
    """

    channels: Mapping[str, Channel] = field(default_factory=dict)
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    action_names: tuple[str, ...] = ()
    action_units: tuple[str, ...] = ()
    action_mode: str = ""
    action_frame: str = ""
    keys: Mapping[str, list[float]] | None = None
    idle: tuple[float, ...] = ()


class GymnasiumWorld:
    """`GymnasiumWorld("CartPole-v1")`, or a function that builds an environment.

    env:      an id, which is made without its time limit (that is Spec.max_episode_steps, which `as_env` keeps),
              or a function that returns a new environment each time it is called.
    rgb:      also show `rgb`, where the environment draws itself with render_mode="rgb_array". Where its observation is
              a picture already (uint8 or floats up to 1, [H, W, 3], [3, H, W] or grey), that is `rgb`, and takes the place of
              `observation`. Of a dictionary each entry that is an array is a channel.
    size:     (height, width) to which rgb is area-averaged; None leaves it as it is drawn.
    info_channels: numbers of the environment's `info` that become channels, float32 [B]: ("lives",).
    forkable: None finds out: an environment whose Python state is plain numbers is copied between two instances on
              trial, and only if every step agrees bit for bit are its states values. False makes states tickets for
              the present, and several episodes at once run in processes, each with an environment of its own.
    snapshots: what copies the environment's state, by default sim/snapshot.py.
    name:     for the spec, where the environment's own says too little.
    adapter:  further channels (depth, pose, more cameras) and what actions mean; by default the attribute `terrella` of
              the environment, where it has one.
    dt_s:     seconds in a step; by default the environment's own `dt` or `tau`, else one over its frames per second, else 0.1.
    repeat:   steps of the environment in one of the world (action repeat): each action is held for so many, rewards are added up.
    options:  handed to gymnasium.make.

    Channels: observation [B, *shape], reward float32 [B], done bool [B] (terminated, or truncated by the environment
    itself; then the state's `truncated` says so), rgb uint8 [B, H, W, 3]. After `done` the world stands still with reward 0.
    Chance comes from `rng`: at `start`, and where states are values at each `imagine` too. spec.card["how"] says what is known
    from where. Raises TerrellaError, a sentence, for what cannot be found, made, reset or drawn, and for Tuple spaces.
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
        repeat: int = 1,
        **options,
    ):
        self._lock = threading.Lock()  # one environment serves all episodes, so only one may move at a time
        self._env, found = build(env, rgb, options)
        found = found if repeat == 1 else f"{found}@{repeat}"
        self._name, self._size, self._info = name or found, check_size(size), tuple(info_channels)
        self._repeat = repeat
        check_space(self._env.action_space, self._name)
        drawn = rgb and self._env.render_mode == "rgb_array"
        self._parts = parts_of(self._env.observation_space, self._name, rgb, drawn)
        with explained(self._name, "reset"):
            self._env.reset(seed=0)
        self._snapshots, self._viewer = None, self._env
        if forkable is not False:
            self._copied(build(env, rgb, options)[0], snapshots or Snapshots, bool(forkable))
        self._ticket = 0
        self._processes: Processes | None = None
        same = {
            "rgb": rgb,
            "size": size,
            "info_channels": info_channels,
            "dt_s": dt_s,
            "name": name,
            "adapter": adapter,
            "repeat": repeat,
        }
        self._another = partial(GymnasiumWorld, env, forkable=False, **same, **options)
        with explained(self._name, "reset"):
            seen, info = self._env.reset(seed=0)
        chosen: Adapter = adapter or getattr(self._env.unwrapped, "terrella", Adapter())
        settled = {at: self._settled(at, channel, info) for at, channel in chosen.channels.items()}
        self._adapter = replace(chosen, channels=settled)
        self._kept = {at: one.read for at, one in settled.items() if str(one.read).startswith("info.")}
        self._drawn = self._picture_size(seen, rgb)
        self.spec = self._describe(facts_of(self._env, chosen.action_names), dt_s)
        limit = self._env.spec.max_episode_steps if self._env.spec else None
        if isinstance(env, str) and "max_episode_steps" not in options:
            limit = gymnasium.registry[self._env.spec.id].max_episode_steps
        self.spec = replace(self.spec, max_episode_steps=-(-limit // repeat) if limit and limit > 0 else None)

    def _copied(self, twin: gymnasium.Env, copier: Callable, must: bool) -> None:
        self._snapshots, why = _try_copying(self._env, twin, copier)
        if self._snapshots is not None:
            self._viewer = twin
            twin.reset(seed=0)
            return
        twin.close()
        if must:
            raise TerrellaError(f"{self._name} cannot be copied ({why}); leave out forkable=True.")

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
        with explained(self._name, "reset"):
            observation, info = self._env.reset(seed=seed)
            return self._row(observation, 0.0, False, False, info)

    def move(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Steps the one environment, `repeat` times or until the episode ends: what is seen of it."""
        with explained(self._name, "stepped"):
            earned = 0.0
            for _ in range(self._repeat):
                seen, reward, terminated, truncated, info = self._env.step(action)
                earned += float(reward)
                if terminated or truncated:
                    break
            return self._row(seen, earned, terminated, truncated, info)

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
        row: dict[str, Any] = {name: part.read(observation, self._name) for name, part in self._parts.items()}
        if "rgb" in row:
            row["rgb"] = self._sized(row["rgb"])
        row |= {
            "reward": np.float32(reward),
            "done": np.bool_(terminated or truncated),
            "truncated": np.bool_(truncated and not terminated),
            **{name: np.float32(info[name]) for name in self._info},
            **{name: self._fitting(name, followed(None, info, str(path))) for name, path in self._kept.items()},
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
        channel, bare = self._adapter.channels.get(name), self._viewer.unwrapped
        with explained(self._name, "drawn" if channel is None else f"asked for its {name}"):
            if channel is None:
                return self._fitting(name, self._sized(np.asarray(self._viewer.render())))
            read = channel.read
            return self._fitting(name, followed(bare, {}, read) if isinstance(read, str) else read(bare))

    def _sized(self, picture: np.ndarray) -> np.ndarray:
        if self._size is None and picture.shape[:2] != self._drawn:
            now, before = ("x".join(map(str, (size or ())[:2])) for size in (picture.shape, self._drawn))
            raise TerrellaError(
                f"the pictures of {self._name} change their size, from {before} to {now}; give one for all (--size 64 64)."
            )
        return resized(picture, self._size)

    def _fitting(self, name: str, value: Any) -> np.ndarray:
        space = self.spec.channels[name]
        array = np.array(value, space.dtype)
        if array.shape != space.shape:
            raise TerrellaError(f"{self.spec.name} gave '{name}' of shape {array.shape}; its space is {space}.")
        return array

    def _settled(self, name: str, channel: Channel, info: Mapping) -> Channel:
        """The channel with a space, if need be that of its present value."""
        if channel.space is not None:
            return channel
        try:
            bare, read = self._env.unwrapped, channel.read
            value = followed(bare, info, read) if isinstance(read, str) else read(bare)
            return replace(channel, space=space_of(value, kind_of(name)))
        except TerrellaError as error:
            raise TerrellaError(f"the channel '{name}' of {self._name} cannot be read: {error}") from error

    def _picture_size(self, observation: Any, rgb: bool) -> tuple[int, int] | None:
        """(height, width) of the pictures as they come; None without any."""
        if "rgb" in self._parts:
            height, width = self._parts["rgb"].read(observation, self._name).shape[:2]
            return height, width
        return picture_size(self._viewer, self._name) if rgb else None

    def _describe(self, told: EnvironmentFacts, dt_s: float | None) -> Spec:
        channels = {name: part.space for name, part in self._parts.items() if name != "rgb"}
        channels |= {"reward": REWARD, "done": DONE}
        channels |= {name: spaces.Box(-np.inf, np.inf, (), np.float32) for name in self._info}
        if self._drawn is not None:
            channels["rgb"] = spaces.Box(0, 255, (*(self._size or self._drawn), 3), np.uint8)
        if self._snapshots is not None:
            self._width = (len(self._snapshots.take(self._env)[0]),)
        more = self._adapter
        channels |= {at: channel.space for at, channel in more.channels.items() if channel.space is not None}
        what = f"the Gymnasium environment {self._name.removeprefix('gym:')}"
        return Spec(
            name=self._name,
            action=self._env.action_space,
            channels=channels,
            observes=(),
            dt_s=(dt_s or told.dt_s) * self._repeat,
            units={name: channel.unit for name, channel in more.channels.items() if channel.unit},
            cameras=more.cameras,
            action_names=told.names,
            action_units=more.action_units,
            action_mode=more.action_mode,
            action_frame=more.action_frame,
            keys=more.keys if more.keys is not None else told.keys,
            forkable=self._snapshots is not None,
            max_batch=None if self._snapshots is not None else MOST,
            card={"what": what, "kind": "simulator", "how": told.how},
            idle=tuple(more.idle),
        )


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
                    lives.append((_bytes(seen), reward, terminated, truncated, snapshots.take(each)))
                if lives[0] != lives[1]:
                    return None, "a copy of it does not live the same life"
                if terminated or truncated:
                    break
    except NotCopyable as error:
        return None, str(error)
    except Exception as error:  # its own, or that of a copy by halves: what is played alone will tell
        return None, f"a trial of it ended with {type(error).__name__}: {error}"
    return snapshots, ""


def _bytes(seen: Any) -> Any:
    """An observation as what can be compared."""
    if isinstance(seen, Mapping):
        return [(key, _bytes(value)) for key, value in seen.items()]
    return np.asarray(seen).tobytes()


def check_size(size: tuple[int, int] | None) -> tuple[int, int] | None:
    """The size of a picture, if it can be one; else TerrellaError."""
    if size is None:
        return None
    sound = len(size) == 2 and all(int(side) == side and 1 <= side <= 4096 for side in size)
    if not sound:
        raise TerrellaError(f"a picture of {tuple(size)} pixels cannot be: size is (height, width), 1 to 4096 each.")
    return int(size[0]), int(size[1])
