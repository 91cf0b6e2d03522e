"""How fast worlds step and learn on a GPU: correctness beside the CPU, a table with the bars, and a profile of what misses its bar.

    make bench-gpu                      # eight minutes at most on one card; needs the wheels in NEEDED beside PyTorch
    make bench-gpu ARGS=--cpu           # rehearses all of it on a CPU, with small networks and batches: its figures say nothing

Prints a table and writes bench-gpu.json.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

NEEDED = ("torch", "numpy", "numba", "gymnasium", "safetensors", "tyro", "PIL")
if missing := [name for name in NEEDED if not find_spec(name)]:
    sys.exit(f"Install these first: pip install {' '.join(missing)}  (PIL is the package pillow)")

import torch  # noqa: E402
import tyro  # noqa: E402

import terrella  # noqa: E402
from terrella.core import chance, make_rng  # noqa: E402
from terrella.core.backend import tensor_programs  # noqa: E402
from terrella.core.dispatch import Dispatches  # noqa: E402
from terrella.learn.devices import half_precision  # noqa: E402
from terrella.worlds.config import HistoryConfig  # noqa: E402
from terrella.worlds.controls import AXES, Controls  # noqa: E402
from terrella.worlds.flow import FlowConfig, FlowNetwork  # noqa: E402
from terrella.worlds.frame_history import FrameHistory, StartClips  # noqa: E402
from terrella.worlds.latent import LatentWorld  # noqa: E402
from terrella.worlds.latent_network import LatentConfig, LatentNetwork  # noqa: E402
from terrella.worlds.learned import About, LearnedWorld  # noqa: E402
from terrella.worlds.step_program import StepPrograms  # noqa: E402

LARGE = (144, 256, 352)  # widths of a flow network of some 12M parameters
SMALL = (16, 24, 32)


@dataclass
class Row:
    """A line of the table. bar: the least frames/s or steps/s on one H100; kernels: dispatched by a step as it is."""

    what: str
    batch: int
    bar: float
    per_s: float = 0.0
    way: str = ""
    kernels: int = 0
    waits: int = 0
    off: float = 0.0  # share of pixels or numbers that differ from the CPU's
    error: str = ""
    profile: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Settings:
    """What is measured and for how long."""

    cpu: bool = False  # Rehearse on a CPU.
    only: tuple[str, ...] = ()  # Names of the rows, by default all.
    seconds: float = 5.0  # Of each row.
    compile: bool = True  # --no-compile: steps are captured as they are.
    out: Path = Path("bench-gpu.json")

    @property
    def device(self) -> torch.device:
        return torch.device("cpu" if self.cpu else "cuda")


def flow_world(settings: Settings) -> LearnedWorld:
    """A world of frames alone, 64 x 64, untrained but not silent."""
    size, slots, actions = (64, 64), 4, 4
    torch.manual_seed(0)
    network = FlowNetwork(FlowConfig(size, slots, 36 + slots * actions, channels=SMALL if settings.cpu else LARGE))
    torch.nn.init.normal_(network.output.weight, std=0.1)
    frames = torch.randint(0, 256, (8, slots, 3, *size), dtype=torch.uint8, generator=make_rng(0))
    scene = FrameHistory(HistoryConfig(size, slots, actions), StartClips.of(frames, actions))
    return LearnedWorld(About("flow", Controls.buttons(actions), 0.1), scene=scene, generator=network)


def latent_world(settings: Settings, arm: bool) -> LatentWorld:
    """A latent world of pictures, or an arm of four joints that is its own latent."""
    shape: dict = {"vectors": (("qpos", 4), ("qvel", 4)), "identity": True, "latent": 8} if arm else {"size": (64, 64)}
    torch.manual_seed(0)
    network = LatentNetwork(LatentConfig(2, **shape))
    return LatentWorld(
        About("latent", Controls(AXES, (-1.0,) * 2, (1.0,) * 2), 0.1), network, torch.randn(8, network.config.latent)
    )


def rows_of(settings: Settings) -> Iterator[tuple[str, int, float, Callable[[], Any]]]:
    """Name, batch, bar and maker of each world."""
    many = (lambda batch: 2) if settings.cpu else (lambda batch: batch)
    for name, batches in (("doom-maze", ((1, 250), (256, 5000))), ("doom-corridor", ((1, 200),))):
        for batch, bar in batches[: 1 if settings.cpu else None]:
            yield name, batch, bar, lambda name=name: terrella.load(name)
    for batch, bar in ((1, 400), (512, 5000)):
        yield "flow", many(batch), bar, lambda: flow_world(settings)
    yield "latent", many(65_536), 1e7, lambda: latent_world(settings, False)
    yield "arm", many(65_536), 1e7, lambda: latent_world(settings, True)


def measured(row: Row, make: Callable[[], Any], settings: Settings) -> Row:
    """The row with what was measured."""
    device, reference = settings.device, make()
    world = reference.to(device)
    row.off = differing(reference, world, settings)
    rng = make_rng(0)
    state, action = world.start(row.batch, rng), world.spec.sample_action(row.batch, rng)
    numbers, seeds = world.controls.encode(action.to(device)), chance.seeds(row.batch, rng, device)
    for _ in range(2):
        state = world.advance(state, numbers, seeds)
    with Dispatches(device) as count:
        drawn(world.advance(state, numbers, seeds))
    row.kernels, row.waits = count.kernels, count.waits
    step = StepPrograms(world, "inductor" if settings.compile and not settings.cpu else None)

    def run() -> None:
        nonlocal state
        state = step(state, numbers, seeds)

    row.per_s = row.batch * runs_per_second(run, settings)
    row.way = next(iter(step.programs.values())).way
    if row.per_s < row.bar:
        row.profile = profiled(run, settings) | {"call sites": dict(count.by_site.most_common(10))}
    return row


def differing(reference, world, settings: Settings) -> float:
    """The share of pixels, or numbers of a latent, that differ by more than rounding from those of the CPU's own way after three
    steps with the same seeds."""
    shown = []
    for one, programs in ((reference, False), (world, settings.cpu)):
        with ExitStack() as stack:
            if programs:
                stack.enter_context(tensor_programs())
            rng = make_rng(7)
            state = one.start(2, rng)
            for step in range(3):
                state = one.imagine(state, one.spec.sample_action(2, make_rng(step)), rng)
            name = "rgb" if isinstance(one, LearnedWorld) else "latent"
            shown.append(one.render(state, [name])[name].float().cpu())
    allowed = 2.0 if shown[0].amax() > 8 else 1e-3
    return float(((shown[0] - shown[1]).abs() > allowed).float().mean())


def trained(row: Row, settings: Settings) -> Row:
    """Frames a second of a flow network's training from clips that lie on the device as uint8: bf16, gradients and updates."""
    device, world = settings.device, flow_world(settings)
    network = world.generator.to(device).train().requires_grad_(True)
    optimiser = torch.optim.AdamW(network.parameters(), 1e-4, fused=not settings.cpu)
    slots, length = network.config.slots, 64 if settings.cpu else 20_000
    recording = torch.randint(0, 256, (length, 3, 64, 64), dtype=torch.uint8, device=device)
    window = torch.arange(slots + 1, device=device)

    def loss(clips: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        truth = clips.float() / 127.5 - 1
        with half_precision(device):
            seen = network.encode(truth[:, 1:], noise.new_zeros(len(clips), network.config.context))
            made = network.clean(seen, noise, noise.new_full((len(clips),), 0.5))
        return (made - truth[:, 0]).square().mean()

    fast = torch.compile(loss) if settings.compile and not settings.cpu else loss

    def run() -> None:
        rows = torch.randint(slots, length, (row.batch, 1), device=device) - window
        optimiser.zero_grad()
        fast(recording[rows], torch.randn(row.batch, 3, 64, 64, device=device)).backward()
        optimiser.step()

    row.per_s, row.way = row.batch * runs_per_second(run, settings), "bf16" if not settings.cpu else "float32"
    if row.per_s < row.bar:
        row.profile = profiled(run, settings)
    return row


def drawn(state) -> None:
    """Has every tensor of the state computed."""
    for name in state:
        state[name]


def runs_per_second(run: Callable[[], None], settings: Settings) -> float:
    run()
    run()
    wait(settings)
    began, count = time.perf_counter(), 0
    while count < 2 or time.perf_counter() - began < settings.seconds:
        run()
        count += 1
        if count % 8 == 0:
            wait(settings)
    wait(settings)
    return count / (time.perf_counter() - began)


def wait(settings: Settings) -> None:
    if not settings.cpu:
        torch.cuda.synchronize()


def profiled(run: Callable[[], None], settings: Settings) -> dict[str, Any]:
    """What a run does: launches, share of the time in which the device works, the ten kernels that take longest in milliseconds."""
    activities = [torch.profiler.ProfilerActivity.CPU] + [torch.profiler.ProfilerActivity.CUDA] * (not settings.cpu)
    began = time.perf_counter()
    with torch.profiler.profile(activities=activities) as profile:
        run()
        wait(settings)
    took_ms = (time.perf_counter() - began) * 1e3
    events = profile.key_averages()
    times = {
        event.key: (event.self_cpu_time_total if settings.cpu else event.self_device_time_total) / 1e3
        for event in events
    }
    leading = sorted(times.items(), key=lambda pair: -pair[1])[:10]
    launches = sum(event.count for event in events if "Launch" in event.key)
    return {
        "launches": launches,
        "busy": min(1.0, sum(times.values()) / took_ms),
        "kernels": {name: round(ms, 3) for name, ms in leading},
    }


def table(rows: list[Row]) -> str:
    lines = [f"{'':16} {'batch':>7} {'per second':>13} {'bar':>11}      kernels waits  differs"]
    for row in rows:
        verdict = "error" if row.error else "holds" if row.per_s >= row.bar else "short"
        rate = f"{row.per_s:13,.1f} {row.bar:11,.0f} {verdict}"
        counts = f"{row.kernels:6,} {row.waits:5} {row.off:8.2%}"
        lines.append(f"{row.what:16} {row.batch:7,} {rate} {counts}  {row.error or row.way}")
    return "\n".join(lines)


def main(settings: Settings) -> int:
    if not settings.cpu and not torch.cuda.is_available():
        print("PyTorch finds no CUDA device here; ARGS=--cpu rehearses the script on a CPU.")
        return 2
    absent = [name for name in ("mujoco_warp", "warp") if not find_spec(name)]
    if absent:
        print(f"Without {', '.join(absent)}: MuJoCo on the card is not measured.")
    device = torch.cuda.get_device_name() if not settings.cpu else "CPU (a rehearsal)"
    print(f"{device}, PyTorch {torch.__version__}", flush=True)
    rows = []
    jobs = [
        (Row(name, batch, bar), lambda row, make=make: measured(row, make, settings))
        for name, batch, bar, make in rows_of(settings)
    ]
    jobs.append((Row("flow training", 2 if settings.cpu else 256, 5000), lambda row: trained(row, settings)))
    for row, job in jobs:
        if settings.only and row.what not in settings.only:
            continue
        try:
            rows.append(job(row))
        except Exception as error:  # the other rows are still measured
            row.error = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
            rows.append(row)
        print(table(rows[-1:]).splitlines()[1], flush=True)
    print(table(rows))
    settings.out.write_text(
        json.dumps({"device": device, "rehearsal": settings.cpu, "rows": [asdict(row) for row in rows]}, indent=1)
    )
    for row in rows:
        if row.profile:
            print(f"\n{row.what}, batch {row.batch}: {json.dumps(row.profile, indent=1)}")
    return 1 if any(row.error for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Settings, description=__doc__)))
