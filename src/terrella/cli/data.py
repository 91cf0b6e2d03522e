"""The commands that look after recordings: doctor, convert, merge, view, label."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from ..workflows.progress import stage
from ..workflows.results import command, folder_name
from .say import Host, Json, Port, RecordingName, Token, opened, result, say

Fps = Annotated[float | None, arg(help="Frames per second of the new dataset. Default: those of the recording.")]
Policy = Annotated[
    Literal["previous", "nearest", "linear"],
    arg(help="How a sensor with its own clock is sampled: its latest value, the nearest in time, or interpolated."),
]


@contextmanager
def _whole_or_nothing(target: Path) -> Iterator[None]:
    """After Ctrl-C, says whether a command that writes all of `target` or nothing has written it."""
    before = target.exists()
    try:
        yield
    except KeyboardInterrupt:
        left = f"{target} was written whole" if target.exists() and not before else f"nothing was written at {target}"
        say(f"terrella: stopped; {left}, and the source is untouched.")
        raise SystemExit(130) from None


def doctor(
    folder: Annotated[Path, Positional, arg(metavar="RECORDING")],
    repair: bool = False,
    out: Path | None = None,
    yes: bool = False,
    json: Json = False,
) -> int:
    """Look for faults in a recording and say how to repair each.

    The exit code is 1 if there are any, and 0 after a repair.

    Args:
        folder: A LeRobot v3 dataset, recorded by Terrella or by any other program.
        repair: Write a repaired copy that keeps every intact row. The original is not changed.
        out: Folder of the repaired copy. Default: FOLDER-mended.
        yes: Repair without asking, even if most rows would be lost.
    """
    from ..care import repair as mend
    from ..care.doctor import examine

    def allowed(sentence: str) -> bool:
        if sys.stdin.isatty():
            say(f"{sentence} Go on? [y/N]")
            return sys.stdin.readline().strip().lower() in ("y", "yes")
        return False

    diagnosis = examine(folder)
    facts: dict[str, object] = {"dataset": str(folder), "sound": not diagnosis.faults, **diagnosis.facts()}
    lines = [diagnosis.report(str(folder))]
    if repair:
        target = out or folder.resolve().with_name(f"{folder.resolve().name}-mended")
        with _whole_or_nothing(target), stage("mending", say) as report:
            done = mend(folder, target, progress=lambda pieces, of: report(pieces, of), allow_loss=yes or allowed)
        facts |= {"mended": str(target), "done": done}
        lines += [*done, f"the mended copy: {target}"]
    following = command("terrella", "data", "doctor", folder, repair=True) if diagnosis.faults and not repair else ""
    result(facts, json, "\n".join(lines), following)
    return 1 if diagnosis.faults and not repair else 0


@dataclass(frozen=True)
class ConvertConfig:
    """Settings of `data convert`."""

    to: Literal["auto", "lerobot", "mcap", "minari", "robomimic", "rollouts", "videos", "images"] = "auto"
    """Format to write, if the name of the target does not imply it."""
    fps: Fps = None
    policy: Policy = "previous"
    pictures: Literal["video", "png"] = "video"
    """How a LeRobot dataset stores pictures: H.264 video, or PNG (lossless, larger)."""
    episodes: int = 10  # Number of rollouts to record from "gym:ID".
    seed: int = 0  # The same seed gives the same result.


def convert(
    source: RecordingName,
    target: Annotated[Path, Positional, arg(metavar="TARGET")],
    config: ConvertConfig = ConvertConfig(),
    json: Json = False,
) -> None:
    """Convert a recording to another format: LeRobot v3, MCAP, Minari, HDF5, rollouts (.npz), videos, images.

    Whatever the new format cannot hold is listed at the end. The target is written completely or not at all.

    Args:
        source: The recording to read. Its format is recognised from its content. "gym:ID" records rollouts of a Gymnasium
            environment with random actions.
        target: The recording to write. NAME.mcap and NAME.hdf5 choose their formats; any other name is a LeRobot v3 folder.
    """
    from ..exchange.convert import open_source, write_source
    from ..exchange.formats.lerobot import LeRobotRows

    fps = config.fps
    recording = open_source(source, fps, config.episodes, config.seed)
    rows = LeRobotRows(fps if recording.fps is None or fps != recording.fps else None, config.policy, config.pictures)
    with _whole_or_nothing(target), stage(f"converting {recording.name}", say) as report:
        to = None if config.to == "auto" else config.to
        left_out = write_source(recording, target, to, rows, lambda done, of: report(done, of))
    facts = {"source": str(source), "target": str(target), "sensors": sorted(recording.sensors), "left_out": left_out}
    lines = [*(f"left out or changed: {what}" for what in left_out), f"{source} is now {target}"]
    checking = command("terrella", "data", "doctor", target) if (target / "meta" / "info.json").is_file() else ""
    result(facts, json, "\n".join(lines), checking)


def merge(
    sources: Annotated[tuple[str, ...], Positional, arg(metavar="[RECORDING ...]")],
    out: Path,
    mapping: Path | None = None,
    fps: Fps = None,
    dry: bool = False,
    json: Json = False,
) -> None:
    """Merge recordings of several robots into one training set, with named dimensions, masks and statistics per robot.

    Args:
        sources: Recordings in any format.
        out: Folder of the merged dataset (LeRobot v3).
        mapping: TOML file that maps each robot's dimensions to the merged ones. Without it, a mapping is guessed from the names and
            written to OUT.toml, for you to check, edit and pass here.
        dry: Write the guessed mapping and stop.
    """
    from ..exchange.convert import open_source
    from ..exchange.merging.write import merge_into

    recordings = {path: open_source(path) for path in sources}
    with _whole_or_nothing(out), stage("merging", say) as report:
        facts, text = merge_into(recordings, out.resolve(), mapping, fps, dry, lambda done, of: report(done, of))
    following = command("terrella", "data", "doctor", out)
    result(facts, json, text, "" if dry else following)


def view(
    folder: RecordingName,
    rerun: bool = False,
    out: Path | None = None,
    port: Port = 8766,
    host: Host = "127.0.0.1",
    token: Token = None,
    json: Json = False,
) -> None:
    """Look through a recording in the browser: cameras, depth, plots, map and points side by side. Mark bad episodes.

    Args:
        folder: A recording in any format.
        rerun: Open it in the Rerun viewer instead, if Rerun is installed.
        out: Folder for the export of the episodes that are not marked bad. Default: FOLDER-good.
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
        opened(folder, address, {"dataset": folder}, json)

    here = Path(folder).resolve() if "://" not in folder else Path.cwd() / folder.rstrip("/").rsplit("/", 1)[-1]
    serve(browse(folder, carry=repair), port, host, token, ready, out or here.with_name(f"{here.name}-good"))


def label(
    run: Annotated[Path, Positional, arg(metavar="RUN")],
    folder: Annotated[Path, Positional, arg(metavar="RECORDING")],
    out: Path,
    labelled: Path | None = None,
    frames: int = 200,
    seed: int = 0,
    json: Json = False,
) -> None:
    """Write a copy of a recording with the latent actions that `terrella train latent-actions` learned.

    Args:
        run: Folder of the training run.
        folder: Recording to label. Pictures alone are enough.
        out: Folder of the labelled copy. `terrella train video` can learn a world from it.
        labelled: Recording with real actions, used to map keys to latent actions.
        frames: Frames of --labelled to use.
        seed: The same seed gives the same result.
    """
    from ..exchange import write_source
    from ..exchange.formats.lerobot import LeRobotRows
    from ..learn import latent_codes

    with stage("labelling", say) as report:
        keys = latent_codes.map_keys(run, labelled, report, frames, seed=seed) if labelled else None
        labels = latent_codes.labelled(run, folder, report, keys)
        pictures = "png" if labels.exact else "video"  # exact ones stay exact
        facts = {**labels.facts, "notes": write_source(labels.source, out, "lerobot", LeRobotRows(pictures=pictures))}
    if keys:
        facts |= {"key_accuracy": keys.accuracy, "commonest_action": keys.commonest, "labelled_frames": keys.used}
    following = command("terrella", "train", "video", out, out=f"runs/{folder_name(out.name)}")
    result({"dataset": str(out), **facts}, json, following=following)
