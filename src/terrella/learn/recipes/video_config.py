"""Settings of `train video`, and the kind of world that a recording allows."""

from dataclasses import dataclass

from ...core.errors import DatasetError
from ...worlds.config import VideoConfig
from ...worlds.objects import ROWS
from ..presets import PresetName
from ..recording import INSTANCES, OBJECTS, THINGS, Box, Recording, has_channel

WIDTHS = (32, 56, 88, 128)  # channels of a U-Net
USUAL_HOURS = 24.0  # of training, where none are given


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run."""

    name: str = "world"  # Name of the world.
    # Height and width of its frames in pixels. Default: those of the recording, scaled down to at most 96 x 128 pixels in all.
    size: tuple[int, int] | None = None
    # --no-geometry: learn from frames and actions alone, although the recording has depth and poses.
    geometry: bool = True
    # Channels of the generator at 1/2, 1/4, 1/8, ... of the size (without depth at 1/4, 1/8 and 1/16). Default: 32 56 88 128, and
    # without depth those of the preset.
    channels: tuple[int, ...] = ()
    # Size of a generator without depth: small has 2.4M parameters, medium 11M, large 23M, huge 43M. Default: small on a CPU; on a
    # GPU medium from 5 minutes, large from an hour, huge from four, as far as its memory allows.
    preset: PresetName = "auto"
    # --no-compile: on a GPU, run the network of a world without depth as it is.
    compile: bool = True
    half: bool = True  # --no-half: compute in float32 where the device computes bfloat16.
    frames: int = 4  # Number of past frames that a world without geometry sees.
    # Vectors of the recording, such as the place of a hand, that the world predicts beside its frames, so that policies that see
    # them can act in it. For worlds of frames alone, which predict single numbers, such as health, anyway.
    predict: tuple[str, ...] = ()
    # Training steps of the model that predicts reward, termination, vitals and --predict.
    outcome_steps: int = 1500
    # Training steps of the objects, which are drawn as billboards that move, change and vanish. Needs a recording with object
    # instances. 0: no separate model, the generator draws them.
    objects_steps: int = 2500
    # --no-moving: treat everything as static, although the recording marks what moves (monsters, doors, pick-ups).
    moving: bool = True
    # Flow steps a frame (without depth 3, unless more than 1 are given). With more than one the whole flow from noise to frame is
    # learned, so that a frame is a sample, not a mean. A world with depth can then be the teacher of `train distil`.
    flow_steps: int = 1
    # Training steps of the generator. Training ends after these or after --hours, whichever comes first. Default: 8000 on a CPU,
    # 60000 on a GPU.
    steps: int | None = None
    # Hours of training, of all stages together, earlier runs included; learning rates decay over them. Default: 24.
    hours: float | None = None
    # Frames per step. Default: 8 on a CPU, 64 on a GPU.
    batch: int | None = None
    # Peak learning rate of the generator. Default: 8e-4, and without depth 6e-3.
    learning_rate: float | None = None
    motion_steps: int = 6000  # Training steps of the motion model.
    keyframes: int = 640  # Number of recorded keyframes that the world keeps in memory.
    # A box x0 y0 x1 y1 of the map in metres that training never sees, to score new places.
    keep_out: Box | None = None
    critic_from: int = 1500  # Step from which a critic judges sharpness.
    critic_weight: float = 0.3  # Weight of the critic, relative to the loss.
    # Training steps of the depth and odometry estimator. 0 leaves it out.
    estimator_steps: int = 2500
    # Predicted frames from which the uncertainty is learned. 0 leaves it out.
    uncertainty_frames: int = 9000
    save_every_s: float = 120.0  # Seconds between saves.
    strip_every_s: float = 300.0  # Seconds between pictures of truth and prediction.
    seed: int = 0  # Random seed.
    device: str = "auto"  # cpu, cuda or auto.

    @property
    def minutes(self) -> float | None:
        """Minutes of training; None where no --hours are given."""
        return None if self.hours is None else 60 * self.hours

    @property
    def limit_hours(self) -> float:
        """The hours after which training ends."""
        return USUAL_HOURS if self.hours is None else self.hours


def video_config(recording: Recording, config: TrainConfig) -> VideoConfig:
    """The kind of world that can be learned from a recording."""
    cache, controls = recording.cache, recording.controls
    posed = config.geometry and recording.posed
    moving = posed and config.moving and THINGS in cache.arrays
    objects = moving and has_channel(cache, OBJECTS) and has_channel(cache, INSTANCES) and config.objects_steps > 0
    if objects and cache.arrays[OBJECTS].shape[1:] != (ROWS, 4):
        raise DatasetError(
            f"{recording.name} lists objects as {cache.arrays[OBJECTS].shape[1:]}, and {(ROWS, 4)} is read: number and place "
            f"of up to {ROWS}. Record it so, or train with --objects-steps 0."
        )
    height, width = cache.rgb.shape[1:3]
    return VideoConfig(
        tuple(cache.world["camera"]) if posed else (1.0, 1.0, 0.5, 0.5),
        controls.numbers,
        (height, width),
        config.channels or WIDTHS,
        slots=3 if posed else config.frames,
        geometry=posed,
        steps=config.flow_steps,
        moving=moving,
        objects=objects,
        cameras=recording.cameras,
    )
