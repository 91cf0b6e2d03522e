"""Shows clips to a world and lets it dream on: predicted motion (actions only) or true motion (poses only)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..core.errors import DatasetError, ObservationError
from ..core.state import State
from ..core.world import World, make_rng
from .clips import Clip, evidence
from .fidelity import gradient_energy, psnr, ssim

PREDICTED, TRUE = "predicted", "true"


@dataclass(frozen=True)
class Dream:
    """What came of B clips over T steps: psnr and energy [B, T]; ssim [B, K] and frames uint8 [B, K, H, W, 3] at the
    K horizons; pose [B, T, 7], or None for a world that shows none; error (mean absolute, intensities 0 to 1) and
    uncertainty [B, T], or None for a world that does not say what error it expects."""

    psnr: torch.Tensor
    energy: torch.Tensor
    ssim: torch.Tensor
    frames: torch.Tensor
    pose: torch.Tensor | None
    error: torch.Tensor | None = None
    uncertainty: torch.Tensor | None = None

    @staticmethod
    def join(dreams: Sequence[Dream]) -> Dream:
        """Batches of clips as one."""
        poses = [part.pose for part in dreams if part.pose is not None]
        errors = [part.error for part in dreams if part.error is not None]
        doubts = [part.uncertainty for part in dreams if part.uncertainty is not None]
        return Dream(
            psnr=torch.cat([part.psnr for part in dreams]),
            energy=torch.cat([part.energy for part in dreams]),
            ssim=torch.cat([part.ssim for part in dreams]),
            frames=torch.cat([part.frames for part in dreams]),
            pose=torch.cat(poses) if poses else None,
            error=torch.cat(errors) if errors else None,
            uncertainty=torch.cat(doubts) if doubts else None,
        )


def fold_context(world: World, clips: Sequence[Clip], rng: torch.Generator) -> State:
    """The state after the context frames: each is evidence upon what the world imagined from the one before."""
    if not world.spec.observes:
        raise ObservationError(f"{world.spec.name} takes no evidence, so it cannot go on from a recording.")
    state = world.observe(evidence(clips, world.spec, 0), None, rng)
    for row in range(1, clips[0].context):
        state = world.imagine(state, actions_at(world, clips, row - 1), rng)
        state = world.observe(evidence(clips, world.spec, row), state, rng)
    return state


def actions_at(world: World, clips: Sequence[Clip], row: int) -> torch.Tensor:
    """The recorded action of row `row` of each clip: [B, *spec.action.shape]."""
    actions = torch.from_numpy(np.stack([np.asarray(clip.action[row]) for clip in clips]))
    return actions.reshape(len(clips), *(world.spec.action.shape or ()))


def true_motion_works(world: World, clip: Clip, rng: torch.Generator) -> bool:
    """Whether the world draws what is seen from a pose that it is given: `observe({"pose": ...}, state)`."""
    if "pose" not in world.spec.observes or clip.pose is None:
        return False
    try:
        world.observe({"pose": poses_at([clip], clip.context)}, fold_context(world, [clip], rng), rng)
    except ObservationError:
        return False
    return True


def dream(
    world: World,
    clips: Sequence[Clip],
    motion: str,
    horizons: Sequence[int],
    rng: torch.Generator,
    others: Sequence[Clip] | None = None,
) -> Dream:
    """Rolls clips (one batch) to the largest horizon and compares each frame with the truth.

    `others`: clips whose actions are played instead of the true ones ("another player's hands").
    """
    state = fold_context(world, clips, rng)
    context, last = clips[0].context, max(horizons)
    shows_pose = "pose" in world.spec.channels
    doubts = "uncertainty" in world.spec.channels
    channels = ("rgb", *(("pose",) if shows_pose else ()), *(("uncertainty",) if doubts else ()))
    likeness, energy, structure, kept, poses, errors, doubted = [], [], [], [], [], [], []
    for step in range(1, last + 1):
        row = context - 1 + step
        if motion == TRUE:
            state = world.observe({"pose": poses_at(clips, row)}, state, rng)
        else:
            state = world.imagine(state, actions_at(world, others or clips, row - 1), rng)
        seen = {name: tensor.cpu() for name, tensor in world.render(state, channels).items()}
        truth = frames_at(clips, row)
        likeness.append(psnr(seen["rgb"], truth))
        energy.append(gradient_energy(seen["rgb"]))
        if shows_pose:
            poses.append(seen["pose"])
        if doubts:
            errors.append((seen["rgb"].float() - truth.float()).abs().mean((1, 2, 3)) / 255)
            doubted.append(seen["uncertainty"])
        if step in horizons:
            structure.append(ssim(seen["rgb"], truth))
            kept.append(seen["rgb"])
    return Dream(
        psnr=torch.stack(likeness, 1),
        energy=torch.stack(energy, 1),
        ssim=torch.stack(structure, 1),
        frames=torch.stack(kept, 1),
        pose=torch.stack(poses, 1) if poses else None,
        error=torch.stack(errors, 1) if doubts else None,
        uncertainty=torch.stack(doubted, 1) if doubts else None,
    )


def dream_all(
    world: World,
    clips: Sequence[Clip],
    motion: str,
    horizons: Sequence[int],
    batch: int,
    seed: int,
    others: Sequence[Clip] | None = None,
) -> Dream:
    """`dream` of any number of clips, `batch` of them at a time or as many as the world takes; the same seed, the same."""
    size = min(batch, world.spec.max_batch or batch)
    parts = []
    for start in range(0, len(clips), size):
        hands = others[start : start + size] if others else None
        parts.append(dream(world, clips[start : start + size], motion, horizons, make_rng(seed + start), hands))
    return Dream.join(parts)


def stand_still(clips: Sequence[Clip], steps: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Copy-last: PSNR of each clip's last context frame against each of the `steps` after it; and the gradient energy
    of these true frames: two [n, steps]."""
    last = frames_at(clips, clips[0].context - 1)
    truth = [frames_at(clips, clips[0].context + step) for step in range(steps)]
    likeness = torch.stack([psnr(last, frames) for frames in truth], 1)
    return likeness, torch.stack([gradient_energy(frames) for frames in truth], 1)


def frames_at(clips: Sequence[Clip], row: int) -> torch.Tensor:
    """The recorded frame of row `row` of each clip: uint8 [B, H, W, 3]."""
    return torch.from_numpy(np.stack([np.asarray(clip.rgb[row]) for clip in clips]))


def poses_at(clips: Sequence[Clip], row: int) -> torch.Tensor:
    """The recorded pose of row `row` of each clip: float32 [B, 7]; DatasetError where a clip has none."""
    if any(clip.pose is None for clip in clips):
        raise DatasetError("these clips hold no poses; record them, or leave true motion out.")
    return torch.from_numpy(
        np.stack([np.asarray(clip.pose[row], np.float32) for clip in clips if clip.pose is not None])
    )
