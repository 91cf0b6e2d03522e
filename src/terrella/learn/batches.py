"""What a generator learns from: what it is shown, and the frame that it should draw; and views of places that stand still."""

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
from .trainer import Now

# Dream(what is shown, now) -> frames [B, 4 or 5, H, W] as the generator under training draws them, on the CPU
Dream = Callable[[Conditioning, Now], torch.Tensor]


@dataclass(frozen=True)
class Batch:
    """What a generator is shown, and the true frames [B, 4 or 5, H, W] that it should draw, in its own code."""

    shown: Conditioning
    truth: torch.Tensor
    weight: torch.Tensor | None = None  # [B, 1, H, W], how much each pixel counts; None: all alike
    instruction: torch.Tensor | None = None  # [B, D], the embedding of what was asked for, where the recording says it

    def judged(self, clean: torch.Tensor) -> torch.Tensor:
        """Drawn frames `clean`, with the truth where nothing counts: no loss and no critic sees what was drawn there."""
        return clean if self.weight is None else torch.where(self.weight > 0, clean, as_drawn(self.truth))

    def to(self, device) -> Batch:
        weight, instruction = (None if part is None else part.to(device) for part in (self.weight, self.instruction))
        return Batch(self.shown.to(device), self.truth.to(device), weight, instruction)


@torch.no_grad()
def drawn_now(generator: UNet, shown: Conditioning, now: Now, steps: int = 1) -> torch.Tensor:
    """Frames [B, 4 or 5, H, W] as a generator under training draws them, on the CPU: see Dream."""
    batch, _, height, width = shown.last.shape
    noise = now.randn(batch, 4, height, width)
    with now.half():
        return generate(generator, noise, shown.to(now.device), steps).float().cpu()


def as_drawn(truth: torch.Tensor) -> torch.Tensor:
    """True frames [B, 4 or 5, H, W] as a generator draws them, which gives what moves as logits."""
    return torch.cat([truth[:, :4], 40 * truth[:, 4:] - 20], 1)


def coded(rgb: torch.Tensor) -> torch.Tensor:
    """uint8 to the generator's code of colour, -1 to 1."""
    return rgb.float() / 127.5 - 1


@dataclass(frozen=True)
class Views:
    """B rows of a recording, and the keyframes from which each is to be drawn."""

    chosen: list[Keyframes]
    target: np.ndarray
    recording: Recording
    config: VideoConfig

    @staticmethod
    def drawn(
        recording: Recording, memory: Keyframes, config: VideoConfig, batch: int, rng: np.random.Generator, back: int
    ) -> Views:
        """Half of the samples stand in recorded places (memory, thinned at random), half see only their own episode's past.

        Both learn to complete: the first where memory is dense, the second where it is sparse. `back` rows before each
        target are of its episode and usable.
        """
        target = rng.choice(recording.within(back, 0), batch)
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
        return Views(chosen, target, recording, config)

    def glimpse(self, rows: np.ndarray) -> Glimpse:
        """What the chosen keyframes know of the views at `rows`."""
        config, pose = self.config, self.recording.pose(rows)
        memory, picks = gathered(self.chosen, config.size)
        return look(memory, picks, pose, config.camera, config.size, config.slots)

    def carried(self, rgb, depth, from_rows: np.ndarray, to_rows: np.ndarray, glimpse: Glimpse) -> torch.Tensor:
        """The frame at `from_rows` (given, dreamt or true) carried into the views at `to_rows`."""
        poses = self.recording.pose(from_rows), self.recording.pose(to_rows)
        return carry_unknown(rgb, depth, poses[0], glimpse.known, glimpse.depth, poses[1], self.config.camera)


def _retrieved(memory: Keyframes, pose: torch.Tensor, config: VideoConfig) -> list[int]:
    """The keyframes to use for the view from `pose` [7]."""
    picks = retrieve(memory, pose[None], config.camera, config.size, config.sources)[0]
    return picks[picks >= 0].tolist()


def _past(recording: Recording, row: int, rng: np.random.Generator) -> np.ndarray:
    """A few rows of the same episode's past, the newest some steps ago, as a dream far from its keyframes has them."""
    newest = row - int(rng.choice([2, 4, 8, 16, 32, 64]))
    gaps = rng.integers(3, 24, size=int(rng.integers(1, 7))).cumsum() - 3
    past = np.maximum(newest - gaps, recording.start[row])
    past = np.unique(np.minimum(past, row - 1))
    seen = past[recording.usable[past]]  # what training must not see is not shown either
    return seen if len(seen) else np.array([row - 1])


def place_batch(
    recording: Recording, memory: Keyframes, config: VideoConfig, batch: int, now: Now, dream: Dream | None
) -> Batch:
    """Views of recorded places; the last frame is recorded in half of the batches, else dreamt (never without `dream`)."""
    rng = now.rng
    views = Views.drawn(recording, memory, config, batch, rng, back=2)
    target, before = views.target, views.target - 1
    rgb, depth = recording.rgb(before), recording.depth(before)
    if dream and rng.random() < 0.5:
        glimpse, earlier = views.glimpse(before), before - 1
        known = recording.rgb(earlier), recording.depth(earlier)
        last = _now_and_then(views.carried(*known, earlier, before, glimpse), 0.5, rng)
        clean = dream(Conditioning(glimpse, last, context_thumbnail(known[0])), now)
        rgb, depth = pixels(clean), decode_depth(clean[:, 3])
    glimpse = views.glimpse(target)
    last = _now_and_then(views.carried(rgb, depth, before, target, glimpse), 0.9, rng)
    truth = torch.cat([coded(recording.rgb(target)), encode_depth(recording.depth(target))[:, None]], 1)
    return varied(Batch(Conditioning(glimpse, last, context_thumbnail(rgb)), truth), rng)


def varied(batch: Batch, rng: np.random.Generator) -> Batch:
    """The same batch in a mirrored world (half of the time) with other colours (likewise): one map has few rooms, and
    the look of a new one should be taken from what is seen of it, not from the rooms of the recording."""
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


def _now_and_then(last: torch.Tensor, often: float, rng: np.random.Generator) -> torch.Tensor:
    return last * torch.from_numpy(rng.random(len(last)) < often)[:, None, None, None]
