"""The settings of a world of pictures, and those of its parts that follow from them."""

from dataclasses import dataclass

from ..space.camera import Intrinsics

THUMBNAIL = (3, 4)  # rows and columns of the context thumbnail, a tiny picture of the last frame


@dataclass(frozen=True)
class GeneratorConfig:
    """Of the U-Net that draws a frame."""

    size: tuple[int, int]  # height and width of a frame, pixels
    slots: int  # colours from the scene that it sees at each pixel
    context: int  # numbers that it is conditioned on beside maps
    channels: tuple[int, ...] = (32, 56, 88, 128)  # at 1/2, 1/4, 1/8 and 1/16 of the size
    steps: int = 1  # flow-matching steps a frame
    residual: bool = False  # it draws the change of the newest frame
    moving: bool = False  # it also sees the last two frames and draws where things are


@dataclass(frozen=True)
class MotionConfig:
    """Of the body of a world with poses."""

    actions: int  # numbers of an encoded action
    history: int = 8  # actions before the present one that it sees
    body_m: float = 0.0  # half the width in metres of the body that slides along walls; 0: none stops it
    short: float = 0.0  # share of a step by which it stops short of a wall
    stairs: bool = False  # its height follows that of the recorded places around


@dataclass(frozen=True)
class KeyframesConfig:
    """Of the scene of a world with poses."""

    camera: Intrinsics  # of all pictures
    size: tuple[int, int] = (96, 128)  # height and width of a frame, pixels
    sources: int = 6  # keyframes that are warped into a view
    slots: int = 3  # of them, those that the generator sees at each pixel
    memory_mb: float = 16.0  # MiB of an episode's own memory
    known_enough: float = 0.95  # share of a drawn frame that memory knew, above which it is no keyframe
    new_view: tuple[float, float] = (0.4, 0.2)  # metres and radians from the nearest keyframe
    moving: bool = False  # things move


@dataclass(frozen=True)
class HistoryConfig:
    """Of the scene of a frames-only world."""

    size: tuple[int, int]  # height and width of a frame, pixels
    slots: int  # last frames that are kept
    actions: int  # numbers of an encoded action
    moves: tuple[tuple[int, int], ...] = ()  # x and y in pixels by which pictures scroll, (0, 0) first; none: no mosaic
    cameras: tuple[str, ...] = ()  # picture channels that lie side by side in a frame, from the left; (): rgb alone
    recalls: bool = False  # earlier frames are kept, and one is recalled (space/recall.py)


@dataclass(frozen=True)
class VideoConfig:
    """What a training run chooses for a world of pictures."""

    camera: Intrinsics  # of all pictures, as in Spec
    actions: int  # numbers of an encoded action
    size: tuple[int, int] = (96, 128)  # height and width of a frame, pixels
    channels: tuple[int, ...] = (32, 56, 88, 128)  # of the generator at 1/2, 1/4, 1/8 and 1/16 of the size
    sources: int = 6  # keyframes that are warped into a view
    slots: int = 3  # of them, those that the generator sees at each pixel; in a frames-only world the last frames
    history: int = 8  # actions before the present one that the motion model sees
    body_m: float = 0.0  # half the width in metres of the body that slides along walls; 0: none stops it
    short: float = 0.0  # share of a step by which it stops short of a wall
    memory_mb: float = 16.0  # MiB of an episode's own memory (space/memory.py); with 0 it holds the last frame alone
    known_enough: float = 0.95  # share of a drawn frame that memory knew, above which it is no keyframe
    new_view: tuple[float, float] = (0.4, 0.2)  # metres and radians from the nearest keyframe of the episode's own
    geometry: bool = True  # False: no depth and pose; the last frames stand for memory (worlds/frame_history.py)
    steps: int = 1  # flow-matching steps a frame
    vitals: tuple[float, ...] = ()  # with which episodes begin; the outcome has their names
    residual: bool = False  # a frame is the newest one and its change, without mixture and noise
    objects: bool = False  # things are billboards (worlds/objects.py), which the generator neither sees nor draws
    moving: bool = False  # things move: the generator sees the last two frames, and memory keeps what stands still
    # of a frames-only world: picture channels side by side in a frame, from the left; (): rgb alone
    cameras: tuple[str, ...] = ()

    @property
    def generator(self) -> GeneratorConfig:
        """Of the network that draws. Its context: the thumbnail and, where no motion model turns them into a view, the actions."""
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
        return HistoryConfig(self.size, self.slots, self.actions, cameras=self.cameras)
