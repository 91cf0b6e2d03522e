"""Times a learned world's ways of drawing against each other, in turns, and prints ratios to eager torch.

    python benchmarks/fast.py doom-maze

Ways: eager torch, torch.compile, ONNX Runtime; the network alone and the whole step (motion, memory, network, picture), with
each number of threads; how far the ways' frames lie apart, at once and after a dream; what preparing them took.
"""

from __future__ import annotations

import json as jsonlib
import statistics
import time
from collections.abc import Callable
from typing import Annotated

import torch
import tyro

import terrella
from terrella.worlds.fast import EAGER, ONNX, example_inputs, onnx_forward

DREAM = 32  # steps after which two ways' frames are compared


def main(
    world: Annotated[str, tyro.conf.Positional] = "doom-maze",
    threads: tuple[int, ...] = (1, 2),
    turns: int = 100,
    compile: bool = True,
    json: bool = False,
) -> None:
    """Measure how fast each way draws, and how alike.

    Args:
        world: What `terrella list` shows, or the path of a checkpoint.
        threads: Threads that torch and ONNX Runtime are given.
        turns: Frames that each way draws.
        compile: --no-compile leaves torch.compile out, which takes a minute or two of compiling.
        json: Print one JSON document instead of lines.
    """
    learned = terrella.load(world)
    rows, prepared, alike = [], {}, {}
    for count in threads:
        torch.set_num_threads(count)
        ways, took = ways_of(learned, compile)
        prepared[count] = took
        alike = alike or likeness(learned, ways)
        rows += timed(learned, ways, count, turns)
    found = {"world": world, "turns": turns, "prepared_s": prepared, "rows": rows, "beside_eager": alike}
    print(jsonlib.dumps(found, indent=1) if json else report(found))


def ways_of(learned, compile: bool) -> tuple[dict[str, Callable], dict[str, float]]:
    """Each way of drawing, warm, and the seconds that it took to make."""
    vars(learned.generator).pop("forward", None)
    given, eager = example_inputs(learned), learned.generator.forward
    makers = {EAGER: lambda: eager, ONNX: lambda: onnx_forward(learned.generator, given)}
    if compile:
        makers["torch.compile"] = lambda: torch.compile(eager, dynamic=False)
    ways, took = {}, {}
    for name, make in makers.items():
        begun = time.perf_counter()
        with torch.inference_mode():
            way = make()
            way(*given)
        ways[name], took[name] = way, time.perf_counter() - begun
    return ways, took


def timed(learned, ways: dict[str, Callable], threads: int, turns: int) -> list[dict]:
    """Milliseconds of the network alone and of the whole step, one frame of each way after the other."""
    given, network = example_inputs(learned), {name: [] for name in ways}
    with torch.inference_mode():
        for _ in range(turns):
            for name, way in ways.items():
                network[name].append(clocked(lambda way=way: way(*given)))
    whole = {name: [] for name in ways}
    rng = terrella.make_rng(0)
    state = learned.start(1, rng)
    for turn in range(turns + 5):
        action = learned.spec.sample_action(1, rng)
        after = state
        for name, way in ways.items():
            learned.generator.forward = way

            def step(state=state, action=action):
                nonlocal after
                after = learned.imagine(state, action, rng)
                learned.render(after, ("rgb",))

            took = clocked(step)
            if turn >= 5:
                whole[name].append(took)
        state = after
    vars(learned.generator).pop("forward", None)
    return [
        row_of(threads, what, name, took)
        for what, times in (("network", network), ("whole step", whole))
        for name, took in times.items()
    ]


def clocked(run: Callable[[], object]) -> tuple[float, float]:
    """Milliseconds by the wall's clock, and of the processor: the latter hardly depends on what else the machine does."""
    begun, worked = time.perf_counter(), time.process_time()
    run()
    return (time.perf_counter() - begun) * 1e3, (time.process_time() - worked) * 1e3


def row_of(threads: int, what: str, way: str, times: list[tuple[float, float]]) -> dict:
    wall, cpu = (sorted(column) for column in zip(*times))
    late = wall[int(0.95 * len(wall))]
    middle = statistics.median
    return {"threads": threads, "what": what, "way": way, "ms": middle(wall), "p95_ms": late, "cpu_ms": middle(cpu)}


def likeness(learned, ways: dict[str, Callable]) -> dict[str, dict]:
    """Of each way beside eager torch: the largest difference of one frame in [-1, 1], and of the pixel values that a dream
    of DREAM steps shows, the share that differ, the largest difference in levels of 255 and the PSNR."""
    given, dreams, frames = example_inputs(learned), {}, {}
    for name, way in ways.items():
        with torch.inference_mode():
            frames[name] = way(*given)
        learned.generator.forward = way
        rng, chance = terrella.make_rng(1), terrella.make_rng(2)
        state, shown = learned.start(1, rng), []
        for _ in range(DREAM):
            state = learned.imagine(state, learned.spec.sample_action(1, chance), rng)
            shown.append(learned.render(state, ("rgb",))["rgb"].int())
        dreams[name] = torch.stack(shown)
    vars(learned.generator).pop("forward", None)
    found = {}
    for name in ways:
        apart = (dreams[name] - dreams[EAGER]).abs()
        error = float(apart.double().square().mean())
        found[name] = {
            "frame": float((frames[name] - frames[EAGER]).abs().max()),
            "dream_share": float((apart > 0).double().mean()),
            "dream_levels": int(apart.max()),
            "dream_psnr_db": float(10 * torch.log10(torch.tensor(255**2 / error))) if error else float("inf"),
        }
    return found


def report(found: dict) -> str:
    lines = [f"{found['world']}, {found['turns']} frames of each way, drawn in turns"]
    for row in found["rows"]:
        same = [r for r in found["rows"] if (r["threads"], r["what"]) == (row["threads"], row["what"])]
        base = next(r for r in same if r["way"] == EAGER)
        lines.append(
            f"  {row['threads']} threads  {row['what']:10}  {row['way']:13} {row['ms']:7.2f} ms (95%: {row['p95_ms']:.1f})  "
            f"{1e3 / row['ms']:6.1f} frames/s  x{base['ms'] / row['ms']:.2f};  processor {row['cpu_ms']:6.2f} ms  "
            f"x{base['cpu_ms'] / row['cpu_ms']:.2f}"
        )
    for name, beside in found["beside_eager"].items():
        lines.append(
            f"  {name:13} beside eager: one frame within {beside['frame']:.1e}; {DREAM} steps: {beside['dream_share']:.1e} of "
            f"the pixel values differ, by {beside['dream_levels']} levels at most, {beside['dream_psnr_db']:.0f} dB"
        )
    for threads, took in found["prepared_s"].items():
        lines.append(f"  {threads} threads, to prepare: " + ", ".join(f"{n} {s:.1f} s" for n, s in took.items()))
    return "\n".join(lines)


if __name__ == "__main__":
    tyro.cli(main)
