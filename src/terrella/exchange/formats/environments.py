"""Rollouts of a Gymnasium environment under random actions, made when they are read."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import gymnasium
import numpy as np

from ...core.errors import DatasetError
from ...core.numbers import single_number
from ...core.step_length import infos_of_step, step_length
from ...data.source import Sensor, Source, Take
from . import arrays, rows, spaces
from .arrays import Array, Place

_FOLLOW = [("rewards",), ("terminations",), ("truncations",)]
_MAX_STEPS = 1000


def from_env(
    env: str | Callable[[], gymnasium.Env], episodes: int = 10, seed: int = 0, fps: float | None = None
) -> Source:
    """Rollouts of an environment, given by its id or a function that makes one; the same at each call of `takes`.

    fps: rows per second. Default: from what the environment says of its steps (core/step_length.py), else rows.FPS_UNKNOWN.

    An episode is truncated after 1000 steps. There is one more observation than actions: the last one is kept. Spaces are
    flattened as in minari.read; notes name the parts of observations that are no arrays, and infos.
    DatasetError for unknown ids, and for an action or a whole observation that is no array.
    """
    if episodes < 1:
        raise DatasetError(f"{episodes} episodes make no recording; ask for 1 or more.")
    rows.check_fps(fps, "the rollout")
    made, name = _make(env)
    observation, action = spaces.to_json(made.observation_space), spaces.to_json(made.action_space)
    infos = made.reset(seed=seed)[1]
    seconds, clock = step_length(made)
    infos = dict.fromkeys([*infos, *infos_of_step(made)])
    stated = {"fps": seconds and 1 / seconds}
    made.close()
    leaves = {
        (root, *place): leaf
        for root, space in (("observations", observation), ("actions", action))
        for place, leaf in spaces.leaves(space, root, name).items()
    }
    known = {place: leaf for place, leaf in leaves.items() if leaf}
    known |= dict.fromkeys(_FOLLOW, Array((0,), np.dtype(float)))
    sensors, notes = arrays.columns(known, partial(arrays.sensor_at, arrays.GYMNASIUM), name)
    if ";" in clock and fps is None:
        notes.append(f"the step length of {name} is {clock}.")
    if infos:
        notes.append(f"the infos of {name} are left out ({', '.join(map(str, infos))}).")
    odd = [place for place, leaf in leaves.items() if leaf and place not in sensors]
    if any(place[0] == "actions" for place in odd) or not any(place[0] == "observations" for place in sensors):
        what = ", ".join(map(arrays.spelled, odd)) or "observations without numbers"
        raise DatasetError(f"'{what}' of {name} cannot be recorded; wrap the environment so that it has arrays.")
    leaves = {place: leaf for place, leaf in leaves.items() if place not in odd}

    def takes(rate: float) -> Iterator[Take]:
        made, _ = _make(env)
        try:
            for number in range(episodes):
                draw = np.random.SeedSequence([seed, number]).generate_state(2)
                yield _take(_rollout(made, draw), leaves, sensors, rate, name, int(draw[0]))
        finally:
            made.close()

    facts = {"observation_space": observation, "action_space": action, "env": name, "seed": seed}
    return arrays.source(name, name, sensors, takes, fps=fps, about=stated, notes=notes, facts=facts)


def _make(env: str | Callable[[], gymnasium.Env]) -> tuple[gymnasium.Env, str]:
    try:
        made = gymnasium.make(env) if isinstance(env, str) else env()
    except (gymnasium.error.Error, ImportError, TypeError, ValueError) as error:
        raise DatasetError(f"the environment '{env}' cannot be made: {str(error).splitlines()[0]}.") from error
    if not isinstance(made, gymnasium.Env):
        raise DatasetError(f"{made!r} is not a Gymnasium environment; give an id, or a function that makes one.")
    return made, env if isinstance(env, str) else type(made.unwrapped).__name__


def _rollout(env: gymnasium.Env, draw: np.ndarray) -> dict[str, list]:
    seen, _ = env.reset(seed=int(draw[0]))
    env.action_space.seed(int(draw[1]))
    episode: dict[str, list] = {name: [] for name in arrays.GYMNASIUM}
    episode["observations"].append(seen)
    done = cut = False
    while not (done or cut):
        action = env.action_space.sample()
        seen, reward, terminated, truncated, _ = env.step(action)
        done, steps = bool(single_number(terminated, "its termination")), len(episode["actions"]) + 1
        cut = bool(single_number(truncated, "its truncation")) or (steps == _MAX_STEPS and not done)
        for name, value in zip(arrays.GYMNASIUM, (seen, action, single_number(reward, "its reward"), done, cut)):
            episode[name].append(value)
    return episode


def _take(
    episode: Mapping[str, list],
    leaves: Mapping[Place, Array | None],
    sensors: Mapping[Place, Sensor],
    fps: float,
    name: str,
    seed: int,
) -> Take:
    stored: dict[Place, Array] = {}
    texts: dict[Place, list[str]] = {}
    for place in {**leaves, **sensors}:
        values = episode[str(place[0])]
        for key in place[1:]:
            values = [value[key] for value in values]
        if place not in sensors:
            texts[place] = [str(text) for text in values]
            continue
        sensor = sensors[place]
        try:
            values = np.stack([np.asarray(it, sensor.dtype).reshape(rows.stored_shape(sensor)) for it in values])
        except (TypeError, ValueError) as error:
            raise DatasetError(f"{name} gave {sensor.name} of another shape than its space says: {error}.") from error
        stored[place] = Array(values.shape, values.dtype, lambda start, stop, values=values: values[start:stop])
    task, kept = spaces.split_texts(texts)
    readings = arrays.readings(stored, sensors, np.arange(len(episode["observations"])) / fps, name)
    return Take(readings, task, facts={"seed": seed, **({"texts": kept} if kept else {})})
