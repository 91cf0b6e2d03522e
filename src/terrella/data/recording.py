"""record: steps any World under a policy and records what is observed."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from ..core.errors import DatasetError
from ..core.policy import Policy, act
from ..core.world import Observation, World, make_rng
from .format import Layout
from .recorder import Recorder, Watch

LONGEST = 1050  # steps after which episodes of worlds without a limit are cut off


@dataclass(frozen=True)
class RecordOptions:
    """How `record` records."""

    fps: float | None = None  # rows a second that the recording states; None takes one over the world's step
    max_episode_steps: int | None = None  # steps of an episode; None takes the world's limit, or LONGEST
    task: str | None = None  # the instruction of every episode; None makes one of the world's name
    pictures: Literal["video", "png"] = "video"  # how pictures are stored
    live: Watch | None = None  # a viewer that is sent every row while it is recorded


def record(
    world: World,
    policy: Policy,
    root: str | Path,
    frames: int,
    rng: torch.Generator,
    progress: Callable[[int, int], None] | None = None,
    enough: Callable[[], bool] = lambda: False,
    options: RecordOptions = RecordOptions(),
) -> Recorder:
    """Steps `world` under `policy` and records one row a step, until `root` holds `frames` rows or `enough()` is true.

    Rows of an earlier run count. An episode ends at `done` or at its step limit. Its seed follows from `rng` and from its
    number, so a run that was killed and started again with the same seed gives the same recording as one that was not.
    `progress(rows, frames)` is called after each row. Returns the closed recorder (its rows and episodes can be read).
    DatasetError as Recorder raises it; episodes committed before are safe.
    """
    if frames < 2:
        raise DatasetError(f"{frames} frames are no recording: an episode has 2 rows or more; ask for more frames.")
    max_episode_steps = options.max_episode_steps
    if max_episode_steps is None:
        max_episode_steps = world.spec.max_episode_steps or LONGEST
    if max_episode_steps < 1:
        raise DatasetError(f"episodes of {max_episode_steps} steps are none; ask for one step or more.")
    layout = replace(Layout.of(world.spec, options.fps), pictures=options.pictures)
    base = base_of(rng)
    task = options.task or f"explore {world.spec.name}"
    # an interrupted episode is discarded, for its seed gives it again
    with Recorder(root, layout, task, "discard", options.live) as recorder:

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
    """The number from which the seeds of all episodes of a recording follow."""
    return int(torch.randint(2**62, (1,), generator=rng).item())


def seed_of(base: int, episode: int) -> int:
    """The seed of an episode, which depends on its number alone: not on the worker or the episodes before."""
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
    """Adds the rows of one episode of at most `steps` steps to `recorder` and leaves it open. `stop()` is called after each row."""
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
