"""stable-worldmodel's TwoRoom as `judge.py` needs it: its expert's episodes as a recording, and starts taken from others.

Imported in the environment of `make judge` alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from terrella.core.spec import DONE, Spec
from terrella.data import Layout, Recorder

# torchvision's compiled operators are missing beside a CPU torch; it only has to find them defined.
_OPERATORS = torch.library.Library("torchvision", "DEF")
for _name in ("nms", "qnms"):
    _OPERATORS.define(f"{_name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

import stable_worldmodel as swm  # noqa: E402
from stable_worldmodel.envs.two_room import ExpertPolicy  # noqa: E402
from stable_worldmodel.policy import BasePolicy  # noqa: E402

ENVIRONMENT, SIZE, LONGEST = "swm/TwoRoom-v1", (64, 64), 100
REACHED = 16.0  # pixels of 224: what TwoRoom calls reached
WALL = 112.0  # where the wall between the rooms stands
DOOR_MARGIN = 1.75  # pixels beside a door that TwoRoom still lets through
AT_ONCE = 25  # episodes that are collected side by side


def opened(count: int) -> Any:
    """`count` TwoRooms side by side, in stable-worldmodel's own harness."""
    return swm.World(ENVIRONMENT, num_envs=count, image_shape=SIZE, max_episode_steps=LONGEST)


def collect(writer: Any, episodes: int, seed: int) -> None:
    """Episodes of the expert that comes with TwoRoom, as noisy as its authors record it."""
    world = opened(AT_ONCE)
    world.set_policy(ExpertPolicy(action_noise=2.0, action_repeat_prob=0.05, seed=seed))
    world.collect(writer=writer, episodes=episodes, seed=seed)
    world.close()


class Recorded:
    """A writer for `World.collect`: pictures and actions, and nothing else, become a recording of Terrella's."""

    def __init__(self, out: Path):
        box = spaces.Box(0, 255, (*SIZE, 3), np.uint8)
        spec = Spec(
            f"gym:stable_worldmodel:{ENVIRONMENT}",
            spaces.Box(-1, 1, (2,), np.float32),
            {"rgb": box, "done": DONE},
            (),
            0.1,
            action_names=("right", "down"),
            max_episode_steps=LONGEST,
        )
        layout = Layout.of(spec)
        self._recorder = Recorder(out, Layout(**{**vars(layout), "pictures": "png"}), "reach the target", "discard")

    def __enter__(self) -> Recorded:
        return self

    def __exit__(self, *exception: object) -> None:
        self._recorder.close()

    def write_episodes(self, episodes: Any) -> None:
        for episode in episodes:
            last = len(episode["pixels"]) - 1
            for row, rgb in enumerate(episode["pixels"]):
                if row == last:
                    self._recorder.add({"rgb": rgb})
                    break
                done = bool(episode["terminated"][row + 1])
                self._recorder.add({"rgb": rgb}, episode["action"][row], 0.0, done)
            self._recorder.end_episode()


class Held(swm.data.Dataset):
    """Episodes that nobody trained on, kept in memory: where evaluation begins, and what its goals are."""

    def __init__(self) -> None:
        self.held: list[dict[str, np.ndarray]] = []

    @property
    def column_names(self) -> list[str]:
        return ["pixels", "state"]

    def __enter__(self) -> Held:
        return self

    def __exit__(self, *exception: object) -> None:
        super().__init__(np.array([len(one["state"]) for one in self.held]), np.zeros(len(self.held), int))

    def write_episodes(self, episodes: Any) -> None:
        for episode in episodes:
            self.held.append({name: np.stack(episode[name]) for name in self.column_names})

    def _load_slice(self, ep_idx: int, start: int, end: int) -> dict:
        found = {name: torch.from_numpy(array[start:end]) for name, array in self.held[ep_idx].items()}
        return found | {"pixels": found["pixels"].permute(0, 3, 1, 2)}

    def starts(self, offset: int, count: int, seed: int, unsolved: bool) -> tuple[list[int], list[int]]:
        """`count` (episode, row) with a goal `offset` rows later, drawn without repetition; `unsolved`: further than REACHED."""
        found = [
            (number, row)
            for number, one in enumerate(self.held)
            for row in range(len(one["state"]) - offset)
            if not unsolved or np.linalg.norm(one["state"][row + offset] - one["state"][row]) >= REACHED
        ]
        if len(found) < count:
            raise SystemExit(f"{len(found)} starts were collected, and {count} are asked for: collect more.")
        chosen = np.random.default_rng(seed).permutation(len(found))[:count]
        return [found[at][0] for at in chosen], [found[at][1] for at in chosen]

    def crossing(self, episodes: list[int], rows: list[int], offset: int) -> np.ndarray:
        """bool: whose goal is in the other room."""
        states = [self.held[number]["state"] for number in episodes]
        x = [(one[row][0] < WALL) != (one[row + offset][0] < WALL) for one, row in zip(states, rows)]
        return np.array(x)


class Acting(BasePolicy):
    """A policy of Terrella's in stable-worldmodel's harness. policy_of(goals [B, H, W, 3]) gives one for these goals.
    `ms`: of each decision, an episode's share of a batch."""

    def __init__(self, policy_of: Any, seed: int):
        super().__init__()
        self._policy_of, self._seed, self._policy, self.ms = policy_of, seed, None, []

    def get_action(self, infos: dict, **kwargs: Any) -> np.ndarray:
        import time

        seen = {"rgb": torch.from_numpy(infos["pixels"][:, -1])}
        if self._policy is None:
            self._policy = self._policy_of(torch.from_numpy(infos["goal"][:, -1]))
            self._rng = torch.Generator().manual_seed(self._seed)
            self._memory = self._policy.begin(len(infos["pixels"]), self._rng)
        began = time.perf_counter()
        action, self._memory = self._policy.act(seen, self._memory, self._rng)
        self.ms.append(1e3 * (time.perf_counter() - began) / len(action))
        return action.detach().cpu().numpy().astype(np.float32)


CALLABLES = [
    {"method": "_set_state", "args": {"state": {"value": "state"}}},
    {"method": "_set_goal_state", "args": {"goal_state": {"value": "goal_state"}}},
]


class _Watched(BasePolicy):
    """A policy, and where the agent was at each of its decisions: places, each [n, 2] in pixels of 224."""

    def __init__(self, policy: Any):
        super().__init__()
        self.policy, self.places = policy, []

    def set_env(self, env: Any) -> None:
        super().set_env(env)
        self.policy.set_env(env)

    def get_action(self, infos: dict, **kwargs: Any) -> np.ndarray:
        self.places.append(_places(infos))
        return self.policy.get_action(infos, **kwargs)


def _places(infos: dict) -> np.ndarray:
    return np.array(infos["state"][:, -1, :2], np.float64)


def evaluated(
    policy: Any, held: Held, starts: tuple[list[int], list[int]], offset: int, budget: int
) -> tuple[np.ndarray, np.ndarray]:
    """bool [n] twice: which starts reached their goals, by stable-worldmodel's own `evaluate`; and strictly, by a way that nowhere
    cuts the wall, and into the goal's own room (within REACHED may be through the wall)."""
    world, watched = opened(len(starts[0])), _Watched(policy)
    world.set_policy(watched)
    np.random.seed(0)
    found = world.evaluate(
        dataset=held,
        episodes_idx=starts[0],
        start_steps=starts[1],
        goal_offset=offset,
        eval_budget=budget,
        callables=CALLABLES,
    )
    goals = np.stack([held.held[number]["state"][row + offset][:2] for number, row in zip(*starts)])
    ways = np.stack([*watched.places, _places(world.infos)], 1)
    rooms = [one.unwrapped for one in world.envs.envs]
    world.close()
    reached = np.asarray(found["episode_successes"], bool)
    valid = [keeps_to_the_door(way, room) for way, room in zip(ways, rooms)]
    return reached, reached & valid & ((ways[:, -1, 0] < WALL) == (goals[:, 0] < WALL))


def keeps_to_the_door(way: np.ndarray, room: Any) -> bool:
    """Whether a way [steps, 2] is in the wall's stripe only where a door is (with the margin that TwoRoom itself leaves)."""
    shares = np.linspace(0, 1, 6)[:, None, None]
    x, y = np.moveaxis(way[None, :-1] * (1 - shares) + way[None, 1:] * shares, 2, 0)
    inside = abs(x - WALL) <= room.wall_thickness // 2
    doors = zip(room.door_positions[: room.num_doors].tolist(), room.door_sizes[: room.num_doors].tolist())
    open_ = np.any([abs(y - centre) <= half + DOOR_MARGIN for centre, half in doors], axis=0)
    return not bool((inside & ~open_).any())
