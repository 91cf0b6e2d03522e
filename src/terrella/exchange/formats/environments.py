"""Rollouts of a Gymnasium environment under random actions, drawn when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import gymnasium
import numpy as np

from ...core.errors import DatasetError
from ...data.source import Readings, Sensor, Source, Take
from . import rows, spaces

_MOST_STEPS = 1000


def from_env(
    env: str | Callable[[], gymnasium.Env], episodes: int = 10, seed: int = 0, fps: float | None = None
) -> Source:
    """Rollouts of an environment, its id or a function that makes one; the same at each call of `takes`.

    fps: rows a second; by default from the environment's dt or tau, else its render_fps, else rows.FPS_UNKNOWN.

    An episode is cut (truncated) after 1000 steps. Observations are one more than actions: the one after the last step is
    kept. Spaces are flattened as in minari.read.
    DatasetError for unknown ids, and spaces that are not arrays.
    """
    if episodes < 1:
        raise DatasetError(f"{episodes} episodes are no recording; ask for 1 or more.")
    rows.check_fps(fps, "the rollout")
    made, name = _make(env)
    observation, action = spaces.to_json(made.observation_space), spaces.to_json(made.action_space)
    rate, notes = rows.rate_of(fps, _rate(made), name)
    made.close()
    both = ((rows.OBSERVATION, observation), (rows.ACTION, action))
    leaves = {role: spaces.leaves(role, space, name) for role, space in both}
    sensors = {leaf.sensor.name: leaf.sensor for parts in leaves.values() for leaf in parts if leaf.sensor}
    for role, kind in ((rows.REWARD, "float64"), (rows.DONE, "bool"), (rows.TRUNCATED, "bool")):
        sensors[role] = replace(rows.sensor_for("", role, (), kind), name=role)

    def takes() -> Iterator[Take]:
        made, _ = _make(env)
        try:
            for number in range(episodes):
                draw = np.random.SeedSequence([seed, number]).generate_state(2)
                yield _take(_rollout(made, draw), leaves, sensors, rate, name, int(draw[0]))
        finally:
            made.close()

    facts = {"observation_space": observation, "action_space": action, "env": name, "seed": seed}
    return Source(name, sensors, takes, rate, notes=notes, facts=facts)


def _make(env: str | Callable[[], gymnasium.Env]) -> tuple[gymnasium.Env, str]:
    try:
        made = gymnasium.make(env) if isinstance(env, str) else env()
    except (gymnasium.error.Error, ImportError, TypeError, ValueError) as error:
        raise DatasetError(f"the environment '{env}' cannot be made: {str(error).splitlines()[0]}.") from error
    if not isinstance(made, gymnasium.Env):
        raise DatasetError(f"{made!r} is no Gymnasium environment; give an id, or a function that makes one.")
    return made, env if isinstance(env, str) else type(made.unwrapped).__name__


def _rate(env: gymnasium.Env) -> float | None:
    """The environment's own word on how many of its steps make a second."""
    for name in ("dt", "tau"):
        dt_s = getattr(env.unwrapped, name, None)
        if isinstance(dt_s, int | float) and dt_s > 0:
            return 1 / dt_s
    stated = env.metadata.get("render_fps")
    return float(stated) if isinstance(stated, int | float) and stated > 0 else None


def _rollout(env: gymnasium.Env, draw: np.ndarray) -> dict[str, list]:
    seen, _ = env.reset(seed=int(draw[0]))
    env.action_space.seed(int(draw[1]))
    found: dict[str, list] = {rows.OBSERVATION: [seen], rows.ACTION: []}
    found |= {name: [] for name in (rows.REWARD, rows.DONE, rows.TRUNCATED)}
    done = cut = False
    while not (done or cut):
        action = env.action_space.sample()
        seen, reward, terminated, truncated, _ = env.step(action)
        done, steps = bool(terminated), len(found[rows.ACTION]) + 1
        cut = bool(truncated) or (steps == _MOST_STEPS and not done)
        for name, value in zip(found, (seen, action, float(reward), done, cut)):  # type: ignore[arg-type]
            found[name].append(value)
    return found


def _take(
    found: Mapping[str, list],
    leaves: Mapping[str, tuple[spaces.Leaf, ...]],
    sensors: Mapping[str, Sensor],
    fps: float,
    name: str,
    seed: int,
) -> Take:
    time_s = np.arange(len(found[rows.OBSERVATION])) / fps
    readings, task, texts = {}, "", {}
    for role, parts in leaves.items():
        for leaf in parts:
            values = found[role]
            for key in leaf.path:
                values = [value[key] for value in values]
            if leaf.sensor is None:
                if leaf.is_instruction and len(set(values)) == 1 and not task:
                    task = str(values[0])
                else:
                    texts["/".join(map(str, (f"{role}s", *leaf.path)))] = [str(text) for text in values]
                continue
            shape = rows.stored_shape(leaf.sensor)
            try:
                stacked = np.stack([np.asarray(value, leaf.sensor.dtype).reshape(shape) for value in values])
            except (TypeError, ValueError) as error:
                raise DatasetError(
                    f"{name} gave {leaf.sensor.name} of another shape than its space says: {error}."
                ) from error
            readings[leaf.sensor.name] = Readings(time_s[: len(values)], rows.from_stored(stacked, leaf.sensor))
    for role in (rows.REWARD, rows.DONE, rows.TRUNCATED):
        readings[role] = Readings(time_s[:-1], np.asarray(found[role], sensors[role].dtype)[:, None])
    return Take(readings, task, facts={"seed": seed, **({"texts": texts} if texts else {})})
