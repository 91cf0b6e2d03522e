"""What a batch gains: frames a second of one episode and of many, forks, the size of a state, rollouts that nobody looks at.

python benchmarks/batches.py [--worlds doom-maze doom-corridor] [--batch 64] [--threads 2]
"""

from __future__ import annotations

import argparse
import time

import torch

import terrella
from terrella.core import rollout


def frames_per_second(world, batch: int, steps: int) -> tuple[float, float]:
    """Of imagining and rendering rgb, the best of three: frames a second, and a second of the processor, which other work on the
    machine changes little."""
    rng = terrella.make_rng(0)
    state = world.start(batch, rng)
    clocks, best = (time.perf_counter, time.process_time), [0.0, 0.0]
    with torch.inference_mode():
        for _ in range(3):
            began = [clock() for clock in clocks]
            for _ in range(steps):
                state = world.imagine(state, world.spec.sample_action(batch, rng), rng)
                world.render(state, ("rgb",))
            rates = [batch * steps / (clock() - since) for clock, since in zip(clocks, began)]
            best = [max(pair) for pair in zip(best, rates)]
    return best[0], best[1]


def unseen_steps_per_second(world, batch: int, steps: int = 64) -> float:
    """Of a rollout that asks for pose, reward and done alone, the best of three."""
    rng = terrella.make_rng(0)
    actions = torch.stack([world.spec.sample_action(batch, rng) for _ in range(steps // 8)]).repeat_interleave(8, 0)
    best = 0.0
    for _ in range(3):
        state = world.start(batch, rng)
        began = time.perf_counter()
        rollout(world, state, actions, rng, ("pose", "reward", "done"))
        best = max(best, batch * len(actions) / (time.perf_counter() - began))
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", nargs="+", default=["doom-maze", "doom-corridor"])
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    for name in given.worlds:
        world, rng = terrella.load(name), terrella.make_rng(0)
        frames_per_second(world, 1, 4)  # compiles
        one, many = frames_per_second(world, 1, 40), frames_per_second(world, given.batch, 3)
        for clock, alone, together in zip(("", " of the processor"), one, many):
            rates = f"{alone:.1f} frames/s{clock} with one episode, {together:.1f} with {given.batch}"
            print(f"{name}: {rates}: x{together / alone:.2f}", flush=True)
        state = world.start(1, rng)
        for _ in range(8):
            state = world.imagine(state, world.spec.sample_action(1, rng), rng)
        state["rgb"]
        began = time.perf_counter()
        forked = state.fork(300)
        took = time.perf_counter() - began
        whole = f"{forked.nbytes / 2**20:.2f} MiB" if hasattr(forked, "nbytes") else "not counted"
        print(f"  a state holds {state.nbytes / 2**20:.3f} MiB; fork(300) took {1e3 * took:.2f} ms, then {whole}")
        print(
            f"  pose, reward and done alone, batch {given.batch}: {unseen_steps_per_second(world, given.batch):,.0f} steps/s"
        )


if __name__ == "__main__":
    main()
