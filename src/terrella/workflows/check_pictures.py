"""`check` of worlds that show pictures: what moves in them is tracked, and judged like states."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..core.errors import DatasetError, TerrellaError
from ..core.spec import Spec
from ..core.world import World
from ..measure.clips import Clip
from ..measure.rollouts import StepMetric, dream
from ..physics import PhysicalSystem, Trajectory, trajectory_of
from ..physics.tracks import Tracked, fit_tracked

CONTEXT = 4  # rows that a world observes before it predicts
EDGE = 3  # rows after those that are judged: velocities are measured from the pictures at both sides
FITTED = 80  # rollouts at most to which tracker and scale are fitted
RECORDED = "recorded"
MASKS = ("segmentation", "instances")  # kinds of channels that number what is seen at each pixel


@dataclass(frozen=True)
class PictureMotions:
    """Motions of one length, and how they were measured."""

    known: Trajectory  # other true rollouts
    truth: Trajectory
    dream: Trajectory
    note: str


def needs_pictures(system: PhysicalSystem | None, spec: Spec) -> bool:
    """Whether a world has no positions of bodies, but pictures."""
    bodies = system.bodies if system is not None else ()
    return bool(spec.kinds("rgb")) and not any(body.position.channel in spec.channels for body in bodies)


@torch.no_grad()
def motions_in_pictures(
    world: World,
    system: PhysicalSystem | None,
    clips: list[Clip],
    known: list[Clip],
    metres_per_pixel: float | None,
    rng: torch.Generator,
) -> PictureMotions:
    """The motion of what is tracked in recorded pictures and in those that a world predicts. Clips have EDGE rows more than are
    judged. TerrellaError where nothing can be tracked or no scale be fitted."""
    channel, dt_s = world.spec.kinds("rgb")[0], world.spec.dt_s
    steps = clips[0].horizon
    pictures = [_rows(some, channel) for some in (known, clips)]
    places = [None if metres_per_pixel else _positions(system, some, dt_s) for some in (known, clips)]
    fitted = places[0][:, :FITTED] if places[0] is not None else None
    masks = _masks(known[:FITTED], channel)
    tracked = fit_tracked(pictures[0][:, :FITTED], dt_s, system, fitted, metres_per_pixel, masks)
    metric = StepMetric((channel,), lambda seen, *_: {channel: seen[channel]})
    predicted = dream(world, clips, RECORDED, steps, rng, [metric])[channel].transpose(0, 1)
    pictures.append(torch.cat([pictures[1][:CONTEXT], predicted.to(torch.uint8)]))
    firsts = [None if part is None else part[0] for part in (places[0], places[1], places[1])]
    (others, good), (truth, whole), (mine, _) = (
        tracked.trajectory(part, dt_s, first) for part, first in zip(pictures, firsts)
    )
    if min(int(good.sum()), int(whole.sum())) < 2:
        raise DatasetError(
            "in nearly all rollouts something reaches the picture's edge, where it cannot be measured; take fewer --steps."
        )
    others, truth, mine = (_judged(part, keep) for part, keep in ((others, good), (truth, whole), (mine, whole)))
    by = "" if masks is None else ", found by the recorded masks"
    return PictureMotions(others, truth, mine, _note(tracked, float(whole.double().mean()), by))


def _judged(motion: Trajectory, keep: Tensor) -> Trajectory:
    return motion.at(keep).between(CONTEXT - 1, motion.steps + 1 - EDGE)


def _note(tracked: Tracked, kept: float, by: str) -> str:
    things = ", ".join(body.name for body in tracked.system.bodies[:-1])
    words = f"Judged by pictures: {things} tracked{by}, {tracked.scale.metres_per_pixel:.3g} m a pixel ({tracked.scale.source})"
    return words + (
        f"; {1 - kept:.0%} of rollouts left out, as something reaches the picture's edge." if kept < 1 else "."
    )


def _masks(clips: list[Clip], channel: str) -> Tensor | None:
    """Masks of the camera of `channel`, int [T + 1, B, h, w]; None where none were recorded."""
    camera = channel.removeprefix("rgb")
    names = [kind + camera for kind in MASKS if all(kind + camera in clip.channels for clip in clips)]
    if not names:
        return None
    return torch.from_numpy(np.stack([np.asarray(clip.channels[names[0]], np.int64) for clip in clips], 1))


def _rows(clips: list[Clip], channel: str) -> Tensor:
    """uint8 [T + 1, B, H, W, 3]."""
    if any(channel not in clip.channels for clip in clips):
        raise DatasetError(f"the recording has no '{channel}', which the world shows; record it.")
    return torch.from_numpy(np.stack([np.asarray(clip.channels[channel]) for clip in clips], 1))


def _positions(system: PhysicalSystem | None, clips: list[Clip], dt_s: float) -> Tensor | None:
    """Recorded positions [T + 1, B, N, axes], m; None where the recording lacks them."""
    if system is None or any(name not in clips[0].channels for name in system.channels):
        return None
    rows = {
        name: torch.from_numpy(np.stack([np.asarray(clip.channels[name], np.float32) for clip in clips], 1))
        for name in system.channels
    }
    return trajectory_of(system, rows, dt_s).position[..., list(system.axes)]


def check_scale(metres_per_pixel: float | None) -> None:
    """TerrellaError for a scale that is none."""
    if metres_per_pixel is not None and not 0 < metres_per_pixel < float("inf"):
        raise TerrellaError(f"--metres-per-pixel is above 0; got {metres_per_pixel:g}.")
