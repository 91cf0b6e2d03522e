"""OGBench's cube-single: a robot arm carries a cube to where it lies in the goal, from starts where it lies elsewhere.

    make judge-cube                                          # in the environment of `make judge`
    make judge-cube ARGS="--episodes 200 --reach steps 3000" # fewer recordings, a shorter training

It records OGBench's own scripted oracle with noise on its actions, numbers alone: no pictures, no rewards, and no goals, which are
what episodes came to. It learns a world of them and a goal-conditioned policy, and plays OGBench's own five tasks and random ones.
A table in Markdown, success by OGBench's own criterion (the cube within 4 cm of its target at any of 200 steps) with Wilson's
interval, beside random actions and none. What stands there already is not made again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import ogbench  # noqa: F401  registers cube-single-v0
import torch
from gymnasium import spaces
from ogbench.manipspace.oracles.markov.cube_markov import CubeMarkovOracle
from trained import trained, words

from terrella.act.planning import GoalBeliefPolicy, distance_to
from terrella.core.spec import DONE, Spec
from terrella.data import Layout, Recorder
from terrella.measure.statistics import wilson

NAME, STEPS = "cube-single-v0", 200
ACTIONS = ("x", "y", "z", "yaw", "gripper")
NOISE = np.array(
    [1.0, 1.0, 1.0, 3.0, 10.0]
)  # of an action's numbers, in shares of an episode's own: as OGBench's noisy recordings have it
AT_ONCE = 25
LOW, HIGH = np.array([0.3, -0.3]), np.array([0.55, 0.3])  # metres: where OGBench's own recordings have cubes
Act = Callable[[np.ndarray], np.ndarray]


def numbers(state: np.ndarray) -> np.ndarray:
    """What is seen of OGBench's state vectors [..., 28]: [..., 17]. The hand's place, how it is turned, the gripper's opening and
    its touch; the cube's place and how it is turned, the same again after a quarter turn; and where the cube is from the hand.
    No speeds: who imitates reads its own last action off them, and repeats it."""
    hand, cube = state[..., 12:15], state[..., 19:22]
    turned, lies = (
        _quartered(*np.moveaxis(state[..., 15:17], -1, 0)),
        _quartered(*np.moveaxis(state[..., 26:28], -1, 0)),
    )
    apart = lies * turned.conj()
    parts = [hand, state[..., 15:19], cube, _pair(lies), 2 * (cube - hand), _pair(apart)]
    return np.concatenate(parts, -1).astype(np.float32)


def _quartered(cos: np.ndarray, sin: np.ndarray) -> np.ndarray:
    """Four times an angle, as a complex number."""
    return (cos + 1j * sin) ** 4


def _pair(number: np.ndarray) -> np.ndarray:
    return np.stack([number.real, number.imag], -1)


def recorded(out: Path, episodes: int, noise: float, seed: int) -> None:
    """Episodes of 200 steps of the oracle, which carries the cube to one place after another. Some are noisier than others."""
    box = spaces.Box(-np.inf, np.inf, numbers(np.zeros(28)).shape, np.float32)
    spec = Spec(
        f"gym:{NAME}",
        spaces.Box(-1, 1, (len(ACTIONS),), np.float32),
        {"observation": box, "done": DONE},
        (),
        0.05,
        action_names=ACTIONS,
        max_episode_steps=STEPS,
    )
    env = gymnasium.make(NAME, terminate_at_goal=False, mode="data_collection", max_episode_steps=STEPS + 1)
    oracle, rng = CubeMarkovOracle(env=env), np.random.default_rng(seed)
    np.random.seed(seed)  # the oracle draws from it
    with Recorder(out, Layout.of(spec), "carry the cube about", "discard") as recorder:
        for episode in range(episodes):
            seen, info = env.reset(seed=1_000_000 * seed + episode)
            oracle.reset(seen, info)
            spread = rng.uniform(0, noise)
            for _ in range(STEPS):
                action = np.asarray(oracle.select_action(seen, info)) + spread * NOISE * rng.normal(size=len(ACTIONS))
                action = action.clip(-1, 1).astype(np.float32)
                recorder.add({"observation": numbers(seen)}, action, 0.0, False)
                seen, _, _, _, info = env.step(action)
                if oracle.done:
                    seen, info = env.unwrapped.set_new_target()
                    oracle.reset(seen, info)
            recorder.add({"observation": numbers(seen)})
            recorder.end_episode()


def tasks(count: int, seed: int, own: bool) -> Iterator[dict[str, Any]]:
    """`count` tasks as OGBench's `reset` takes them: its own five in turn, or the cube and its target anywhere, further apart
    than what counts as reached."""
    rng, found = np.random.default_rng(seed), 0
    while found < count:
        start, goal = rng.uniform(LOW, HIGH), rng.uniform(LOW, HIGH)
        if own:
            yield {"task_id": 1 + found % 5}
        elif np.linalg.norm(start - goal) > 0.06:  # a start is moved by up to a centimetre in both directions
            places = {"init_xyzs": np.array([[*start, 0.02]]), "goal_xyzs": np.array([[*goal, 0.02]])}
            yield {"task_info": {"task_name": "anywhere", **places}}
        else:
            continue
        found += 1


def played(policy_of: Callable[[np.ndarray], Act], count: int, seed: int, own: bool) -> dict[str, Any]:
    """How many of `count` tasks were done within 200 steps. policy_of(goals [B, 28]) gives what acts on states [B, 28]."""
    envs = [gymnasium.make(NAME, max_episode_steps=STEPS).unwrapped for _ in range(min(AT_ONCE, count))]
    done, steps, ms = [], [], []
    asked = list(tasks(count, seed, own))
    for first in range(0, count, len(envs)):
        group = asked[first : first + len(envs)]
        begun = [
            env.reset(seed=10_000 * seed + first + at, options=task) for at, (env, task) in enumerate(zip(envs, group))
        ]
        for env in envs:
            env.action_space.seed(seed)
        seen = np.stack([one[0] for one in begun])
        act = policy_of(np.stack([one[1]["goal"] for one in begun]))
        solved, taken = np.array([env._success for env in envs[: len(group)]]), np.full(len(group), STEPS)
        if solved.any():
            raise SystemExit("a start is already solved: these tasks are not what they are said to be.")
        for step in range(STEPS):
            began = time.perf_counter()
            actions = act(seen)
            ms.append(1e3 * (time.perf_counter() - began) / len(group))
            for at in np.flatnonzero(~solved):
                seen[at], _, _, _, info = envs[at].step(actions[at])
                solved[at], taken[at] = info["success"], step + 1
            if solved.all():
                break
        done += solved.tolist()
        steps += taken[solved].tolist()
    for env in envs:
        env.close()
    by_task = {str(1 + at): float(np.mean(done[at::5])) for at in range(5)} if own else {}
    return {
        "reached": int(np.sum(done)),
        "of": count,
        "steps": float(np.mean(steps)) if steps else None,
        "ms": float(np.median(ms)),
        "by_task": by_task,
    }


def arms(world: Any, actor: Any, seed: int) -> dict[str, Callable[[np.ndarray], Act]]:
    """Who plays, by name."""

    def still(goals: np.ndarray) -> Act:
        return lambda seen: np.zeros((len(seen), len(ACTIONS)), np.float32)

    def at_random(goals: np.ndarray) -> Act:
        rng = np.random.default_rng(seed + len(goals))
        return lambda seen: rng.uniform(-1, 1, (len(seen), len(ACTIONS))).astype(np.float32)

    def reaching(goals: np.ndarray) -> Act:
        policy = GoalBeliefPolicy(
            world, actor, distance_to(world, {"observation": torch.from_numpy(numbers(goals))}, "last")
        )
        rng = torch.Generator().manual_seed(seed)
        memory = policy.begin(len(goals), rng)

        def act(seen: np.ndarray) -> np.ndarray:
            nonlocal memory
            action, memory = policy.act({"observation": torch.from_numpy(numbers(seen))}, memory, rng)
            return action.numpy().astype(np.float32)

        return act

    return {"idle": still, "random": at_random, "reaching": reaching}


def line(name: str, kind: str, found: dict[str, Any]) -> str:
    share = wilson(found["reached"], found["of"])
    told = f"{100 * share.value:.1f} [{100 * share.low:.1f}, {100 * share.high:.1f}]"
    by_task = ", ".join(f"{100 * value:.0f}" for value in found["by_task"].values())
    steps = "" if found["steps"] is None else f"{found['steps']:.0f}"
    return f"| {name}, {kind} | {told} of {found['of']} | {by_task} | {steps} | {found['ms']:.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("judged/cube"))
    parser.add_argument("--episodes", type=int, default=500, help="of 200 steps, that are recorded to learn from")
    parser.add_argument("--noise", type=float, default=0.1, help="of the recorded actions, at most")
    parser.add_argument("--starts", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0, help="of recording and training")
    parser.add_argument("--test-seed", type=int, default=42, help="of the tasks that are played")
    parser.add_argument("--arms", nargs="*", default=["idle", "random", "reaching"])
    parser.add_argument(
        "--kinds", nargs="*", default=["own", "anywhere"], help="OGBench's own five tasks, and random ones"
    )
    parser.add_argument(
        "--train", nargs="*", default=["steps", "300"], help="words for `terrella train latent`, without --"
    )
    parser.add_argument(
        "--reach",
        nargs="*",
        default=["steps", "10000", "farthest", "100"],
        help="words for `terrella train goals`, without --",
    )
    asked = parser.parse_args()
    torch.set_num_threads(1)
    asked.out.mkdir(parents=True, exist_ok=True)

    def record(out: Path) -> None:
        recorded(out, asked.episodes, asked.noise, asked.seed + 1)

    world, actor, spent = trained(asked.out, asked.seed, record, words(asked.train), words(asked.reach))
    print("Processor minutes of training:", ", ".join(f"{name} {s / 60:.1f}" for name, s in spent.items()), flush=True)
    print("\n| | success % | of OGBench's tasks 1 to 5 | steps | ms a decision |\n| --- | --- | --- | --- | --- |")
    found: dict[str, dict[str, Any]] = {}
    for kind in asked.kinds:
        for name in asked.arms:
            result = played(arms(world, actor, asked.seed)[name], asked.starts, asked.test_seed, kind == "own")
            found.setdefault(kind, {})[name] = result
            print(line(name, kind, result), flush=True)
            (asked.out / f"cube-{asked.test_seed}.json").write_text(json.dumps({"spent_s": spent, **found}, indent=1))


if __name__ == "__main__":
    main()
