"""Seconds that one step of a Gymnasium environment lasts: from its own clock, control rate, time step or frame rate."""

import ast
import inspect
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from fractions import Fraction
from operator import attrgetter
from textwrap import dedent
from types import SimpleNamespace
from typing import Any

import gymnasium

from .errors import TerrellaError
from .numbers import single_number
from .spec import Spec, neutral_action

# Simulated time in seconds, in attributes of the bare environment.
_SIMULATORS = ("data.time", "sim.data.time", "physics.data.time", "_env.physics.data.time")
_CLOCKS = ("time", "sim_time", "simulation_time", "_time")
# By name the rate, or the length, of a step of the environment.
_RATES = (
    "control_freq", "control_frequency", "control_hz", "control_rate", "ctrl_freq", "policy_freq", "policy_frequency",
)  # fmt: skip
_PERIODS = ("control_timestep", "control_dt", "ctrl_timestep", "ctrl_dt", "step_dt")
# The length of a step of the environment or of its physics; of its physics alone; and how many of these a step has.
_STEPS = ("dt", "tau", "timestep", "sim.dt")
_PHYSICS = ("physics_dt", "sim_dt", "sim_timestep", "physics_timestep", "model.opt.timestep", "sim.model.opt.timestep")
_COUNTS = (
    "frame_skip", "n_substeps", "num_substeps", "substeps", "sim_steps", "decimation", "action_repeat",
)  # fmt: skip
_HOLDS = ("skip", "frameskip", "actionrepeat")  # of wrappers, without underscores
_FRAMES = ("render_fps", "video.frames_per_second", "fps")
_OWNERS = ("_env", "config", "cfg")  # parts of the bare environment, or its settings, that may hold the control rate
_UNIT = re.compile(r"\s*(fps|hz)\s*$", re.IGNORECASE)
_TRIAL_STEPS, _LONGEST_S = 3, 60.0


def step_length(env: gymnasium.Env) -> tuple[float | None, str]:
    """(seconds that one step of `env` lasts, where they come from and what else the environment says); (None, ...) where it
    says nothing.

    `env` has been reset; one with a clock is stepped up to three times. In this order: the advance of its simulated time
    (MuJoCo's `data.time`, or a `time` that all steps advance alike); a control rate; a time step, times its substeps where it
    counts them. A time step of which two or more make a frame of `render_fps` is a substep, and the frame is the step, unless
    the source of `step` repeats nothing. Without any of these, the frame.
    """
    frame, remark = _frame(env)
    held, suffix = _held(env)
    declared = _control(env) | _stepped(env, frame) | frame
    stated = {f"{name}{suffix}": length * held for name, length in declared.items()}
    measured = _measured(env)
    if not measured and not stated:
        return None, "; ".join(["no rate is declared", *remark])
    chosen, seconds = next(iter((measured or stated).items()))
    others = {name: other for name, other in stated.items() if not math.isclose(other, seconds, rel_tol=0.02)}
    differing = [f"by its {name} it would be {1 / other:g}" for name, other in others.items()]
    return seconds, "; ".join([f"its {chosen}", *differing, *(["--fps sets another"] if differing else []), *remark])


def infos_of_step(env: gymnasium.Env) -> list[str]:
    """The keys of `info` after a step of an environment that was reset; [] where the step fails."""
    with suppress(Exception):  # foreign code: its own errors are reported where it is stepped in earnest
        return [str(key) for key in env.step(_trial(env))[4]]
    return []


def _trial(env: gymnasium.Env) -> Any:
    """The neutral action; of a Dict or Tuple, which no Spec has, a random one."""
    try:
        return neutral_action(Spec("trial", env.action_space, {}, (), 1.0))[()]
    except TerrellaError:
        return env.action_space.sample()


def _measured(env: gymnasium.Env) -> dict[str, float]:
    """{clock: seconds that each step advances it}; {} where no clock is one."""
    clocks = {name: now for name in (*_SIMULATORS, *_CLOCKS) if isinstance(now := _at(env.unwrapped, name), float)}
    if not clocks:
        return {}
    times = {name: [now] for name, now in clocks.items()}
    try:
        action = _trial(env)
        for _ in range(_TRIAL_STEPS):
            _, _, terminated, truncated, _ = env.step(action)
            for name, seen in times.items():
                seen.append(float(_at(env.unwrapped, name)))
            if terminated or truncated:
                break
    except Exception:  # foreign code: its own errors are reported where it is stepped in earnest
        return {}
    for name, seen in times.items():
        steps = [after - before for before, after in zip(seen, seen[1:])]
        alike = all(math.isclose(step, steps[0], rel_tol=1e-3) for step in steps)
        own = name in _SIMULATORS or (len(steps) > 1 and steps[0] != 1)  # 1: it counts steps
        if steps and alike and own and 1e-5 < steps[0] < _LONGEST_S:
            return {f"clock `{name}`": float(f"{steps[0]:.6g}")}
    return {}


def _held(env: gymnasium.Env) -> tuple[float, str]:
    """(steps of the bare environment for which wrappers hold an action, ", held ... times" or "")."""
    held, layer = 1.0, env
    while isinstance(layer, gymnasium.Wrapper):
        names = {name.replace("_", "").lower(): value for name, value in vars(layer).items()}
        held *= next((count for name in _HOLDS if (count := _number(names.get(name)))), 1.0)
        layer = layer.env
    return held, f", held {held:g} times by a wrapper" if held > 1 else ""


def _control(env: gymnasium.Env) -> dict[str, float]:
    parts = {f"{name}.": part for name in _OWNERS if (part := getattr(env.unwrapped, name, None)) is not None}
    for prefix, part in {"": env.unwrapped, **parts}.items():
        owner = SimpleNamespace(**{str(key): it for key, it in part.items()}) if isinstance(part, Mapping) else part
        rates = {name: 1 / rate for name, rate in _positive(owner, _RATES)}
        for name, length in {**rates, **dict(_positive(owner, _PERIODS))}.items():
            return {f"{prefix}{name}": length}
    return {}


def _stepped(env: gymnasium.Env, frame: dict[str, float]) -> dict[str, float]:
    """{what declares the step: seconds, ...}, the step first, from time steps, their number, and the length of a frame."""
    count_name, count = next(iter(_positive(env.unwrapped, _COUNTS)), ("", 1.0))
    steps, physics = dict(_positive(env.unwrapped, _STEPS)), dict(_positive(env.unwrapped, _PHYSICS))
    frame_s = next(iter(frame.values()), None)
    lengths: dict[str, float] = {}
    for name, length in {**steps, **physics}.items():
        computed = isinstance(getattr(type(env.unwrapped), name, None), property)  # as MujocoEnv.dt: it counts them
        counted = name in steps and (computed or _nearer(length, length * count, frame_s))
        if count == 1 or counted:
            lengths[name] = length
        else:
            lengths[f"{name} x {count_name}"] = length * count
    if count > 1 or frame_s is None or not lengths:
        return lengths
    name, length = next(iter(lengths.items()))
    multiple = frame_s / length
    if (name in physics and not math.isclose(multiple, 1, rel_tol=0.02)) or (_whole(multiple) and _repeats(env)):
        return {**frame, f"{name}, a substep,": length}
    return lengths


def _nearer(one: float, other: float, frame_s: float | None) -> bool:
    """Whether the first of two lengths is nearer to that of a frame, as a ratio."""
    return frame_s is not None and abs(math.log(one / frame_s)) < abs(math.log(other / frame_s))


def _whole(multiple: float) -> bool:
    return multiple > 1.5 and math.isclose(multiple, round(multiple), rel_tol=0.1)


def _repeats(env: gymnasium.Env) -> bool:
    """Whether a step has a loop that counts, in `step` or in a method of its own that it calls; True where it has no source."""
    waiting, names = ["step"], set[str]()
    while waiting:
        name = waiting.pop()
        names.add(name)
        try:
            bodies = [vars(kind)[name] for kind in type(env.unwrapped).__mro__ if name in vars(kind)]
            sources = [inspect.getsource(getattr(body, "__func__", body)) for body in bodies]
            nodes = [node for source in sources for node in ast.walk(ast.parse(dedent(source)))]
        except (OSError, TypeError, SyntaxError):
            return True
        if any(isinstance(node, ast.While) or (isinstance(node, ast.For) and _counts(node.iter)) for node in nodes):
            return True
        calls = (node.func for node in nodes if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute))
        own = {call.attr for call in calls if ast.unparse(call.value) in ("self", "super()")}
        waiting += [one for one in own - names - {*waiting} if "render" not in one]
    return False


def _counts(loop: ast.expr) -> bool:
    return isinstance(loop, ast.Call) and ast.unparse(loop.func) == "range"


def _frame(env: gymnasium.Env) -> tuple[dict[str, float], list[str]]:
    """({frame rate: seconds of a frame}, [what cannot be read])."""
    metadata = getattr(env, "metadata", None) or {}
    for name in _FRAMES:
        if (stated := metadata.get(name)) is not None:
            rate = _number(stated)
            return ({name: 1 / rate}, []) if rate else ({}, [f"its {name}, {stated!r}, is no rate"])
    return {}, []


def _positive(owner: Any, names: tuple[str, ...]) -> Iterator[tuple[str, float]]:
    """(name, number) of the attributes that are positive numbers; frame_skip may be spelled _frameSkip or FRAME_SKIP."""
    spelled = {name.replace("_", "").lower(): name for name in reversed(dir(owner))}
    for name in names:
        own = spelled.get(name.replace("_", ""), name)
        if number := _number(_at(owner, own)):
            yield own, number


def _at(owner: Any, path: str) -> Any:
    """The value at a path of attributes; the result, where it is a method; None where there is none."""
    try:
        value = attrgetter(path)(owner)
        return value() if callable(value) else value
    except Exception:  # foreign code, whose answer is optional
        return None


def _number(value: Any) -> float | None:
    """A positive finite number, or text that spells one ("30", "30 fps", "30000/1001"); else None."""
    try:
        number = float(Fraction(_UNIT.sub("", value))) if isinstance(value, str) else single_number(value, "")
    except (TerrellaError, ValueError, ZeroDivisionError):
        return None
    return number if not isinstance(value, bool) and 0 < number < math.inf else None
