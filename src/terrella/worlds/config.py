"""What a training run chooses of a world of pictures, and the settings of the parts that follow from it."""

from __future__ import annotations

from dataclasses import dataclass

from ..space.camera import Intrinsics

THUMBNAIL = (3, 4)  # rows and columns of the context thumbnail, the tiny picture of the last frame


@dataclass(frozen=True)
class GeneratorConfig:
    """size: (height, width) of the frames; slots: warped colours that it sees at each pixel; context: numbers that it is
    conditioned on beside maps; channels: at 1/2, 1/4, 1/8 and 1/16 of the size; steps: flow-matching steps a frame; residual
    and moving: as in VideoConfig."""

    size: tuple[int, int]
    slots: int
    context: int
    channels: tuple[int, ...] = (32, 56, 88, 128)
    steps: int = 1
    residual: bool = False
    moving: bool = False


@dataclass(frozen=True)
class MotionConfig:
    """actions: numbers in an action; history: of the actions before it that count; body_m: half the width of the body that
    slides along walls, 0: none stops it; short: the share of a step by which it stops short of a wall; stairs: its height
    follows that of the recorded places around."""

    actions: int
    history: int = 8
    body_m: float = 0.0
    short: float = 0.0
    stairs: bool = False


@dataclass(frozen=True)
class KeyframesConfig:
    """camera: intrinsics of all pictures; the rest as in VideoConfig."""

    camera: Intrinsics
    size: tuple[int, int] = (96, 128)
    sources: int = 6
    slots: int = 3
    memory_mb: float = 16.0
    known_enough: float = 0.95
    new_view: tuple[float, float] = (0.4, 0.2)
    moving: bool = False


@dataclass(frozen=True)
class HistoryConfig:
    """size: (height, width) of the frames; slots: last frames that are kept; actions: numbers in an action; moves: displacements
    by which a picture may scroll, x and y in pixels, the first of them 0, 0; with none there is no mosaic."""

    size: tuple[int, int]
    slots: int
    actions: int
    moves: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True)
class VideoConfig:
    """size: (height, width) of the frames; camera: intrinsics as in Spec; actions: numbers in an action."""

    camera: Intrinsics
    actions: int
    size: tuple[int, int] = (96, 128)
    channels: tuple[int, ...] = (32, 56, 88, 128)  # of the generator at 1/2, 1/4, 1/8 and 1/16 of the size
    sources: int = 6  # keyframes that are warped into a view
    slots: int = 3  # of them, those that the generator sees at each pixel; or the last frames that it sees
    history: int = 8  # actions that the motion model remembers
    body_m: float = 0.0  # half the width of the body that slides along walls, as recordings show it; 0: none stops it
    short: float = 0.0  # the share of a step by which it stops short of a wall
    memory_mb: float = 16.0  # MiB of an episode's own memory (space/memory.py); with 0 it holds the last frame alone
    known_enough: float = 0.95  # share of a dreamt frame that memory knew, above which it is not kept as a keyframe
    new_view: tuple[float, float] = (0.4, 0.2)  # metres and radians from the nearest keyframe of its own
    geometry: bool = True  # False: no depth and pose, the last frames stand for memory (worlds/frame_history.py)
    steps: int = 1  # flow-matching steps a frame
    vitals: tuple[float, ...] = ()  # with which episodes begin (names are its outcome's)
    residual: bool = False  # a frame is the newest slot and what changes in it, drawn at once: no mixture, no noise
    # things are billboards (worlds/objects.py): the generator neither sees nor draws what they cover
    objects: bool = False
    moving: bool = False  # things move: the last two frames are shown everywhere, and memory keeps what stands still

    @property
    def generator(self) -> GeneratorConfig:
        """Of the network that draws: its context is the thumbnail and, where nothing else says what they cause, the actions."""
        acts = self.history if self.moving else 0 if self.geometry else self.slots
        context = 3 * THUMBNAIL[0] * THUMBNAIL[1] + self.actions * acts
        return GeneratorConfig(self.size, self.slots, context, self.channels, self.steps, self.residual, self.moving)

    @property
    def motion(self) -> MotionConfig:
        """Of the body of a world with poses."""
        return MotionConfig(self.actions, self.history, self.body_m, self.short, self.moving)

    @property
    def keyframes(self) -> KeyframesConfig:
        """Of the scene of a world with poses."""
        memory = self.memory_mb, self.known_enough, self.new_view
        return KeyframesConfig(self.camera, self.size, self.sources, self.slots, *memory, self.moving)

    @property
    def frames(self) -> HistoryConfig:
        """Of the scene of a frames-only world."""
        return HistoryConfig(self.size, self.slots, self.actions)
