"""stable-worldmodel's own harness as `judge.py` needs it: a task's episodes as a recording, and starts of others.

Imported in the environment of `make judge` alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
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
from stable_worldmodel.policy import BasePolicy  # noqa: E402

SIZE, LONGEST = (64, 64), 100
AT_ONCE = 25  # episodes that are collected side by side


@dataclass(frozen=True)
class Task:
    """What differs between environments. States are arrays [..., S] of the environment's own `state`.

    recorder(seed) collects what is learned from; solved(states, goals): whether goals count as reached already;
    hard(states, goals): of the kind that `hard_means` names; kept(way [T, S], goal, environment): whether a way was an honest one;
    numbers(states): what is seen in place of pictures, None where that is pictures.
    """

    environment: str
    goal: str
    action_names: tuple[str, ...]
    recorder: Callable[[int], BasePolicy]
    solved: Callable[[np.ndarray, np.ndarray], np.ndarray]
    hard: Callable[[np.ndarray, np.ndarray], np.ndarray]
    hard_means: str
    kept: Callable[[np.ndarray, np.ndarray, Any], bool]
    published: str
    numbers: Callable[[np.ndarray], np.ndarray] | None = None

    def seen(self, pictures: np.ndarray | None, states: np.ndarray) -> dict[str, np.ndarray]:
        """Pictures [n, H, W, 3] and states [n, S] as channels."""
        if self.numbers is not None:
            return {"observation": self.numbers(states).astype(np.float32)}
        assert pictures is not None, "this task is seen in pictures"
        return {"rgb": pictures}

    def shown(self, infos: dict, pictures: str = "pixels", states: str = "state") -> dict[str, torch.Tensor]:
        """What a policy sees of the harness's `infos`: of where it is, or of its goal."""
        seen = infos[pictures][:, -1] if self.numbers is None else None
        found = self.seen(seen, np.asarray(infos[states], np.float64)[:, -1])
        return {name: torch.from_numpy(value) for name, value in found.items()}

    def opened(self, count: int, pictures: bool = True) -> Any:
        """`count` environments side by side, in stable-worldmodel's own harness; without pictures many times as fast."""
        return swm.World(
            self.environment, num_envs=count, image_shape=SIZE, max_episode_steps=LONGEST, add_pixels=pictures
        )

    def collect(self, writer: Any, episodes: int, seed: int, pictures: bool = True) -> None:
        """Episodes of the recorder."""
        world = self.opened(AT_ONCE, pictures)
        world.set_policy(self.recorder(seed))
        world.collect(writer=writer, episodes=episodes, seed=seed)
        world.close()


class Recorded:
    """A writer for `World.collect`: what is seen and actions, and nothing else, become a recording of Terrella's."""

    def __init__(self, task: Task, out: Path):
        self._task, box = task, spaces.Box(0, 255, (*SIZE, 3), np.uint8)
        if task.numbers is not None:
            box = spaces.Box(-np.inf, np.inf, task.numbers(np.zeros(7)).shape, np.float32)
        spec = Spec(
            f"gym:stable_worldmodel:{task.environment}",
            spaces.Box(-1, 1, (2,), np.float32),
            {"rgb" if task.numbers is None else "observation": box, "done": DONE},
            (),
            0.1,
            action_names=task.action_names,
            max_episode_steps=LONGEST,
        )
        layout = Layout.of(spec)
        self._recorder = Recorder(out, Layout(**{**vars(layout), "pictures": "png"}), task.goal, "discard")

    def __enter__(self) -> Recorded:
        return self

    def __exit__(self, *exception: object) -> None:
        self._recorder.close()

    def write_episodes(self, episodes: Any) -> None:
        for episode in episodes:
            pictures = np.stack(episode["pixels"]) if "pixels" in episode else None
            shown = self._task.seen(pictures, np.stack(episode["state"]))
            last = len(episode["state"]) - 1
            for row in range(last + 1):
                seen = {name: values[row] for name, values in shown.items()}
                if row == last:
                    self._recorder.add(seen)
                    break
                done = bool(episode["terminated"][row + 1])
                self._recorder.add(seen, episode["action"][row], 0.0, done)
            self._recorder.end_episode()


class Held(swm.data.Dataset):
    """Episodes that nobody trained on, kept in memory: where evaluation begins, and what its goals are."""

    def __init__(self, task: Task) -> None:
        self.task, self.held = task, list[dict[str, np.ndarray]]()

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
        """`count` (episode, row) with a goal `offset` rows later, drawn without repetition; `unsolved`: not reached already."""
        found = [
            (number, row)
            for number, one in enumerate(self.held)
            for row in range(len(one["state"]) - offset)
            if not (unsolved and self.task.solved(one["state"][row], one["state"][row + offset]))
        ]
        if len(found) < count:
            raise SystemExit(f"{len(found)} starts were collected, and {count} are asked for: collect more.")
        chosen = np.random.default_rng(seed).permutation(len(found))[:count]
        return [found[at][0] for at in chosen], [found[at][1] for at in chosen]

    def goals(self, starts: tuple[list[int], list[int]], offset: int) -> tuple[np.ndarray, np.ndarray]:
        """The states [n, S] at starts, and those of their goals."""
        states = [self.held[number]["state"] for number in starts[0]]
        pairs = [(one[row], one[row + offset]) for one, row in zip(states, starts[1])]
        return np.stack([first for first, _ in pairs]), np.stack([last for _, last in pairs])


class Acting(BasePolicy):
    """A policy of Terrella's in stable-worldmodel's harness. policy_of(goals by channel [B, ...]) gives one for these goals.
    `ms`: of each decision, an episode's share of a batch."""

    def __init__(self, task: Task, policy_of: Any, seed: int):
        super().__init__()
        self._task, self._policy_of, self._seed, self._policy, self.ms = task, policy_of, seed, None, []

    def get_action(self, infos: dict, **kwargs: Any) -> np.ndarray:
        import time

        seen = self._task.shown(infos)
        if self._policy is None:
            self._policy = self._policy_of(self._task.shown(infos, "goal", "goal_state"))
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
    """A policy, and the states at each of its decisions, each [n, S]."""

    def __init__(self, policy: Any):
        super().__init__()
        self.policy, self.states = policy, []

    def set_env(self, env: Any) -> None:
        super().set_env(env)
        self.policy.set_env(env)

    def get_action(self, infos: dict, **kwargs: Any) -> np.ndarray:
        self.states.append(_states(infos))
        return self.policy.get_action(infos, **kwargs)


def _states(infos: dict) -> np.ndarray:
    return np.array(infos["state"][:, -1], np.float64)


def evaluated(
    policy: Any, held: Held, starts: tuple[list[int], list[int]], offset: int, budget: int
) -> tuple[np.ndarray, np.ndarray]:
    """bool [n] twice: which starts reached their goals, by stable-worldmodel's own `evaluate`; and by an honest way (Task.kept)."""
    world, watched = held.task.opened(len(starts[0])), _Watched(policy)
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
    goals = held.goals(starts, offset)[1]
    ways = np.stack([*watched.states, _states(world.infos)], 1)
    played = [one.unwrapped for one in world.envs.envs]
    world.close()
    reached = np.asarray(found["episode_successes"], bool)
    return reached, reached & [held.task.kept(way, goal, one) for way, goal, one in zip(ways, goals, played)]
