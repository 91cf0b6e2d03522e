"""What a world is, as data: its actions, its cameras, its channels, its clock and its units.

Importing this needs no torch, so that people who only convert and mend recordings need none either.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from gymnasium import spaces

from .errors import ActionError, ChannelError

if TYPE_CHECKING:
    import torch

# The spaces of the channels `reward` and `done`, alike in all worlds.
REWARD = spaces.Box(-np.inf, np.inf, (), np.float32)
DONE = spaces.Box(0, 1, (), np.bool_)  # pyright: ignore[reportCallIssue, reportArgumentType]
POSE = spaces.Box(-np.inf, np.inf, (7,), np.float32)
POSE_UNIT = "m, quaternion wxyz of T_world_cam"
PLACES_UNIT = "x and y in m, heading in rad, kind"
WALKABLE = 4  # the kind of place where one can stand (core/world.py)
NO_MOUNT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

BUTTONS, CHOICE = "buttons", "choice"
AXES = ("axes", "position", "velocity", "torque", "pose_delta")  # what the numbers of a Box may mean
MODES = (BUTTONS, CHOICE, *AXES)
_IDLE = {"noop", "idle", "none", "stay", "nothing", "donothing", "noaction", "wait", "still", "pass", "noopaction"}


def shape_of(space: spaces.Space) -> tuple[int, ...]:
    """The shape of one value; ActionError for spaces whose values are not one array (Dict, Tuple)."""
    if space.shape is None:
        raise ActionError(f"the values of {space} are not one array")
    return space.shape


def dtype_of(space: spaces.Space) -> np.dtype:
    """The dtype of the values."""
    return np.dtype(space.dtype)


def torch_dtype_of(space: spaces.Space) -> torch.dtype:
    """The same as torch spells it."""
    import torch

    return torch.from_numpy(np.zeros(0, space.dtype)).dtype


def kind_of(channel: str) -> str:
    """The kind of a channel, "rgb" of "rgb.wrist": what its values mean."""
    return channel.partition(".")[0]


def suffix_of(channel: str) -> str:
    """Which one of its kind a channel is, "wrist" of "rgb.wrist"; "" for the main one."""
    return channel.partition(".")[2]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    intrinsics: fx/W, fy/H, cx/W, cy/H.
    size:       height and width of its pictures in pixels.
    pose:       the pose channel that it is mounted on; None where nobody knows where it is.
    mount:      T_pose_cam: x, y, z in metres and quaternion w, x, y, z; camera x forward, y left, z up.
    """

    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int]
    pose: str | None = "pose"
    mount: tuple[float, float, float, float, float, float, float] = NO_MOUNT


@dataclass(frozen=True)
class Spec:
    """The declaration that every tool reads instead of asking `hasattr`.

    action:       space of one action (no batch axis).
    channels:     what `render` can show, name -> space of one observation (no batch axis). A name is a kind, or a kind and
                  which one of it: "rgb" and "rgb.wrist", "depth.wrist", "pose.wrist".
    observes:     the channels that `observe` needs as evidence.
    may_observe:  the channels that it takes as well where they are at hand (what moves, how the player is).
    dt_s:         seconds of world time that one `imagine` advances.
    units:        channel -> unit, for the channels that have one ("m", "reward").
    cameras:      picture channel -> the camera that takes it.
    action_names: one name per button (MultiBinary), choice (Discrete, of which a MultiDiscrete has several) or axis (Box).
    action_units: one unit per axis ("m", "rad/s", "N m"), or none.
    action_mode:  what the numbers mean: "buttons", "choice", "axes", "position", "velocity", "torque" or "pose_delta"; read off
                  the space where it is "".
    action_frame: the frame in which axes are meant ("world", "body", "tool"), where they have one.
    keys:         browser key (`KeyboardEvent.code`) -> the action that it stands for while held, as a
                  flat list of floats; buttons held together are combined by element-wise maximum, of one choice the last counts.
    forkable:     False where a state cannot be kept and returned to (an external game process).
    max_batch:    the largest batch that `start` accepts; None for no limit.
    max_episode_steps: steps after which whoever trains in the world cuts an episode off (truncates it); None for no limit.
    differentiable: True where gradients flow from the channels through `imagine` to the action.
    card:         free facts for people: training data, hardware, scores.
    idle:         the flat action that does nothing, where there is one and neither its name nor its mode says which.
    leap:         steps that the world's `leap` takes at once (core/world.py); 0 where it has none.
    """

    name: str
    action: spaces.Space
    channels: Mapping[str, spaces.Space]
    observes: tuple[str, ...]
    dt_s: float
    units: Mapping[str, str] = field(default_factory=dict)
    action_names: tuple[str, ...] = ()
    action_units: tuple[str, ...] = ()
    action_mode: str = ""
    action_frame: str = ""
    keys: Mapping[str, list[float]] = field(default_factory=dict)
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    forkable: bool = True
    max_batch: int | None = None
    max_episode_steps: int | None = None
    differentiable: bool = False
    card: Mapping[str, object] = field(default_factory=dict)
    may_observe: tuple[str, ...] = ()
    idle: tuple[float, ...] = ()
    leap: int = 0

    def __post_init__(self):
        if not self.action_mode:
            object.__setattr__(self, "action_mode", _mode_of(self.action))

    @property
    def camera(self) -> tuple[float, float, float, float] | None:
        """The intrinsics of the main camera, that of `rgb`; None without one."""
        main = self.cameras.get("rgb")
        return main.intrinsics if main else None

    def kinds(self, kind: str) -> tuple[str, ...]:
        """The channels of one kind, the main one first: kinds("rgb") -> ("rgb", "rgb.wrist")."""
        return tuple(sorted((name for name in self.channels if kind_of(name) == kind), key=suffix_of))

    @property
    def recorded(self) -> tuple[str, ...]:
        """The channels that a recording holds, and a policy sees: all but a mosaic, which is made of the pictures before."""
        return tuple(name for name in self.channels if kind_of(name) != "mosaic")

    def check_channels(self, channels) -> None:
        """Raises ChannelError naming the channels that exist."""
        for name in channels:
            if name not in self.channels:
                raise ChannelError(f"{self.name} cannot render '{name}'; it has {', '.join(self.channels)}.")

    def check_action(self, action: torch.Tensor, batch: int) -> torch.Tensor:
        """The action as a tensor [batch, *action.shape] of the space's dtype; ActionError where it does not fit.

        A float action that needs a gradient keeps it.
        """
        import torch

        low, high = self.action_limits
        shape = (batch, *shape_of(self.action))
        try:
            tensor = torch.as_tensor(action)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ActionError(f"{self.name} takes an action of numbers of shape {shape}; got {action!r}.") from error
        if tuple(tensor.shape) != shape:
            raise ActionError(f"{self.name} takes an action of shape {shape} (batch first); got {tuple(tensor.shape)}.")
        if tensor.device.type == "meta":  # which has no values to check
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
        """Uniform random actions [batch, *action.shape], from `rng` alone; axes without a limit stay within 1000."""
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
        """The smallest and the largest action, in the space's dtype."""
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
            f"{self.name} has the action space {space}; only Box, Discrete, MultiBinary and MultiDiscrete are known."
        )


def idle_name(names: Sequence[str]) -> int | None:
    """Which of the names is called doing nothing; None where none is."""
    plain = ["".join(filter(str.isalpha, name.lower())) for name in names]
    return next((at for at, name in enumerate(plain) if name in _IDLE), None)


def can_idle(spec: Spec) -> bool:
    """Whether there is an action that does nothing; a choice must be named so, or told."""
    return spec.action_mode != CHOICE or bool(spec.idle) or idle_name(spec.action_names) is not None


def neutral_action(spec: Spec) -> np.ndarray:
    """The action [*action.shape] that does least: what the spec says, no button, the first choice that is called a no-op or
    else the first, axes at 0 or at the limit nearest to it."""
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
