"""`collect`: a policy's or a person's episodes of a world become a recording."""

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from .. import library
from ..act.explorer import Explorer
from ..act.policies_by_name import policy_of
from ..core.errors import DatasetError, TerrellaError
from ..core.policy import Policy
from ..core.spec import Spec
from ..core.world import World, make_rng
from ..data import Dataset, Layout, Recorder, RecordOptions, record
from ..data.collect import Job, LocalWorkers
from ..data.collect import collect as collect_episodes
from ..data.ray import RayWorkers
from .opening import ControlsConfig, EnvironmentConfig, load_named
from .progress import Progress, Report, silent, stage
from .real_environment import check_alike, open_real
from .recording_facts import describe, recording_facts
from .results import jsonable

FRAMES = 10_000
SMALL_SIDE = 96  # pixels: pictures with shorter sides are stored as PNG

Pictures = Literal["auto", "png", "video", "none"]
Stored = Literal["video", "png"]


@dataclass(frozen=True)
class RecordConfig:
    """Settings of every recording."""

    out: Path  # Folder of the dataset (LeRobot v3). An unfinished recording there is continued.
    human: bool = False  # Play in the browser yourself; without it a script explores.
    live_mcap: str | None = None  # Also log to a file NAME.mcap, or to Foxglove at a port of this machine.
    seed: int = 0  # The same seed gives the same result.
    port: int = 8765  # Port of the page; 0 picks a free one.


@dataclass(frozen=True)
class DoomRecordConfig(RecordConfig):
    """Settings of a recording of Doom."""

    scenario: str = "my_way_home"
    """A ViZDoom scenario, or maps of a game: freedoom2/MAP01,MAP02 (each episode uses one of them)."""
    skill: int | None = None  # Difficulty, 1 to 5; default: the scenario's own.
    frames: int = 100_000  # Frames to record in all. With --human there is no limit.
    height: int = 192  # Height of the pictures in pixels; the width is 4/3 of it.


@dataclass(frozen=True)
class CollectConfig(RecordConfig):
    """Settings of a recording of any world."""

    frames: int | None = None  # Frames to record in all; default 10,000. With --human there is no limit.
    pictures: Pictures = "auto"
    """"png" is lossless, "video" is H.264, "auto" is png up to 96 pixels a side and video above; "none" draws none."""
    policy: str | None = None
    """explorer, random, idle, plan, constant:VALUE, the folder of a learned policy, MODULE:NAME or FILE.py:NAME."""
    inside: Annotated[str | None, arg(name="in")] = None
    """The world in which the policy `plan` plans, or through which a learned policy acts; default: the recorded one. It gives the
    default size of a Gymnasium environment's pictures."""
    episodes: int | None = None  # Whole episodes to record in all, in place of --frames.
    workers: int | None = None
    """Processes that play at the same time, an episode each; the recording is the same with any number of them."""
    on: Literal["here", "ray"] = "here"
    """Where the workers are: processes of this machine, or Ray's (of the cluster at RAY_ADDRESS, if it is set)."""
    controls: ControlsConfig = ControlsConfig()
    environment: EnvironmentConfig = EnvironmentConfig()

    @property
    def by_workers(self) -> bool:
        return self.episodes is not None or self.workers is not None or self.on != "here"

    def check(self) -> None:
        """TerrellaError for settings that exclude each other."""
        if self.by_workers and (self.human or self.live_mcap):
            raise TerrellaError("--human and --live-mcap are for one player; leave --episodes, --workers and --on out.")
        if self.human and self.policy:
            raise TerrellaError("--human and --policy both say who plays; give one of them.")
        if self.frames is not None and self.episodes is not None:
            raise TerrellaError("--frames and --episodes both say how much to record; give one of them.")
        named = re.split("[@:]", self.policy or "")[0]
        if self.inside and named != "plan" and not (named and Path(named).is_dir()):
            raise TerrellaError(
                "--in is for a --policy that plans or acts in a world: plan, or a learned one's folder."
            )
        if self.inside and self.environment.randomise is not None:
            raise TerrellaError("--randomise is for a simulator that is recorded without --in; leave one of them out.")


@dataclass(frozen=True)
class CollectResult:
    """A recording, and what it holds."""

    dataset: Path
    facts: Mapping[str, object]
    """frames, episodes, world; look (a picture), film, and figures of how much of the world was covered."""

    def to_json(self) -> dict[str, Any]:
        return jsonable({"dataset": self.dataset, **self.facts})

    def summary(self) -> str:
        return "\n".join(f"{name}: {value}" for name, value in {"dataset": self.dataset, **self.facts}.items())


def collect(world: str | Path, config: CollectConfig, *, progress: Progress = silent) -> CollectResult:
    """Records episodes of any world: an environment (gym:CartPole-v1, gym:ALE/Breakout-v5, gym:PACKAGE:ID) or a learned world.

    Continues an unfinished recording in the same folder. TerrellaError or DatasetError for what cannot be recorded.
    """
    config.check()
    rgb, policy = config.pictures != "none", config.policy or "explorer"
    make = partial(open_player, str(world), config.controls, config.environment, rgb, policy, config.inside)
    opened, make_policy = make()
    for line in describe(opened.spec):
        progress(line)
    kept = storage_of(opened.spec) if config.pictures in ("auto", "none") else config.pictures
    if config.by_workers:
        return _collect_by_workers(make, opened, config, kept, progress)
    frames = FRAMES if config.frames is None else config.frames
    return _record(opened, config, frames, kept, make_policy() if config.policy else None, progress)


def collect_doom(config: DoomRecordConfig, *, progress: Progress = silent) -> CollectResult:
    """Records the game Doom: pictures, depth, camera pose, actions and rewards."""
    height = config.height
    depth = (min(max(height, 1), 96), min(max(height, 1), 96) * 4 // 3)
    size = (height, height * 4 // 3)
    world = library.load(f"doom:{config.scenario}", size=size, depth_size=depth, skill=config.skill)
    return _record(world, config, config.frames, "video", None, progress)


def open_player(
    name: str,
    controls: ControlsConfig,
    environment: EnvironmentConfig,
    rgb: bool,
    policy: str,
    inside: str | None = None,
):
    """A world, and a function that makes its policy: in a worker, too. inside: the world in which the policy plans or acts;
    TerrellaError where it does not fit."""
    if inside is None:
        world = controls.of(environment.open(name, rgb=rgb))
        return world, lambda: policy_of(policy, world.spec, world)
    learned = load_named(inside, "cpu")
    opened = open_real(name, environment, learned.spec) if rgb else environment.open(name, rgb=False)
    world = controls.of(opened)
    check_alike(learned.spec, world.spec)
    return world, lambda: policy_of(policy, world.spec, learned)


def storage_of(spec: Spec) -> Stored:
    """The default storage of pictures of such a world."""
    drawn = spec.channels.get("rgb")
    return "png" if drawn is not None and max((drawn.shape or (0,))[:2]) <= SMALL_SIDE else "video"


def explore(
    world: World,
    out: Path,
    frames: int,
    seed: int,
    report: Report,
    options: RecordOptions,
    policy: Policy | None = None,
    enough: Callable[[], bool] = lambda: False,
) -> Recorder:
    """Adds episodes of a script, or of `policy`, to the dataset `out`; `options` and `enough` as in `data.record`."""
    has_rows = (out / "meta" / "info.json").exists()
    if policy is None:
        policy = explorer = Explorer(world.spec, out / ".explorer")
        kept = Dataset(out) if has_rows else None
        explorer.recall(kept.length - len(kept.episodes) if kept else 0)  # each episode ends with a row without action
    try:
        return record(world, policy, out, frames, make_rng(seed), report, enough, options)
    except DatasetError:
        raise
    except TerrellaError as error:  # the world's
        safe = Dataset(out).length if (out / "meta" / "info.json").exists() else 0
        raise TerrellaError(f"{error} {safe:,} frames are safe in {out}." if safe else str(error)) from error


def _collect_by_workers(
    make: Callable, world: World, config: CollectConfig, pictures: Stored, progress: Progress
) -> CollectResult:
    pool = RayWorkers if config.on == "ray" else LocalWorkers
    workers = pool(1 if config.workers is None else config.workers)
    layout, out = replace(Layout.of(world.spec), pictures=pictures), Path(config.out)
    upto = None if config.episodes is not None else FRAMES if config.frames is None else config.frames
    try:
        with stage("recording", progress) as report:
            job = Job.of(make, world.spec, make_rng(config.seed), layout)
            collect_episodes(job, out, workers, config.episodes, upto, report)
    except KeyboardInterrupt:
        safe = len(Dataset(out).episodes) if (out / "meta" / "info.json").exists() else 0
        raise KeyboardInterrupt(f"stopped: {safe:,} episodes are safe in {out}; the same command continues.") from None
    return CollectResult(out, recording_facts(Dataset(out), world.spec.name, progress))


def _record(
    world: World, config: RecordConfig, frames: int, pictures: Stored, policy: Policy | None, progress: Progress
) -> CollectResult:
    """Records one player: a person, a policy or the explorer."""
    layout, out = replace(Layout.of(world.spec), pictures=pictures), Path(config.out)
    facts: dict[str, object] = {}
    with _live_log(config.live_mcap, layout, world.spec.name, facts, progress) as live:
        if config.human:
            _serve_recorder(world, config, layout, live, progress)
        else:
            with stage("recording", progress) as report:
                options = RecordOptions(pictures=pictures, live=live)
                done = explore(world, out, frames, config.seed, report, options, policy)
            facts |= {"waited_for_encoder_s": round(done.pressure.waited_s, 3)}
    dataset = Dataset(out) if out.exists() else None
    if dataset is None or not dataset.length:
        hint = "press the record button on the page before you play." if config.human else "ask for more --frames."
        raise DatasetError(f"nothing was recorded: an episode has two frames or more; {hint}")
    return CollectResult(out, facts | recording_facts(dataset, world.spec.name, progress))


def _serve_recorder(world: World, config: RecordConfig, layout: Layout, live: Any, progress: Progress) -> None:
    """Serves the page on which a person plays and records, until Ctrl-C."""
    from .. import serve
    from .key_keeper import KeyKeeper

    def ready(address: str) -> None:
        progress(f"Open {address} and press the record button there; Ctrl-C here when you have played enough.")

    keeper = KeyKeeper(world.spec)
    sink = lambda: Recorder(config.out, keeper.with_keys(layout), "play", live=live)  # noqa: E731
    page = serve.ServeConfig(port=config.port, seed=config.seed)
    serve.serve([world], page, sink_factory=sink, keep=keeper, on_ready=ready)


@contextmanager
def _live_log(
    target: str | None, layout: Layout, name: str, facts: dict[str, object], progress: Progress
) -> Iterator[Any]:
    """A Live to log to, None without a target. Adds to `facts` where to look, and how much of it was lost."""
    if target is None:
        yield None
        return
    from ..exchange.live import Live

    with Live(target, {**layout.sensors, **layout.streams}, name) as live:
        where = f"ws://127.0.0.1:{live.port} (open it in Foxglove)" if live.port else target
        progress(f"Watch at {where}.")
        yield live
    facts |= {"watched": where, "watch_dropped": live.dropped, "watch_notes": list(live.notes)}
