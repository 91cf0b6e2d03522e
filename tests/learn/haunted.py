"""The corridor with a thing in it that moves along with the player, marked in pictures and told apart."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from gymnasium import spaces
from tests.data.corridor import DEPTH, Corridor

from terrella.space.camera import yaw
from terrella.worlds.objects import ROWS


class Haunted(Corridor):
    """The corridor with a thing before the middle of the picture, 1.5 m away, and a health that falls as one walks."""

    def __init__(self):
        super().__init__(goal_m=12.0)
        mask = spaces.Box(0, 1, DEPTH, np.bool_)  # pyright: ignore[reportCallIssue, reportArgumentType]
        more = {"things": mask, "health": spaces.Box(0, 100, (), np.float32)}
        self.spec = replace(self.spec, channels={**self.spec.channels, **more})

    def render(self, state, channels):
        seen = super().render(state, [name for name in channels if name not in ("things", "health")])
        mark = torch.zeros(1, *DEPTH, dtype=torch.bool)
        mark[:, 4:8, 6:10] = True
        if "depth" in seen:
            seen["depth"] = torch.where(mark, 1.5, seen["depth"])
        more = {"things": mark, "health": (100 - (state["walked"] * 8).round()).float()}
        return {name: more[name] if name in more else seen[name] for name in channels}


class Peopled(Haunted):
    """The same, told apart: the thing keeps 1.5 m before the eye."""

    def __init__(self):
        super().__init__()
        marks = spaces.Box(0, ROWS, DEPTH, np.uint8)  # pyright: ignore[reportCallIssue, reportArgumentType]
        more = {"instances": marks, "objects": spaces.Box(-np.inf, np.inf, (ROWS, 4), np.float32)}
        self.spec = replace(self.spec, channels={**self.spec.channels, **more})

    def render(self, state, channels):
        seen = super().render(state, [*{*channels, "things", "pose"} - {"objects", "instances"}])
        x, y, z, *_ = seen["pose"][0].tolist()
        heading = float(yaw(seen["pose"])[0])
        seen["instances"] = seen["things"].to(torch.uint8)
        seen["objects"] = torch.zeros(1, ROWS, 4)
        listed = [5.0, x + 1.5 * math.cos(heading), y + 1.5 * math.sin(heading), z - 0.5]
        seen["objects"][0, 0] = torch.tensor(listed)
        return {name: seen[name] for name in channels}
