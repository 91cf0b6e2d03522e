"""Plays a world through the real server and a real browser, and prints what a player gets; beside DIAMOND if asked.

    python benchmarks/play.py doom-maze --minutes 10 --diamond ~/diamond
    python benchmarks/play.py doom-maze --minutes 60 --fast

DIAMOND (https://github.com/eloialonso/diamond) is imported from the user's own checkout: its Atari denoiser with its
published configuration (64x64, 3 denoising steps), random weights, which cost the same as trained ones.
"""

from __future__ import annotations

import contextlib
import json as jsonlib
import os
import random
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

import tyro

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = ["--disable-gpu", "--disable-background-networking", "--disable-component-update"]
FLAGS += ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []

SERVER = """
import sys, terrella
from terrella.serve import ServeConfig, serve
options = {"fast": True} if sys.argv[2:] == ["fast"] else {}
serve([terrella.load(sys.argv[1], **options)], ServeConfig(port=0), on_ready=lambda address: print(address, flush=True))
"""

OURS = """
import json, sys, time, torch, terrella
world = terrella.load(sys.argv[1])
rng = torch.Generator().manual_seed(0)
times, state = [], world.start(1, rng)
with torch.no_grad():
    for step in range(int(sys.argv[2])):
        action = world.spec.sample_action(1, rng)
        begun = time.perf_counter()
        state = world.imagine(state, action, rng)
        world.render(state, ("rgb",))
        times.append(time.perf_counter() - begun)
        if "done" in world.spec.channels and bool(world.render(state, ("done",))["done"][0]):
            state = world.start(1, rng)
height, width, _ = world.spec.channels["rgb"].shape
print(json.dumps({"ms": [t * 1e3 for t in times[5:]], "pixels": height * width, "threads": torch.get_num_threads()}))
"""

# The denoiser needs only two type names of DIAMOND's `data` and `utils`, which would pull in its training stack.
DIAMOND = """
import json, sys, time, types, torch
sys.path.insert(0, sys.argv[1] + "/src")
for name, needed in (("data", "Batch"), ("utils", "LossAndLogs")):
    sys.modules[name] = types.ModuleType(name)
    setattr(sys.modules[name], needed, object)
from models.diffusion import Denoiser, DenoiserConfig, DiffusionSampler, DiffusionSamplerConfig, InnerModelConfig
inner = InnerModelConfig(img_channels=3, num_steps_conditioning=4, cond_channels=256, depths=[2, 2, 2, 2],
                         channels=[64, 64, 64, 64], attn_depths=[0, 0, 0, 0], num_actions=18)
torch.manual_seed(0)
denoiser = Denoiser(DenoiserConfig(inner_model=inner, sigma_data=0.5, sigma_offset_noise=0.3)).eval()
sampler = DiffusionSampler(denoiser, DiffusionSamplerConfig(num_steps_denoising=3))
seen, acts, times = torch.rand(1, 4, 3, 64, 64) * 2 - 1, torch.zeros(1, 4, dtype=torch.long), []
with torch.no_grad():
    for step in range(int(sys.argv[2])):
        begun = time.perf_counter()
        frame, _ = sampler.sample(seen, acts)
        times.append(time.perf_counter() - begun)
        seen = torch.cat([seen[:, 1:], frame[:, None]], 1)
print(json.dumps({"ms": [t * 1e3 for t in times[5:]], "pixels": 64 * 64, "threads": torch.get_num_threads()}))
"""


def main(
    world: Annotated[str, tyro.conf.Positional] = "doom-maze",
    minutes: float = 1.0,
    diamond: Path | None = None,
    fast: bool = False,
    json: bool = False,
) -> None:
    """Measure play: delivered frames, key-to-frame latency, drift of the frame time, memory, time to the first frame.

    Args:
        world: What `terrella list` shows, or the path of a checkpoint.
        minutes: How long to play.
        diamond: A checkout of DIAMOND, to time its denoiser in the same run.
        fast: Play as `terrella play --fast` does (DIAMOND is set against eager torch all the same).
        json: Print one JSON document instead of lines.
    """
    result = play(world, minutes, fast)
    if diamond is not None:
        result["beside_diamond"] = beside_diamond(world, diamond)
    print(jsonlib.dumps(result, indent=1) if json else report(result))


def play(world: str, minutes: float, fast: bool = False) -> dict:
    """Drives headless Chromium with keys for `minutes`; figures of what was painted on its canvas."""
    from playwright.sync_api import sync_playwright

    found = os.environ.get("TERRELLA_BROWSER") or next(filter(None, map(shutil.which, BROWSERS)), None)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=FLAGS)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        begun = time.monotonic()
        with serving(world, fast) as (process, address):
            page.goto(address)
            while not page.evaluate("!!window.terrella && terrella.painted > 0"):
                if time.monotonic() - begun > 120 or page.evaluate("window.terrella?.state === 'refused'"):
                    sys.exit(f"no frame came: {page.locator('#banner').inner_text()}")
                time.sleep(0.01)
            first_frame_s = time.monotonic() - begun
            frames, resident = drive(page, process.pid, minutes * 60)
            latencies, dropped = page.evaluate("[terrella.latencies, terrella.dropped]")
            pixels = page.evaluate("(c => [c.height, c.width])(document.querySelector('figure canvas'))")
        browser.close()
    return summary(world, pixels, first_frame_s, frames, resident, latencies, dropped)


@contextlib.contextmanager
def serving(world: str, fast: bool):
    given = [sys.executable, "-c", SERVER, world, *(["fast"] if fast else [])]
    process = subprocess.Popen(given, stdout=subprocess.PIPE, text=True)
    try:
        address = process.stdout.readline().strip() if process.stdout else ""
        if not address:
            sys.exit(f"the server did not start (exit {process.wait()}); see its words above.")
        yield process, address
    finally:
        process.terminate()
        process.wait(20)


def drive(page, pid: int, seconds: float) -> tuple[list[dict], list[tuple[float, float]]]:
    """Holds one or two random keys at a time, as a player would; the painted frames and (time, resident MiB) samples."""
    chance, frames, resident = random.Random(0), [], []
    codes = page.evaluate("terrella.keys")
    begun = polled = time.monotonic()
    seq = page.evaluate("terrella.framesAfter(0).at(-1)?.seq ?? 0")
    while time.monotonic() - begun < seconds:
        held = chance.sample(codes, min(len(codes), chance.choice([1, 1, 2])))
        for code in held:
            page.keyboard.down(code)
        time.sleep(chance.uniform(0.15, 0.6))
        for code in held:
            page.keyboard.up(code)
        time.sleep(chance.uniform(0.0, 0.1))
        if time.monotonic() - polled > 5:
            polled = time.monotonic()
            frames += page.evaluate(f"terrella.framesAfter({frames[-1]['seq'] if frames else seq})")
            resident.append((polled - begun, resident_mib(pid)))
    frames += page.evaluate(f"terrella.framesAfter({frames[-1]['seq'] if frames else seq})")
    resident.append((time.monotonic() - begun, resident_mib(pid)))
    return frames, resident


def resident_mib(pid: int) -> float:
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
    except OSError:
        return float("nan")


def summary(world, pixels, first_frame_s, frames, resident, latencies, dropped) -> dict:
    times = [frame["t"] for frame in frames]
    if len(times) < 20 or len(latencies) < 2:
        sys.exit(
            f"only {len(times)} frames and {len(latencies)} key changes were seen; play for longer with --minutes."
        )
    span = min(60e3, (times[-1] - times[0]) / 2)  # the first and the last minute, or half of a shorter run
    early = [frame for frame in frames if frame["t"] <= times[0] + span]
    late = [frame for frame in frames if frame["t"] >= times[-1] - span]
    after_warmup = [mib for at, mib in resident if at >= min(60.0, resident[-1][0] / 2)]
    return {
        "world": world,
        "height": pixels[0],
        "width": pixels[1],
        "seconds": (times[-1] - times[0]) / 1e3,
        "frames_painted": len(times),
        "frames_decoded_but_not_painted": dropped,
        "fps_delivered": (len(times) - 1) * 1e3 / (times[-1] - times[0]),
        "key_to_frame_ms": {"p50": quantile(latencies, 0.5), "p95": quantile(latencies, 0.95), "n": len(latencies)},
        "frame_interval_ms": {
            "first": interval(early),
            "last": interval(late),
            "ratio": interval(late) / interval(early),
        },
        "generation_ms": {"first": made(early), "last": made(late), "ratio": made(late) / made(early)},
        "resident_mib": {"after_warmup": after_warmup[0], "last": after_warmup[-1]},
        "first_frame_s": first_frame_s,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
    }


def quantile(values: list[float], q: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(q * len(ordered)))]


def interval(frames: list[dict]) -> float:
    return (frames[-1]["t"] - frames[0]["t"]) / (len(frames) - 1)


def made(frames: list[dict]) -> float:
    return statistics.median(frame["generationMs"] for frame in frames)


def beside_diamond(world: str, checkout: Path, steps: int = 25, rounds: int = 2) -> dict:
    """Model time alone, in turns so that both meet the same machine: one step of the world, one frame of DIAMOND."""
    checkout = checkout.expanduser().resolve()
    if not (checkout / "src" / "models" / "diffusion" / "denoiser.py").exists():
        sys.exit(
            f"{checkout} is no checkout of DIAMOND; git clone https://github.com/eloialonso/diamond and pass its folder."
        )
    ours, theirs = [], []
    for _ in range(rounds):
        ours.append(timed(OURS, world, steps))
        theirs.append(timed(DIAMOND, str(checkout), steps))
    ours_ms, theirs_ms = (statistics.median(sum((run["ms"] for run in runs), [])) for runs in (ours, theirs))
    ours_px, theirs_px = ours[0]["pixels"], theirs[0]["pixels"]
    return {
        "world_ms": ours_ms,
        "diamond_ms": theirs_ms,
        "threads": ours[0]["threads"],
        "times_faster_per_frame": theirs_ms / ours_ms,
        "times_faster_per_pixel": (theirs_ms / theirs_px) / (ours_ms / ours_px),
    }


def timed(program: str, subject: str, steps: int) -> dict:
    done = subprocess.run([sys.executable, "-c", program, subject, str(steps)], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"a timing failed:\n{done.stderr}")
    return jsonlib.loads(done.stdout.strip().splitlines()[-1])


def report(result: dict) -> str:
    key, frame, made_ms, mib = (
        result[k] for k in ("key_to_frame_ms", "frame_interval_ms", "generation_ms", "resident_mib")
    )
    lines = [
        f"{result['world']} at {result['width']}x{result['height']}, {result['seconds']:.0f} s, {result['cores']} cores",
        f"  delivered          {result['fps_delivered']:.1f} frames/s",
        f"  key to frame       p50 {key['p50']:.0f} ms, p95 {key['p95']:.0f} ms (n={key['n']})",
        f"  frame interval     first {frame['first']:.2f} ms, last {frame['last']:.2f} ms (x{frame['ratio']:.3f})",
        f"  generation         first {made_ms['first']:.2f} ms, last {made_ms['last']:.2f} ms (x{made_ms['ratio']:.3f})",
        f"  resident memory    {mib['after_warmup']:.0f} MiB, at the end {mib['last']:.0f} MiB",
        f"  first frame after  {result['first_frame_s']:.1f} s",
    ]
    if peer := result.get("beside_diamond"):
        lines += [
            f"  one step           {peer['world_ms']:.1f} ms; DIAMOND, 3 steps at 64x64: {peer['diamond_ms']:.1f} ms",
            f"  beside DIAMOND     x{peer['times_faster_per_frame']:.2f} faster per frame, "
            f"x{peer['times_faster_per_pixel']:.2f} per pixel",
        ]
    return "\n".join(lines)


if __name__ == "__main__":
    tyro.cli(main)
