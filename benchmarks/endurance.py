"""Runs a world for an hour of its own time without a pause, and prints whether its steps stay as quick and its memory as small.

    python benchmarks/endurance.py doom-maze --hours 1 --fast
    python benchmarks/endurance.py doom-maze --steps 20000 --alone

No browser and no clock hold it back (benchmarks/play.py has both): an hour of a world of 35 steps a second is 126,000 steps.
A story's own memory goes on from story to story, so that it fills up and stays full. Processor time stands beside the
clock's, for a machine that is not quiet.
"""

from __future__ import annotations

import gc
import json as jsonlib
import os
import resource
import statistics
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

import terrella

STRETCHES = 10


def main(
    world: Annotated[str, tyro.conf.Positional] = "doom-maze",
    hours: float = 1.0,
    steps: int | None = None,
    threads: int = 1,
    fast: bool = False,
    alone: bool = False,
    memory_mb: float | None = None,
    seed: int = 0,
    json: bool = False,
) -> None:
    """Measure the cost of each step, and the memory, from the first stretch of a long run to the last.

    Args:
        world: What `terrella list` shows, or the path of a checkpoint.
        hours: Of the world's time.
        steps: Steps instead of hours.
        threads: Threads that torch is given.
        fast: Draw as `terrella play --fast` does.
        alone: Leave the recorded keyframes out, so that the story's own memory is all there is.
        memory_mb: Budget of a story's own memory, in MiB; by itself as the world was saved.
        seed: Of the keys that are held and of the world's chance.
        json: Print one JSON document instead of lines.
    """
    torch.set_num_threads(threads)
    options: dict[str, Any] = {**({"fast": True} if fast else {}), **({"memory": False} if alone else {})}
    learned = terrella.load(world, memory_mb=memory_mb, **options)
    count = steps or round(hours * 3600 / learned.spec.dt_s)
    if count < 10 * STRETCHES:
        sys.exit(f"{count} steps are too few to compare stretches of; give {10 * STRETCHES} or more.")
    found = run(learned, count, seed)
    budget = memory_mb if memory_mb is not None else getattr(getattr(learned, "config", None), "memory_mb", None)
    taken = max((row["memory_mib"] for row in found["stretches"] if "memory_mib" in row), default=None)
    found["within_budget"] = None if budget is None or taken is None else taken <= budget
    found |= {
        "world": world,
        "memory_mb": memory_mb,
        "alone": alone,
        "threads": threads,
        "way": learned.spec.card.get("fast", "eager torch"),
        "seed": seed,
    }
    print(jsonlib.dumps(found, indent=1) if json else report(found))


def run(learned, steps: int, seed: int) -> dict:
    """One story after the other, under keys held for a quarter of a second to a second; per stretch of the run the wall and
    processor time of a step (imagine and draw), the resident memory, the size of the state, and of its own memory."""
    rng, keys = terrella.make_rng(seed), terrella.make_rng(seed + 1)
    state, stories, left, stretches = learned.start(1, rng), 1, 0, []
    for _ in range(20):
        state = learned.imagine(state, learned.spec.sample_action(1, keys), rng)  # the first steps compile kernels
    edges = [steps * k // STRETCHES for k in range(STRETCHES + 1)]
    begun = time.perf_counter()
    for first, stop in zip(edges, edges[1:]):
        wall, cpu = [], []
        for _ in range(first, stop):
            if left == 0:
                action, left = learned.spec.sample_action(1, keys), int(torch.randint(9, 36, (1,), generator=keys))
            left -= 1
            then, worked = time.perf_counter(), time.process_time()
            state = learned.imagine(state, action, rng)
            learned.render(state, ("rgb",))
            wall.append((time.perf_counter() - then) * 1e3)
            cpu.append((time.process_time() - worked) * 1e3)
            if bool(learned.render(state, ("done",))["done"][0]):
                kept = {name: state[name] for name in state if name.startswith("memory_")}
                state, stories = learned.start(1, rng).replace(**kept), stories + 1
        gc.collect()
        row = {"steps": stop, "ms": statistics.median(wall), "p95_ms": late(wall), "cpu_ms": statistics.median(cpu)}
        row |= {"resident_mib": resident_mib(), "state_mib": state.nbytes / 2**20, **own_memory(learned, state)}
        stretches.append(row)
        print(f"  {stop:,} of {steps:,} steps: {row['ms']:.1f} ms", file=sys.stderr, flush=True)
    lasted = time.perf_counter() - begun
    first, last = stretches[0], stretches[-1]
    return {
        "steps": steps,
        "world_s": steps * learned.spec.dt_s,
        "seconds": lasted,
        "steps_per_s": steps / lasted,
        "stories": stories,
        "stretches": stretches,
        "growth": {key: last[key] / first[key] - 1 for key in ("ms", "p95_ms", "cpu_ms")},
        "resident_growth_mib": last["resident_mib"] - first["resident_mib"],
        "peak_resident_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        / (1024 if sys.platform != "darwin" else 2**20),
    }


def own_memory(learned, state) -> dict:
    """Keyframes of the story's own, and the MiB that they take."""
    if "keyframes" not in learned.spec.channels:
        return {}
    kinds = learned.render(state, ("keyframes",))["keyframes"][0, :, 3]
    taken = sum(tensor.numel() * tensor.element_size() for name, tensor in state.items() if name.startswith("memory_"))
    return {"keyframes": int((kinds > 1).sum()), "memory_mib": taken / 2**20}


def late(times: list[float]) -> float:
    return sorted(times)[int(0.95 * len(times))]


def resident_mib() -> float:
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
    except OSError:
        return float("nan")


def report(found: dict) -> str:
    lines = [
        f"{found['world']}, {found['way']}, {found['threads']} threads: {found['steps']:,} steps = {found['world_s']:.0f} s "
        f"of its time in {found['seconds']:.0f} s ({found['steps_per_s']:.1f} steps/s), {found['stories']} stories"
    ]
    for row in found["stretches"]:
        lines.append(
            f"  to {row['steps']:9,}: {row['ms']:6.2f} ms (95%: {row['p95_ms']:.2f}; processor {row['cpu_ms']:.2f}), resident "
            f"{row['resident_mib']:,.0f} MiB, state {row['state_mib']:.1f} MiB"
            + (
                f", {row['keyframes']} keyframes of its own in {row['memory_mib']:.2f} MiB"
                if "keyframes" in row
                else ""
            )
        )
    growth = found["growth"]
    lines.append(
        f"  last tenth against first: wall {growth['ms']:+.1%}, 95% {growth['p95_ms']:+.1%}, processor {growth['cpu_ms']:+.1%}, "
        f"resident {found['resident_growth_mib']:+.0f} MiB (peak {found['peak_resident_mib']:,.0f})"
    )
    if found["within_budget"] is not None:
        lines.append(f"  memory within its budget: {'yes' if found['within_budget'] else 'NO'}")
    return "\n".join(lines)


if __name__ == "__main__":
    tyro.cli(main)
