"""Spec: the declaration of a world. Importing this needs no torch, so tools that convert and repair recordings run without it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from gymnasium import spaces

from .errors import ActionError, ChannelError
from .instruction import INSTRUCTION_SIZE, TEXT_BYTES

if TYPE_CHECKING:
    import torch

# The spaces of channels that are the same in all worlds.
REWARD = spaces.Box(-np.inf, np.inf, (), np.float32)
DONE = spaces.Box(0, 1, (), np.bool_)  # pyright: ignore[reportCallIssue, reportArgumentType]
EVENT = DONE  # of a channel that says whether something happened in this step, such as "hit"
POSE = spaces.Box(-np.inf, np.inf, (7,), np.float32)
TEXT = spaces.Box(0, 255, (TEXT_BYTES,), np.uint8)
INSTRUCTION = spaces.Box(-1, 1, (INSTRUCTION_SIZE,), np.float32)
POSE_UNIT = "m, quaternion wxyz of T_world_cam"
PLACES_UNIT = "x and y in m, heading in rad, kind"
LEAST_PICTURE_SIDE = 16  # pixels
WALKABLE = 4  # kind in the channel `places`: somewhere to stand (core/world.py)
NO_MOUNT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

BUTTONS, CHOICE = "buttons", "choice"
AXES = ("axes", "position", "velocity", "torque", "pose_delta")  # meanings of the numbers of a Box
MODES = (BUTTONS, CHOICE, *AXES)
_IDLE = {"noop", "idle", "none", "stay", "nothing", "donothing", "noaction", "wait", "still", "pass", "noopaction"}
_IDLE |= {"nopush", "notorque"}


def shape_of(space: spaces.Space) -> tuple[int, ...]:
    """The shape of one value; ActionError for spaces whose values are not one array (Dict, Tuple)."""
    if space.shape is None:
        raise ActionError(f"the values of {space} are not one array")
    return space.shape


def dtype_of(space: spaces.Space) -> np.dtype:
    """The numpy dtype of the values."""
    return np.dtype(space.dtype)


def torch_dtype_of(space: spaces.Space) -> torch.dtype:
    """The torch dtype of the values."""
    import torch

    return torch.from_numpy(np.zeros(0, space.dtype)).dtype


def is_picture(shape: tuple[int, ...]) -> bool:
    """Whether arrays [H, W, C] are pictures; smaller ones are codes of cells, as those of MiniGrid."""
    return len(shape) == 3 and min(shape[:2]) >= LEAST_PICTURE_SIDE


def kind_of(channel: str) -> str:
    """The kind of a channel, which says what its values mean: "rgb" of "rgb.wrist"."""
    return channel.partition(".")[0]


def suffix_of(channel: str) -> str:
    """The suffix of a channel, "wrist" of "rgb.wrist"; "" for the main channel of its kind."""
    return channel.partition(".")[2]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera."""

    intrinsics: tuple[float, float, float, float]  # fx/W, fy/H, cx/W, cy/H
    size: tuple[int, int]  # height and width of its pictures, pixels
    pose: str | None = "pose"  # the pose channel of the body that it is mounted on; None where its pose is unknown
    mount: tuple[float, float, float, float, float, float, float] = NO_MOUNT
    """T_pose_cam: x, y, z in metres and quaternion w, x, y, z; camera x forward, y left, z up."""


@dataclass(frozen=True)
class Spec:
    """The declaration of a world. Tools read it instead of asking `hasattr`."""

    name: str  # name of the world
    action: spaces.Space  # space of one action, without the batch axis
    channels: Mapping[str, spaces.Space]
    """What `render` can show: channel -> space of one entry, without the batch axis. A channel is named by its kind, or by its
    kind and a suffix: "rgb" and "rgb.wrist", "depth.wrist", "pose.wrist"."""
    observes: tuple[str, ...]  # channels that `observe` requires
    dt_s: float  # seconds of world time that one `imagine` advances
    units: Mapping[str, str] = field(default_factory=dict)  # channel -> unit ("m", "reward"), where it has one
    action_names: tuple[str, ...] = ()
    """One name for each button (MultiBinary), choice (Discrete, or one of a MultiDiscrete) or axis (Box); () for none."""
    action_units: tuple[str, ...] = ()  # one unit for each axis ("m", "rad/s", "N m"); () for none
    action_mode: str = ""  # meaning of the numbers: one of MODES. "" takes it from the space
    action_frame: str = ""  # coordinate frame of the axes ("world", "body", "tool"); "" for none
    keys: Mapping[str, list[float]] = field(default_factory=dict)
    """Browser key (`KeyboardEvent.code`) -> flat action while it is held. Buttons held together combine by element-wise
    maximum; of a choice, the key pressed last counts."""
    cameras: Mapping[str, Camera] = field(default_factory=dict)  # picture channel -> its camera
    forkable: bool = True  # False where an earlier state cannot be used again (an external game process)
    max_batch: int | None = None  # largest batch that `start` accepts; None for no limit
    max_episode_steps: int | None = None  # steps after which training truncates an episode; None for no limit
    differentiable: bool = False  # whether gradients flow from the channels through `imagine` to the action
    card: Mapping[str, object] = field(default_factory=dict)  # facts for people: training data, hardware, scores
    may_observe: tuple[str, ...] = ()  # channels that `observe` uses where the observation has them
    idle: tuple[float, ...] = ()  # the flat action that does nothing, where its name and mode do not say which one does
    leap: int = 0  # steps that `leap` advances at once (core/world.py); 0 for worlds without it
    system: Mapping[str, object] = field(default_factory=dict)
    """Bodies, walls and limits for the laws of physics, JSON values (physics/system.py); {} where they are unknown."""
    embodiment: str = ""  # the body that actions drive, whatever its task ("mujoco:table-yam"); "" for the world's name

    def __post_init__(self):
        if not self.action_mode:
            object.__setattr__(self, "action_mode", _mode_of(self.action))

    @property
    def camera(self) -> tuple[float, float, float, float] | None:
        """The intrinsics of the main camera, that of `rgb`; None without one."""
        main = self.cameras.get("rgb")
        return main.intrinsics if main else None

    def kinds(self, kind: str) -> tuple[str, ...]:
        """The channels of one kind, the main one first: kinds("rgb") gives ("rgb", "rgb.wrist")."""
        return tuple(sorted((name for name in self.channels if kind_of(name) == kind), key=suffix_of))

    @property
    def recorded(self) -> tuple[str, ...]:
        """The channels that a recording holds and a policy sees: all but a mosaic, which follows from earlier pictures. A recording
        holds `text` as the episode's task."""
        return tuple(name for name in self.channels if kind_of(name) != "mosaic")

    def check_channels(self, channels) -> None:
        """ChannelError, with the channels that exist, where the world lacks one."""
        for name in channels:
            if name not in self.channels:
                raise ChannelError(f"{self.name} cannot render '{name}'; it has {', '.join(self.channels)}.")

    def check_action(self, action: torch.Tensor, batch: int) -> torch.Tensor:
        """The action as a tensor [batch, *action.shape] of the dtype of the space, with its gradient; ActionError where its shape,
        type or a value does not fit the space. Values on a device other than the CPU are not looked at."""
        import torch

        low, high = self.action_limits
        shape = (batch, *shape_of(self.action))
        try:
            tensor = torch.as_tensor(action)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ActionError(f"{self.name} takes an action of numbers of shape {shape}; got {action!r}.") from error
        if tuple(tensor.shape) != shape:
            raise ActionError(f"{self.name} takes an action of shape {shape} (batch first); got {tuple(tensor.shape)}.")
        if tensor.device.type != "cpu":  # to look at a value is to wait for the device
            return tensor.to(torch_dtype_of(self.action))
        if tensor.is_complex() or not torch.isfinite(tensor).all():
            raise ActionError(f"{self.name} was given an action that is not a finite number.")
        plain = tensor.float() if tensor.dtype == torch.bfloat16 else tensor  # which numpy does not have
        given = plain.detach().cpu().numpy()
        array = given.astype(dtype_of(self.action))
        whole = array.dtype.kind == "f" or (array == given).all()
        if not (whole and (array >= low).all() and (array <= high).all()):
            raise ActionError(f"{self.name} takes actions in {self.action}; got {given.tolist()}.")
        return tensor.to(torch_dtype_of(self.action), copy=True)

    def sample_action(self, batch: int, rng: torch.Generator) -> torch.Tensor:
        """Uniform random actions [batch, *action.shape], drawn from `rng`; unbounded axes are drawn from -1000 to 1000."""
        import torch

        low, high = self.action_limits
        numpy_rng = np.random.default_rng(int(torch.randint(2**31 - 1, (1,), generator=rng, device=rng.device).item()))
        shape, dtype = (batch, *shape_of(self.action)), dtype_of(self.action)
        if dtype.kind == "f":
            array = numpy_rng.uniform(np.clip(low, -1e3, 1e3), np.clip(high, -1e3, 1e3), shape).astype(dtype)
        else:
            array = numpy_rng.integers(low, high, shape, endpoint=True).astype(dtype)
        return torch.from_numpy(array)

    @cached_property
    def action_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """(smallest, largest) action [*action.shape], in the dtype of the space."""
        space = self.action
        if isinstance(space, spaces.Box):
            return space.low, space.high
        if isinstance(space, spaces.MultiBinary):
            return np.zeros(space.shape, space.dtype), np.ones(space.shape, space.dtype)
        if isinstance(space, spaces.Discrete):
            return np.asarray(space.start), np.asarray(space.start + space.n - 1)
        if isinstance(space, spaces.MultiDiscrete):
            return space.start, space.start + space.nvec - 1
        raise ActionError(
            f"{self.name} has the action space {space}; it must be a Box, Discrete, MultiBinary or MultiDiscrete."
        )


def idle_name(names: Sequence[str]) -> int | None:
    """The index of the name that means doing nothing ("noop", "idle", ...); None where none does."""
    plain = ["".join(filter(str.isalpha, name.lower())) for name in names]
    return next((at for at, name in enumerate(plain) if name in _IDLE), None)


def can_idle(spec: Spec) -> bool:
    """Whether some action does nothing. Of a choice, its name or `spec.idle` must say so."""
    return spec.action_mode != CHOICE or bool(spec.idle) or idle_name(spec.action_names) is not None


def trust_channel(spec: Spec) -> str:
    """The channel whose value ends what is imagined, where it is above a limit: `invented`, for a position drifts under every plan
    alike; the whole `uncertainty` in worlds that do not tell its parts apart."""
    return "invented" if "invented" in spec.channels else "uncertainty"


def cuts_plans(spec: Spec) -> bool:
    """Whether plans end, unless a limit is given, where the world is not trusted. Not in latent worlds: no value stands for what
    lies beyond, and a plan too short for the task did worse there than one that errs (docs/lab/planning.md)."""
    return "latent" not in spec.channels


def chance_error(spec: Spec) -> float:
    """The error of a random observation of the world, in the unit of its `uncertainty`: for pictures by its card, for latents the
    square root of 2. NaN where the world has no `uncertainty`, or does not say."""
    card = spec.card.get("uncertainty")
    ceiling = card.get("ceiling") if isinstance(card, Mapping) else None
    if "uncertainty" not in spec.channels:
        return math.nan
    if isinstance(ceiling, int | float) and 0 < ceiling <= 1:
        return float(ceiling)
    return math.sqrt(2) if "latent" in spec.channels else math.nan


def measured_trust(spec: Spec) -> int | None:
    """The steps of a rollout that were measured to be within trust, from the world's card (`trust_steps_measured`): for longer it
    is not trusted, whatever error it expects. None where the card has no such number."""
    steps = spec.card.get("trust_steps_measured")
    return steps if isinstance(steps, int) and not isinstance(steps, bool) and steps >= 0 else None


def trust_level(first: float, chance: float) -> float:
    """The error at which trust in a rollout ends: half way from `first`, that of its first step, to `chance`."""
    return first + 0.5 * max(chance - first, 0.0)


def neutral_action(spec: Spec) -> np.ndarray:
    """The action [*action.shape] that does least: `spec.idle` where it is given; else no button; the choice whose name means doing
    nothing, or the first; axes at 0, or at the limit nearest to 0."""
    low, high = spec.action_limits
    if spec.idle:
        return np.asarray(spec.idle, dtype_of(spec.action)).reshape(shape_of(spec.action))
    if spec.action_mode == CHOICE and np.ndim(low) == 0:
        return np.asarray(low + (idle_name(spec.action_names) or 0), dtype_of(spec.action))
    return np.clip(np.zeros(shape_of(spec.action)), low, high).astype(dtype_of(spec.action))


def _mode_of(space: spaces.Space) -> str:
    if isinstance(space, spaces.MultiBinary):
        return BUTTONS
    return CHOICE if isinstance(space, spaces.Discrete | spaces.MultiDiscrete) else AXES[0]
