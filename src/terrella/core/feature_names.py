"""The names of channels as features of LeRobot's recordings and policies, and back: `rgb.wrist` is observation.images.wrist."""

import re
from collections.abc import Iterable

from .errors import DatasetError

RGB, DEPTH, STATE, POSE = "observation.images.rgb", "observation.depth", "observation.state", "observation.pose"
ACTION, REWARD, DONE = "action", "next.reward", "next.done"
POSE_NAMES = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
MOST_LETTERS = 200
NAME = re.compile(rf"\w[\w.-]{{0,{MOST_LETTERS}}}")  # valid name of a feature, which also names files and folders
RENAMED = {"cast": "objects"}  # channel of old recordings -> its name now
_MAIN = {"rgb": RGB, "depth": DEPTH, "pose": STATE, "reward": REWARD, "done": DONE, "observation": "observation"}
_IMAGES = "observation.images."


def feature_of(channel: str) -> str:
    """The feature that holds a channel: rgb.wrist -> observation.images.wrist, depth.wrist -> observation.depth.wrist; of the main
    camera observation.images.rgb, observation.depth and observation.state (its pose)."""
    kind, _, suffix = channel.partition(".")
    if channel in _MAIN:
        return _MAIN[channel]
    return f"{_IMAGES}{suffix}" if kind == "rgb" and suffix else f"observation.{channel}"


def channel_of(feature: str, names: Iterable[str] = ()) -> str:
    """The inverse of `feature_of`, for other writers' features too; `names` of its numbers, () where unknown."""
    if feature in (STATE, POSE):
        return "pose" if tuple(names) == POSE_NAMES else feature.removeprefix("observation.")
    for channel, known in _MAIN.items():
        if feature == known:
            return channel
    if feature.startswith(_IMAGES):
        return f"rgb.{feature.removeprefix(_IMAGES)}"
    channel = feature.removeprefix("observation.")
    return RENAMED.get(channel, channel)


def current_feature(feature: str) -> str:
    """The name now of a feature of an old recording."""
    channel = feature.removeprefix("observation.")
    return f"observation.{RENAMED[channel]}" if channel in RENAMED and channel != feature else feature


def file_name(feature: str) -> str:
    """A name that a feature, which names files, can have: "arm/pos" gives "arm_pos"."""
    plain = re.sub(r"[^\w.-]", "_", feature)[:MOST_LETTERS]
    return plain if NAME.fullmatch(plain) else f"_{plain}"


def features_of(channels: Iterable[str]) -> dict[str, str]:
    """channel -> feature, for all channels of one world. Beside a channel `state`, the pose is observation.pose. Letters that no
    file name may have become "_": "arm/pos" is observation.arm_pos. DatasetError where two channels would share a feature."""
    features: dict[str, str] = {}
    channels = list(channels)
    for channel in channels:
        feature = POSE if channel == "pose" and "state" in channels else feature_of(channel)
        feature = file_name(feature)
        for other, taken in features.items():
            if taken.lower() == feature.lower():
                raise DatasetError(f"the channels '{other}' and '{channel}' would both be {feature}; rename one.")
        features[channel] = feature
    return features
