"""train_latent_actions: a few actions learned from pictures alone, by asking which of K outcomes explains the next frame.

Each code is a hypothesis of what follows. The code whose outcome is nearest to what followed is trained to come nearer
(hard expectation-maximisation, shared out evenly at first so that every code finds work), and the inverse model learns
to name it from the two frames. Recorded actions are never looked at.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from ..core.errors import DatasetError, TrainingError
from ..data import ClipCache, Dataset, split
from .latent_model import Forward, Inverse
from .run_folder import load_run
from .strips import write_lines
from .updates import Report, Updates, descend, device_named

EVEN_FOR = 0.5  # share of the training in which the codes are shared out evenly

BENDING = 0.003  # of the loss, for each pixel by which a frame bends the motion of a code


@dataclass(frozen=True)
class LatentConfig:
    """Settings of a training run.

    Args:
        codes: How many actions are learned.
        stride: Rows from the frame that an action begins with to the frame that it leads to; so far ahead that the motion is
            worth a pixel or more, and no further than a key is held.
        size: Height and width in pixels at which frames are looked at.
        steps: Training steps.
        batch: Pairs of frames a step.
        learning_rate: At its height.
        save_every_s: Seconds between saves.
        strip_every_s: Seconds between pictures of what each code does.
        seed: Of everything random.
        device: cpu, cuda or auto.
    """

    codes: int = 8
    stride: int = 2
    size: tuple[int, int] = (48, 64)
    steps: int = 1800
    batch: int = 16
    learning_rate: float = 2e-3
    save_every_s: float = 60.0
    strip_every_s: float = 120.0
    seed: int = 0
    device: str = "auto"


def train_latent_actions(data: str | Path, out: str | Path, config: LatentConfig, report: Report) -> dict:
    """Trains, or goes on with, the run in `out`; every 20th episode is held out, as `train video` does. Returns its facts."""
    out = Path(out)
    if any(length < 32 or length % 8 for length in config.size):
        raise TrainingError(f"--size {config.size[0]} {config.size[1]}: give multiples of 8, 32 or more.")
    if not 2 <= config.codes <= 64 or config.stride < 1 or config.steps < 1 or config.batch < 1:
        raise TrainingError("--codes is 2 to 64, and --stride, --steps and --batch are 1 or more.")
    device_named(config.device)
    cache = pictures(data, config.size, report)
    run = _Run(cache, out, config)
    run.updates.run(config.steps, run.step, run.draw_strip, config.save_every_s, config.strip_every_s, report)
    run.draw_strip()
    return {"run": str(out), **run.updates.outcome}


def pictures(data: str | Path, size: tuple[int, int], report: Report) -> ClipCache:
    """The clip cache of a recording that has pictures; DatasetError where it has none."""
    dataset = Dataset(data)
    if not dataset.has("rgb"):
        raise DatasetError(f"{data} holds no pictures (rgb); latent actions are learned from pictures.")
    return ClipCache.open(dataset, size, lambda done, total: report(done, total, "building the clip cache"))


def frames_at(cache: ClipCache, rows: np.ndarray) -> torch.Tensor:
    """float32 [n, 3, H, W] in [0, 1]"""
    assert cache.rgb is not None
    return torch.from_numpy(np.ascontiguousarray(cache.rgb[rows])).permute(0, 3, 1, 2).float() / 255


def pair_rows(cache: ClipCache, episodes: list[int], stride: int) -> np.ndarray:
    """Rows of `episodes` whose episode goes on for `stride` rows more."""
    rows = [np.arange(start, max(start, stop - stride)) for start, stop in (cache.episodes[i] for i in episodes)]
    return np.concatenate([np.zeros(0, np.int64), *rows])


class LatentModel:
    """What a run has learned: `inverse` names codes, `forward` carries them out."""

    def __init__(self, config: LatentConfig):
        self.config = config
        self.device = device_named(config.device)
        self.inverse, self.forward = Inverse(config.codes).to(self.device), Forward(config.codes).to(self.device)
        self.modules: dict[str, nn.Module] = {"inverse": self.inverse, "forward": self.forward}

    @torch.inference_mode()
    def infer(self, before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
        """Codes int64 [B] that led from one frame [B, 3, H, W] in [0, 1] to the other."""
        return self.inverse(before.to(self.device), after.to(self.device)).argmax(1).cpu()

    @torch.inference_mode()
    def predict(self, before: torch.Tensor, code: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The frame [B, 3, H, W] in [0, 1] that follows under codes int64 [B], and the flow (see Forward.outcome)."""
        before = before.to(self.device)
        told = F.one_hot(code.to(self.device), self.config.codes).float()
        frame, flow, _ = self.forward.outcome(self.forward.features(before), before, told)
        return frame.clamp(0, 1).cpu(), flow.cpu()


def load_latent(run: str | Path, device: str = "auto") -> LatentModel:
    """The model of a training run; TrainingError where the folder holds none."""
    run = Path(run)
    facts = load_run(run, {}, {})
    if facts is None or not isinstance(facts.get("recipe"), dict) or "codes" not in facts["recipe"]:
        raise TrainingError(f"{run} is no run of `terrella train latent-actions`; give the folder of one.")
    recipe = {name: facts["recipe"][name] for name in ("codes", "stride", "size", "steps", "batch", "seed")}
    model = LatentModel(LatentConfig(**{**recipe, "size": tuple(recipe["size"]), "device": device}))
    load_run(run, model.modules, {})
    return model


class _Run:
    """The pieces of one training run."""

    def __init__(self, cache: ClipCache, out: Path, config: LatentConfig):
        self.cache, self.out, self.config = cache, out, config
        torch.manual_seed(config.seed)
        self.model = LatentModel(config)
        train, held_out = split(len(cache.episodes))
        self.rows, self.unseen = pair_rows(cache, train, config.stride), pair_rows(cache, held_out, config.stride)
        if len(self.rows) < 64:
            raise DatasetError(
                f"{cache.length} rows leave {len(self.rows)} pairs of frames, {config.stride} rows apart, to learn from; "
                "64 are needed: record more, or give a smaller --stride."
            )
        weights = [weight for module in self.model.modules.values() for weight in module.parameters()]
        self.optimiser = torch.optim.AdamW(weights, config.learning_rate, (0.9, 0.99), weight_decay=1e-4)
        self.updates = Updates(out, _recipe(config, cache), self.model.modules, {"optimiser": self.optimiser})

    def step(self, step: int) -> dict[str, float]:
        """One step; all its randomness comes from (seed, step), so a resumed run sees what an unbroken one would."""
        config, model = self.config, self.model
        rng = np.random.default_rng([config.seed, step])
        share = step / config.steps
        for group in self.optimiser.param_groups:
            group["lr"] = config.learning_rate * min(1, (step + 1) / 50) * (0.525 + 0.475 * np.cos(np.pi * share))
        rows = rng.choice(self.rows, config.batch)
        before = frames_at(self.cache, rows).to(model.device)
        after = frames_at(self.cache, rows + config.stride).to(model.device)
        features = model.forward.features(before)
        with torch.no_grad():
            likely = posterior(model.forward.errors(features, before, after), share)
            code = torch.from_numpy(_drawn(likely.cpu().double().numpy(), rng)).to(model.device)
        told = F.one_hot(code, config.codes).float()
        drawn, _, bend = model.forward.outcome(features, before, told)
        losses = {"outcome": (drawn - after).abs().mean(), "bend_px": bend.abs().mean()}
        losses["naming"] = -(likely * model.inverse(before, after).log_softmax(1)).sum(1).mean()
        total = losses["outcome"] + BENDING * losses["bend_px"] + 0.1 * losses["naming"]
        if not torch.isfinite(total):
            raise TrainingError(
                f"the loss is not a number at step {step}; the last save is good: lower --learning-rate."
            )
        descend(self.optimiser, total, step, *model.modules.values())
        return {name: float(value.detach()) for name, value in losses.items()}

    def draw_strip(self) -> None:
        """Eight held-out moments from left to right; from above: the frame, what followed, the outcome of the inferred code,
        of a random one, and then of each code in turn, three times over so that its motion is plain to see."""
        rows = self.unseen if len(self.unseen) else self.rows
        rows = rows[np.linspace(0, len(rows) - 1, 8).astype(int)]
        before, after = frames_at(self.cache, rows), frames_at(self.cache, rows + self.config.stride)
        random = torch.randint(self.config.codes, (8,), generator=torch.Generator().manual_seed(self.config.seed))
        lines = [before, after]
        lines += [self.model.predict(before, code)[0] for code in (self.model.infer(before, after), random)]
        for code in range(self.config.codes):
            frame = before
            for _ in range(3):
                frame = self.model.predict(frame, torch.full((8,), code))[0]
            lines.append(frame)
        coded = [(255 * line).round().to(torch.uint8) for line in lines]
        write_lines(coded, self.out / f"strip-{self.updates.facts['step']:06d}.png")


def posterior(errors: torch.Tensor, share: float) -> torch.Tensor:
    """How likely each code is [B, K] from the errors of its outcome [B, K], after a `share` of the training: sharper and
    sharper, and at first corrected so that no code is without work (a few rounds of Sinkhorn's balancing)."""
    early = max(0.0, 1 - share / EVEN_FOR)
    likely = (-errors / errors.mean(1, keepdim=True) / (0.005 + 0.1 * early)).softmax(1)
    if early:
        even = 0.1 * len(errors) / errors.shape[1]
        for _ in range(3):
            likely = likely / (likely.sum(0) + even)
            likely = likely / likely.sum(1, keepdim=True)
    return likely


def _drawn(likely: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One code for each row of `likely` [B, K], as likely as it says."""
    upto = likely.cumsum(1)
    return (rng.random((len(likely), 1)) * upto[:, -1:] > upto[:, :-1]).sum(1)


def _recipe(config: LatentConfig, cache: ClipCache) -> dict:
    """What must not change within a run; where it runs, and how often it saves, may."""
    fixed = asdict(replace(config, device="", save_every_s=0, strip_every_s=0))
    return json.loads(json.dumps({**fixed, "frames": cache.length}))
