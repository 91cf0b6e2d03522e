"""The commands that look after recordings: doctor, convert, merge, view, label."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from .. import progress
from .say import Host, Json, Port, Seed, Token, result, say

Fps = Annotated[float | None, arg(help="Rows a second; without it those that the recording has.")]
Policy = Annotated[
    Literal["previous", "nearest", "linear"],
    arg(help="What a row holds of a sensor with a clock of its own: its newest reading, the nearest, or a mixture."),
]


def doctor(
    folder: Positional[Path], repair: bool = False, out: Path | None = None, yes: bool = False, json: Json = False
) -> int:
    """Look for faults in a recording and say how to mend each; the exit code is 1 where there are any.

    Args:
        folder: Folder of a LeRobot v3 dataset, ours or anybody's.
        repair: Write a mended copy that keeps every whole row; the original is not touched.
        out: Where the mended copy goes; without it FOLDER-mended.
        yes: Repair without asking even where most rows would be lost.
    """
    from ..care import repair as mend
    from ..care.doctor import examine

    def allowed(sentence: str) -> bool:
        if sys.stdin.isatty():
            say(f"{sentence} Go on? [y/N]")
            return sys.stdin.readline().strip().lower() in ("y", "yes")
        return False

    found = examine(folder)
    facts: dict[str, object] = {"dataset": str(folder), "sound": not found.faults, **found.facts()}
    lines = [found.report(str(folder))]
    if repair:
        target = out or folder.resolve().with_name(f"{folder.resolve().name}-mended")
        with progress.shown("mending") as report:
            done = mend(folder, target, progress=lambda pieces, of: report(pieces, of), allow_loss=yes or allowed)
        facts |= {"mended": str(target), "done": done}
        lines += [*done, f"the mended copy: {target}"]
    result(facts, json, "\n".join(lines))
    return 1 if found.faults and not repair else 0


def convert(
    source: Positional[str],
    target: Positional[Path],
    to: Literal["auto", "lerobot", "mcap", "minari", "robomimic", "rollouts", "videos", "images"] = "auto",
    fps: Fps = None,
    policy: Policy = "previous",
    pictures: Literal["video", "png"] = "video",
    episodes: int = 10,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Turn a recording of one format into another: LeRobot v3, MCAP, Minari, HDF5, rollouts, videos, images.

    Args:
        source: Where it lies (which format it is, is seen from what lies there), or "gym:ID" for rollouts of an environment.
        target: Where it shall lie; NAME.mcap and NAME.hdf5 name their formats, else it is a LeRobot v3 folder.
        to: The format to write, where its name does not tell.
        pictures: How LeRobot rows keep pictures: H.264 video, or PNG, which is exact and larger.
        episodes: Rollouts to draw from "gym:ID".
    """
    from ..exchange.convert import open_source, write_source
    from ..exchange.formats.lerobot import Rows

    found = open_source(source, fps, episodes, seed)
    rows = Rows(fps if found.fps is None or fps != found.fps else None, policy, None, pictures)
    with _whole_or_nothing(target), progress.shown(f"converting {found.name}") as report:
        left_out = write_source(found, target, None if to == "auto" else to, rows, lambda done, of: report(done, of))
    facts = {"source": str(source), "target": str(target), "sensors": sorted(found.sensors), "left_out": left_out}
    result(
        facts, json, "\n".join([*(f"left out or changed: {what}" for what in left_out), f"{source} is now {target}"])
    )


@contextmanager
def _whole_or_nothing(target: Path) -> Iterator[None]:
    """Says what Ctrl-C leaves of a command that writes all of `target` or nothing."""
    try:
        yield
    except KeyboardInterrupt:
        say(f"terrella: stopped; nothing was written at {target}, and what was read is untouched.")
        raise SystemExit(130) from None


def merge(
    sources: Positional[tuple[str, ...]],
    out: Path,
    mapping: Path | None = None,
    fps: Fps = None,
    dry: bool = False,
    json: Json = False,
) -> None:
    """Make one training set of several robots' recordings: named dimensions, masks, statistics of each body.

    Args:
        sources: Recordings of any format.
        out: Folder of the merged dataset (LeRobot v3).
        mapping: File that says which number is which; without one it is guessed from the names and written to OUT.toml,
            to be looked at, edited and given here.
        dry: Write the guessed mapping alone.
    """
    from ..exchange.convert import open_source
    from ..exchange.merging.write import merge_into

    found = {path: open_source(path) for path in sources}
    with _whole_or_nothing(out), progress.shown("merging") as report:
        facts, text = merge_into(found, out.resolve(), mapping, fps, dry, lambda done, of: report(done, of))
    result(facts, json, text)


def view(
    folder: Positional[str],
    rerun: bool = False,
    out: Path | None = None,
    port: Port = 8766,
    host: Host = "127.0.0.1",
    token: Token = None,
    json: Json = False,
) -> None:
    """Look through a recording in the browser: cameras, plots, depth, map and points in step; mark what is bad.

    Args:
        folder: Recording of any format.
        rerun: Hand it to Rerun instead, where that is installed.
        out: Folder to which the page exports the episodes that are not marked bad; without it FOLDER-good.
    """
    if rerun:
        from ..exchange.convert import open_source
        from ..exchange.formats import rerun as viewer

        for what in viewer.show(open_source(folder)):
            say(f"left out: {what}.")
        return
    from ..care import repair
    from ..exchange.browse import browse
    from ..serve.viewer import view as serve

    def ready(address: str) -> None:
        result({"address": address, "dataset": folder}, json, f"{folder}: open {address}")

    here = Path(folder).resolve() if "://" not in folder else Path.cwd() / folder.rstrip("/").rsplit("/", 1)[-1]
    good = out or here.with_name(f"{here.name}-good")
    serve(browse(folder, carry=repair), port, host, token, ready, good)


def label(
    run: Positional[Path],
    folder: Positional[Path],
    out: Path,
    labelled: Path | None = None,
    frames: int = 200,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Write a copy of a recording whose actions are the codes that `terrella train latent-actions` learned.

    Args:
        run: Folder of that run.
        folder: Recording to label; pictures alone will do.
        out: Folder of the labelled copy, which `terrella train video` makes a world of.
        labelled: Recording with real actions, by which keys are mapped to codes.
        frames: How many of its frames are looked at.
    """
    from ..exchange import write_source
    from ..exchange.formats.lerobot import Rows
    from ..learn import latent_codes

    with progress.shown("labelling") as report:
        keys = latent_codes.map_keys(run, labelled, report, frames, seed=seed) if labelled else None
        labels = latent_codes.labelled(run, folder, report, keys)
        pictures = "png" if labels.exact else "video"  # exact ones stay exact
        facts = {**labels.facts, "notes": write_source(labels.source, out, "lerobot", Rows(pictures=pictures))}
    if keys:
        facts |= {"key_accuracy": keys.accuracy, "commonest_action": keys.commonest, "labelled_frames": keys.used}
    result({"dataset": str(out), **facts}, json)
