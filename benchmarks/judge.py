"""stable-worldmodel's own harness judges planners in a latent world that `terrella train latent` learned of pictures.

    make judge                                                       # all of it, in an environment of its own: TwoRoom
    make judge ARGS="--task push --out judged/push"                  # PushT; push-numbers sees its state in place of pictures
    make judge ARGS="--starts 400 --seeds 5 --arms reaching"         # more starts, some of the arms

It records the task's own recorder, trains a world and a goal-conditioned policy on pictures and actions alone, and plays starts
of other episodes. A table in Markdown, success with Wilson's interval: by the published protocol (50 starts, a goal 25 steps ahead
in the recording, 50 steps, CEM of 300 plans in 30 rounds), and with starts whose goal is not already reached. What stands there
already (a recording, a run) is not made again.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from judge_harness import Acting, Held, Recorded, Task, evaluated
from judge_tasks import TASKS
from stable_worldmodel import PlanConfig
from stable_worldmodel.policy import BasePolicy, RandomPolicy, WorldModelPolicy
from stable_worldmodel.solver import CEMSolver
from trained import trained, words

from terrella.act.goal_network import GoalActor
from terrella.act.planning import Cost, CostModel, GoalBeliefPolicy, Planner, SearchConfig, distance_to
from terrella.core import World
from terrella.measure.statistics import wilson

OFFSET, BUDGET, BLOCK, HORIZON = 25, 50, 5, 5


def arms(task: Task, world: World, actor: GoalActor, seed: int) -> dict[str, Callable[[], BasePolicy]]:
    """Who is judged, by name."""

    def cem() -> BasePolicy:
        solver = CEMSolver(CostModel(world), batch_size=1, num_samples=300, n_steps=30, topk=30, seed=seed)
        return WorldModelPolicy(solver, PlanConfig(HORIZON, HORIZON, action_block=BLOCK, warm_start=True))

    def ours(make: Callable[[Cost], Any]) -> Callable[[], BasePolicy]:
        return lambda: Acting(task, lambda goals: make(distance_to(world, goals, "last")), seed)

    varied = GoalActor(actor.network, world.spec, varied=True)
    config = SearchConfig("icem", samples=64, iterations=5, horizon=HORIZON, block=BLOCK, replan=HORIZON)
    short = SearchConfig("icem", samples=16, iterations=2, horizon=HORIZON, block=BLOCK, replan=HORIZON)
    return {
        "random": lambda: RandomPolicy(seed),
        "reaching": ours(lambda cost: GoalBeliefPolicy(world, actor, cost)),
        "icem": ours(lambda cost: Planner(world, cost, config)),
        "icem anew": ours(lambda cost: Planner(world, cost, replace(config, replan=1))),
        "icem+reaching": ours(lambda cost: Planner(world, cost, short, proposal=varied)),
        "cem 300x30": cem,
    }


def judged(held: Held, policy: BasePolicy, count: int, seed: int, unsolved: bool) -> dict[str, Any]:
    """Success over `count` starts: of all, by honest ways, by those of the hard goals; and the milliseconds of a decision."""
    starts = held.starts(OFFSET, count, seed, unsolved)
    began = time.process_time()
    with contextlib.redirect_stdout(io.StringIO()):
        reached, strictly = evaluated(policy, held, starts, OFFSET, BUDGET)
    hard = held.task.hard(*held.goals(starts, OFFSET))
    ms = float(np.median(getattr(policy, "ms", [np.nan])))
    return {
        "reached": int(reached.sum()),
        "strictly": int(strictly.sum()),
        "of": count,
        "hard_reached": int(strictly[hard].sum()),
        "hard": int(hard.sum()),
        "ms": None if np.isnan(ms) else round(ms, 2),
        "processor_s": round(time.process_time() - began, 1),
    }


def _share(reached: int, count: int) -> str:
    if not count:
        return "-"
    found = wilson(reached, count)
    return f"{100 * found.value:.1f} [{100 * found.low:.1f}, {100 * found.high:.1f}]"


def line(name: str, rows: list[dict[str, Any]]) -> str:
    """A row of the table: all seeds together."""
    total = {key: sum(row[key] for row in rows) for key in ("reached", "strictly", "of", "hard_reached", "hard")}
    ms = [row["ms"] for row in rows if row["ms"] is not None]
    shares = ", ".join(f"{100 * row['reached'] / row['of']:.1f}" for row in rows)
    taken = f"{np.median(ms):.1f}" if ms else ""
    whole, strictly = (_share(total[key], total["of"]) for key in ("reached", "strictly"))
    hard = _share(total["hard_reached"], total["hard"])
    return f"| {name} | {whole} | {shares} | {strictly} | {hard} of {total['hard']} | {taken} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=TASKS, default="rooms")
    parser.add_argument("--out", type=Path, default=Path("judged"))
    parser.add_argument("--episodes", type=int, default=300, help="that are recorded to learn from")
    parser.add_argument("--held", type=int, default=200, help="further episodes, whose rows are starts and goals")
    parser.add_argument("--starts", type=int, default=50)
    parser.add_argument("--seeds", type=int, default=1, help="each with its own recording, training, starts and draws")
    parser.add_argument(
        "--arms", nargs="*", default=["random", "reaching", "icem", "icem anew", "icem+reaching", "cem 300x30"]
    )
    parser.add_argument(
        "--train", nargs="*", default=["steps", "1200"], help="words for `terrella train latent`, without --"
    )
    parser.add_argument(
        "--reach", nargs="*", default=["steps", "1000"], help="words for `terrella train goals`, without --"
    )
    asked = parser.parse_args()
    task = TASKS[asked.task]
    torch.set_num_threads(1)
    asked.out.mkdir(parents=True, exist_ok=True)
    ready = []
    for seed in range(asked.seeds):

        def record(out: Path, seed: int = seed) -> None:
            with Recorded(task, out) as writer:
                task.collect(writer, asked.episodes, 1000 * seed, task.numbers is None)

        ready.append(trained(asked.out, seed, record, words(asked.train), words(asked.reach)))
    with Held(task) as held:
        task.collect(held, asked.held, 777_000)
    for seed, (_, _, spent) in enumerate(ready):
        took = ", ".join(f"{name} {seconds / 60:.1f}" for name, seconds in spent.items())
        print(f"Training of seed {seed} took {took} processor minutes.", flush=True)
    found: dict[str, dict[str, list]] = {}
    for kind, unsolved in (("published protocol", False), ("unsolved starts", True)):
        print(f"\n{kind}: a goal {OFFSET} steps ahead, {BUDGET} steps; published: {task.published}\n")
        print(f"| | success % | by seed | strictly | strictly, {task.hard_means} | ms a decision |")
        print("| --- | --- | --- | --- | --- | --- |")
        for name in asked.arms:
            rows = [
                judged(held, arms(task, world, actor, seed)[name](), asked.starts, 42 + seed, unsolved)
                for seed, (world, actor, _) in enumerate(ready)
            ]
            found.setdefault(kind, {})[name] = rows
            print(line(name, rows), flush=True)
            (asked.out / "judge.json").write_text(
                json.dumps({"spent_s": [spent for _, _, spent in ready], **found}, indent=1)
            )


if __name__ == "__main__":
    main()
