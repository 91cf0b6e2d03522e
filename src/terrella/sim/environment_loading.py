"""Makes Gymnasium environments, and explains in one sentence why one cannot be made, reset or rendered."""

import importlib
import os
import re
import runpy
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium

from ..core.errors import TerrellaError
from . import islet  # noqa: F401  it registers Islet-v0
from .drawn_pictures import DrawnPictures

_DISPLAY = re.compile(r"display|video device|gl context|\b(glfw|opengl|egl|osmesa|x11|glx|xlib)\b")

_PACKAGES = {"BabyAI-": "minigrid", "MiniGrid-": "minigrid"}  # beginnings of ids, and the modules that register them
_EXTRA = re.compile(r"gymnasium\[(box2d|mujoco)\]")  # extras of Gymnasium that are also ours


def build(env: str | Callable[[], gymnasium.Env], rgb: bool, options: dict) -> tuple[gymnasium.Env, str]:
    """(environment, name) of an id, "module:Id" or a function. An id is made without its time limit; modules are also searched in
    the working directory. TerrellaError where it cannot be made."""
    if callable(env):
        built = env()
        return built, f"gym:{built.spec.id if built.spec else type(built.unwrapped).__name__}"
    if ":" in env and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())  # as `python -m` does
    options = {"max_episode_steps": -1, "disable_env_checker": True, **options}
    module = env.partition(":")[0] if ":" in env else ""
    package = next((one for begins, one in _PACKAGES.items() if env.startswith(begins)), "")
    with explained(f"gym:{env}", "made", module):
        try:
            if package:
                importlib.import_module(package)
            built = gymnasium.make(env, **options)
            if rgb and "rgb_array" in _render_modes(built):
                built.close()
                built = gymnasium.make(env, render_mode="rgb_array", **options)
                use_tracking_camera(built)
            return built, f"gym:{env}"
        except (gymnasium.error.NameNotFound, gymnasium.error.NamespaceNotFound) as error:
            reason = _ended(error).replace("mean: ", "mean ")
            hint = (
                ""
                if module or "Did you mean" in reason
                else " If it is in an installed package, name it: gym:PACKAGE:ID."
            )
            raise TerrellaError(f"Gymnasium cannot make '{env}': {reason}{hint}") from error
        except (gymnasium.error.Error, TypeError) as error:
            if extra := _EXTRA.search(str(error)):
                raise TerrellaError(
                    f"'{env}' needs packages that are not installed: pip install 'terrella[{extra[1]}]'."
                ) from error
            raise TerrellaError(f"Gymnasium cannot make '{env}': {error}") from error


def use_tracking_camera(env: gymnasium.Env) -> None:
    """Renders a MuJoCo environment from its model's camera `track` if its default view is static, so that runners stay visible."""
    renderer = getattr(env.unwrapped, "mujoco_renderer", None)
    if renderer is None or renderer.camera_id != -1 or "trackbodyid" in (renderer.default_cam_config or {}):
        return
    cameras = [renderer.model.camera(number).name for number in range(renderer.model.ncam)]
    if "track" in cameras:
        renderer.camera_id = cameras.index("track")


@contextmanager
def explained(name: str, doing: str, module: str = "") -> Iterator[None]:
    """Turns every error of an environment while it is made, reset or rendered into a TerrellaError; `module`: its module."""
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
            f"the Python module '{module}' of {name} was not found; pip install its package, or run this in the folder of "
            f"{missing}.py."
        )
    if isinstance(error, ModuleNotFoundError) and missing:
        return f"{name} needs the package '{missing}', which is not installed: pip install it."
    if _DISPLAY.search(text):
        return (
            f"{name} cannot draw without a display ({_ended(error)}) Set MUJOCO_GL=egl or MUJOCO_GL=osmesa for MuJoCo, "
            "PYGLET_HEADLESS=true for pyglet, SDL_VIDEODRIVER=dummy for pygame, or run it under xvfb-run."
        )
    return f"{name} fails when it is {doing}, with its own error: {type(error).__name__}: {_ended(error)}"


def _ended(error: Exception) -> str:
    """The first line of an error, as a sentence."""
    first = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(". ")
    return first if first.endswith("?") else f"{first}."


def renders_pictures(env: gymnasium.Env) -> bool:
    """Whether `render()` gives a picture of the moment."""
    mode = str(env.render_mode)
    return mode.startswith("rgb") and not mode.endswith("_list")


def _render_modes(env: gymnasium.Env) -> Sequence[str]:
    return (getattr(env, "metadata", None) or {}).get("render_modes") or ()


def first_picture(env: gymnasium.Env, name: str, pictures: DrawnPictures) -> tuple[tuple[int, int] | None, str]:
    """((height, width) of the picture of an environment after a reset or None; why there is none)."""
    if not renders_pictures(env):
        made = f"it was made with render_mode={env.render_mode!r}, not 'rgb_array'"
        return None, made if "rgb_array" in _render_modes(env) else ""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # its greeting would mix with our output
    with explained(name, "drawn"):
        try:
            drawn = env.render()
        except gymnasium.error.DependencyNotInstalled as error:
            return None, _ended(error).rstrip(".")
    try:
        height, width = pictures.read(drawn).shape[:2]
    except TerrellaError as error:
        return None, str(error)
    return (height, width), ""


def load_adapter(source: str) -> Any:
    """The object `adapter` in a Python file, or NAME in "FILE.py:NAME"; TerrellaError where there is none."""
    path, _, name = source.partition(":")
    name = name or "adapter"
    if not Path(path).is_file():
        raise TerrellaError(f"there is no file {path}; --adapter takes a Python file, or FILE.py:NAME.")
    try:
        adapter = runpy.run_path(path).get(name)
    except Exception as error:
        raise TerrellaError(f"{path} fails: {type(error).__name__}: {_ended(error)}") from error
    if adapter is None:
        raise TerrellaError(f"{path} has no '{name}'; define adapter = Adapter(...), or give {path}:NAME.")
    return adapter() if isinstance(adapter, type) else adapter
