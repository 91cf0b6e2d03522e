"""Budgets of play: frames a second, for which a world of frames is drawn in fewer steps, and memory of what was seen."""

import statistics
import time

import torch

from ..core.errors import TerrellaError
from ..core.spec import neutral_action
from ..core.world import World, make_rng
from ..worlds.config import KeyframesConfig
from ..worlds.keyframe_scene import KeyframeScene
from ..worlds.learned import LearnedWorld
from .progress import Progress

WARM, TIMED = 2, 5  # frames


def at_pace(world: World, fps: float, progress: Progress) -> World:
    """The world, drawn in the most steps that this machine draws at `fps` frames a second, or in one. Says what is given up, and
    where the pace cannot be kept. TerrellaError unless `fps` is above 0 and at most the world's own."""
    own = 1 / world.spec.dt_s
    if not 0 < fps <= own * 1.001:
        raise TerrellaError(
            f"--fps {fps:g}: {world.spec.name} has {own:.3g} steps a second; give up to that many frames a second."
        )
    most = world.generator.config.steps if isinstance(world, LearnedWorld) else 1
    for steps in range(most, 0, -1):
        drawn = world.replaced(steps=steps) if isinstance(world, LearnedWorld) and steps < most else world
        reached = 1 / frame_s(drawn)
        if reached >= fps:
            break
    given = f" in {steps} drawing step{'s' * (steps > 1)} a frame, not {most}: less sharp" if steps < most else ""
    if reached >= fps:
        progress(f"{world.spec.name} keeps {fps:g} frames a second{given or ', as it is'}")
    else:
        progress(
            f"{world.spec.name} cannot keep {fps:g} frames a second here: {reached:.2g} is the most{given and ',' + given}"
        )
    return drawn


def say_memory(world: World, memory_mb: float, progress: Progress) -> None:
    """Says what an episode of the world, opened with the budget, remembers of its way, and what is given up. TerrellaError for a
    world that remembers nothing which a budget could limit."""
    if not isinstance(world, LearnedWorld):
        return  # a memory that was added says what it needs
    if not isinstance(world.scene, KeyframeScene):
        raise TerrellaError(
            f"{world.spec.name} keeps its last pictures alone, the same memory for any way; leave --memory-mb out."
        )
    own, usual = world.scene.own, world.scene.with_memory(budget_mb=KeyframesConfig.memory_mb).own.capacity
    holds = f"{own.capacity} view{'s' * (own.capacity != 1)} of its way, in {own.nbytes / 2**20:.2g} MiB an episode"
    less = f", not {usual}: older ones are forgotten sooner" if own.capacity < usual else ""
    over = f"; --memory-mb {memory_mb:g} cannot hold one" if own.nbytes > memory_mb * 2**20 else ""
    progress(f"{world.spec.name} remembers {holds}{less}{over}")


@torch.inference_mode()
def frame_s(world: World) -> float:
    """The median time of a step with its pictures, in seconds."""
    rng, shown, took = make_rng(0), world.spec.kinds("rgb"), []
    state, action = world.start(1, rng), torch.as_tensor(neutral_action(world.spec))[None]
    for _ in range(WARM + TIMED):
        began = time.perf_counter()
        state = world.imagine(state, action, rng)
        for picture in world.render(state, shown).values():
            picture.cpu()
        took.append(time.perf_counter() - began)
    return statistics.median(took[WARM:])
