"""What a story's memory costs: milliseconds a frame and bytes over a long walk, with the memory filling up and full.

python benchmarks/memory.py [WORLD] [--steps 20000] [--memory-mb 16] [--recorded]

One story under random persistent keys, one thread, batch 1, imagine and render. CPU time is given beside the clock's, for a
machine that is not quiet. Without --recorded the world's recorded keyframes are left out, so that its own memory is at work.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time

import torch

import terrella


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("world", nargs="?", default="doom-maze")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--every", type=int, default=1_000)
    parser.add_argument("--memory-mb", type=float, default=16.0)
    parser.add_argument("--recorded", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    world = terrella.load(given.world, memory=given.recorded, memory_mb=given.memory_mb)
    rng, hands = terrella.make_rng(given.seed), terrella.make_rng(given.seed + 1)
    state, left = world.start(1, rng), 0
    action = world.spec.sample_action(1, hands)
    clock, cpu, rows = [], [], []
    for step in range(1, given.steps + 1):
        if not left:
            action = world.spec.sample_action(1, hands)
            left = int(torch.randint(5, 30, (1,), generator=hands))
        if bool(world.render(state, ("done",))["done"][0]):
            state = world.start(1, rng).replace(**{name: state[name] for name in state if name.startswith("memory_")})
        left -= 1
        began = time.perf_counter(), time.process_time()
        state = world.imagine(state, action, rng)
        world.render(state, ("rgb",))
        clock.append(1e3 * (time.perf_counter() - began[0]))
        cpu.append(1e3 * (time.process_time() - began[1]))
        if step % given.every == 0:
            table = world.render(state, ("keyframes",))["keyframes"][0]
            held = {name: tensor for name, tensor in state.items() if name.startswith("memory_")}
            row = {
                "steps": step,
                "ms": round(statistics.median(clock), 2),
                "cpu_ms": round(statistics.median(cpu), 2),
                "cpu_ms_95": round(statistics.quantiles(cpu, n=20)[-1], 2),
                "keyframes": int((table[:, 3] > 1).sum()),
                "memory_mib": round(sum(t.numel() * t.element_size() for t in held.values()) / 2**20, 2),
            }
            print(json.dumps(row), flush=True)
            rows.append(row)
            clock, cpu = [], []
    full = [row for row in rows if row["keyframes"] == rows[-1]["keyframes"]]
    within = max(row["memory_mib"] for row in rows) <= given.memory_mb
    print(f"memory within its budget of {given.memory_mb:g} MiB: {'yes' if within else 'NO'}")
    print(
        f"CPU ms a frame with {full[0]['keyframes']} keyframes: {full[0]['cpu_ms']} at {full[0]['steps']:,} steps, ",
        end="",
    )
    print(f"{full[-1]['cpu_ms']} at {full[-1]['steps']:,}: {1000 / full[-1]['cpu_ms']:.1f} frames/s")


if __name__ == "__main__":
    main()
