"""What a guard costs a task: plans are chosen by the dreams of a bare world and of a guarded one, and carried out in the simulator.

    python benchmarks/guard.py --out runs/guard                  # records, trains, plans; what stands there is not made again
    python benchmarks/guard.py --out runs/guard --tasks throw    # one task; --worlds throw=runs/mine takes a world of yours

throw: of random launches of a ball between walls, the one that ends nearest to a target. push: of random movements of an arm, the
one after which block and ball lie nearest to where they should. An episode's target is where one more random plan leads, so that it
can be reached. The return is 0 for a random choice and 1 for the target. Both worlds see the same candidates.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import terrella
from terrella.core import World, make_rng, rollout
from terrella.data import record
from terrella.learn.recipes.latent import LatentTraining
from terrella.measure.statistics import mean_interval
from terrella.physics import Guarded, PhysicalSystem, Tolerance, Trajectory, calibrate, trajectory_of

KNOWN, MOVED_M = 200, 0.02  # true rollouts for the tolerances; how far a target is from where things lie
CONTROL_S = 0.05  # of the arm


@dataclass(frozen=True)
class Candidates:
    """E episodes of K + 1 plans; the first of each gives the target."""

    first: Mapping[str, Tensor]  # channel -> [E (K + 1), ...]
    actions: Tensor  # [T, E (K + 1), ...]
    true: Mapping[str, Tensor]  # channel -> [T + 1, E (K + 1), ...]
    things: Callable[
        [Mapping[str, Tensor]], Tensor
    ]  # channels [..., E (K + 1), n] -> what has a target [..., E (K + 1), d], m
    plans: int  # K + 1

    def distances(self, seen: Mapping[str, Tensor]) -> Tensor:
        """From where the plans 1 to K end to the target [E, K], m."""
        ends = self.things({name: part[-1] for name, part in seen.items()}).double().unflatten(0, (-1, self.plans))
        target = (
            self.things({name: part[-1] for name, part in self.true.items()}).double().unflatten(0, (-1, self.plans))
        )
        return (ends[:, 1:] - target[:, :1]).norm(dim=-1)


def throws(truth: World, episodes: int, plans: int, steps: int, seed: int) -> Candidates:
    """Launches of a ball, of the speeds of training."""
    drawn = truth.render(truth.start(episodes * plans, make_rng(seed)), truth.spec.observes)
    whole = {name: part.clone() for name, part in drawn.items()}
    for name in ("position", "radius"):  # one ball an episode
        whole[name] = whole[name].unflatten(0, (episodes, plans))[:, :1].expand(-1, plans, -1).flatten(0, 1)
    actions = torch.zeros(steps, episodes * plans, dtype=torch.long)
    channels = PhysicalSystem.from_json(truth.spec.system).channels
    start = truth.observe(whole, None, make_rng(0))
    true = rollout(truth, start, actions, make_rng(0), channels).observations
    return Candidates(whole, actions, true, lambda seen: seen["position"], plans)


def pushes(truth: World, episodes: int, plans: int, steps: int, seed: int) -> Candidates:
    """Movements of an arm to four places one after the other; episodes whose target is where something was pushed to."""
    channels, rng = PhysicalSystem.from_json(truth.spec.system).channels, make_rng(seed)
    tries = 6 * episodes
    started = rollout(
        truth, truth.start(tries, rng), terrella.load_policy("random", truth.spec), rng, (), steps=40
    ).final

    def things(seen: Mapping[str, Tensor]) -> Tensor:
        return torch.cat([seen["qpos"][..., 2:4], seen["qpos"][..., 9:11]], -1)

    def plan(count: int) -> Tensor:
        held = truth.spec.sample_action(4 * count, rng).unflatten(0, (4, count))
        return held.repeat_interleave(steps // 4, 0)

    target = plan(tries)
    ends = rollout(truth, started, target, make_rng(0), channels).observations["qpos"]
    moved = (things({"qpos": ends[-1]}) - things({"qpos": ends[0]})).norm(dim=-1) > MOVED_M
    rows = (moved & ~started["done"]).nonzero()[:episodes, 0]
    start = started.at(rows).fork(plans)
    actions = plan(len(rows) * plans).unflatten(1, (len(rows), plans))
    actions[:, :, 0] = target[:, rows]
    actions = actions.flatten(1, 2)
    true = rollout(truth, start, actions, make_rng(0), channels).observations
    return Candidates({name: part[0] for name, part in true.items()}, actions, true, things, plans)


@dataclass(frozen=True)
class Task:
    truth: Callable[[], World]
    candidates: Callable[[World, int, int, int, int], Candidates]
    frames: int
    training: Mapping[str, Any]


TASKS: Mapping[str, Task] = {
    "throw": Task(
        lambda: terrella.load("physics:bouncing", pictures=False),
        throws,
        10_000,
        {"hidden": 128, "members": 2, "rollout": 8, "steps": 600},
    ),
    "push": Task(
        lambda: terrella.load("mujoco:blocks", cameras=(), control_s=CONTROL_S),
        pushes,
        20_000,
        {"hidden": 192, "members": 1, "rollout": 6, "steps": 1200},
    ),
}


def learned(name: str, truth: World, out: Path) -> World:
    """The world of a task, recorded and trained where it is missing."""
    task, run, rng = TASKS[name], out / name / "run", make_rng(0)
    if not (run / "world" / "world.json").exists():
        policy = terrella.load_policy("random", truth.spec)
        record(truth, policy, out / name / "recording", task.frames, rng)
        channels = PhysicalSystem.from_json(truth.spec.system).channels
        settings = LatentTraining(name, channels=channels, history=1, leap=0, batch=64, **task.training)
        terrella.train_latent(out / name / "recording", run, settings)
    return terrella.load(run)


def tolerances_of(name: str, truth: World, steps: int, coarse: float | None) -> list[Tolerance]:
    """Of other true rollouts; coarse: as a share of what still says something."""
    known = TASKS[name].candidates(truth, KNOWN, 1, steps, 1_000)
    motion = trajectory_of(PhysicalSystem.from_json(truth.spec.system), known.true, truth.spec.dt_s)
    strict = [one for one in calibrate(motion) if not one.wrong_here]
    if coarse is None:
        return strict
    return [
        Tolerance(one.law, max(one.value, coarse * one.law.ceiling(motion)), one.rollouts, one.false_alarms)
        for one in strict
    ]


def broken_steps(motion: Trajectory, tolerances: list[Tolerance]) -> float:
    """The share of steps that break a law."""
    above = torch.stack([one.law.residual(motion) > one.value for one in tolerances])
    return float(above.any(0).double().mean())


def dream(world: World, given: Candidates, channels: tuple[str, ...]) -> tuple[Mapping[str, Tensor], float]:
    """The channels of all plans, and the processor time, s."""
    state = world.observe({name: given.first[name] for name in world.spec.observes}, None, make_rng(0))
    began = time.process_time()
    seen = rollout(world, state, given.actions, make_rng(0), channels).observations
    return seen, time.process_time() - began


def judged(name: str, truth: World, world: World, args: argparse.Namespace) -> str:
    given = TASKS[name].candidates(truth, args.episodes, args.plans + 1, args.steps, 2_000)
    system = PhysicalSystem.from_json(truth.spec.system)
    tolerances = tolerances_of(name, truth, args.steps, args.coarse)
    guarded = Guarded(world, system, tolerances)
    true, rows, returns = given.distances(given.true), [], {}
    chance, best = true.mean(1), true.amin(1)
    spent: dict[str, list[float]] = {"bare": [], "guarded": []}
    for arm, mine in (("bare", world), ("guarded", guarded)):
        seen, seconds = dream(mine, given, system.channels)
        spent[arm].append(seconds)
        pick = given.distances(seen).argmin(1)
        returns[arm] = 1 - true.gather(1, pick[:, None])[:, 0] / chance
        error = (given.things(seen)[1:] - given.things(given.true)[1:]).norm(dim=-1).mean()
        broken = broken_steps(trajectory_of(system, seen, world.spec.dt_s), tolerances)
        rows.append(
            f"| {name} | {arm} | {mean_interval(returns[arm], make_rng(0))} | {broken:.1%} | {float(error):.3f} |"
        )
    for _ in range(args.repeats):
        for arm, mine in (("bare", world), ("guarded", guarded)):
            spent[arm].append(dream(mine, given, system.channels)[1])
    change = mean_interval(returns["guarded"] - returns["bare"], make_rng(0))
    ratio = sorted(b / a for a, b in zip(spent["bare"], spent["guarded"]))[len(spent["bare"]) // 2]
    rows.append(f"| {name} | best candidate | {mean_interval(1 - best / chance, make_rng(0))} | | |")
    rows.append(
        f"\n{name}: guarded minus bare {change}; time {ratio:.2f} times the bare dream's, {given.actions.shape[1]} at once\n"
    )
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/guard"), help="folder of recordings and worlds")
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--worlds", nargs="*", default=[], metavar="TASK=RUN", help="worlds that are trained already")
    parser.add_argument("--episodes", type=int, default=120)
    parser.add_argument("--plans", type=int, default=16, help="candidates of an episode")
    parser.add_argument("--steps", type=int, default=24)
    parser.add_argument(
        "--coarse", type=float, help="tolerances as a share of the largest that say something; default: the truth's"
    )
    parser.add_argument("--repeats", type=int, default=4, help="of both dreams, for the time")
    args = parser.parse_args()
    given = dict(one.split("=", 1) for one in args.worlds)
    print(
        "| task | world | return | steps that break a law | mean error, m |\n| --- | --- | --- | --- | --- |",
        flush=True,
    )
    for name in args.tasks:
        truth = TASKS[name].truth()
        world = terrella.load(given[name]) if name in given else learned(name, truth, args.out)
        print(judged(name, truth, world, args), flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    with torch.no_grad():
        main()
