"""Any Gymnasium environment as a World. If its state can be copied exactly, it can fork, batch and plan."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from ..core.errors import ObservationError, StaleStateError, TerrellaError
from ..core.instruction import embed, text_to_bytes
from ..core.numbers import single_number
from ..core.spec import DONE, INSTRUCTION, REWARD, TEXT, Camera, Spec, kind_of
from ..core.state import State
from ..core.step_length import infos_of_step
from ..core.world import make_rng
from .drawn_pictures import DrawnPictures
from .environment_facts import EnvironmentFacts, facts_of
from .environment_loading import build, explained, first_picture, renders_pictures
from .observation_channels import check_space, entry_at, label_of, parts_of, resized, space_of, value_at
from .processes import MAX_EPISODES, Processes
from .snapshot import NotCopyable, Snapshots

_TRIALS, _TRIAL_STEPS = 3, 40


@dataclass(frozen=True)
class Channel:
    """A further channel of an environment."""

    # A function of the bare environment that returns the current value [*space.shape]; or a path: "info.depth" (a key of `info`),
    # "camera.pose" (attributes and methods).
    read: Callable[[gymnasium.Env], np.ndarray | float] | str
    space: spaces.Space | None = None  # default: from the first value
    unit: str = ""


@dataclass(frozen=True)
class Adapter:
    """What Gymnasium has no term for, such as depth and poses, so that a posed world can be learned from an environment.

        class MyGame(gymnasium.Env):
            terrella = Adapter(
                channels={
                    "depth": Channel(lambda env: env.depth_buffer(), spaces.Box(0, 100, (96, 128), np.float32), "m"),
                    "pose": Channel(lambda env: env.camera_pose(), POSE, POSE_UNIT),
                },
                cameras={"rgb": Camera((0.5, 0.67, 0.5, 0.5), (96, 128))},
            )

    The fields on actions are those of Spec. The default of names and keys comes from the environment.
    """

    # depth: metres along the optical axis. pose: x, y, z in metres and quaternion w, x, y, z of T_world_cam; world z up; camera x
    # forward, y left, z up. Names such as "rgb.wrist" are further cameras.
    channels: Mapping[str, Channel] = field(default_factory=dict)
    cameras: Mapping[str, Camera] = field(default_factory=dict)  # picture channel -> Camera
    action_names: tuple[str, ...] = ()
    action_units: tuple[str, ...] = ()
    action_mode: str = ""
    action_frame: str = ""
    keys: Mapping[str, list[float]] | None = None
    idle: tuple[float, ...] = ()


@dataclass(frozen=True)
class GymnasiumConfig:
    """The settings of a GymnasiumWorld."""

    # Show `rgb`, if the environment renders with render_mode="rgb_array", in any form that sim/drawn_pictures.py reads. An
    # observation that is a picture (uint8 or floats up to 1 or 255; [H, W, 3], [3, H, W] or grey) is shown as `rgb` instead of
    # `observation`.
    rgb: bool = True
    # (height, width) to which rgb is area-averaged; None for its own size.
    size: tuple[int, int] | None = None
    # Numbers in `info` that become channels, float32 [B], such as ("lives",).
    info_channels: Sequence[str] = ()
    # Whether states can be forked. None: tested by copying the state between two instances, whose steps must agree bit for bit.
    # False: a state is only a ticket for the present, and parallel episodes run in processes of their own.
    forkable: bool | None = None
    # How states are copied. Default: sim/snapshot.py.
    snapshots: Callable[[gymnasium.Env], Any] | None = None
    # Seconds per step. Default: what the environment says of it (core/step_length.py), else 0.1.
    dt_s: float | None = None
    # Name for the spec. Default: the environment's.
    name: str = ""
    # Further channels and the meaning of actions. Default: the environment's attribute `terrella`.
    adapter: Adapter | None = None
    # Action repeat: environment steps per step of the world, with summed rewards.
    repeat: int = 1
    # Arguments of gymnasium.make.
    options: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def of(**settings: Any) -> GymnasiumConfig:
        """The config of these settings; those that are not its fields become `options`."""
        own = {one.name for one in fields(GymnasiumConfig)} - {"options"}
        options = {name: value for name, value in settings.items() if name not in own}
        return GymnasiumConfig(**{name: settings[name] for name in own & set(settings)}, options=options)


class GymnasiumWorld:
    """`GymnasiumWorld("CartPole-v1")`. env: an id, made without its time limit (which becomes Spec.max_episode_steps, kept by
    `as_env`), or a function that returns a new environment at each call.

    Channels: observation [B, *shape] (each array in nested Dicts and Tuples is its own channel), reward float32 [B], done bool [B]
    (terminated, or truncated by the environment, see `truncated` in the state), rgb uint8 [B, H, W, 3]; of an observation with a
    text, such as a mission, text and instruction (core/world.py). After `done` the world stands still with reward 0. `start` uses
    `rng`, and so does each `imagine` if the world is forkable. spec.card["how"] says where facts about the environment come
    from, spec.card["left_out"] what is in no channel and why. `settings` are fields of the config. TerrellaError where the
    environment cannot be found, made, reset or rendered, and where nothing of its observation is an array."""

    def __init__(
        self, env: str | Callable[[], gymnasium.Env], config: GymnasiumConfig = GymnasiumConfig(), **settings: Any
    ):
        config = replace(config, **settings)
        self._lock = threading.Lock()  # all episodes share one environment, so only one may step at a time
        rgb, options, repeat = config.rgb, dict(config.options), config.repeat
        self._env, own_name = build(env, rgb, options)
        own_name = own_name if repeat == 1 else f"{own_name}@{repeat}"
        self._name, self._repeat = config.name or own_name, repeat
        self._size, self._info = check_size(config.size), tuple(config.info_channels)
        check_space(self._env.action_space, self._name, "actions")
        renders = rgb and renders_pictures(self._env)
        with explained(self._name, "reset"):
            seen, info = self._env.reset(seed=0)
        self._parts = parts_of(self._env.observation_space, seen, rgb, renders, self._info)
        if not self._parts.arrays and not renders:
            check_space(self._env.observation_space, self._name, "observations")
        self._snapshots, self._viewer = None, self._env
        texts_change = self._parts.text is not None  # with the episode, which a trial may not show
        if config.forkable or (config.forkable is None and not texts_change):
            self._try_forking(build(env, rgb, options)[0], config.snapshots or Snapshots, bool(config.forkable))
        self._ticket = 0
        self._processes: Processes | None = None
        self._make_another = partial(GymnasiumWorld, env, replace(config, forkable=False, snapshots=None))
        with explained(self._name, "reset"):
            seen, info = self._env.reset(seed=0)
        adapter: Adapter = config.adapter or getattr(self._env.unwrapped, "terrella", Adapter())
        channels = {at: self._with_space(at, channel, info) for at, channel in adapter.channels.items()}
        self._adapter = replace(adapter, channels=channels)
        self._info_paths = {at: one.read for at, one in channels.items() if str(one.read).startswith("info.")}
        self._drawn = DrawnPictures()
        self._rgb_size, why = self._picture_size(seen) if rgb else (None, "")
        left_out = self._parts.left_out | ({"pictures": why} if why else {})
        facts = facts_of(self._env, adapter.action_names)
        infos = dict.fromkeys([*info, *(infos_of_step(self._env) if config.forkable is not False else ())])
        unread = [key for key in infos if key not in self._used_infos()]
        left_out |= {f"info.{key}": "no channel reads it; an adapter can" for key in unread}
        self.spec = self._describe(facts, config.dt_s, left_out)
        limit = self._env.spec.max_episode_steps if self._env.spec else None
        if isinstance(env, str) and "max_episode_steps" not in options:
            limit = gymnasium.registry[self._env.spec.id].max_episode_steps
        self.spec = replace(self.spec, max_episode_steps=-(-limit // repeat) if limit and limit > 0 else None)

    def _try_forking(self, twin: gymnasium.Env, copier: Callable, must: bool) -> None:
        self._snapshots, why = _try_copying(self._env, twin, copier)
        if self._snapshots is not None:
            self._viewer = twin
            twin.reset(seed=0)
            return
        twin.close()
        if must:
            raise TerrellaError(f"{self._name} cannot be copied ({why}); leave forkable=True out.")

    def start(self, batch: int, rng: torch.Generator) -> State:
        """`batch` resets of the environment, seeded from `rng`."""
        if batch < 1 or (self.spec.max_batch and batch > self.spec.max_batch):
            raise TerrellaError(
                f"{self.spec.name} starts a batch of 1 to {self.spec.max_batch or 'any number'}; got {batch}."
            )
        with self._lock:
            if self._snapshots is None and batch > 1 and self._processes is None:
                self._processes = Processes(self.spec.name, self._make_another)
            if self._processes is not None:
                return self._processes.start(_seeds(batch, rng))
            return self._state([self.begin(seed) for seed in _seeds(batch, rng)])

    def begin(self, seed: int) -> dict[str, np.ndarray]:
        """Resets the environment; returns its channels."""
        with explained(self._name, "reset"):
            observation, info = self._env.reset(seed=seed)
            return self._row(observation, 0.0, False, False, info)

    def step(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Steps the environment `repeat` times or until the episode ends; returns its channels."""
        with explained(self._name, "stepped"):
            total, terminated, truncated = 0.0, False, False
            for _ in range(self._repeat):
                seen, reward, *ends, info = self._env.step(action)
                total += single_number(reward, f"the reward of {self._name}")
                terminated, truncated = (bool(single_number(end, f"the end of {self._name}")) for end in ends)
                if terminated or truncated:
                    break
            return self._row(seen, total, terminated, truncated, info)

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """The prior, or a start: a simulator cannot be set from an observation."""
        if observation:
            raise ObservationError(f"{self.spec.name} is a simulator and takes no observation; pass an empty mapping.")
        return prior if prior is not None else self.start(1, rng)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One step of each batch entry; entries that are done stand still with reward 0."""
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
                rows.append(self.step(actions[entry]))
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
        row: dict[str, Any] = {name: part.read(observation, self._name) for name, part in self._parts.arrays.items()}
        for name in filter(lambda name: kind_of(name) == "rgb", row):
            row[name] = self._sized(row[name]) if name == "rgb" else resized(row[name], self._size)
        if self._parts.text is not None:
            text = str(entry_at(observation, self._parts.text, self._name))
            row |= {"text": text_to_bytes(text), "instruction": embed(text)}
        row |= {
            "reward": np.float32(reward),
            "done": np.bool_(terminated or truncated),
            "truncated": np.bool_(truncated and not terminated),
            **{name: np.float32(single_number(info[name], f"info['{name}'] of {self._name}")) for name in self._info},
            **{name: self._fitting(name, value_at(None, info, str(path))) for name, path in self._info_paths.items()},
        }
        if self._snapshots is not None:
            try:
                numbers, kinds = self._snapshots.take(self._env)
            except NotCopyable as error:
                message = f"{self.spec.name} has state that cannot be copied: {error}; open it with forkable=False."
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
                raise StaleStateError(f"{self.spec.name} runs in processes since this state; start again.")
        elif self._snapshots is None:
            if "ticket" not in state or state.batch != 1 or int(state["ticket"][0]) != self._ticket:
                raise StaleStateError(
                    f"{self.spec.name} has moved on since this state and cannot go back (forkable=False)."
                )
        elif "numbers" not in state or state["numbers"].shape[1:] != self._width:
            raise TerrellaError(f"this is not a state of {self.spec.name}: {state}.")

    def _read(self, name: str, state: State) -> torch.Tensor:
        """A channel that is computed on demand: the environment's picture, or a channel of its adapter."""
        with self._lock:
            values = []
            for entry in range(state.batch):
                if self._snapshots is not None:
                    self._snapshots.put(self._viewer, state["numbers"][entry].tolist(), state["kinds"][entry].tolist())
                values.append(self.look(name))
        return torch.from_numpy(np.stack(values))

    def look(self, name: str) -> np.ndarray:
        """The current value of one channel."""
        channel, bare = self._adapter.channels.get(name), self._viewer.unwrapped
        with explained(self._name, "drawn" if channel is None else f"asked for its {name}"):
            if channel is None:
                return self._fitting(name, self._sized(self._drawn.read(self._viewer.render())))
            read = channel.read
            return self._fitting(name, value_at(bare, {}, read) if isinstance(read, str) else read(bare))

    def _sized(self, picture: np.ndarray) -> np.ndarray:
        if self._size is None and picture.shape[:2] != self._rgb_size:
            now, before = ("x".join(map(str, (size or ())[:2])) for size in (picture.shape, self._rgb_size))
            raise TerrellaError(
                f"the pictures of {self._name} change their size, from {before} to {now}; give a fixed size (--size 64 64)."
            )
        return resized(picture, self._size)

    def _fitting(self, name: str, value: Any) -> np.ndarray:
        space = self.spec.channels[name]
        array = np.array(value, space.dtype)
        if array.shape != space.shape:
            raise TerrellaError(f"{self.spec.name} gave '{name}' of shape {array.shape}; its space is {space}.")
        return array

    def _with_space(self, name: str, channel: Channel, info: Mapping) -> Channel:
        """The channel with a space, by default that of its current value."""
        if channel.space is not None:
            return channel
        try:
            bare, read = self._env.unwrapped, channel.read
            value = value_at(bare, info, read) if isinstance(read, str) else read(bare)
            return replace(channel, space=space_of(value, kind_of(name)))
        except TerrellaError as error:
            raise TerrellaError(f"the channel '{name}' of {self._name} cannot be read: {error}") from error

    def _picture_size(self, observation: Any) -> tuple[tuple[int, int] | None, str]:
        """((height, width) of the pictures before resizing or None without pictures, why there are none)."""
        if "rgb" in self._parts.arrays:
            height, width = self._parts.arrays["rgb"].read(observation, self._name).shape[:2]
            return (height, width), ""
        return first_picture(self._viewer, self._name, self._drawn)

    def _used_infos(self) -> set[str]:
        """The keys of `info` that are read."""
        return {*self._info, *(str(path).split(".")[1] for path in self._info_paths.values())}

    def _describe(self, facts: EnvironmentFacts, dt_s: float | None, left_out: Mapping[str, str]) -> Spec:
        channels = {name: part.shown(self._size) for name, part in self._parts.arrays.items() if name != "rgb"}
        channels |= {"reward": REWARD, "done": DONE}
        if self._parts.text is not None:
            channels |= {"text": TEXT, "instruction": INSTRUCTION}
        channels |= {name: spaces.Box(-np.inf, np.inf, (), np.float32) for name in self._info}
        if self._rgb_size is not None:
            channels["rgb"] = spaces.Box(0, 255, (*(self._size or self._rgb_size), 3), np.uint8)
        if self._snapshots is not None:
            self._width = (len(self._snapshots.take(self._env)[0]),)
        adapter = self._adapter
        channels |= {at: channel.space for at, channel in adapter.channels.items() if channel.space is not None}
        what = f"the Gymnasium environment {self._name.removeprefix('gym:')}"
        how = {**facts.how, **({"pictures": self._drawn.form} if self._drawn.form else {})}
        how |= {"task": f"the text '{label_of(self._parts.text)}'"} if self._parts.text is not None else {}
        card = {"what": what, "kind": "simulator", "how": how, "renamed": self._parts.renamed, "left_out": {**left_out}}
        return Spec(
            name=self._name,
            action=self._env.action_space,
            channels=channels,
            observes=(),
            dt_s=(dt_s or facts.dt_s) * self._repeat,
            units={name: channel.unit for name, channel in adapter.channels.items() if channel.unit},
            cameras=adapter.cameras,
            action_names=facts.names,
            action_units=adapter.action_units,
            action_mode=adapter.action_mode,
            action_frame=adapter.action_frame,
            keys=adapter.keys if adapter.keys is not None else facts.keys,
            forkable=self._snapshots is not None,
            max_batch=None if self._snapshots is not None else MAX_EPISODES,
            card=card,
            idle=tuple(adapter.idle),
        )


def _seeds(count: int, rng: torch.Generator) -> list[int]:
    return torch.randint(2**31 - 1, (count,), generator=rng, device=rng.device).tolist()


def _reseed(env: gymnasium.Env, seed: int) -> None:
    """Sets PCG64's 128 bits directly, which is done at every step: ten times faster than a new generator."""
    bits = env.unwrapped.np_random.bit_generator
    if not isinstance(bits, np.random.PCG64):
        raise NotCopyable(f"its random generator is a {type(bits).__name__}")
    spread = {"state": seed * 0x9E3779B97F4A7C15F39CC0605CEDC835 % 2**128, "inc": 0xDA3E39CB94B95BDB}
    bits.state = {"bit_generator": "PCG64", "state": spread, "has_uint32": 0, "uinteger": 0}  # pyright: ignore[reportAttributeAccessIssue]


def _try_copying(env: gymnasium.Env, twin: gymnasium.Env, copier: Callable) -> tuple[Any, str]:
    """(snapshots, "") if `twin`, set to the state of `env` before every step, steps identically; else (None, why not)."""
    actions = Spec("trial", env.action_space, {}, (), 1.0)
    rng = make_rng(0)
    try:
        snapshots = copier(env)
        for seed in range(_TRIALS):
            env.reset(seed=seed)
            for action in actions.sample_action(_TRIAL_STEPS, rng).numpy():
                twin.reset(seed=seed + _TRIALS)  # a detour, so that state missed by the snapshot differs
                twin.step(action)
                snapshots.put(twin, *snapshots.take(env))
                results = []
                for each in (env, twin):
                    _reseed(each, seed)
                    seen, reward, terminated, truncated, _ = each.step(action)
                    results.append((_bytes(seen), reward, terminated, truncated, snapshots.take(each)))
                if results[0] != results[1]:
                    return None, "a copy of it does not step identically"
                if terminated or truncated:
                    break
    except NotCopyable as error:
        return None, str(error)
    except Exception as error:  # its own, or that of an incomplete copy
        return None, f"a trial of it ended with {type(error).__name__}: {error}"
    return snapshots, ""


def _bytes(seen: Any) -> Any:
    """An observation in a form that can be compared."""
    if isinstance(seen, Mapping):
        return [(key, _bytes(value)) for key, value in seen.items()]
    if isinstance(seen, tuple):
        return [_bytes(value) for value in seen]
    return np.asarray(seen).tobytes()


def check_size(size: tuple[int, int] | None) -> tuple[int, int] | None:
    """The size if it is a valid picture size; else TerrellaError."""
    if size is None:
        return None
    if len(size) != 2 or not all(int(side) == side and 1 <= side <= 4096 for side in size):
        raise TerrellaError(f"{tuple(size)} is not a picture size: size is (height, width), 1 to 4096 each.")
    return int(size[0]), int(size[1])
