"""Goals as a person writes them: a picture file, numbers, CHANNEL=VALUE, or the word reward."""

import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError

from ..core.errors import ObservationError, PlanningError, TerrellaError
from ..core.spec import Spec, kind_of
from ..core.world import Observation, World, make_rng

REWARD = "reward"
PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".gif")
_WILDCARDS = ("_", "any", "nan")
_NO_STATE = (
    "reward", "done", "uncertainty", "drifted", "invented", "truncated", "snapshot", "latent", "text", "instruction",
)  # fmt: skip


def read_goal(text: str, spec: Spec) -> dict[str, torch.Tensor]:
    """The goal that `text` describes: {} for "reward", else channel -> value [*shape]. TerrellaError where it does not fit."""
    if text == REWARD:
        return {}
    name, equals, value = text.partition("=")
    if equals and not Path(text).exists():
        spec.check_channels((name,))
        return {name: _value(value, name, spec)}
    if text.lower().endswith(PICTURES):
        if "rgb" not in spec.channels:
            raise ObservationError(f"{spec.name} shows no pictures; give a state, or CHANNEL=VALUE.")
        return {"rgb": _picture(Path(text), spec, "rgb")}
    channel = state_channel(spec)
    return {channel: _value(text, channel, spec)}


def is_observation(text: str) -> bool:
    """Whether a goal of skills is a picture, CHANNEL=VALUE or numbers, not words."""
    name, equals, _ = text.partition("=")
    if (equals and len(name.split()) == 1) or text.lower().endswith((*PICTURES, ".npy", ".json")):
        return True
    words = [word.strip() for word in text.strip("[]() ").split(",")]
    return all(word in _WILDCARDS or _is_number(word) for word in words)


def _is_number(word: str) -> bool:
    try:
        float(word)
        return True
    except ValueError:
        return False


def with_estimated_pose(goal: Observation, world: World) -> Observation:
    """A goal that is one picture [1, ...], with the pose where the world localises it; any other goal as it is."""
    if set(goal) != {"rgb"} or not {"rgb", "pose"} <= set(world.spec.channels):
        return goal
    try:
        return {**goal, **world.render(world.observe(goal, None, make_rng(0)), ("pose",))}
    except TerrellaError:
        return goal


def state_channel(spec: Spec) -> str:
    """The channel that holds the state as a vector: `observation`, or the first vector. PlanningError where there is none."""
    plain = {name: space for name, space in spec.channels.items() if kind_of(name) not in _NO_STATE}
    vectors = [name for name, space in plain.items() if len(space.shape or ()) == 1]
    if not vectors:
        raise PlanningError(f"{spec.name} has no state of numbers; its channels are {', '.join(spec.channels)}.")
    return "observation" if "observation" in vectors else vectors[0]


def _value(text: str, name: str, spec: Spec) -> torch.Tensor:
    """The value of a channel: numbers with commas (_ matches any), a .npy or .json file, or a picture file."""
    path = Path(text)
    if text.lower().endswith(PICTURES):
        return _picture(path, spec, name)
    try:
        if path.suffix == ".npy":
            array = np.load(path, allow_pickle=False)
        elif path.suffix == ".json":
            array = np.asarray(json.loads(path.read_text(encoding="utf-8")), np.float64)
        else:
            words = [word.strip() for word in text.strip("[]() ").split(",")]
            array = np.array([np.nan if word in _WILDCARDS else float(word) for word in words])
    except FileNotFoundError as error:
        raise TerrellaError(f"there is no file {text}.") from error
    except (ValueError, OSError) as error:
        raise TerrellaError(
            f"'{text}' is no goal: give a picture file, numbers as in 0.5,_,0 (_ matches any), CHANNEL=VALUE, or reward."
        ) from error
    shape = tuple(spec.channels[name].shape or ())
    array = array.reshape(()) if array.size == 1 and shape == () else array
    if array.shape != shape:
        raise ObservationError(
            f"the goal for '{name}' has {array.size} numbers, where {spec.name} has the shape {shape}."
        )
    return torch.from_numpy(array.astype(np.float32))


def _picture(path: Path, spec: Spec, name: str) -> torch.Tensor:
    try:
        with Image.open(path) as image:
            array = np.asarray(image.convert("RGB"))
    except FileNotFoundError as error:
        raise TerrellaError(f"there is no picture {path}.") from error
    except (UnidentifiedImageError, OSError) as error:
        raise TerrellaError(f"{path} is no picture that can be read ({error}).") from error
    shape = tuple(spec.channels[name].shape or ())
    if array.shape != shape:
        raise ObservationError(
            f"{path} has {array.shape[0]} x {array.shape[1]} pixels, where {spec.name} sees {shape[0]} x {shape[1]}."
        )
    return torch.from_numpy(array.copy())
