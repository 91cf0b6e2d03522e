"""Small worlds of made-up parts, untrained but not silent."""

from __future__ import annotations

import torch

from terrella.core import make_rng
from terrella.space.camera import planar_pose
from terrella.space.keyframes import Keyframes, doubled
from terrella.worlds.body import Motion, MotionBody
from terrella.worlds.config import VideoConfig
from terrella.worlds.controls import Controls
from terrella.worlds.generator import UNet
from terrella.worlds.keyframe_scene import KeyframeScene
from terrella.worlds.learned import About, LearnedWorld
from terrella.worlds.objects import LOOK, NUMBER, PLACE, Billboards, BillboardsConfig
from terrella.worlds.outcome import ConstantConfig, ConstantOutcome, FrameOutcome, OutcomeConfig

CAMERA, SIZE = (0.5, 0.8, 0.5, 0.5), (16, 32)


def keyframes(count: int, rng: torch.Generator) -> Keyframes:
    """Views of a round room of 3 m, in as many directions, each of one colour."""
    depth = torch.full((count, *SIZE), 3.0)
    rgb = torch.randint(0, 256, (count, 3, 1, 1), dtype=torch.uint8, generator=rng).expand(-1, -1, *SIZE)
    zero = torch.zeros(count)
    pose = planar_pose(zero, zero, zero + 1, torch.arange(count) * 6.28 / count)
    return Keyframes.of(doubled(rgb.contiguous()), depth, pose, CAMERA)


def place(
    controls: Controls, moving: bool = False, objects: bool = False, seed: int = 0, history: int = 2
) -> LearnedWorld:
    """A world with poses: keyframes of a room, a body that any kind of action moves, and, where asked for, things in it."""
    torch.manual_seed(seed)
    rng = make_rng(seed)
    sees = {"history": history, "body_m": 0.3, "memory_mb": 1.0, "moving": moving}
    config = VideoConfig(CAMERA, controls.numbers, SIZE, (8, 8), **sees)
    motion, generator = Motion(config.motion), UNet(config.generator)
    for weight in (generator.output.weight, *motion.glide.parameters()):
        torch.nn.init.normal_(weight, std=0.05)
    scene = KeyframeScene(config.keyframes, keyframes(8, rng), keyframes(3, rng))
    parts: dict = {"outcome": ConstantOutcome(ConstantConfig(-0.1, 1.0))}
    if objects:
        parts["objects"] = one_thing(
            Billboards(BillboardsConfig(controls.numbers, 2, looks=4, moves=3, rows=4, starts=3))
        )
        kinds = OutcomeConfig(controls.numbers, (0.0, 1.0), ("health",), ((-1.0, 0.0),), (9.0,), begins=(9.0,))
        parts["outcome"] = FrameOutcome(kinds)
    about = About("made", controls, 0.1, card={"what": "made for tests"})
    return LearnedWorld(about, scene=scene, generator=generator, body=MotionBody(motion), **parts)


def one_thing(objects: Billboards) -> Billboards:
    """With one billboard two metres ahead in every start."""
    objects.pictures[:] = 255
    objects.boxes[:] = torch.tensor([0.4, 0.4, 0.0, 1.0])
    objects.moves[1, 0] = 0.25
    objects.begun[:, 0, NUMBER], objects.begun[:, 0, LOOK] = 1.0, 0.0
    objects.begun[:, 0, PLACE] = torch.tensor([2.0, 0.0, 0.5])
    return objects
