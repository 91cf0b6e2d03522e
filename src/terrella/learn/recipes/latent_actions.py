"""train latent-actions: a few actions learned from pictures alone; see objectives/latent_actions.py."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ...core.errors import DatasetError, TrainingError
from ...data import ClipCache, Clips, ClipsConfig
from ..devices import device_named
from ..feeds import ClipStream
from ..objectives.latent_actions import LatentActionsObjective
from ..objectives.latent_model import LatentModel
from ..recording import Recording
from ..run_folder import load_run, resume_file
from ..sized_feed import SizedFeed
from ..strips import write_lines
from ..trainer import Report, Run, Trainer

STAGE = "codes"
WHY = "latent actions are learned from pictures"


@dataclass(frozen=True)
class LatentActionsConfig:
    """Settings of a training run."""

    codes: int = 8  # Number of actions to learn.
    # Rows between the two frames of a pair. Choose it so that the motion is a pixel or more, but no longer than a key is pressed.
    stride: int = 2
    size: tuple[int, int] = (48, 64)  # Height and width in pixels at which frames are compared.
    steps: int = 1800  # Training steps.
    batch: int = 16  # Pairs of frames per step.
    learning_rate: float = 2e-3  # Peak learning rate.
    save_every_s: float = 60.0  # Seconds between saves.
    strip_every_s: float = 120.0  # Seconds between pictures of the effect of each code.
    seed: int = 0  # Random seed.
    device: str = "auto"  # cpu, cuda or auto.


def train_latent_actions(data: str | Path, out: str | Path, config: LatentActionsConfig, report: Report) -> dict:
    """Trains, or resumes, the run in `out`; every 20th episode is held out, as in `train video`. Returns the facts of the run."""
    if any(length < 32 or length % 8 for length in config.size):
        raise TrainingError(f"--size {config.size[0]} {config.size[1]}: give multiples of 8, 32 or more.")
    if not 2 <= config.codes <= 64 or config.stride < 1 or config.steps < 1 or config.batch < 1:
        raise TrainingError("--codes is 2 to 64, and --stride, --steps and --batch are 1 or more.")
    device = device_named(config.device)
    recording = Recording.open(data, config.size, report, why=WHY)
    pairs = len(pair_rows(recording.cache, recording.seen, config.stride))
    if pairs < 64:
        raise DatasetError(
            f"{recording.cache.length} rows leave {pairs} pairs of frames, {config.stride} rows apart, to learn from; "
            "64 are needed: record more, or give a smaller --stride."
        )
    run = Run.of(out, config, report, device, frames=recording.cache.length)
    torch.manual_seed(config.seed)
    model = LatentModel(config.codes, config.stride, config.size, device)
    objective = LatentActionsObjective(model, config.learning_rate)

    def clips(size: int) -> ClipStream:
        settings = ClipsConfig(2, ("rgb",), size, stride=config.stride, seed=config.seed, episodes=recording.seen)
        return ClipStream(Clips(recording.cache, settings), lambda rows, now: rows["rgb"])

    trainer = Trainer(run, STAGE, SizedFeed(clips, config.batch), objective, config.steps)

    def draw() -> None:
        draw_strip(model, recording, config.seed, run.out / f"strip-{trainer.facts['step']:06d}.png")

    trainer.train(draw)
    draw()
    return {"run": str(out), **trainer.summary}


def load_latent(run: str | Path, device: str = "auto") -> LatentModel:
    """The model of a training run; TrainingError if the folder has none."""
    path = resume_file(Path(run), STAGE)
    facts = load_run(path, {}, {})
    if facts is None or "codes" not in facts["recipe"]:
        raise TrainingError(f"{run} is no run of `terrella train latent-actions`; give the folder of one.")
    recipe = facts["recipe"]
    model = LatentModel(recipe["codes"], recipe["stride"], tuple(recipe["size"]), device_named(device))
    load_run(path, {"inverse": model.inverse, "forward": model.forward}, {})
    return model


def pictures(data: str | Path, size: tuple[int, int], report: Report) -> ClipCache:
    """The clip cache of a recording; DatasetError if it has no pictures."""
    return Recording.open(data, size, report, why=WHY).cache


def frames_at(cache: ClipCache, rows: np.ndarray) -> torch.Tensor:
    """float32 [n, 3, H, W] in [0, 1]"""
    assert cache.rgb is not None
    return torch.from_numpy(np.ascontiguousarray(cache.rgb[rows])).permute(0, 3, 1, 2).float() / 255


def pair_rows(cache: ClipCache, episodes: list[int], stride: int) -> np.ndarray:
    """Rows of `episodes` that have `stride` rows after them in their episode."""
    rows = [np.arange(start, max(start, stop - stride)) for start, stop in (cache.episodes[i] for i in episodes)]
    return np.concatenate([np.zeros(0, np.int64), *rows])


def draw_strip(model: LatentModel, recording: Recording, seed: int, path: Path) -> None:
    """Eight held-out pairs from left to right; from above: the frame, the next, the prediction for the inferred code, for a random
    one, and then for each code, applied three times so that its motion is visible."""
    cache, stride = recording.cache, model.stride
    unseen = pair_rows(cache, list(recording.held_out), stride)
    rows = unseen if len(unseen) else pair_rows(cache, recording.seen, stride)
    rows = rows[np.linspace(0, len(rows) - 1, 8).astype(int)]
    before, after = frames_at(cache, rows), frames_at(cache, rows + stride)
    random = torch.randint(model.codes, (8,), generator=torch.Generator().manual_seed(seed))
    lines = [before, after, *(model.predict(before, code)[0] for code in (model.infer(before, after), random))]
    for code in range(model.codes):
        frame = before
        for _ in range(3):
            frame = model.predict(frame, torch.full((8,), code))[0]
        lines.append(frame)
    write_lines([(255 * line).round().to(torch.uint8) for line in lines], path)
