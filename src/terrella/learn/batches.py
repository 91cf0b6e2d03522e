"""Training batches of generators: their conditioning and the true frames; and views of static places."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from ..space.keyframes import Glimpse, Keyframes, gathered, look, retrieve
from ..space.reproject import carry_unknown
from ..worlds.config import THUMBNAIL, VideoConfig
from ..worlds.generator import Conditioning, UNet, context_thumbnail, decode_depth, encode_depth, generate, pixels
from .recording import Recording
from .train_step import TrainStep

# Dream(conditioning, now) -> frames [B, 4 or 5, H, W] as the generator under training draws them, on the CPU
Dream = Callable[[Conditioning, TrainStep], torch.Tensor]


@dataclass(frozen=True)
class Batch:
    """The conditioning of a generator, and the true frames [B, 4 or 5, H, W] in its own code."""

    shown: Conditioning
    truth: torch.Tensor
    weight: torch.Tensor | None = None  # [B, 1, H, W], of each pixel; None: uniform

    def judged(self, clean: torch.Tensor) -> torch.Tensor:
        """Generated frames `clean`, with the truth where the weight is 0, so that neither losses nor critic see these pixels."""
        return clean if self.weight is None else torch.where(self.weight > 0, clean, as_generated(self.truth))

    def to(self, device) -> Batch:
        weight = None if self.weight is None else self.weight.to(device)
        return Batch(self.shown.to(device), self.truth.to(device), weight)


@torch.no_grad()
def generate_now(generator: UNet, shown: Conditioning, now: TrainStep, steps: int = 1) -> torch.Tensor:
    """Frames [B, 4 or 5, H, W] as a generator under training draws them, on the CPU: see Dream."""
    batch, _, height, width = shown.last.shape
    noise = now.randn(batch, 4, height, width)
    with now.half():
        return generate(generator, noise, shown.to(now.device), steps).float().cpu()


def as_generated(truth: torch.Tensor) -> torch.Tensor:
    """True frames [B, 4 or 5, H, W] in the form of generated ones, in which the mask of moving things is logits."""
    return torch.cat([truth[:, :4], 40 * truth[:, 4:] - 20], 1)


def encode_rgb(rgb: torch.Tensor) -> torch.Tensor:
    """uint8 to the generator's code of colour, -1 to 1."""
    return rgb.float() / 127.5 - 1


@dataclass(frozen=True)
class PlaceViews:
    """B rows of a recording, and the keyframes from which each is drawn."""

    chosen: list[Keyframes]
    target: np.ndarray
    recording: Recording
    config: VideoConfig

    @staticmethod
    def drawn(
        recording: Recording, memory: Keyframes, config: VideoConfig, batch: int, rng: np.random.Generator, back: int
    ) -> PlaceViews:
        """Half of the samples use keyframes of the memory, thinned at random, half only those of their own episode's past, so that
        completion is learned both with dense and with sparse memory. Each target has `back` usable rows before it."""
        target = rng.choice(recording.rows_within(back, 0), batch)
        chosen = []
        for index, row in enumerate(target):
            pose = recording.pose([row])[0]
            if index % 2 == 0:
                picks = _retrieved(memory, pose, config)
                if rng.random() < 0.4:
                    picks = [pick for pick in picks if rng.random() < 0.6]
                chosen.append(memory.at(picks))
            else:
                own = recording.keyframes(_past(recording, int(row), rng), config.camera)
                chosen.append(own.at(_retrieved(own, pose, config)))
        return PlaceViews(chosen, target, recording, config)

    def glimpse(self, rows: np.ndarray) -> Glimpse:
        """The glimpses of the chosen keyframes from the poses of `rows`."""
        config, pose = self.config, self.recording.pose(rows)
        memory, picks = gathered(self.chosen, config.size)
        return look(memory, picks, pose, config.camera, config.size, config.slots)

    def carried(self, rgb, depth, from_rows: np.ndarray, to_rows: np.ndarray, glimpse: Glimpse) -> torch.Tensor:
        """The frames at `from_rows`, recorded or generated, warped into the views at `to_rows`."""
        poses = self.recording.pose(from_rows), self.recording.pose(to_rows)
        return carry_unknown(rgb, depth, poses[0], glimpse.known, glimpse.depth, poses[1], self.config.camera)


def _retrieved(memory: Keyframes, pose: torch.Tensor, config: VideoConfig) -> list[int]:
    """The keyframes to use for the view from `pose` [7]."""
    picks = retrieve(memory, pose[None], config.camera, config.size, config.sources)[0]
    return picks[picks >= 0].tolist()


def _past(recording: Recording, row: int, rng: np.random.Generator) -> np.ndarray:
    """A few rows of the same episode's past, the newest some steps ago, as when play is far from its keyframes."""
    newest = row - int(rng.choice([2, 4, 8, 16, 32, 64]))
    gaps = rng.integers(3, 24, size=int(rng.integers(1, 7))).cumsum() - 3
    past = np.maximum(newest - gaps, recording.start[row])
    past = np.unique(np.minimum(past, row - 1))
    seen = past[recording.usable[past]]  # rows that are kept out are not shown either
    return seen if len(seen) else np.array([row - 1])


def place_batch(
    recording: Recording, memory: Keyframes, config: VideoConfig, batch: int, now: TrainStep, dream: Dream | None
) -> Batch:
    """Views of recorded places; the last frame is recorded in half of the batches, else generated by `dream`, if given."""
    rng = now.rng
    views = PlaceViews.drawn(recording, memory, config, batch, rng, back=2)
    target, before = views.target, views.target - 1
    rgb, depth = recording.rgb(before), recording.depth(before)
    if dream and rng.random() < 0.5:
        glimpse, earlier = views.glimpse(before), before - 1
        known = recording.rgb(earlier), recording.depth(earlier)
        last = _masked_at_random(views.carried(*known, earlier, before, glimpse), 0.5, rng)
        clean = dream(Conditioning(glimpse, last, context_thumbnail(known[0])), now)
        rgb, depth = pixels(clean), decode_depth(clean[:, 3])
    glimpse = views.glimpse(target)
    last = _masked_at_random(views.carried(rgb, depth, before, target, glimpse), 0.9, rng)
    truth = torch.cat([encode_rgb(recording.rgb(target)), encode_depth(recording.depth(target))[:, None]], 1)
    return augmented(Batch(Conditioning(glimpse, last, context_thumbnail(rgb)), truth), rng)


def augmented(batch: Batch, rng: np.random.Generator) -> Batch:
    """The batch, mirrored with probability 1/2, and with permuted colours with probability 1/2: a recording has few places, and a
    generator should take the look of a new one from what is visible of it."""
    glimpse, last, context = batch.shown.glimpse, batch.shown.last, batch.shown.context
    colours = torch.arange(3)
    if rng.random() < 0.5:
        colours = torch.from_numpy(rng.permutation(3))
    planes = torch.cat([colours, torch.tensor([3])])
    parts = [glimpse.rgb[:, :, colours], glimpse.trust, glimpse.depth, glimpse.known]
    parts += [last[:, planes], context.unflatten(1, (3, *THUMBNAIL))[:, colours], batch.truth[:, planes]]
    if rng.random() < 0.5:
        parts = [part.flip(-1) for part in parts]
    return Batch(Conditioning(Glimpse(*parts[:4]), parts[4], parts[5].flatten(1)), parts[6])


def _masked_at_random(last: torch.Tensor, keep: float, rng: np.random.Generator) -> torch.Tensor:
    return last * torch.from_numpy(rng.random(len(last)) < keep)[:, None, None, None]
