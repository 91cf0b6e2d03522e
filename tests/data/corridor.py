"""A first-person world in a few lines: rooms on a grid, seen by marching rays. Its truth is known without a game."""

from __future__ import annotations

import numpy as np
import torch
from gymnasium import spaces

from terrella.core import Camera, Spec, State

BUTTONS = ("MOVE_FORWARD", "MOVE_BACKWARD", "MOVE_LEFT", "MOVE_RIGHT", "TURN_LEFT", "TURN_RIGHT")
MAP = (
    "##########",
    "#   #    #",
    "#        #",
    "#   #    #",
    "## ###  ##",
    "#   #    #",
    "#   #    #",
    "##########",
)
CELL_M = 2.0
WALLS = np.array([[place == "#" for place in line] for line in MAP])
HEIGHT, WIDTH, DEPTH = 48, 64, (12, 16)


class Corridor:
    """batch 1; starts in the first room; `done` never, unless `goal_m` from the start is passed."""

    def __init__(self, goal_m: float = float("inf")):
        self.goal_m = goal_m
        self.spec = Spec(
            name="corridor",
            action=spaces.MultiBinary(6),
            channels={
                "rgb": spaces.Box(0, 255, (HEIGHT, WIDTH, 3), np.uint8),
                "depth": spaces.Box(0, np.inf, DEPTH, np.float32),
                "pose": spaces.Box(-np.inf, np.inf, (7,), np.float32),
                "reward": spaces.Box(-np.inf, np.inf, (), np.float32),
                "done": spaces.Box(0, 1, (), np.bool_),
            },
            observes=(),
            dt_s=1 / 35,
            units={"depth": "m"},
            action_names=BUTTONS,
            cameras={"rgb": Camera((0.5, 0.8, 0.5, 0.5), (HEIGHT, WIDTH))},
            max_batch=1,
        )

    def start(self, batch: int, rng: torch.Generator) -> State:
        yaw = float(torch.rand(1, generator=rng)) * 6.28
        return State({"where": torch.tensor([[3.1, 3.1, yaw]], dtype=torch.float64), "walked": torch.zeros(1)})

    def observe(self, observation, prior, rng) -> State:
        return prior if prior is not None else self.start(1, rng)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        x, y, yaw = state["where"][0].tolist()
        forward, backward, left, right, turn_left, turn_right = action[0].tolist()
        yaw += 0.06 * (turn_left - turn_right)
        go, side = 0.25 * (forward - backward), 0.2 * (left - right)
        new_x = x + go * np.cos(yaw) - side * np.sin(yaw)
        new_y = y + go * np.sin(yaw) + side * np.cos(yaw)
        x = new_x if _free(new_x, y) else x  # slides along walls
        y = new_y if _free(x, new_y) else y
        walked = state["walked"] + float(np.hypot(go, side))
        return State({"where": torch.tensor([[x, y, yaw]], dtype=torch.float64), "walked": walked})

    def render(self, state: State, channels) -> dict[str, torch.Tensor]:
        x, y, yaw = state["where"][0].tolist()
        done = state["walked"] > self.goal_m
        seen = {}
        for name in channels:
            if name == "pose":
                pose = [x, y, 1.0, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
                seen[name] = torch.tensor([pose], dtype=torch.float32)
            elif name == "depth":
                columns = torch.from_numpy(_depth(x, y, yaw, DEPTH[1])).float()
                seen[name] = columns.expand(1, *DEPTH).contiguous()
            elif name == "rgb":
                seen[name] = torch.from_numpy(picture(x, y, yaw))[None]
            elif name == "reward":
                seen[name] = done.float() + x
            else:
                seen[name] = done
        return seen


class Keys:
    """A policy that changes its keys every five steps; its memory is the keys held and the step."""

    def begin(self, batch, rng):
        return [(torch.zeros(1, 6, dtype=torch.int8), 0)] * batch

    def act(self, observation, memory, rng):
        held = [torch.randint(2, (1, 6), generator=rng, dtype=torch.int8) if n % 5 == 0 else now for now, n in memory]
        return torch.cat(held), [(now, n + 1) for now, (_, n) in zip(held, memory)]


keys = Keys()


def _free(x: float, y: float) -> bool:
    return not any(WALLS[int((y + dy) // CELL_M), int((x + dx) // CELL_M)] for dx in (-0.4, 0.4) for dy in (-0.4, 0.4))


def _depth(x: float, y: float, yaw: float, columns: int) -> np.ndarray:
    """float64 [columns]: depth along the optical axis, left to right."""
    slope = ((np.arange(columns) + 0.5) / columns - 0.5) / 0.5
    step = np.arange(1, 420) * 0.05
    at_x = x + step * (np.cos(yaw) + slope[:, None] * np.sin(yaw))
    at_y = y + step * (np.sin(yaw) - slope[:, None] * np.cos(yaw))
    row = (at_y // CELL_M).astype(int).clip(0, WALLS.shape[0] - 1)
    column = (at_x // CELL_M).astype(int).clip(0, WALLS.shape[1] - 1)
    return step[WALLS[row, column].argmax(1)]


def picture(x: float, y: float, yaw: float) -> np.ndarray:
    """A smooth picture, uint8 [HEIGHT, WIDTH, 3], that moves with the pose."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] / np.array([HEIGHT, WIDTH])[:, None, None]
    light = 0.5 + 0.2 * np.sin(4 * (u + yaw)) + 0.2 * np.cos(3 * v + x / 2)
    return (255 * np.stack([light, 0.8 * light, light * 0.3 + 0.02 * y], -1)).clip(0, 255).astype(np.uint8)
