"""How fast worlds step and learn on a GPU: correctness beside the CPU, a table with the bars, and a profile of what misses its bar.

    make bench-gpu                      # eight minutes at most on one card; needs the wheels in NEEDED beside PyTorch
    make bench-gpu ARGS=--cpu           # rehearses all of it on a CPU, with small networks and batches: its figures say nothing
    make bench-gpu ARGS="--learn gym:ALE/Breakout-v5 gym:ALE/Pong-v5 --minutes 10"   # instead: from an id to a score, one by one

Prints a table and writes bench-gpu.json.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
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
from terrella.core.errors import TerrellaError  # noqa: E402
from terrella.learn.feeds import RandomBatches  # noqa: E402
from terrella.learn.objectives.flow_frames import FlowClips, FlowFrames  # noqa: E402
from terrella.learn.recipes.video_flat import FLOW_ROLLOUT as ROLLOUT  # noqa: E402
from terrella.learn.train_step import TrainStep  # noqa: E402
from terrella.learn.trainer import Run, Trainer  # noqa: E402
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
    """A line of the table. bar: the least frames/s or steps/s on one H100; kernels: dispatched by a step as it is, most_kernels at
    most."""

    what: str
    batch: int
    bar: float
    most_kernels: int = 0
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
    learn: tuple[str, ...] = ()  # Environments that `terrella learn` learns instead, one after the other.
    minutes: float = 10.0  # Of each of these.

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


# Of each world the bar of kernels a step, and batches with the bars of their speed on one H100. The arm: 430,000 imagined seconds
# a second, in steps of 0.1 s with actions drawn for each.
BARS = {
    "doom-maze": (900, ((1, 250), (256, 5000))),
    "doom-corridor": (1100, ((1, 200),)),
    "islet": (500, ((1, 300), (512, 15_000))),
    "flow": (300, ((1, 400), (512, 5000))),
    "latent": (80, ((65_536, 1e7),)),
    "arm": (60, ((65_536, 4.3e6),)),
}
ELSEWHERE = {  # bars that take longer than this script, and the command that measures each
    "ten minutes from id to score": "--learn gym:ALE/Breakout-v5 gym:ALE/Pong-v5 ... --minutes 10",
    "beside DIAMOND's own code": "lab/atari_beside_diamond.py",
}


def rows_of(settings: Settings) -> Iterator[tuple[Row, Callable[[], Any]]]:
    """The rows of worlds, and what makes each world."""
    for name, (kernels, batches) in BARS.items():
        loads = name in ("doom-maze", "doom-corridor", "islet")
        for batch, bar in batches[: 1 if settings.cpu and loads else None]:
            row = Row(name, min(batch, 2) if settings.cpu else batch, bar, kernels)
            if loads:
                yield row, lambda name=name: terrella.load(name)
            else:
                yield (
                    row,
                    lambda name=name: flow_world(settings) if name == "flow" else latent_world(settings, name == "arm"),
                )


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
    count = counted(reference.to("meta"))
    row.kernels, row.waits = count.kernels, count.waits
    step = StepPrograms(world, "inductor" if settings.compile and not settings.cpu else None)

    def run() -> None:
        nonlocal state
        fresh = torch.rand_like(numbers) * 2 - 1 if row.what == "arm" else numbers
        state = step(state, fresh, seeds)

    row.per_s = row.batch * runs_per_second(run, settings)
    row.way = next(iter(step.programs.values())).way
    if row.per_s < row.bar:
        row.profile = profiled(run, settings) | {"call sites": dict(count.by_site.most_common(10))}
    return row


def counted(world: Any) -> Dispatches:
    """What a step and its picture dispatch, on meta tensors."""
    rng, shown = make_rng(0), [name for name in ("rgb", "reward", "done") if name in world.spec.channels]
    state, action = world.start(1, rng), world.spec.sample_action(1, rng)
    for _ in range(2):
        state = world.imagine(state, action, rng)
        world.render(state, shown)
    for arena in state.arenas.values():
        arena.make_room(1)
    with Dispatches("meta") as count:
        world.render(world.imagine(state, action, rng), shown)
    return count


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
    """Frames a second of the training of a flow network by clips of a recording that lies on the device as uint8: as `train video`
    trains it after its drafts, gradients and updates included."""
    device, network = settings.device, flow_world(settings).generator.train().requires_grad_(True)
    objective = FlowFrames(network.to(device), 6e-3, ROLLOUT, 4.0)
    if settings.compile and not settings.cpu:
        objective.compile()
    slots, length = network.config.slots, 64 if settings.cpu else 20_000
    recording = torch.randint(0, 256, (length, 3, 64, 64), dtype=torch.uint8, device=device)
    window = torch.arange(slots + ROLLOUT, device=device)

    def clips(now: TrainStep) -> FlowClips:
        rows = (now.rand(row.batch, 1) * (length - len(window))).long() + window
        return FlowClips(recording[rows], now.rand(row.batch, len(window), 4), None)

    with TemporaryDirectory() as folder:
        run_facts = Run(Path(folder), {}, lambda *_: None, device=device)
        trainer = Trainer(run_facts, "flow", RandomBatches(clips), objective, 1000, strides=ROLLOUT)
        trainer.facts["step"] = 500  # of 1000 batches: beyond the drafts
        run = lambda: trainer._step(trainer.facts["step"])  # noqa: E731
        row.per_s, row.way = (
            row.batch * ROLLOUT * runs_per_second(run, settings),
            "bf16" if not settings.cpu else "float32",
        )
        with Dispatches(device) as count:
            run()
        row.waits = count.waits if not settings.cpu else 0  # a CPU may look at its losses at once
        if row.per_s < row.bar:
            row.profile = profiled(run, settings) | {"call sites": dict(count.by_site.most_common(10))}
    return row


def robot(row: Row, settings: Settings) -> Row:
    """Steps of 5 ms a second of go1 with random actions, observed; on a card by mujoco-warp."""
    if absent := [
        name for name in ("mujoco", "mjlab", *(() if settings.cpu else ("mujoco_warp", "warp"))) if not find_spec(name)
    ]:
        row.error = f"not measured, without {', '.join(absent)}"
        return row
    world = terrella.load("mujoco:go1", cameras=(), device="" if settings.cpu else "cuda")
    rng, names = (
        make_rng(0),
        [name for name in world.spec.channels if name in ("observation", "qpos", "qvel", "reward")],
    )
    state = fresh = world.start(row.batch, rng)
    low, high = (torch.as_tensor(limit, device=state.device) for limit in world.spec.action_limits)

    def run() -> None:
        nonlocal state
        action = torch.lerp(low, high, torch.rand(row.batch, len(low), device=state.device))
        state = world.imagine(state, action, rng)
        state = state.mixed(state["done"], fresh)
        world.render(state, names)

    many = world.spec.dt_s / 0.005  # steps of 5 ms in one of the world
    row.per_s, row.way = row.batch * many * runs_per_second(run, settings), "steps of 5 ms"
    return row


def learned(name: str, settings: Settings) -> dict[str, Any]:
    """What `terrella learn` makes of an environment in the minutes: steps, seconds of each stage, the verdict of its score."""
    out = settings.out.parent / "bench-learned" / re.sub(r"[^\w.-]+", "-", name)
    config = terrella.LearnConfig(minutes=settings.minutes, out=out, device=settings.device.type)
    try:
        result = terrella.learn(name, config, progress=print)
    except TerrellaError as error:
        return {"environment": name, "error": str(error)}
    facts = {"environment": name, "minutes": settings.minutes, "steps": result.steps, "seconds": dict(result.spent_s)}
    return facts | {"verdict": list(result.verdict), "card": str(result.card)}


def learn_all(settings: Settings) -> int:
    """Learns the environments, nothing beside them: a compilation takes the cores that a recording needs."""
    found = []
    for name in settings.learn:
        found.append(learned(name, settings))
        print("\n".join([name, *found[-1].get("verdict", [found[-1].get("error", "")])]), flush=True)
        settings.out.write_text(json.dumps({"rehearsal": settings.cpu, "learned": found}, indent=1))
    return 1 if any("error" in one for one in found) else 0


def runs_per_second(run: Callable[[], Any], settings: Settings) -> float:
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


def profiled(run: Callable[[], Any], settings: Settings) -> dict[str, Any]:
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
    lines = [f"{'':16} {'batch':>7} {'per second':>13} {'bar':>11}      kernels  bar      waits  differs"]
    for row in rows:
        verdict = "-" if row.error else "pass" if row.per_s >= row.bar else "miss"
        rate = f"{row.per_s:13,.1f} {row.bar:11,.0f} {verdict}"
        fewer = "pass" if row.kernels <= row.most_kernels else "miss"
        kernels = (
            f"{row.kernels:6,} {row.most_kernels:5,} {fewer}" if row.most_kernels and not row.error else f"{'':17}"
        )
        lines.append(
            f"{row.what:16} {row.batch:7,} {rate} {kernels} {row.waits:5} {row.off:8.2%}  {row.error or row.way}"
        )
    return "\n".join(lines)


def main(settings: Settings) -> int:
    if not settings.cpu and not torch.cuda.is_available():
        print("PyTorch finds no CUDA device here; ARGS=--cpu rehearses the script on a CPU.")
        return 2
    if settings.learn:
        return learn_all(settings)
    absent = [name for name in ("mujoco", "mjlab", "mujoco_warp", "warp") if not find_spec(name)]
    if absent:
        print(f"Without {', '.join(absent)}: MuJoCo on the card is not measured.")
    device = torch.cuda.get_device_name() if not settings.cpu else "CPU (a rehearsal)"
    print(f"{device}, PyTorch {torch.__version__}", flush=True)
    rows = []
    jobs: list[tuple[Row, Callable[..., Row]]]
    jobs = [(row, lambda row, make=make: measured(row, make, settings)) for row, make in rows_of(settings)]
    jobs.append((Row("flow training", 2 if settings.cpu else 128, 5000), lambda row: trained(row, settings)))
    jobs.append((Row("go1", 2 if settings.cpu else 8192, 1.5e6), lambda row: robot(row, settings)))
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
    for what, how in ELSEWHERE.items():
        print(f"{what}: not measured here. {how}")
    settings.out.write_text(
        json.dumps({"device": device, "rehearsal": settings.cpu, "rows": [asdict(row) for row in rows]}, indent=1)
    )
    for row in rows:
        if row.profile:
            print(f"\n{row.what}, batch {row.batch}: {json.dumps(row.profile, indent=1)}")
    return 1 if any(row.error and "not measured" not in row.error for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Settings, description=__doc__)))
