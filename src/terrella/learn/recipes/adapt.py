"""adapt: a world goes on learning, on a recording of another body or camera, beside what it learned before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from ...core.errors import DatasetError, TrainingError
from ...core.world import World
from ...worlds.folder import load_latent
from ...worlds.latent import LatentWorld
from ...worlds.learned import LearnedWorld
from ..latent_validation import ARMS, HORIZONS, open_loop
from ..recording import Recording
from ..trainer import Report
from .adapt_frames import adapt_frames, settings_of
from .latent import Beginning, LatentTraining, open_rows, train_latent, vectors_of

LATENT_RATE, FRAMES_RATE, PLACES_RATE = 5e-4, 3e-3, 4e-4  # peak learning rates


@dataclass(frozen=True)
class AdaptConfig:
    """Settings of `adapt`."""

    minutes: float = 10.0  # Minutes of training, earlier runs included.
    # Training steps. Training ends after these or after --minutes, whichever comes first. Default: 4000, with pictures 2500, of a
    # world that draws frames 8000, on a GPU 60000.
    steps: int | None = None
    # Peak learning rate. Default: 5e-4, of a world of frames alone 3e-3, with depth and poses 4e-4.
    learning_rate: float | None = None
    # Clips per step, those of --keep included. Default: 128, with pictures 32, of frames 8, on a GPU 64.
    batch: int | None = None
    # --no-laws: leave the laws of physics out of the loss. They are a part of it where the recording describes its bodies.
    laws: bool = True
    seed: int = 0  # Random seed.
    device: str = "auto"  # cpu, cuda or auto.


def adapt(
    world: World, data: str | Path, out: str | Path, config: AdaptConfig, report: Report, keep: str | Path | None = None
) -> dict:
    """Trains, or resumes, a copy of a learned world on the recording `data`; `out`/world is the result. A world with depth and
    poses has the places of `data` from then on. keep: a recording of what it learned before, of which half of the clips are, of
    frames a quarter. Returns facts, the verdict first; `errors` has, of each recording, the world's open-loop error on held-out
    episodes by step, before and after, as a share of copy-last's: of latents, or the squared error of frames. TrainingError for a
    world that cannot go on learning; DatasetError for a recording with other channels or actions."""
    rate, counts = config.learning_rate, [one for one in (config.steps, config.batch) if one is not None]
    if config.minutes <= 0 or min(counts, default=1) < 1 or (rate is not None and rate <= 0):
        raise TrainingError("--minutes and --learning-rate are more than 0, and --steps and --batch 1 or more.")
    if isinstance(world, LearnedWorld):
        settings, usual = settings_of(world), PLACES_RATE if world.config.geometry else FRAMES_RATE
        settings = replace(
            settings, hours=config.minutes / 60, steps=config.steps, batch=config.batch, seed=config.seed,
            learning_rate=config.learning_rate or usual, device=config.device,
        )  # fmt: skip
        facts, errors = adapt_frames(world, data, out, settings, report, keep)
        return {**facts, "latent": False, "verdict": verdict(errors), "errors": errors}
    if not isinstance(world, LatentWorld):
        raise TrainingError(
            f"{world.spec.name} is no learned world, and only these adapt: give a run of `terrella train`."
        )
    shape = world.network.config
    new, old = (_fitting(world, one, report) if one is not None else None for one in (data, keep))
    assert new is not None
    before = {name: errors_on(world, one) for name, one in (("new", new), ("old", old)) if one is not None}
    settings = LatentTraining(
        world.spec.name, shape.sees_pictures, shape.sees_vectors, tuple(name for name, _ in shape.vectors), shape.size,
        history=shape.history, frames=shape.frames, hidden=shape.hidden, members=shape.members, leap=shape.leap,
        steps=config.steps, hours=config.minutes / 60, batch=config.batch, learning_rate=config.learning_rate or LATENT_RATE,
        seed=config.seed, device=config.device,
    )  # fmt: skip
    facts = train_latent(data, out, settings, report, begin=Beginning(world, old, config.laws))
    adapted = load_latent(facts["world"])
    after = {name: errors_on(adapted, one) for name, one in (("new", new), ("old", old)) if one is not None}
    errors = {name: {"before": before[name], "after": after[name]} for name in before}
    return {**facts, "latent": True, "verdict": verdict(errors), "errors": errors}


def _fitting(world: LatentWorld, data: str | Path, report: Report) -> Recording:
    """The recording, with the channels and the actions of the world."""
    shape, controls = world.network.config, world.controls
    recording = open_rows(data, shape.size, report)
    if shape.size is not None and recording.cache.rgb is None:
        raise DatasetError(f"{data} has no pictures, which {world.spec.name} predicts; record them as well.")
    have = dict(vectors_of(recording))
    if other := [f"{name} of {width}" for name, width in shape.vectors if have.get(name) != width]:
        holds = ", ".join(f"{name} of {width}" for name, width in have.items()) or "none"
        raise DatasetError(f"{world.spec.name} takes the vectors {', '.join(other)}; {data} has {holds}.")
    mine = recording.controls
    if mine is None or (mine.kind, mine.numbers) != (controls.kind, controls.numbers):
        raise DatasetError(
            f"{data} has other actions than {world.spec.name}, which takes {controls.numbers} {controls.kind}; record a body with "
            "as many."
        )
    fps, own = recording.cache.fps, 1 / world.spec.dt_s
    if abs(fps / own - 1) > 0.01:
        raise DatasetError(f"{data} has {fps:g} steps a second, and {world.spec.name} {own:g}; record it at that rate.")
    if not recording.held_out:
        raise DatasetError(f"{data} has one episode, and none to measure on is left; record two or more.")
    return recording


def errors_on(world: LatentWorld, recording: Recording) -> dict[str, float]:
    """The open-loop error of the latent after some steps on held-out episodes, as a share of copy-last's."""
    latent = open_loop(world, recording, HORIZONS).table()["latent"]
    return {step: round(latent[ARMS[0]][step] / max(latent[ARMS[2]][step], 1e-9), 4) for step in latent[ARMS[0]]}


def verdict(errors: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """What was gained and what was forgotten, in two sentences."""
    new = errors["new"]
    last = list(new["after"])[-1]
    now, was = new["after"][last], new["before"][last]
    words = f"After {last} steps its error on the new recording is {now:.2f} of copy-last's, before {was:.2f}."
    if "old" not in errors:
        return f"{words} What it forgot was not measured: give --keep with a recording that it was trained on."
    old = errors["old"]
    last = list(old["after"])[-1]
    return f"{words} On the old one it is {old['after'][last]:.2f}, before {old['before'][last]:.2f}."
