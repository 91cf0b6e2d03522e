"""How `learn` opens an environment: the size of its pictures, steps per second, and steps of an episode."""

import time
from dataclasses import replace

from ..core.errors import TerrellaError
from ..core.world import World, make_rng
from ..data.recording import LONGEST
from ..learn.recording import learned_size
from .opening import EnvironmentConfig

REAL_TIME_FPS, HELD_FPS = (
    32,
    25,
)  # steps per second that a learned world plays on two cores; faster games are held to 25
EPISODES = 12  # recorded at least, shorter ones if need be: scoring needs some that training did not see


def held_to_real_time(name: str, environment: EnvironmentConfig) -> str:
    """The environment's name, with each action held for several of its steps (gym:ID@N) where it has more steps per second than
    are played in real time."""
    if not name.startswith("gym:") or "@" in name or environment.fps:
        return name
    world = environment.open(name)
    rate = 1 / world.spec.dt_s
    if callable(close := getattr(world, "close", None)):
        close()
    return name if rate <= REAL_TIME_FPS else f"{name}@{max(2, round(rate / HELD_FPS))}"


def open_small(name: str, environment: EnvironmentConfig, most: int) -> World:
    """The environment, with pictures of the size at which they are learned, of `most` pixels, if that is smaller."""
    world = environment.open(name)
    drawn = world.spec.channels.get("rgb")
    if drawn is None:
        raise TerrellaError(
            f"{name} shows no pictures, and a world is learned from them; an environment draws itself as rgb_array, "
            "or its observation is a picture."
        )
    height, width = (drawn.shape or (0, 0))[:2]
    if environment.size or not name.startswith("gym:") or height * width <= most:
        return world
    if callable(close := getattr(world, "close", None)):
        close()
    return replace(environment, size=learned_size(height, width, most)).open(name)


def longest_episode(world: World, frames: int, seconds: float) -> int:
    """The most steps of an episode with which several episodes are recorded in the time, by a trial of a few steps."""
    rng = make_rng(0)
    state = world.start(1, rng)
    began, done = time.monotonic(), 0
    while done < 20 or (done < 200 and time.monotonic() - began < 1):
        state = world.imagine(state, world.spec.sample_action(1, rng), rng)
        seen = world.render(state, list(world.spec.channels))
        done += 1
        if "done" in seen and bool(seen["done"][0]):
            state = world.start(1, rng)
    pace_s = (time.monotonic() - began) / done
    expected = min(frames, seconds / pace_s)
    return min(world.spec.max_episode_steps or LONGEST, LONGEST, max(100, int(expected / EPISODES)))
