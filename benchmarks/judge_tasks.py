"""The environments that stable-worldmodel's harness judges in: who records them, what a solved start is, which goals are hard.

TwoRoom's expert comes with it. PushT's published recordings are people's and have to be fetched, so its are of `Pushing`, below.
Imported in the environment of `make judge` alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from judge_harness import Task  # before the rest: it mends torchvision
from stable_worldmodel.envs.two_room import ExpertPolicy
from stable_worldmodel.policy import BasePolicy

REACHED = 16.0  # pixels of 224: what TwoRoom calls reached
WALL = 112.0  # where the wall between the rooms stands
DOOR_MARGIN = 1.75  # pixels beside a door that TwoRoom still lets through

NEAR, TURNED = 20.0, np.pi / 9  # what PushT calls reached: pixels of 512 of pusher and block together, radians
MIDDLE = 45.0  # pixels from the block's origin to its middle
CLEAR = 105.0  # pixels from its middle at which the pusher passes it
BORDER, SIDE = 25.0, 512.0


def keeps_to_the_door(way: np.ndarray, goal: np.ndarray, room: Any) -> bool:
    """Whether a way [steps, S] is in the wall's stripe only where a door is (with the margin that TwoRoom itself leaves), and
    ends in the goal's own room (within REACHED may be through the wall)."""
    shares = np.linspace(0, 1, 6)[:, None, None]
    x, y = np.moveaxis(way[None, :-1, :2] * (1 - shares) + way[None, 1:, :2] * shares, 2, 0)
    inside = abs(x - WALL) <= room.wall_thickness // 2
    doors = zip(room.door_positions[: room.num_doors].tolist(), room.door_sizes[: room.num_doors].tolist())
    open_ = np.any([abs(y - centre) <= half + DOOR_MARGIN for centre, half in doors], axis=0)
    return not bool((inside & ~open_).any()) and bool((way[-1, 0] < WALL) == (goal[0] < WALL))


def _turned(states: np.ndarray, goals: np.ndarray) -> np.ndarray:
    return abs((states[..., 4] - goals[..., 4] + np.pi) % (2 * np.pi) - np.pi)


def block_moves(states: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Whether PushT's block alone is further from where it is to be than what counts as reached."""
    apart = np.linalg.norm(states[..., 2:4] - goals[..., 2:4], axis=-1)
    return (apart >= NEAR) | (_turned(states, goals) >= TURNED)


def pushed(states: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Whether PushT's goals count as reached."""
    apart = np.linalg.norm(states[..., :4] - goals[..., :4], axis=-1)
    return (apart < NEAR) & (_turned(states, goals) < TURNED)


class Pushing(BasePolicy):
    """Pushes PushT's block about, towards nothing: it goes round the block to a side, pushes straight on for a while, and again.
    Side, direction, speed and length are drawn; actions are noisy."""

    def __init__(self, seed: int, noise: float = 0.05):
        super().__init__()
        self._rng, self._noise, self._pushes = np.random.default_rng(seed), noise, dict[int, dict[str, Any]]()

    def get_action(self, infos: dict, **kwargs: Any) -> np.ndarray:
        states = np.asarray(infos["state"])[:, -1]
        return np.stack([self._act(number, state) for number, state in enumerate(states)]).astype(np.float32)

    def _act(self, number: int, state: np.ndarray) -> np.ndarray:
        agent, middle = state[:2], state[2:4] + MIDDLE * np.array([-np.sin(state[4]), np.cos(state[4])])
        push = self._pushes.get(number)
        if push is None or push["length"] <= 0 or push["patience"] <= 0:
            push = self._pushes[number] = self._drawn(middle)
        push["there"] |= bool(np.linalg.norm(push["start"] - agent) < 15)
        if push["there"]:
            way = push["way"]
            push["length"] -= 50 * push["speed"]  # a full action goes 50 pixels in a step
        else:
            way = _round(agent, push["start"], middle)
            push["patience"] -= 1
        return np.clip(push["speed"] * way + self._noise * self._rng.normal(size=2), -1, 1)

    def _drawn(self, middle: np.ndarray) -> dict[str, Any]:
        """A push that begins on the table and does not lead the block off it, if one is found in fifty."""
        for _ in range(50):
            angle, aside = self._rng.uniform(0, 2 * np.pi), self._rng.uniform(-55, 55)
            way = np.array([np.cos(angle), np.sin(angle)])
            start, end = middle - CLEAR * way + aside * np.array([-way[1], way[0]]), middle + 80 * way
            if ((start > BORDER) & (start < SIDE - BORDER) & (end > 110) & (end < SIDE - 110)).all():
                break
        speed, length = self._rng.uniform(0.15, 0.5), self._rng.uniform(90, 260)
        start = start.clip(BORDER, SIDE - BORDER)
        return {"start": start, "way": way, "speed": speed, "length": length, "there": False, "patience": 25}


def _round(agent: np.ndarray, goal: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """The direction to a goal that keeps clear of the block."""
    clear, way, to = CLEAR - 12, goal - agent, middle - agent
    far = np.linalg.norm(way) + 1e-9
    way = way / far
    if not (0 < to @ way < far and np.linalg.norm(to - (to @ way) * way) < clear):
        return way
    outward = -to / (np.linalg.norm(to) + 1e-9)
    along = np.array([-outward[1], outward[0]])
    along = along if along @ way > 0 else -along
    way = along + max(0.0, (clear + 8 - np.linalg.norm(to)) / 30) * outward
    return way / np.linalg.norm(way)


def places(states: np.ndarray) -> np.ndarray:
    """Where PushT's pusher and its block are, and how the block is turned: [..., 6], for who sees numbers."""
    angle = states[..., 4:5]
    return np.concatenate([states[..., :4], 100 * np.sin(angle), 100 * np.cos(angle)], -1)


TASKS = {
    "rooms": Task(
        "swm/TwoRoom-v1",
        "reach the target",
        ("right", "down"),
        lambda seed: ExpertPolicy(
            action_noise=2.0, action_repeat_prob=0.05, seed=seed
        ),  # as noisy as its authors record it
        lambda states, goals: np.linalg.norm(goals[..., :2] - states[..., :2], axis=-1) < REACHED,
        lambda states, goals: (states[..., 0] < WALL) != (goals[..., 0] < WALL),
        "in the other room",
        keeps_to_the_door,
        "LeWM 87, DINO-WM 100, a random floor of about 26 (the papers' own training and starts)",
    ),
    "push": Task(
        "swm/PushT-v1",
        "push the block to where it is in the picture",
        ("right", "down"),
        Pushing,
        pushed,
        block_moves,
        "the block has to move",
        lambda way, goal, table: True,
        "LeWM 96, DINO-WM 74 to 90, of LeWM learned from weak recordings 30 to 40 (people's recordings, the papers' own starts)",
    ),
}
TASKS["push-numbers"] = replace(TASKS["push"], numbers=places)
