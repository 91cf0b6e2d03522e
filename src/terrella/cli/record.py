"""The commands `terrella record ...`: a script's or a person's episodes of a world become a dataset."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from .. import progress
from ..core.spec import BUTTONS, CHOICE, Spec, can_idle, neutral_action
from .named import Controls, Environment, Keeper
from .say import Json, Port, Seed, result, say

if TYPE_CHECKING:
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
    frames: int = 10_000,
    pictures: Literal["auto", "png", "video"] = "auto",
) -> None:
    """Record any world: a Gymnasium environment (gym:CartPole-v1, gym:ALE/Breakout-v5, gym:PACKAGE:ID) or a learned world.

    Args:
        name: A name that `terrella list` shows, or the path of a checkpoint.
        frames: Frames to record in all. With --human there is no limit.
        pictures: "png" is lossless, "video" is H.264, "auto" is png up to 96 pixels a side and video above.
    """
    world = controls.of(environment.open(name))
    for line in described(world.spec):
        say(line)
    _record(world, recording, frames, stored_as(world.spec) if pictures == "auto" else pictures)


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
    **more: Any,
) -> Recorder:
    """Lets a script play into the recording `out`, on from what lies there; `more` is what `record` takes."""
    from ..act.explorer import Explorer
    from ..core.errors import DatasetError, TerrellaError
    from ..core.world import make_rng
    from ..data import Dataset, record

    player = Explorer(world.spec, out / ".explorer")
    kept = Dataset(out) if (out / "meta" / "info.json").exists() else None
    player.recall(kept.length - len(kept.episodes) if kept else 0)  # each episode ends with a row without action
    try:
        return record(world, player, out, frames, make_rng(seed), report, pictures=pictures, **more)
    except DatasetError:
        raise
    except TerrellaError as error:  # the world's
        safe = Dataset(out).length if (out / "meta" / "info.json").exists() else 0
        raise TerrellaError(f"{error} {safe:,} frames are safe in {out}." if safe else str(error)) from error


def _record(world: World, recording: Recording, frames: int, pictures: Literal["video", "png"] = "video") -> None:
    from ..core.errors import DatasetError
    from ..data import Dataset, Layout, Recorder

    layout, out = replace(Layout.of(world.spec), pictures=pictures), recording.out
    facts: dict[str, object] = {"dataset": str(out)}
    with _watched(recording.live_mcap, layout, world.spec.name, facts) as live:
        if recording.human:
            from ..serve import serve

            def ready(address: str) -> None:
                say(f"Open {address} and press the record button there; Ctrl-C here when you have played enough.")

            keeper = Keeper(world.spec)
            sink = lambda: Recorder(out, keeper.noted(layout), "play", live=live)  # noqa: E731
            serve([world], port=recording.port, sink_factory=sink, on_ready=ready, seed=recording.seed, keep=keeper)
        else:
            with progress.shown("recording") as report:
                done = explore(world, out, frames, recording.seed, report, pictures, live=live)
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
