"""Rollouts of a Gymnasium environment, drawn when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import gymnasium
import numpy as np

from ...core.errors import DatasetError
from ...data.source import Readings, Sensor, Source, Take
from . import rows, spaces

_MOST_STEPS = 1000


def from_env(
    env_or_id: str | gymnasium.Env | Callable[[], gymnasium.Env],
    policy: Callable[[object], object] | None = None,
    episodes: int = 10,
    seed: int = 0,
    fps: float | None = None,
    render: bool = False,
    max_steps: int = _MOST_STEPS,
) -> Source:
    """Rollouts of a Gymnasium environment, collected when a take is asked for; the same at each call of `takes`.

    env_or_id: an id, an environment (used as it is, and not closed), or a function that makes one.
    policy:    policy(observation) -> action; None draws from the action space, seeded.
    fps:       rows a second; by default from the environment's dt or tau, else its render_fps, else rows.FPS_UNKNOWN.
    render:    also keep what it draws, as "observation.images.render" (an environment handed over must have been made
               with render_mode="rgb_array").
    max_steps: an episode is cut (truncated) after so many.

    Observations are one more than actions: the one after the last step is kept. Spaces are flattened as in minari.read.
    DatasetError for unknown ids, spaces that are not arrays, and environments that draw nothing.
    """
    if episodes < 1 or max_steps < 1:
        raise DatasetError(f"{episodes} episodes of {max_steps} steps are no recording; ask for 1 or more of each.")
    rows.check_fps(fps, "the rollout")
    env, name = _make(env_or_id, render)
    observation, action = spaces.to_json(env.observation_space), spaces.to_json(env.action_space)
    plan = {
        "observations": spaces.leaves(rows.OBSERVATION, observation, name),
        "actions": spaces.leaves(rows.ACTION, action, name),
    }
    sensors = {leaf.sensor.name: leaf.sensor for leaf in (*plan["observations"], *plan["actions"]) if leaf.sensor}
    for role, kind in ((rows.REWARD, "float64"), (rows.DONE, "bool"), (rows.TRUNCATED, "bool")):
        sensors[role] = replace(rows.sensor_for("", role, (), kind), name=role)
    rate, notes = rows.rate_of(fps, _rate(env), name)
    camera = f"{rows.IMAGES}render"
    if render:
        env.reset(seed=seed)
        shape = np.shape(_drawn(env, name))
        sensors[camera] = Sensor(camera, "image", shape, "uint8", rate_hz=rate)
    _close(env, env_or_id)

    def takes() -> Iterator[Take]:
        env, _ = _make(env_or_id, render)
        try:
            for number in range(episodes):
                yield _rollout(
                    env, policy, plan, sensors, seed, number, rate, camera if render else "", max_steps, name
                )
        finally:
            _close(env, env_or_id)

    facts = {"observation_space": observation, "action_space": action, "env": name, "seed": seed}
    return Source(name, sensors, takes, rate, notes=notes, facts=facts)


def _make(env_or_id, render: bool) -> tuple[gymnasium.Env, str]:
    if isinstance(env_or_id, str):
        try:
            env = gymnasium.make(env_or_id, render_mode="rgb_array" if render else None)
        except (gymnasium.error.Error, ImportError, TypeError, ValueError) as error:
            raise DatasetError(
                f"the environment '{env_or_id}' cannot be made: {str(error).splitlines()[0]}."
            ) from error
        return env, env_or_id
    env = env_or_id() if not isinstance(env_or_id, gymnasium.Env) and callable(env_or_id) else env_or_id
    if not isinstance(env, gymnasium.Env):
        raise DatasetError(
            f"{env!r} is no Gymnasium environment; give an id, an environment, or a function that makes one."
        )
    return env, env.spec.id if env.spec else type(env.unwrapped).__name__


def _close(env: gymnasium.Env, given) -> None:
    if env is not given:
        env.close()


def _rate(env: gymnasium.Env) -> float | None:
    """The environment's own word on how many of its steps make a second."""
    for name in ("dt", "tau"):
        dt_s = getattr(env.unwrapped, name, None)
        if isinstance(dt_s, int | float) and dt_s > 0:
            return 1 / dt_s
    told = env.metadata.get("render_fps")
    return float(told) if isinstance(told, int | float) and told > 0 else None


def _drawn(env: gymnasium.Env, name: str) -> np.ndarray:
    drawn = env.render()
    if not isinstance(drawn, np.ndarray) or drawn.dtype != np.uint8 or drawn.ndim != 3 or drawn.shape[2] != 3:
        raise DatasetError(f"{name} draws no pictures; make it with render_mode='rgb_array', or leave out render.")
    return drawn


def _rollout(
    env, policy, plan, sensors, seed: int, number: int, fps: float, camera: str, max_steps: int, name: str
) -> Take:
    draw = np.random.SeedSequence([seed, number]).generate_state(2)
    seen, _ = env.reset(seed=int(draw[0]))
    env.action_space.seed(int(draw[1]))
    observations, actions, rewards, done, cut, pictures = [seen], [], [], [], [], []
    pictures += [_drawn(env, name)] if camera else []
    while len(actions) < max_steps and not (done and (done[-1] or cut[-1])):
        action = env.action_space.sample() if policy is None else policy(seen)
        seen, reward, terminated, truncated, _ = env.step(action)
        observations.append(seen)
        actions.append(action)
        rewards.append(float(reward))
        done.append(bool(terminated))
        cut.append(bool(truncated))
        pictures += [_drawn(env, name)] if camera else []
    cut[-1] = cut[-1] or not done[-1]
    time_s = np.arange(len(observations)) / fps
    readings, task, texts = {}, "", {}
    for root, values in (("observations", observations), ("actions", actions)):
        for leaf in plan[root]:
            found = [_at(value, leaf.path) for value in values]
            if leaf.sensor is None:
                if leaf.is_instruction and len(set(found)) == 1 and not task:
                    task = str(found[0])
                else:
                    texts["/".join(map(str, (root, *leaf.path)))] = [str(text) for text in found]
                continue
            shape = rows.stored_shape(leaf.sensor)
            try:
                stacked = np.stack([np.asarray(value, leaf.sensor.dtype).reshape(shape) for value in found])
            except (TypeError, ValueError) as error:
                raise DatasetError(
                    f"{name} gave {leaf.sensor.name} of another shape than its space says: {error}."
                ) from error
            readings[leaf.sensor.name] = Readings(time_s[: len(found)], rows.from_stored(stacked, leaf.sensor))
    for role, values in ((rows.REWARD, rewards), (rows.DONE, done), (rows.TRUNCATED, cut)):
        readings[role] = Readings(time_s[:-1], np.asarray(values, sensors[role].dtype)[:, None])
    if camera:
        readings[camera] = Readings(time_s, np.stack(pictures))
    return Take(readings, task, facts={"seed": int(draw[0]), **({"texts": texts} if texts else {})})


def _at(value, path: tuple):
    for part in path:
        value = value[part]
    return value
