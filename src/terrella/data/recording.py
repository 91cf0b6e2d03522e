"""record: drives any World with a policy and keeps what happens as a recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from ..core.errors import DatasetError
from ..core.policy import Policy, act
from ..core.world import Observation, World, make_rng
from .format import Layout
from .recorder import Recorder, Watch

LONGEST = 1050  # steps of an episode in worlds that have no limit


def record(
    world: World,
    policy: Policy,
    root: str | Path,
    frames: int,
    rng: torch.Generator,
    progress: Callable[[int, int], None] | None = None,
    fps: float | None = None,
    max_episode_steps: int | None = None,
    task: str | None = None,
    live: Watch | None = None,
    pictures: Literal["video", "png"] = "video",
    enough: Callable[[], bool] = lambda: False,
) -> Recorder:
    """Records until `root` holds `frames` rows (those of an earlier run count), or until it is `enough`, one world step a row.

    An episode ends at `done` or after `max_episode_steps`, by default the world's own limit, or LONGEST.
    Each episode has a generator of its own, drawn from `rng`'s
    seed and the episode's number, so that a run that was killed and started again with the same seed records the same
    as one that was not. `progress(rows, frames)` is called after each row; `live` is logged to; `pictures` as in Layout.
    Returns the closed recorder (its rows and episodes can be read). DatasetError as Recorder raises it; what was
    committed before is safe.
    """
    if frames < 2:
        raise DatasetError(f"{frames} frames are no recording: an episode has 2 rows or more; ask for more frames.")
    if max_episode_steps is None:
        max_episode_steps = world.spec.max_episode_steps or LONGEST
    if max_episode_steps < 1:
        raise DatasetError(f"episodes of {max_episode_steps} steps are none; ask for one step or more.")
    layout = replace(Layout.of(world.spec, fps), pictures=pictures)
    base = base_of(rng)
    task = task or f"explore {world.spec.name}"
    with Recorder(root, layout, task, "discard", live) as recorder:  # what was interrupted, the seed makes again

        def stop() -> bool:
            if progress:
                progress(recorder.rows + recorder.in_flight, frames)
            return enough()

        while recorder.rows < frames - 1 and not enough():  # an episode has 2 rows or more
            steps = min(max_episode_steps, frames - recorder.rows - 1)
            play_episode(world, policy, recorder, make_rng(seed_of(base, recorder.episodes)), steps, stop)
            recorder.end_episode()
    return recorder


def base_of(rng: torch.Generator) -> int:
    """The number from which the seeds of a recording's episodes come."""
    return int(torch.randint(2**62, (1,), generator=rng).item())


def seed_of(base: int, episode: int) -> int:
    """The seed of an episode, by its number alone: whoever plays it, and after whatever, plays the same."""
    return int(np.random.SeedSequence([base, episode]).generate_state(1, np.uint64)[0] >> 2)


@torch.no_grad()
def play_episode(
    world: World,
    policy: Policy,
    recorder: Recorder,
    rng: torch.Generator,
    steps: int,
    stop: Callable[[], bool] = lambda: False,
) -> None:
    """Adds the rows of one episode of at most `steps` to `recorder`, without ending it there. `stop()` is asked after each row."""
    channels = [name for name in world.spec.recorded if name not in ("reward", "done")]
    follow = [name for name in world.spec.channels if name in ("reward", "done")]
    state, memory = world.start(1, rng), policy.begin(1, rng)
    for _ in range(steps):
        seen = world.render(state, channels)
        action, memory = act(policy, seen, memory, 1, world.spec, rng)
        state = world.imagine(state, action, rng)
        after = world.render(state, follow)
        done = bool(after["done"][0]) if "done" in after else False
        reward = float(after["reward"][0]) if "reward" in after else 0.0
        recorder.add(_first(seen), action[0].cpu().numpy(), reward, done)
        if stop() or done:
            break
    recorder.add(_first(world.render(state, channels)))
    stop()


def _first(observation: Observation) -> dict[str, np.ndarray]:
    return {name: tensor[0].cpu().numpy() for name, tensor in observation.items()}
