"""What further training of a finished world shares: the world and a recording beside it, updates with exact resume."""

from __future__ import annotations

import copy
import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import nn

from ..core.errors import DatasetError, TrainingError
from ..core.world import World, make_rng
from ..data import ClipCache, Dataset, split
from ..worlds.controls import Controls
from ..worlds.folder import save_world
from ..worlds.history import HistoryWorld
from ..worlds.video import Generator, VideoWorld, channels_last
from .run_folder import load_run, save_run
from .samples import THINGS, Box, Recording, controls_of, usable_rows

Report = Callable[[float, float, str], None]
Learned = VideoWorld | HistoryWorld


@dataclass(frozen=True)
class Beside:
    """A finished world with the part of a recording that it may be trained on."""

    world: Learned
    dataset: Dataset
    recording: Recording
    held_out: list[int]  # episodes

    @property
    def device(self) -> torch.device:
        return next(self.world.generator.parameters()).device


def beside(world: World, data: str | Path, keep_out: Box | None, report: Report) -> Beside:
    """Opens the recording `data` at the world's size. `keep_out` as in `train video`; None: what the world's card says.

    TrainingError for a world that is not learned; DatasetError where the recording does not fit the world.
    """
    if not isinstance(world, (VideoWorld, HistoryWorld)):
        raise TrainingError(
            f"{world.spec.name} is no world of pictures that was learned; `terrella train video` makes one."
        )
    config, dataset = world.config, Dataset(data)
    cache = ClipCache.open(dataset, config.size, lambda done, total: report(done, total, "building the clip cache"))
    if cache.rgb is None:
        raise DatasetError(f"{data} holds no pictures (rgb); {world.spec.name} is a world of pictures.")
    controls = world.controls if isinstance(world, HistoryWorld) else Controls.buttons(config.actions)
    found = controls_of(cache)
    if (found.kind, found.told) != (controls.kind, controls.told):
        raise DatasetError(
            f"{data} has actions ({found.kind}, {found.told}) that {world.spec.name} does not know "
            f"({controls.kind}, {controls.told}: {', '.join(world.spec.action_names)}); give a recording of the same game."
        )
    if config.moving and THINGS not in cache.arrays:
        raise DatasetError(
            f"{data} does not mark the `things` that move, which {world.spec.name} is shown; record them."
        )
    if config.geometry and (cache.depth is None or cache.pose is None):
        raise DatasetError(f"{data} lacks the depth or the poses that {world.spec.name} is shown; record them as well.")
    train, held_out = split(len(cache.episodes))
    start = np.zeros(cache.length, np.int64)
    for first, last in cache.episodes:
        start[first:last] = first
    said = world.spec.card.get("keep_out")
    box = keep_out
    if box is None and isinstance(said, (list, tuple)):
        box = (float(said[0]), float(said[1]), float(said[2]), float(said[3]))
    if box is not None and cache.pose is None:
        raise DatasetError(f"{data} has no poses, so no part of its map can be kept out; drop --keep-out.")
    usable = usable_rows(cache, train, box, config.camera)
    if usable.sum() < 64:
        raise DatasetError(f"{data} leaves {usable.sum()} frames to train on; record more, or a smaller keep_out.")
    return Beside(world, dataset, Recording(cache, start, usable, controls), held_out)


def with_generator(world: Learned, generator: Generator, steps: int, card: dict) -> Learned:
    """The same world around another generator, which draws a frame in `steps`; `card` is added to its facts. Its doubt is
    left out, for it knew the errors of the old one: `terrella train senses` learns another."""
    fresh = world.with_senses(world.eye if isinstance(world, VideoWorld) else None, None)
    fresh.generator = channels_last(copy.deepcopy(generator).eval().requires_grad_(False))
    fresh.config = replace(world.config, steps=steps)
    kept = {name: value for name, value in world.spec.card.items() if name != "uncertainty"}
    fresh.spec = replace(fresh.spec, card={**kept, **card})
    return fresh


def fingerprint(generator: Generator) -> str:
    """Of its weights, so that a run goes on only with the world that it began from."""
    digest = hashlib.sha256()
    for weight in generator.state_dict().values():
        digest.update(weight.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


class Updates:
    """The steps of a run in the folder `out`: resumed exactly, logged, saved, and drawn now and then.

    All of a step's randomness comes from (seed, step): an interrupted run sees what an unbroken one would.
    """

    def __init__(self, out: str | Path, recipe: dict, modules: dict[str, nn.Module], optimisers: dict):
        self.out, self.modules, self.optimisers = Path(out), modules, optimisers
        self.out.mkdir(parents=True, exist_ok=True)
        self.facts = {"recipe": json.loads(json.dumps(recipe)), "step": 0, "seconds": 0.0}
        found = load_run(self.out, {}, {})
        if found and found.get("recipe") != self.facts["recipe"]:
            raise TrainingError(f"{self.out} holds a run with other settings; repeat them, or give another --out.")
        if found:
            self.facts = load_run(self.out, modules, optimisers) or found

    def run(
        self,
        steps: int,
        update: Callable[[int], dict[str, float]],
        draw: Callable[[], None],
        save_every_s: float,
        strip_every_s: float,
        report: Report,
    ) -> None:
        """`update(step)` until `steps` are done; `draw()` leaves the world as it now is, and a picture of it."""
        facts, recent, whole = self.facts, [], True
        began = saved = drawn = time.monotonic()
        before = facts["seconds"]
        try:
            while facts["step"] < steps:
                whole = False  # a step that Ctrl-C cuts is not saved: the last save goes on exactly
                recent.append(update(facts["step"]))
                facts["step"] += 1
                whole = True
                now = time.monotonic()
                facts["seconds"] = before + now - began
                if now - saved > save_every_s:
                    self.save()
                    saved = now
                if len(recent) == 20 or facts["step"] == steps:
                    self._log(recent, steps, report)
                    recent = []
                if now - drawn > strip_every_s:
                    draw()
                    drawn = time.monotonic()
        except KeyboardInterrupt:
            if whole:
                self.save()
            raise
        self.save()
        draw()

    def save(self) -> None:
        save_run(self.out, self.modules, self.optimisers, self.facts)

    def _log(self, recent: list[dict[str, float]], steps: int, report: Report) -> None:
        mean = {name: float(np.mean([one[name] for one in recent])) for name in recent[-1]}
        with open(self.out / "log.jsonl", "a") as file:
            file.write(json.dumps({"step": self.facts["step"], "seconds": round(self.facts["seconds"]), **mean}) + "\n")
        report(self.facts["step"] / steps, 1.0, " ".join(f"{name} {value:.4f}" for name, value in mean.items()))


def recipe_of(config, world: Learned, dataset: Dataset) -> dict:
    """What must not change within a run; where and how often it is saved may."""
    fixed = {k: v for k, v in asdict(config).items() if k not in ("save_every_s", "strip_every_s", "device")}
    return {**fixed, "world": fingerprint(world.generator), "frames": dataset.length}


def descend(optimiser: torch.optim.Optimizer, module: nn.Module, loss: torch.Tensor, step: int) -> None:
    """One step down the gradient, its norm cut at 1; TrainingError where it is not a number."""
    optimiser.zero_grad()
    loss.backward()
    if not torch.isfinite(nn.utils.clip_grad_norm_(module.parameters(), 1.0)):
        raise TrainingError(f"a gradient is not a number at step {step}; the last save is good: lower --learning-rate.")
    optimiser.step()


def leave(beside: Beside, world: Learned, old: Learned, out: Path, step: int) -> None:
    """The world in out/world, and 64 steps of a held-out episode: truth above the old world's dream above the new's."""
    save_world(world, out / "world", dict(world.spec.card))
    recording = beside.recording
    first, last = recording.cache.episodes[(beside.held_out or [0])[0]]
    rows = np.arange(max(first, min(first + 40, last - 65)), last)[:65]
    lines = [recording.rgb(rows[::8]), *(_dream(one, recording, rows) for one in (old, world))]
    picture = torch.cat([torch.cat(list(line), 2) for line in lines], 1).permute(1, 2, 0).numpy()
    Image.fromarray(picture).save(out / f"strip-{step:06d}.png")


def _dream(world: Learned, recording: Recording, rows: np.ndarray) -> torch.Tensor:
    """Every 8th frame of a dream from the first of `rows` on, along the recorded poses or, where there are none or things
    move, the recorded actions."""
    rng, config = make_rng(1), world.config
    seen = {"rgb": recording.rgb(rows[:1]).permute(0, 2, 3, 1)}
    if config.geometry:
        seen |= {"depth": recording.depth(rows[:1]), "pose": recording.pose(rows[:1])}
    if config.moving:
        seen["things"] = recording.things(rows[:1])
    state = world.observe(seen, None, rng)
    frames = [world.render(state, ("rgb",))["rgb"]]
    for row in rows[1:]:
        if config.geometry and not config.moving:  # what moves answers to actions
            state = world.observe({"pose": recording.pose([row])}, state, rng)
        else:
            action = (
                recording.cache.action[row - 1].astype(world.spec.action.dtype).reshape(world.spec.action.shape or ())
            )
            state = world.imagine(state, torch.from_numpy(action)[None], rng)
        frames.append(world.render(state, ("rgb",))["rgb"])
    return torch.cat(frames)[::8].permute(0, 3, 1, 2)
