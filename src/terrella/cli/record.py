"""The commands `terrella record ...`: a script's or a person's episodes of a world become a dataset."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from .. import progress
from ..core.spec import BUTTONS, CHOICE, Spec, can_idle, neutral_action
from .named import Controls, Environment, Keeper
from .say import Json, Port, Seed, result, say

if TYPE_CHECKING:
    from ..core.policy import Policy
    from ..core.world import World
    from ..data import Dataset, Recorder


@dataclass(frozen=True)
class Recording:
    """Options of every recording.

    Args:
        out: Folder of the dataset (LeRobot v3). An unfinished recording there is continued.
        human: Play in the browser yourself; without it a script explores.
        live_mcap: Also log to a file NAME.mcap, or to Foxglove at a port of this machine.
    """

    out: Path
    human: bool = False
    live_mcap: str | None = None
    seed: Seed = 0
    port: Port = 8765
    json: Json = False


@dataclass(frozen=True)
class Collection:
    """Who plays.

    Args:
        policy: explorer, random, idle, plan, constant:VALUE, the folder of a learned policy, MODULE:NAME or FILE.py:NAME.
        episodes: Whole episodes to record in all, in place of --frames.
        workers: Processes that play at the same time, an episode each; the recording is the same with any number of them.
        on: Where the workers are: processes of this machine, or Ray's (of the cluster that RAY_ADDRESS names, if it does).
    """

    policy: str | None = None
    episodes: int | None = None
    workers: int | None = None
    on: Literal["here", "ray"] = "here"

    @property
    def spread(self) -> bool:
        return self.episodes is not None or self.workers is not None or self.on != "here"

    def check(self, recording: Recording, frames: int | None) -> None:
        from ..core.errors import TerrellaError

        if self.spread and (recording.human or recording.live_mcap):
            raise TerrellaError("--human and --live-mcap are for one player; leave --episodes, --workers and --on out.")
        if recording.human and self.policy:
            raise TerrellaError("--human and --policy both say who plays; give one of them.")
        if frames is not None and self.episodes is not None:
            raise TerrellaError("--frames and --episodes both say how much to record; give one of them.")


def record_doom(
    recording: Recording,
    scenario: str = "my_way_home",
    skill: int | None = None,
    frames: int = 100_000,
    height: int = 192,
) -> None:
    """Record the game Doom: pictures, depth, camera pose, actions and rewards.

    Args:
        scenario: A ViZDoom scenario, or maps of a game: freedoom2/MAP01,MAP02 (each episode uses one of them).
        skill: Difficulty, 1 to 5; default: the scenario's own.
        frames: Frames to record in all. With --human there is no limit.
        height: Height of the pictures in pixels; the width is 4/3 of it.
    """
    from .. import library

    depth = (min(max(height, 1), 96), min(max(height, 1), 96) * 4 // 3)
    world = library.load(f"doom:{scenario}", size=(height, height * 4 // 3), depth_size=depth, skill=skill)
    _record(world, recording, frames)


def record_world(
    name: Positional[str],
    recording: Recording,
    controls: Controls,
    environment: Environment,
    collection: Collection,
    frames: int | None = None,
    pictures: Literal["auto", "png", "video", "none"] = "auto",
) -> None:
    """Record any world: a Gymnasium environment (gym:CartPole-v1, gym:ALE/Breakout-v5, gym:PACKAGE:ID) or a learned world.

    Args:
        name: A name that `terrella list` shows, or the path of a checkpoint.
        frames: Frames to record in all, 10,000 unless it is said. With --human there is no limit.
        pictures: "png" is lossless, "video" is H.264, "auto" is png up to 96 pixels a side and video above; "none" draws none.
    """
    opened = partial(_opened, name, controls, environment, pictures != "none", collection.policy or "explorer")
    collection.check(recording, frames)
    world, policy = opened()
    for line in described(world.spec):
        say(line)
    kept = stored_as(world.spec) if pictures in ("auto", "none") else pictures
    if collection.spread:
        _collect(opened, world, recording, collection, frames, kept)
    else:
        _record(world, recording, 10_000 if frames is None else frames, kept, policy() if collection.policy else None)


def _opened(name: str, controls: Controls, environment: Environment, rgb: bool, policy: str):
    """A world and what makes a policy of it: for a worker, too."""
    from ..act.policies_by_name import policy_of

    world = controls.of(environment.open(name, rgb=rgb))
    return world, lambda: policy_of(policy, world.spec, world)


def stored_as(spec: Spec) -> Literal["video", "png"]:
    """How pictures of such a world are kept, unless it is said."""
    drawn = spec.channels.get("rgb")
    return "png" if drawn is not None and max((drawn.shape or (0,))[:2]) <= 96 else "video"


def explore(
    world: World,
    out: Path,
    frames: int,
    seed: int,
    report: Callable[..., None],
    pictures: Literal["video", "png"],
    policy: Policy | None = None,
    **more: Any,
) -> Recorder:
    """Lets a script, or `policy`, play into the recording `out`, on from what lies there; `more` is what `record` takes."""
    from ..act.explorer import Explorer
    from ..core.errors import DatasetError, TerrellaError
    from ..core.world import make_rng
    from ..data import Dataset, record

    if policy is None:
        policy = player = Explorer(world.spec, out / ".explorer")
        kept = Dataset(out) if (out / "meta" / "info.json").exists() else None
        player.recall(kept.length - len(kept.episodes) if kept else 0)  # each episode ends with a row without action
    try:
        return record(world, policy, out, frames, make_rng(seed), report, pictures=pictures, **more)
    except DatasetError:
        raise
    except TerrellaError as error:  # the world's
        safe = Dataset(out).length if (out / "meta" / "info.json").exists() else 0
        raise TerrellaError(f"{error} {safe:,} frames are safe in {out}." if safe else str(error)) from error


def _collect(
    opened: Any,
    world: World,
    recording: Recording,
    collection: Collection,
    frames: int | None,
    pictures: Literal["video", "png"],
) -> None:
    """Records with workers, and says what came of it."""
    from ..core.world import make_rng
    from ..data import Dataset, Layout
    from ..data.collect import LocalWorkers, collect
    from ..data.ray import RayWorkers

    workers = (RayWorkers if collection.on == "ray" else LocalWorkers)(
        1 if collection.workers is None else collection.workers
    )
    layout, out = replace(Layout.of(world.spec), pictures=pictures), recording.out
    upto = None if collection.episodes is not None else 10_000 if frames is None else frames
    try:
        with progress.shown("recording") as report:
            rng = make_rng(recording.seed)
            collect(opened, world, out, rng, workers, collection.episodes, upto, report, layout)
    except KeyboardInterrupt:
        safe = len(Dataset(out).episodes) if (out / "meta" / "info.json").exists() else 0
        raise KeyboardInterrupt(f"stopped: {safe:,} episodes are safe in {out}; the same command goes on.") from None
    result({"dataset": str(out)} | looked_at(Dataset(out), world.spec.name), recording.json)


def _record(
    world: World,
    recording: Recording,
    frames: int,
    pictures: Literal["video", "png"] = "video",
    policy: Policy | None = None,
) -> None:
    from ..core.errors import DatasetError
    from ..data import Dataset, Layout, Recorder

    layout, out = replace(Layout.of(world.spec), pictures=pictures), recording.out
    facts: dict[str, object] = {"dataset": str(out)}
    with _watched(recording.live_mcap, layout, world.spec.name, facts) as live:
        if recording.human:
            from ..serve import ServeConfig, serve

            def ready(address: str) -> None:
                say(f"Open {address} and press the record button there; Ctrl-C here when you have played enough.")

            keeper = Keeper(world.spec)
            sink = lambda: Recorder(out, keeper.with_keys(layout), "play", live=live)  # noqa: E731
            config = ServeConfig(port=recording.port, seed=recording.seed)
            serve([world], config, sink_factory=sink, keep=keeper, on_ready=ready)
        else:
            with progress.shown("recording") as report:
                done = explore(world, out, frames, recording.seed, report, pictures, policy, live=live)
            facts |= {"waited_for_encoder_s": round(done.pressure.waited_s, 3)}
    dataset = Dataset(out) if out.exists() else None
    if dataset is None or not dataset.length:
        raise DatasetError(
            "nothing was recorded: an episode has two frames or more"
            + (
                "; press the record button on the page before you play."
                if recording.human
                else "; ask for more --frames."
            )
        )
    result(facts | looked_at(dataset, world.spec.name), recording.json)


def looked_at(dataset: Dataset, world: str) -> dict[str, object]:
    """What a recording of `world` holds, with a picture of it to look at; warns of one that teaches little."""
    from ..data import coverage

    facts: dict[str, object] = {"frames": dataset.length, "episodes": len(dataset.episodes), "world": world}
    if dataset.has("rgb"):
        facts["look"] = str(_contact_sheet(dataset, Path(dataset.root) / "look.jpg"))
        films = sorted(Path(dataset.root).glob("videos/*/chunk-*/*.mp4"))
        facts |= {"film": str(films[0])} if films else {}
        covered = coverage(dataset)
        facts |= covered.facts()
        for warning in covered.warnings():
            say(f"Warning: {warning}")
    return facts


def described(spec: Spec) -> list[str]:
    """What is recorded, and of each choice that nobody made on the command line who made it."""
    from ..data.recording import LONGEST

    how = spec.card.get("how")
    told = lambda what: f" ({how[what]})" if isinstance(how, dict) and what in how else ""  # noqa: E731
    drawn, names = spec.channels.get("rgb"), spec.action_names
    height, width = (drawn.shape or (0, 0))[:2] if drawn is not None else (0, 0)
    limit = (
        f"{spec.max_episode_steps:,} steps, its time limit"
        if spec.max_episode_steps
        else f"{LONGEST:,} steps, as none is declared"
    )
    keys = ", ".join(f"{key} {_meant(spec, action)}" for key, action in spec.keys.items() if "+" not in key)
    rest = _meant(spec, neutral_action(spec).reshape(-1).tolist())
    return [
        f"{spec.name}: pictures of {height}x{width} (--size)" if drawn is not None else
        f"{spec.name} shows no pictures: the recording holds numbers alone, of which no world can be trained that is seen.",
        f"{1 / spec.dt_s:g} steps a second{told('frame rate')}; episodes of up to {limit}.",
        f"Actions: {', '.join(names) or spec.action}{told('action names')}; at rest: "
        + (rest if can_idle(spec) else f"{rest}, as none is said to do nothing (--idle)"),
        f"Keys: {keys or 'none (--keys)'}{told('keys')}",
    ]  # fmt: skip


def _meant(spec: Spec, action: list[float]) -> str:
    """The name of a flat action, or its numbers."""
    low, _ = spec.action_limits
    if spec.action_mode == CHOICE and len(action) == 1:
        at = int(action[0] - low)
        return spec.action_names[at] if at < len(spec.action_names) else str(int(action[0]))
    named = [name for name, value in zip(spec.action_names, action) if value]
    if spec.action_mode == BUTTONS and spec.action_names:
        return "+".join(named) or "none"
    return ",".join(f"{value:g}" for value in action)


@contextmanager
def _watched(target: str | None, layout, name: str, facts: dict[str, object]):
    """A Live to log to, None without a target; says where to look, and how much of it was lost."""
    if target is None:
        yield None
        return
    from ..exchange.live import Live

    with Live(target, {**layout.sensors, **layout.streams}, name) as live:
        where = f"ws://127.0.0.1:{live.port} (open it in Foxglove)" if live.port else target
        say(f"Watch at {where}.")
        yield live
    facts |= {"watched": where, "watch_dropped": live.dropped, "watch_notes": list(live.notes)}


def _contact_sheet(dataset, path: Path) -> Path:
    """Twelve pictures from the whole recording, to see at a glance what it holds."""
    from ..measure import strip

    rows = [dataset.length * (2 * place + 1) // 24 for place in range(12)]
    pictures = dataset.rgb_at(rows).reshape(3, 4, *dataset.rgb_at(rows[:1]).shape[1:])
    lines = {f"from {rows[4 * line]:,}": pictures[line] for line in range(3)}
    strip(lines, [""] * 4).convert("RGB").save(path, quality=88)
    return path
