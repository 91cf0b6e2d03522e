"""The command line: the only place that knows every room. Each command is thin, and imports its rooms when it runs."""

from __future__ import annotations

import errno
import json as json_text
import sys
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import Positional, arg
from tyro.extras import SubcommandApp

from .. import progress
from . import data as data_room
from .named import Device, device_of, load_named
from .say import Host, Json, Port, Seed, Token, result, say

if TYPE_CHECKING:
    from ..core.world import World

Watch = Annotated[
    str | None,
    arg(name="live-mcap", help="Log while recording: to a file NAME.mcap, or to Foxglove at a port of this machine."),
]
Fast = Annotated[bool, arg(help="Draw through ONNX Runtime, or a compiled graph on a GPU, if that is faster here.")]

DESCRIPTION = "Learn a world from recordings, step inside it, and measure how far it can be trusted."
CONTEXT = 10  # frames that a world is shown before it dreams, when it is scored: longer than a key's history counts
MARKERS = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; the exit code is 0, its own, 2 with one sentence on stderr, or 130 after Ctrl-C."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        code = _app(given).cli(prog="terrella", description=DESCRIPTION, args=given, config=MARKERS)
    except KeyboardInterrupt:
        print("terrella: stopped; what was finished is kept.", file=sys.stderr)
        return 130
    except Exception as error:
        sentence = _sentence(error)
        if sentence is None:
            raise
        print(f"terrella: {sentence}", file=sys.stderr)
        return 2
    return code or 0


_THEIRS = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS, errno.EEXIST, errno.ENOTDIR, errno.EISDIR)


def _sentence(error: Exception) -> str | None:
    """What to tell a person of an error that is theirs or their disk's; None for a fault of ours: that needs its trace."""
    from ..core.errors import TerrellaError

    if isinstance(error, TerrellaError):
        return str(error)
    if isinstance(error, OSError) and error.errno in _THEIRS:
        where = f" ({error.filename})" if error.filename else ""
        return f"{error.strerror}{where}; choose another folder, or free some space."
    return None


def _app(given: Sequence[str]) -> SubcommandApp:
    recording, training, data, app = SubcommandApp(), SubcommandApp(), SubcommandApp(), SubcommandApp()
    recording.command(name="doom")(record_doom)
    recording.command(name="world")(record_world)
    if given[:1] == ["train"]:
        from . import train

        training_commands = {
            "video": train.video,
            "estimator": train.estimator,
            "uncertainty": train.uncertainty,
            "objects": train.objects,
            "latent-actions": train.latent_actions,
            "distil": train.few_steps,
            "dreams": train.dreams,
        }
        for name, command in training_commands.items():
            training.command(name=name)(command)
    else:
        training.command(name="video")(play)  # never run: it stands for them all
    data.command(data_room.label)
    data.command(data_room.doctor)
    data.command(data_room.convert)
    data.command(data_room.merge)
    data.command(data_room.view)
    app.command(recording, name="record", help="Record a world's episodes: scripted, or played by a person.")
    app.command(training, name="train", help="Train a world on a recording.")
    app.command(play)
    app.command(score)
    app.command(name="list")(list_worlds)
    app.command(data, name="data", help="Look after recordings.")
    return app


# -- record ---------------------------------------------------------------------------------------------------------


def record_doom(
    out: Path,
    scenario: str = "my_way_home",
    skill: int | None = None,
    frames: int = 100_000,
    height: int = 192,
    human: bool = False,
    live_mcap: Watch = None,
    seed: Seed = 0,
    port: Port = 8765,
    json: Json = False,
) -> None:
    """Record the real game: pictures, depth, the camera's pose, actions and rewards.

    Args:
        out: Folder of the dataset (LeRobot v3); an unfinished recording there goes on.
        scenario: Name of a ViZDoom scenario, or maps of a game: freedoom2/MAP01,MAP02; each episode takes one of them.
        skill: 1 to 5, how hard it is; without it the scenario's own.
        frames: Rows to record in all (by the script; a person plays as long as they like).
        height: Height of the pictures; their width is 4/3 of it.
        human: Play yourself, in the browser, instead of watching a script explore.
    """
    from .. import library

    depth = (min(max(height, 1), 96), min(max(height, 1), 96) * 4 // 3)
    world = library.load(f"doom:{scenario}", size=(height, height * 4 // 3), depth_size=depth, skill=skill)
    _record(world, out, frames, human, live_mcap, seed, port, json)


def record_world(
    name: Positional[str],
    out: Path,
    frames: int = 10_000,
    size: tuple[int, int] | None = None,
    pictures: Literal["auto", "png", "video"] = "auto",
    human: bool = False,
    live_mcap: Watch = None,
    seed: Seed = 0,
    port: Port = 8765,
    json: Json = False,
) -> None:
    """Record any world: a Gymnasium environment ("gym:CartPole-v1", "gym:ALE/Breakout-v5"), a learned world, a checkpoint.

    Args:
        name: What `terrella list` shows, or a path.
        out: Folder of the dataset (LeRobot v3); an unfinished recording there goes on.
        frames: Rows to record in all (by the script; a person plays as long as they like).
        size: Height and width of the pictures of a Gymnasium environment; by itself as it draws them, Atari 64 64.
        pictures: How they are kept: "png" exactly, "video" as H.264; "auto" exactly where they are at most 96 pixels a side.
        human: Play yourself, in the browser, instead of watching a script explore.
    """
    from .. import library
    from ..core.errors import TerrellaError

    if size is not None and not name.startswith("gym:"):
        raise TerrellaError("--size is for Gymnasium environments; other worlds show the size that they show.")
    options: dict[str, Any] = {"size": size} if size else {}
    world = library.load(name, **options)
    if pictures == "auto":
        drawn = world.spec.channels.get("rgb")
        pictures = "png" if drawn is not None and max((drawn.shape or (0,))[:2]) <= 96 else "video"
    _record(world, out, frames, human, live_mcap, seed, port, json, pictures)


def _record(
    world: World,
    out: Path,
    frames: int,
    human: bool,
    watch: str | None,
    seed: int,
    port: int,
    json: bool,
    pictures: Literal["video", "png"] = "video",
) -> None:
    from ..act.explorer import Explorer
    from ..core.errors import DatasetError
    from ..core.world import make_rng
    from ..data import Dataset, Layout, Recorder, record

    layout = replace(Layout.of(world.spec), pictures=pictures)
    facts: dict[str, object] = {"dataset": str(out)}
    with _watched(watch, layout, world.spec.name, facts) as live:
        if human:
            from ..serve import serve

            def ready(address: str) -> None:
                say(f"Open {address} and press the record button there; Ctrl-C here when you have played enough.")

            sink = lambda: Recorder(out, layout, "play", live=live)  # noqa: E731
            serve([world], port=port, sink_factory=sink, on_ready=ready, seed=seed)
            if not out.exists():
                raise DatasetError("nothing was recorded: press the record button on the page before you play.")
        else:
            with progress.shown("recording") as report:
                player, rng = Explorer(world.spec), make_rng(seed)
                done = record(world, player, out, frames, rng, report, live=live, pictures=pictures)
            facts |= {"waited_for_encoder_s": round(done.pressure.waited_s, 3)}
    dataset = Dataset(out)
    facts |= {"frames": dataset.length, "episodes": len(dataset.episodes), "world": world.spec.name}
    if dataset.has("rgb"):
        facts["look"] = str(_contact_sheet(dataset, out / "look.jpg"))
    result(facts, json)


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


# -- play -----------------------------------------------------------------------------------------------------------


def play(
    name: Positional[str],
    image: Path | None = None,
    compare: bool = False,
    truth: str = "doom:my_way_home",
    memory: bool = True,
    remember: bool = False,
    estimator: str | None = None,
    memory_mb: float | None = None,
    record: Path | None = None,
    port: Port = 8765,
    host: Host = "127.0.0.1",
    token: Token = None,
    device: Device = "auto",
    fast: Fast = False,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Step inside a world: a learned one or a real game, in the browser.

    Args:
        name: What `terrella list` shows, or the path of a checkpoint.
        image: Begin with this picture (any image file); one can be dropped on the page, too.
        compare: Show the truth beside the dream, driven by the same keys.
        truth: The real game that --compare shows.
        memory: --no-memory plays a learned world without its keyframes.
        remember: Give a world without a spatial memory one: what it showed, it shows again.
        eye: What tells depth and motion to a memory, where the world does not: a file of `terrella train eye`, or a world
            that has an eye.
        memory_mb: What a story may remember, in MiB; as its world was saved, or 16.
        record: Folder of a dataset to which the page may record.
    """
    from ..core.errors import TerrellaError
    from ..serve import serve

    learned = load_named(name, device, memory, fast, remember=remember, estimator=estimator, memory_mb=memory_mb)
    worlds = [learned]
    picture = _first_picture(image, learned) if image is not None else None
    if compare and picture is not None:
        raise TerrellaError("--image cannot be compared with a game, which cannot go on from it; leave --compare out.")
    if compare:
        worlds = [_game_like(learned, truth), learned]
    sink = None
    if record is not None:
        from ..data import Layout, Recorder

        layout, folder = Layout.of(worlds[0].spec), record
        sink = lambda: Recorder(folder, layout, "play")  # noqa: E731
    names = [world.spec.name for world in worlds]

    def ready(address: str) -> None:
        result({"address": address, "worlds": names}, json, f"{' beside '.join(names)}: open {address}")

    serve(worlds, host=host, port=port, token=token, sink_factory=sink, on_ready=ready, seed=seed, picture=picture)


def _first_picture(path: Path, world: World) -> Any:
    """The picture of an image file as the world would see it, after it was seen once: what is refused is refused now."""
    from ..core.errors import ServeError
    from ..core.world import make_rng
    from ..serve import read_picture

    if "rgb" not in world.spec.observes:
        raise ServeError(f"{world.spec.name} takes no pictures, so it cannot begin with one; leave --image out.")
    height, width = world.spec.channels["rgb"].shape[:2]
    picture = read_picture(path, (height, width))
    world.observe({"rgb": picture[None]}, None, make_rng(0))
    return picture


def _game_like(learned: World, name: str) -> World:
    """The real game, with pictures of the size that the learned world shows."""
    from .. import library

    shape = learned.spec.channels["rgb"].shape if "rgb" in learned.spec.channels else None
    like: dict[str, Any] = {"size": shape[:2], "depth_size": shape[:2]} if shape and name.startswith("doom") else {}
    return library.load(name, **like)


# -- score ----------------------------------------------------------------------------------------------------------


def score(
    name: Positional[str],
    data: Path,
    new: Path | None = None,
    fresh: bool = False,
    out: Path = Path("scores"),
    clips: int = 50,
    horizons: tuple[int, ...] = (1, 8, 32, 64),
    long_steps: int = 1000,
    drift: int | None = None,
    device: Device = "auto",
    fast: Fast = False,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Hold a learned world's dreams against what really happened, with its memory and without.

    Args:
        name: What `terrella list` shows, or the path of a checkpoint.
        data: The recording it was trained on; only the episodes kept out of training are used.
        fresh: `data` is another recording, of which training saw nothing: every episode is used.
        new: A recording of places that it never saw; without one, the part of the map that training kept out.
        out: Folder for scorecard.json and scorecard.html.
        clips: Clips of each kind of place; intervals want 50 or more.
        horizons: Steps after which figures are given; a clip is as long as the largest.
        long_steps: Length of the long dream; 0 leaves it out.
        drift: Steps of the drift curves, on clips of their own (at most 24); 0 leaves them out. Unless said, 256 where the
            recordings have clips that long.
    """
    from .. import library
    from ..core.errors import DatasetError, TerrellaError
    from ..core.world import make_rng
    from ..data import split
    from ..measure import (
        Album,
        ExamConfig,
        ScoreConfig,
        as_dict,
        bars,
        clips_from_cache,
        examine,
        in_box,
        out_of_sight,
        write_report,
    )
    from ..measure.bars import summary

    if min(horizons, default=0) < 1 or clips < 1 or (long_steps != 0 and long_steps < 100) or (drift or 0) < 0:
        raise TerrellaError(
            "--horizons and --clips are whole numbers from 1 up, --drift from 0 up, --long-steps is 0 or at least 100."
        )
    world, rng, steps = load_named(name, device, fast=fast), make_rng(seed), max(horizons)
    arms = {"memory": world, "no memory": load_named(name, device, memory=False, fast=fast)}
    if "pose" not in world.spec.observes:  # it lives on history alone: there is no memory to leave out
        arms = {"history": world}
    cache = _cache(data, world)
    every = range(len(cache.episodes))
    held_out = every if fresh else split(len(every))[1]
    box: Any = world.spec.card.get("keep_out")  # a part of the map that training never saw
    known = out_of_sight(*box) if box else None
    sources: dict[str, tuple] = {"recorded": (cache, held_out, known)}
    if new is not None:
        unseen = _cache(new, world)
        sources["new"] = (unseen, range(len(unseen.episodes)), None)
    elif box:
        sources["new"] = (cache, every, in_box(*box))

    def draw(place: str, horizon: int, count: int, chance) -> Any:
        source, episodes, where = sources[place]
        return clips_from_cache(source, episodes, CONTEXT, horizon, count, chance, where)

    places = {place: draw(place, steps, clips, rng) for place in sources}
    long_clips, chance = {}, make_rng(seed + 1)  # the other figures do not depend on whether drift is measured
    for place in sources if drift != 0 else ():
        try:
            long_clips[place] = draw(place, drift or 256, min(clips, 24), chance)
        except DatasetError:
            if drift:
                raise
            say(
                f"No drift curve of {place} places: no clip of 256 steps fits there; --drift STEPS asks for shorter ones."
            )
    obeying = tuple(step for step in ScoreConfig().control_horizons if step <= steps) or (steps,)
    scoring = ScoreConfig(horizons=tuple(sorted(horizons)), control_horizons=obeying)
    config = ExamConfig(score=scoring, long_steps=long_steps)
    album = None if cache.pose is None else Album.of_cache(cache)
    closing = {}  # what is seen again by a world that keeps nothing but its last frame
    if len(arms) > 1:
        closing = {"last frame only": library.load(name, device=device_of(device), memory=False, memory_mb=0)}
    with progress.shown("scoring") as report:
        tell = lambda share, words: report(share, 1, words)  # noqa: E731
        card = examine(arms, places, rng, config, album, tell, long_clips, closing)
    card = replace(card, fates=_fates(arms, sources, scoring.horizons, clips, make_rng(seed + 2)))
    found = bars(card, next(iter(arms)))
    files = write_report(card, found, out, f"{world.spec.name}: the scorecard")
    lines = [
        f"{bar.status:>6}  {bar.name}, {bar.place}: {bar.figure} {bar.unit} (bar: {bar.target})"
        for bar in found
        if bar.figure and not bar.side
    ]
    for row in card.drifts:
        within = f"within twice its first error for {row.usable} of {row.steps} steps"
        lines.append(f" drift  {row.arm}{row.motion and f', {row.motion} motion'}, {row.place}: {within}")
    facts = {**as_dict(card, found), "files": [str(file) for file in files]}
    result(facts, json, "\n".join([*lines, summary(found), f"the page: {files[1]}"]))


def _fates(arms: dict[str, World], sources: dict[str, tuple], horizons: tuple[int, ...], clips: int, rng) -> list:
    """What the arms' dreams tell of rewards, vitals and ends, where world and recordings have vitals."""
    from ..measure.outcomes import fates, passages

    spec, found = next(iter(arms.values())).spec, []
    for place, (cache, episodes, where) in sources.items():
        if set(cache.vitals) & set(spec.channels):
            shown = passages(cache, episodes, CONTEXT, max(horizons), clips, rng, where)
            found += fates(arms, place, shown, horizons, rng)
    return found


def _cache(data: Path, world: World) -> Any:
    """The recording's ClipCache at the size that the world shows."""
    from ..core.errors import TerrellaError
    from ..data import ClipCache

    if "rgb" not in world.spec.channels:
        raise TerrellaError(f"{world.spec.name} shows no pictures, so it cannot be scored; score a learned world.")
    height, width = world.spec.channels["rgb"].shape[:2]
    with progress.shown(f"reading {data}") as report:
        return ClipCache.open(data, size=(height, width), progress=report)


# -- list ----------------------------------------------------------------------------------------------------------


def list_worlds(folders: Positional[tuple[Path, ...]] = (), json: Json = False) -> None:
    """Show the worlds at hand with their cards.

    Args:
        folders: Folders that hold checkpoints of your own.
    """
    from .. import library

    entries = library.worlds(folders)
    if json:
        print(json_text.dumps([entry.as_dict() for entry in entries], indent=1))
        return
    for entry in entries:
        print(f"{entry.name}  [{entry.source}]")
        for fact, value in entry.card.items():
            print(f"    {fact}: {value if isinstance(value, str) else json_text.dumps(value)}")
