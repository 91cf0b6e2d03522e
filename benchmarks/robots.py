"""Steps of MuJoCo's worlds as shares of what MuJoCo alone makes, in one run and in turns; prints JSON.

    python benchmarks/robots.py --robot ant      # go1 where the files of mjlab are installed (docs/robots.md)

`world`: imagine and what a learner is shown (observation, reward, done), fresh random actions at each step. `bare`: the same
states and controls through mujoco.rollout alone, `mjbatch` through that (where it is installed; it pins its own MuJoCo).
`randomised`: worlds with masses, friction and gains of their own. `async`: Gymnasium's AsyncVectorEnv of Ant-v5 (its own
frame skip), against our ant at the same control step.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from importlib.util import find_spec

import gymnasium
import numpy as np
import torch
import tyro

from terrella.core import make_rng
from terrella.sim.mujoco_stepping import mujoco, rollout
from terrella.sim.mujoco_world import MujocoConfig, MujocoWorld
from terrella.sim.randomised import Distribution, Randomised

SHOWN = ("observation", "reward", "done")
ROUGH = {
    "mass": Distribution("uniform", (0.9, 1.1)),
    "friction": Distribution("uniform", (0.4, 1.0)),
    "gain": Distribution("uniform", (0.9, 1.1)),
}


def main(
    robot: str = "ant", batch: int = 512, steps: int = 8, turns: int = 5, frames: int = 200, envs: int = 16
) -> None:
    world = MujocoWorld(robot, MujocoConfig(cameras=()))
    per = round(world.spec.dt_s / world.file.opt.timestep)
    found: dict[str, object] = {"robot": robot, "physics": world.spec.card["physics"], "batch": batch}
    for threads in (1, 2):
        plain = MujocoWorld(robot, MujocoConfig(cameras=(), threads=threads))
        rough = Randomised(plain, ROUGH)
        ways = {
            "bare": bare(plain, batch, steps, threads),
            "world": stepped(plain, batch, steps),
            "randomised": stepped(rough, batch, steps),
        }
        if find_spec("mjbatch"):
            ways["mjbatch"] = by_mjbatch(plain, batch, steps, threads)
        seconds = in_turns(ways, turns)
        rates = {name: batch * steps * per / statistics.median(times) for name, times in seconds.items()}
        told = {f"{name} physics steps/s": round(rate) for name, rate in rates.items()}
        told |= {
            "share of bare": ratio(seconds, "bare", "world"),
            "share of bare, randomised": ratio(seconds, "bare", "randomised"),
        }
        if "mjbatch" in ways:
            told["share of bare, mjbatch"] = ratio(seconds, "bare", "mjbatch")
        found[f"{threads} threads"] = told
    small = MujocoWorld(robot, MujocoConfig(size=(64, 64)))
    state = small.start(frames, make_rng(0))
    small.render(state.at(0), ("rgb",))
    seconds = in_turns({"rgb": lambda: small.render(state, ("rgb",))}, 3)["rgb"]
    found["64x64 pictures/s, one thread"] = round(frames / min(seconds))
    print(json.dumps(found, indent=1))
    print(json.dumps({"async": against_async(envs, 20, turns)}, indent=1))


def stepped(world, batch: int, steps: int) -> Callable[[], object]:
    state, rng = world.start(batch, make_rng(0)), make_rng(1)

    def run() -> None:
        now = state
        for _ in range(steps):
            now = world.imagine(now, world.spec.sample_action(batch, rng), rng)
            world.render(now, SHOWN)

    return run


def bare(world: MujocoWorld, batch: int, steps: int, threads: int) -> Callable[[], object]:
    state, rng, model = world.start(batch, make_rng(0))["physics"].numpy(), make_rng(1), world.file
    per = round(world.spec.dt_s / model.opt.timestep)
    pool, datas = rollout.Rollout(nthread=threads if threads > 1 else 0), [mujoco.MjData(model) for _ in range(threads)]

    def run() -> None:
        now = state
        for _ in range(steps):
            actions = world.spec.sample_action(batch, rng).double().numpy()
            now = pool.rollout(model, datas, now, np.repeat(actions[:, None], per, 1))[0][:, -1]

    return run


def by_mjbatch(world: MujocoWorld, batch: int, steps: int, threads: int) -> Callable[[], object]:
    """From the same states; sensors and states are read after each control step, as mujoco.rollout gives them."""
    from mjbatch import Batch  # pyright: ignore[reportMissingImports]

    model, rng = world.file, make_rng(1)
    start, per = world.start(batch, make_rng(0))["physics"].numpy(), round(world.spec.dt_s / model.opt.timestep)
    worlds = Batch(model, num_sims=batch, num_threads=threads)
    fields = {name: worlds.bind(name) for name in ("state", "qpos", "qvel", "qacc_warmstart", "ctrl", "sensordata")}

    def run() -> None:
        fields["qpos"][:] = start[:, 1 : 1 + model.nq]
        fields["qvel"][:] = start[:, 1 + model.nq : 1 + model.nq + model.nv]
        fields["qacc_warmstart"][:] = 0.0
        for _ in range(steps):
            fields["ctrl"][:] = world.spec.sample_action(batch, rng).numpy()
            worlds.step(nstep=per)
            fields["state"].copy(), fields["sensordata"].copy()

    return run


def against_async(envs: int, steps: int, turns: int) -> dict[str, object]:
    """Control steps a second of Ant-v5 in processes, and of the same ant in one State, at 0.05 s."""
    ours = MujocoWorld("ant", MujocoConfig(cameras=(), control_s=0.05))
    theirs = gymnasium.make_vec("Ant-v5", num_envs=envs, vectorization_mode="async")
    theirs.reset(seed=0)

    def run() -> None:
        for _ in range(steps):
            theirs.step(theirs.action_space.sample())

    seconds = in_turns({"async": run, "ours": stepped(ours, envs * 16, steps)}, turns)
    theirs.close()
    rates = {"async": envs * steps, "ours": envs * 16 * steps}
    told = {name: round(rates[name] / statistics.median(times)) for name, times in seconds.items()}
    return {f"{name} control steps/s": rate for name, rate in told.items()} | {
        "times": round(told["ours"] / told["async"], 2)
    }


def in_turns(ways: dict[str, Callable[[], object]], turns: int) -> dict[str, list[float]]:
    """Seconds of each way, one after the other, so that what else the machine does falls on all alike."""
    found: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(turns + 1):
        for name, run in ways.items():
            began = time.perf_counter()
            run()
            if turn:
                found[name].append(time.perf_counter() - began)
    return found


def ratio(seconds: dict[str, list[float]], one: str, other: str) -> float:
    """The median of the turns' ratios."""
    return round(statistics.median(a / b for a, b in zip(seconds[one], seconds[other])), 3)


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    tyro.cli(main)
