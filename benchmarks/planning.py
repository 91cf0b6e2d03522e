"""What planning in the simulator itself is worth, and what thinking longer adds: the upper bound for worlds learned of it.

    python benchmarks/planning.py [ENVIRONMENT ...] [--episodes 10] [--out plans]

A table in Markdown: success or return with 95% intervals, a line for each number of plans a round, and one for random play from
the same starts.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import torch

import terrella
from terrella.act.planning import (
    FullyObserved,
    Planner,
    PlayResult,
    PlaySettings,
    SearchConfig,
    SuccessCriterion,
    distance_to,
    negative_reward,
    play,
)
from terrella.core import make_rng
from terrella.core.files import write_json
from terrella.core.policy import Random
from terrella.measure.statistics import Figure, mean_interval, wilson


@dataclass(frozen=True)
class Case:
    """How an environment is planned in. goal: numbers of its observation, NaN for any; without one the reward is the goal."""

    config: SearchConfig
    steps: int
    goal: tuple[float, ...] = ()
    done_is_success: bool = False
    samples: tuple[int, ...] = (2, 4, 8, 16, 32)


CASES = {
    "CartPole-v1": Case(SearchConfig("icem", iterations=2, horizon=15, replan=5), 200),
    "Pendulum-v1": Case(SearchConfig("icem", iterations=2, horizon=10, block=2, replan=2), 150),
    "Acrobot-v1": Case(SearchConfig("icem", iterations=2, horizon=12, block=6, replan=3), 200, done_is_success=True),
    "MountainCar-v0": Case(
        SearchConfig("icem", iterations=2, horizon=15, block=10, replan=5), 200, done_is_success=True
    ),
}


def figures(played: PlayResult, case: Case) -> dict[str, Figure]:
    """What episodes were worth, and what a decision took."""
    found = played.episodes
    worth = {"return": mean_interval(torch.tensor([one.reward for one in found]), make_rng(0))}
    if case.done_is_success:
        worth = {"success": wilson(sum(bool(one.success) for one in found), len(found)), **worth}
    imagined = [steps for one in found for steps in one.imagined]
    return {**worth, **({"imagined": mean_interval(torch.tensor(imagined).float(), make_rng(0))} if imagined else {})}


def curve(name: str, case: Case, episodes: int) -> dict[str, dict[str, Figure]]:
    """Random play, and the planner with each number of samples, from the same starts."""
    world = FullyObserved(terrella.load(f"gym:{name}", rgb=False))
    judge = SuccessCriterion(channel="done") if case.done_is_success else SuccessCriterion()
    cost = negative_reward(world.spec)
    if case.goal:
        cost = distance_to(world, {"observation": torch.tensor(case.goal)})
    settings = PlaySettings(case.steps, judge)
    rows = {"random": figures(play(world, Random(world.spec), episodes, settings), case)}
    for samples in case.samples:
        planner = Planner(world, cost, replace(case.config, samples=samples))
        played = play(world, planner, episodes, settings)
        rows[f"{samples} plans a round"] = figures(played, case)
        print(
            f"{name}, {samples}: " + "; ".join(f"{k} {v}" for k, v in rows[f"{samples} plans a round"].items()),
            flush=True,
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("environments", nargs="*", default=list(CASES))
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--samples", type=int, nargs="*", help="plans a round; default: 2 4 8 16 32")
    parser.add_argument("--out", type=Path, default=Path("plans"))
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    for name in asked.environments:
        case = replace(CASES[name], samples=tuple(asked.samples)) if asked.samples else CASES[name]
        rows = curve(name, case, asked.episodes)
        heads = list(dict.fromkeys(head for row in rows.values() for head in row))
        print(f"\n| {name} | {' | '.join(heads)} |\n|{' --- |' * (len(heads) + 1)}")
        for label, row in rows.items():
            print(f"| {label} | {' | '.join(str(row.get(head, '')) for head in heads)} |")
        write_json(
            asked.out / f"{name}.json", {label: {k: v.__dict__ for k, v in row.items()} for label, row in rows.items()}
        )


if __name__ == "__main__":
    main()
