"""Estimator: depth from one picture, and from it motion between two, trained on recordings with depth and augmented pictures."""

import math
from collections.abc import Iterator

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from ...core.errors import DatasetError
from ...core.world import make_rng
from ...data import ClipCache
from ...space.camera import yaw
from ...space.estimator import Estimator, EstimatorConfig, normalise
from ...space.floorplan import Box
from ..feeds import RandomBatches
from ..learners import adamw, warmup_cosine
from ..recording import Recording
from ..train_step import TrainStep
from ..trainer import CPU, Loss, Run, Trainer

DRIFT = 64  # steps over which odometry is integrated to measure drift


class EstimatorObjective:
    """L1 loss of the logarithm of depth and of its gradients. (Motion is computed from depth by space/align.py.)"""

    def __init__(self, recording: Recording, batch: int, learning_rate: float, seed: int):
        self.recording, self.size, self.rows = recording, batch, recording.rows_within(0, 1)
        if len(self.rows) < 64:
            raise DatasetError(
                f"the recording leaves {len(self.rows)} pairs of pictures to learn an estimator from; record more."
            )
        self.some = np.random.default_rng(seed).choice(self.rows, min(len(self.rows), 2000), replace=False)
        self.estimator = _fresh(recording, self.some, seed)
        self.modules = {"estimator": self.estimator}
        self.learners = {"estimator": adamw((self.estimator,), warmup_cosine(learning_rate, 50, 0.02))}

    def sample(self, now: TrainStep) -> tuple[torch.Tensor, torch.Tensor]:
        """Pictures [n, 3, H, W] in 0..1 and their depth, some mirrored, some recoloured."""
        rows = now.rng.choice(self.rows, self.size)
        recording, size = self.recording, _size(self.recording)
        pictures, depth = recording.rgb(rows).float() / 255, recording.depth(rows)
        if tuple(pictures.shape[-2:]) != size:
            pictures = F.interpolate(pictures, size, mode="bilinear", antialias=True, align_corners=False)
            depth = _sized(depth, size)
        if now.rng.random() < 0.5:
            pictures, depth = pictures.flip(-1), depth.flip(-1)
        return recoloured(pictures, now.rng), depth

    def losses(self, batch: tuple[torch.Tensor, torch.Tensor], now: TrainStep) -> Iterator[Loss]:
        picture, depth = (part.to(now.device) for part in batch)
        off = self.estimator.depth_code(normalise(picture)) - self.estimator.code(depth)
        slopes = off.diff(dim=1).abs().mean() + off.diff(dim=2).abs().mean()
        reach = math.log(self.estimator.config.far_m / self.estimator.config.near_m)
        yield Loss("estimator", off.abs().mean() + 0.5 * slopes, {"depth_off": reach * off.abs().mean()})


def _fresh(recording: Recording, some: np.ndarray, seed: int) -> Estimator:
    """An untrained estimator, which gives the mean depth of the rows `some` everywhere."""
    near, far = recording.depth(some[:500]).flatten()[::7].quantile(torch.tensor([0.0005, 0.9995])).tolist()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        fx, fy, cx, cy = recording.cache.world["camera"]
        reach = {"near_m": 0.8 * near, "far_m": max(1.25 * far, 1.6 * near)}
        estimator = Estimator(EstimatorConfig(_size(recording), **reach, camera=(fx, fy, cx, cy)))
        nn.init.zeros_(estimator.output.weight)
    usual = estimator.code(_sized(recording.depth(some[:500]), _size(recording))).mean(0)
    estimator.prior.copy_(((usual + usual.flip(-1)) / 2).clamp(0.02, 0.98).logit())
    estimator.pace.copy_(motion_between(recording, some).abs().mean(0).clamp_min(1e-4) * 2)
    return estimator


def learn_estimator(
    run: Run, recording: Recording, steps: int, batch: int = 16, learning_rate: float = 3e-3
) -> Estimator:
    """A depth and odometry estimator, learned on the CPU."""
    objective = EstimatorObjective(recording, batch, learning_rate, run.seed)
    trainer = Trainer(run, "estimator", RandomBatches(objective.sample), objective, steps, device=CPU)
    trainer.train()
    estimator = objective.estimator.eval().requires_grad_(False)
    with torch.inference_mode():
        looks = [estimator.looks(recording.rgb(part)) for part in np.array_split(np.sort(objective.some), 40)]
        estimator.learn_usual(torch.cat(looks))
    return estimator


def motion_between(recording: Recording, rows: np.ndarray) -> torch.Tensor:
    """The true motion from each of `rows` to the next, [n, 3]: metres forward and left, radians to the left."""
    return relative_motion(recording.pose(rows), recording.pose(rows + 1))


def relative_motion(before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
    """Planar motion between poses [n, 7]: [n, 3] metres forward and left in the frame of `before`, radians to the left."""
    heading, way = yaw(before), after[:, :2] - before[:, :2]
    turn = yaw(after) - heading
    c, s = heading.cos(), heading.sin()
    forward, left = way[:, 0] * c + way[:, 1] * s, way[:, 1] * c - way[:, 0] * s
    return torch.stack([forward, left, torch.atan2(turn.sin(), turn.cos())], 1)


def estimator_errors(
    estimator: Estimator, cache: ClipCache, episodes: list[int], keep_out: Box | None, frames: int = 400
) -> dict:
    """Errors of the estimator on `episodes`, outside the box ("recorded") and inside it ("new").

    Depth: abs_rel, the mean of |error| / truth, and delta_125, the share of pixels within a factor of 1.25. Odometry: moved_off,
    the sum of errors over the distance travelled; turned_off_deg per step; drift_off, the mean position error after DRIFT steps
    over the distance travelled (of stretches longer than half a metre), and drift_deg, that of the heading.
    """
    places = {"recorded": Recording.of(cache, episodes, keep_out)}
    if keep_out is not None:
        x0, y0, x1, y1 = keep_out
        every = Recording.of(cache, list(range(len(cache.episodes))), None)
        x, y = np.asarray(cache.pose)[:, :2].T
        inside = (x > x0) & (x < x1) & (y > y0) & (y < y1)
        places["new"] = Recording(cache, every.start, every.usable & inside)
    return {place: _errors(estimator, recording, frames) for place, recording in places.items()}


@torch.inference_mode()
def _errors(estimator: Estimator, recording: Recording, frames: int) -> dict[str, float]:
    pairs = recording.rows_within(0, 1)
    if not len(pairs):
        return {}
    rows = pairs[:: max(1, len(pairs) // frames)]
    relative_error, within = [], []
    for part in np.array_split(rows, max(1, len(rows) // 32)):
        seen, truth = estimator.depth(recording.rgb(part)), recording.depth(part)
        ratio = seen / truth
        relative_error.append(((seen - truth).abs() / truth).mean((1, 2)))
        within.append((torch.maximum(ratio, 1 / ratio) < 1.25).float().mean((1, 2)))
    facts = {"frames": len(rows), "abs_rel": float(torch.cat(relative_error).mean())}
    facts["delta_125"] = float(torch.cat(within).mean())
    usable = np.zeros(len(recording.usable), bool)
    usable[pairs] = True
    whole = np.convolve(usable, np.ones(DRIFT, int))[DRIFT - 1 :] == DRIFT
    begins = np.flatnonzero(whole)
    if not len(begins):
        return facts
    begins = begins[:: max(1, len(begins) // 24)][:24]
    seen, truth = [], []
    for begin in begins:
        walk = np.arange(begin, begin + DRIFT)
        seen.append(estimator.motion(recording.rgb(walk), recording.rgb(walk + 1)))
        truth.append(motion_between(recording, walk))
    estimated, true = torch.stack(seen), torch.stack(truth)
    way = true[..., :2].norm(dim=-1)
    off = (estimated - true)[..., :2].norm(dim=-1)
    facts |= {"walks": len(begins), "moved_off": float(off.sum() / way.sum())}
    facts["turned_off_deg"] = float((estimated - true)[..., 2].abs().mean().rad2deg())
    ends, true_ends = _integrated(estimated), _integrated(true)
    walked = way.sum(1)
    went = walked > 0.5
    if went.any():
        facts["drift_off"] = float(((ends - true_ends)[went, :2].norm(dim=-1) / walked[went]).mean())
    facts["drift_deg"] = float((ends - true_ends)[:, 2].abs().mean().rad2deg())
    return facts


def _integrated(steps: torch.Tensor) -> torch.Tensor:
    """The whole motion [n, 3] in the first frame, of motions [n, T, 3], each in the frame of the step before."""
    heading = torch.cat([torch.zeros_like(steps[:, :1, 2]), steps[:, :-1, 2]], 1).cumsum(1)
    c, s = heading.cos(), heading.sin()
    x = (steps[..., 0] * c - steps[..., 1] * s).sum(1)
    y = (steps[..., 0] * s + steps[..., 1] * c).sum(1)
    return torch.stack([x, y, steps[..., 2].sum(1)], 1)


def _size(recording: Recording) -> tuple[int, int]:
    """Half the size of the frames, in multiples of 16."""
    height, width = recording.cache.rgb.shape[1:3]
    return max(16, round(height / 32) * 16), max(16, round(width / 32) * 16)


def _sized(depth: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    return F.interpolate(depth[:, None], size, mode="nearest-exact")[:, 0]


def recoloured(pictures: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Pictures [n, 3, H, W] in 0..1 with random colours: channels permuted and mixed, gamma, a smooth light pattern, sometimes
    inverted, noise. Three batches in five are left unchanged."""
    if rng.random() < 0.6:
        return pictures
    count, chance = len(pictures), make_rng(int(rng.integers(2**62)))
    mix = torch.rand(count, 3, 3, generator=chance) ** 2
    mix = torch.lerp(torch.eye(3)[torch.randperm(3, generator=chance)].expand(count, 3, 3), mix / mix.sum(2, True), 0.5)
    changed = torch.einsum("nij,njhw->nihw", mix, pictures)
    gamma = torch.exp(0.5 * torch.randn(count, 3, 1, 1, generator=chance).clamp(-1.5, 1.5))
    changed = changed.clamp(0, 1) ** gamma
    if rng.random() < 0.15:
        changed = 1 - changed
    stain = F.interpolate(torch.rand(count, 1, 3, 4, generator=chance), pictures.shape[-2:], mode="bicubic")
    strength = 0.6 * float(rng.random())
    changed = changed * (1 - strength + strength * 1.5 * stain)
    changed = changed + 0.03 * float(rng.random()) * torch.randn(changed.shape, generator=chance)
    return changed.clamp(0, 1)
