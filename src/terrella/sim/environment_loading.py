"""Opens Gymnasium environments, and says in one sentence why one does not open, start or draw."""

from __future__ import annotations

import os
import re
import runpy
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from ..core.errors import TerrellaError
from . import islet  # noqa: F401  it registers Islet-v0

_DISPLAY = re.compile(r"display|video device|gl context|\b(glfw|opengl|egl|osmesa|x11|glx|xlib)\b")

_EXTRA = re.compile(r"gymnasium\[(box2d|mujoco)\]")  # what Gymnasium asks for, and we under the same name


def build(env: str | Callable[[], gymnasium.Env], rgb: bool, options: dict) -> tuple[gymnasium.Env, str]:
    """(environment, name) of an id, "module:Id", or of a function. One from an id is made
    without its limit; modules are found in the working directory too. TerrellaError says why it cannot be."""
    if callable(env):
        built = env()
        return built, f"gym:{built.spec.id if built.spec else type(built.unwrapped).__name__}"
    if ":" in env and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())  # as `python -m` does
    options = {"max_episode_steps": -1, "disable_env_checker": True, **options}
    module = env.partition(":")[0] if ":" in env else ""
    with explained(f"gym:{env}", "made", module):
        try:
            built = gymnasium.make(env, **options)
            if rgb and "rgb_array" in (built.metadata.get("render_modes") or ()):
                built.close()
                built = gymnasium.make(env, render_mode="rgb_array", **options)
                follow(built)
            return built, f"gym:{env}"
        except (gymnasium.error.NameNotFound, gymnasium.error.NamespaceNotFound) as error:
            said = _ended(error).replace("mean: ", "mean ")
            hint = (
                "" if module or "Did you mean" in said else " If its package is installed, say which: gym:PACKAGE:ID."
            )
            raise TerrellaError(f"Gymnasium cannot make '{env}': {said}{hint}") from error
        except (gymnasium.error.Error, TypeError) as error:
            if extra := _EXTRA.search(str(error)):
                raise TerrellaError(
                    f"'{env}' needs packages that are not installed: pip install 'terrella[{extra[1]}]'."
                ) from error
            raise TerrellaError(f"Gymnasium cannot make '{env}': {error}") from error


def follow(env: gymnasium.Env) -> None:
    """Has a MuJoCo environment drawn by its model's camera `track` where its own view follows nothing, so that who runs stays in
    the picture."""
    renderer = getattr(env.unwrapped, "mujoco_renderer", None)
    if renderer is None or renderer.camera_id != -1 or "trackbodyid" in (renderer.default_cam_config or {}):
        return
    cameras = [renderer.model.camera(number).name for number in range(renderer.model.ncam)]
    if "track" in cameras:
        renderer.camera_id = cameras.index("track")


@contextmanager
def explained(name: str, doing: str, module: str = "") -> Iterator[None]:
    """Whatever an environment raises while it is made, reset or drawn becomes one sentence; `module`: where it is looked for."""
    try:
        yield
    except (TerrellaError, KeyboardInterrupt):
        raise
    except Exception as error:
        raise TerrellaError(_sentence(name, doing, module, error)) from error


def _sentence(name: str, doing: str, module: str, error: Exception) -> str:
    text = f"{type(error).__module__}.{type(error).__name__}: {error}".lower()
    missing = getattr(error.__cause__, "name", None) or getattr(
        error, "name", None
    )  # Gymnasium raises another in its place
    if isinstance(error, ModuleNotFoundError) and missing and module and missing == module[: len(missing)]:
        return (
            f"there is no Python module '{module}' to find {name} in; pip install the package that has it, or run this in the "
            f"folder of {missing}.py."
        )
    if isinstance(error, ModuleNotFoundError) and missing:
        return f"{name} needs the package '{missing}', which is not installed: pip install it."
    if _DISPLAY.search(text):
        return (
            f"{name} cannot draw without a display ({_ended(error)}) Set MUJOCO_GL=egl or MUJOCO_GL=osmesa for MuJoCo, "
            "PYGLET_HEADLESS=true for pyglet, SDL_VIDEODRIVER=dummy for pygame, or run it under xvfb-run."
        )
    return f"{name} fails when it is {doing}, by an error of its own: {type(error).__name__}: {_ended(error)}"


def _ended(error: Exception) -> str:
    """Its first line, as a sentence."""
    first = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(". ")
    return first if first.endswith("?") else f"{first}."


def picture_size(env: gymnasium.Env, name: str) -> tuple[int, int] | None:
    """(height, width) of the picture that a freshly reset environment draws, or None."""
    if env.render_mode != "rgb_array":
        return None
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # its greeting would go to stdout, among our results
    with explained(name, "drawn"):
        try:
            picture = env.render()
        except gymnasium.error.DependencyNotInstalled:
            return None
    if not isinstance(picture, np.ndarray) or picture.ndim != 3 or picture.shape[2] != 3:
        return None
    return picture.shape[0], picture.shape[1]


def load_adapter(source: str) -> Any:
    """The `adapter` of a Python file, or of "FILE.py:NAME" the object of that name; TerrellaError where there is none."""
    path, _, name = source.partition(":")
    name = name or "adapter"
    if not Path(path).is_file():
        raise TerrellaError(f"there is no file {path}; --adapter takes a Python file, or FILE.py:NAME.")
    try:
        found = runpy.run_path(path).get(name)
    except Exception as error:
        raise TerrellaError(f"{path} fails: {type(error).__name__}: {_ended(error)}") from error
    if found is None:
        raise TerrellaError(f"{path} has no '{name}'; it ends with adapter = Adapter(...), or name it as {path}:NAME.")
    return found() if isinstance(found, type) else found
