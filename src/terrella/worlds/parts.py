"""The parts of a learned world: a Protocol each, and the values that pass between them.

In one step data flows one way: the body moves (`Body.step`), the scene says what is known of the view (`Scene.look`), the
generator draws it, the objects are painted over it (`Objects.paint`), and the scene remembers the frame (`Scene.take`).
B is the batch, H x W the size of a frame, A the numbers of an encoded action. A part that a world lacks is a null object,
which is falsy and adds nothing to a state.
"""

# the methods of a Protocol are their docstrings
# pyright: reportReturnType=false
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, Self, runtime_checkable

import torch
from gymnasium import spaces

from ..core.errors import ObservationError
from ..core.state import State
from ..space.camera import Intrinsics
from .generator import Conditioning, DrawnFrame

# Streams of chance (core/chance.py); CHANGES is the first of one stream for each vital.
NOISE, STARTS, LOOKS, MOVES, GOES, CHANGES = 1, 2, 11, 12, 13, 20
Tensors = dict[str, torch.Tensor]  # entries of a State, [B, ...]
Ends = Callable[[], torch.Tensor]  # whether the body says that an episode ends, bool [B]


@dataclass(frozen=True)
class Channels:
    """What a part adds to the Spec: the channels that it shows and their units; the channels that an observation must have,
    and those that it may have."""

    shows: Mapping[str, spaces.Space] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    observes: tuple[str, ...] = ()
    may_observe: tuple[str, ...] = ()


class Walls(NamedTuple):
    """Walls as x1, y1, x2, y2 in metres (space/floorplan.py): `shared` [S, 4] stop every body, `own` [B, N, 4] one each."""

    shared: torch.Tensor
    own: torch.Tensor


@dataclass(frozen=True)
class Evidence:
    """A checked observation. pose [B, 7]: None in a world without poses. seen: state entries of the picture, empty if only the
    pose is known. lone [B]: for pictures that came without pose and depth, whether they show a place outside the recordings."""

    batch: int
    device: torch.device
    pose: torch.Tensor | None = None
    seen: Mapping[str, torch.Tensor] = field(default_factory=dict)
    lone: torch.Tensor | None = None


@runtime_checkable
class WorldPart(Protocol):
    """Common to all parts. kind: the name in world.json; config: the settings as a dataclass, or None."""

    kind: str
    config: Any

    def to(self, device: Any) -> Any:
        """The part on another device."""


@runtime_checkable
class Body(WorldPart, Protocol):
    """How an action moves the viewer. history: actions before the present one that `step` needs; half_m: half its width."""

    history: int
    half_m: float

    def channels(self) -> Channels: ...
    def observe(self, prior: State | None, evidence: Evidence) -> Tensors:
        """The body where the evidence puts it; without a prior it stands still."""

    def step(self, state: State, actions: torch.Tensor, walls: Walls, levels: torch.Tensor) -> Tensors:
        """One step on. actions [B, history + 1, A], the newest last; levels [K, 3]: recorded places in metres, whose height a
        body follows on stairs."""

    def ends(self, after: State, action: torch.Tensor) -> torch.Tensor:
        """bool [B]: whether the episode ends where the action [B, A] led."""


@runtime_checkable
class Scene(WorldPart, Protocol):
    """What is known of a view. camera: None in a world without poses; history: actions that `look` needs; recorded: keyframes
    of the recordings; starts: where episodes begin; drawn_names: state entries that follow from drawing a frame;
    earlier_names: those of them whose value of the frame before is kept as `earlier_NAME`."""

    camera: Intrinsics | None
    device: torch.device
    history: int
    recorded: Any
    starts: Any
    drawn_names: tuple[str, ...]
    earlier_names: tuple[str, ...]

    def with_memory(self, recorded: Any = None, budget_mb: float | None = None) -> Self:
        """With other recorded keyframes, or another budget in MiB for an episode's own."""

    def channels(self) -> Channels: ...
    def start(self, seeds: torch.Tensor) -> tuple[Evidence, torch.Tensor]:
        """Evidence of recorded starts, drawn by chance from the seeds [B]; which starts they are, int64 [B]."""

    def evidence(self, observation: Mapping[str, torch.Tensor], prior: State | None, estimator: Any) -> Evidence:
        """The observation, checked and completed; ObservationError says what is wrong with it."""

    def observe(self, prior: State | None, evidence: Evidence) -> State:
        """A state that has seen and remembers the picture of the evidence; of a new episode without a prior."""

    def adopt(self, state: State) -> State:
        """The state with what it points at in this scene's arenas; ContractError for a state of another layout."""

    def walls(self, state: State) -> tuple[State, Walls]:
        """The walls around; and the state, with those frames drawn in which walls had to be looked for."""

    def look(self, state: State, before: State) -> Conditioning:
        """What is known of the view of `state`, whose frame is not yet drawn; `before` has the last frame."""

    def take(self, state: State, conditioning: Conditioning, frame: DrawnFrame) -> State:
        """`state` with the frame that was drawn from the conditioning, remembered if it shows something new."""

    def render(self, state: State, channels: Sequence[str]) -> Tensors:
        """Those of the channels that are not state entries as they stand."""


@runtime_checkable
class Generator(WorldPart, Protocol):
    """Draws a frame by flow matching in config.steps steps: a UNet or a FlowNetwork."""

    def prepare(self, conditioning: Conditioning) -> Conditioning:
        """The conditioning, with what the generator itself derives from it once a frame."""

    def draw(self, noise: torch.Tensor, conditioning: Conditioning) -> torch.Tensor:
        """The clean frame [B, 4 or 5, H, W]: rgb in [-1, 1], depth code, and where things move the logit of a thing; by chance from
        `noise` [B, 4, H, W]."""


@runtime_checkable
class Objects(WorldPart, Protocol):
    """Things that move by themselves."""

    @property
    def draws(self) -> Mapping[int, Sequence[int]]:
        """The shapes of the random numbers of a step, by their streams."""

    def channels(self, size: tuple[int, int]) -> Channels: ...
    def start(self, pick: torch.Tensor, state: State) -> Tensors:
        """The objects of the starts `pick` [B], in place of the things in their pictures; empty where frames stay as they are."""

    def observe(
        self,
        prior: State | None,
        evidence: Evidence,
        observation: Mapping[str, torch.Tensor],
        camera: Intrinsics | None,
    ) -> Tensors:
        """The objects that the evidence shows."""

    def step(self, before: State, after: State, chances: Mapping[int, torch.Tensor]) -> Tensors:
        """The objects one step on, by random numbers of `draws` (core/chance.uniforms)."""

    def add_walls(self, walls: Walls, state: State, half_m: float) -> Walls:
        """The walls, and the sides of objects that stop a body of this half width."""

    def paint(self, state: State, frame: DrawnFrame, camera: Intrinsics | None) -> DrawnFrame:
        """The frame with the objects of the state in it."""

    def render(self, state: State, channels: Sequence[str]) -> Tensors: ...


@runtime_checkable
class Outcome(WorldPart, Protocol):
    """What a step brings beside its frame: reward float32 [B], done bool [B], vitals. begins: vitals of a new episode."""

    begins: tuple[float, ...]

    @property
    def vectors(self) -> tuple[str, ...]:
        """Channels of several numbers that it predicts."""

    @property
    def draws(self) -> Mapping[int, Sequence[int]]:
        """The shapes of the random numbers of a step, by their streams."""

    def channels(self) -> Channels: ...
    def observe(self, prior: State | None, evidence: Evidence, observation: Mapping[str, torch.Tensor]) -> Tensors:
        """An episode that goes on, with the vitals that are observed."""

    def step(
        self, before: State, after: State, ends: Ends, action: torch.Tensor, chances: Mapping[int, torch.Tensor]
    ) -> Tensors:
        """The outcome of the step by action [B, A]; ends(): whether the body says that the episode ends there, bool [B]; chances:
        random numbers of `draws`. Frames are drawn only if they are read."""

    def render(self, state: State, channels: Sequence[str]) -> Tensors: ...


@runtime_checkable
class Uncertainty(WorldPart, Protocol):
    """The error to expect of a drawn frame."""

    def channels(self) -> Channels: ...
    def expected(self, conditioning: Conditioning, clean: torch.Tensor, gone: torch.Tensor) -> Any:
        """Expected mean absolute errors of rgb, 0..1 (uncertainty.Expected), float32 [B] each. clean: the generator's frame; gone
        [B, len(GONE)]: the way since evidence (uncertainty.py)."""


class Absent:
    """What all null objects share."""

    kind: str = "none"
    config: Any = None
    draws: Mapping[int, Sequence[int]] = MappingProxyType({})

    def __bool__(self) -> bool:
        return False

    def to(self, device: Any) -> Self:
        return self

    def channels(self, *size: tuple[int, int]) -> Channels:
        return Channels()


def newest_frame(state: State) -> torch.Tensor:
    """The newest frame, uint8 [B, 3, H, W]: `rgb` of a keyframe scene, the first of the `frames` of a frame history."""
    return state["rgb"] if "rgb" in state else state["frames"][:, 0]


def picture_of(
    observation: Mapping[str, torch.Tensor], size: tuple[int, int], device, name: str = "rgb"
) -> torch.Tensor:
    """A picture channel of an observation as uint8 [B, 3, H, W]; ObservationError for another type or size."""
    rgb = torch.as_tensor(observation[name])
    if rgb.ndim != 4 or rgb.shape[1:] != (*size, 3) or rgb.dtype != torch.uint8:
        raise ObservationError(
            f"{name} is uint8 [B, {size[0]}, {size[1]}, 3], 0 to 255; got {rgb.dtype} {tuple(rgb.shape)}."
        )
    return rgb.to(device).permute(0, 3, 1, 2).contiguous()


def check_prior(held: int, batch: int) -> None:
    """ObservationError unless the prior's `held` episodes are as many as those of the evidence."""
    if held != batch:
        raise ObservationError(f"the prior holds {held} episodes, the evidence is of {batch}.")
