"""Codec: where each pixel of the next frame comes from, learned on recorded frames and on the codec's own rollouts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from ...core.errors import DatasetError
from ...space.matching import CLEAR, prefer_scroll, scroll_index, source_shares
from ...space.mosaic import update_mosaic
from ...worlds.codec import Codec, CodecInputs
from ...worlds.controls import Controls
from ...worlds.generator import channels_last, context_thumbnail
from ...worlds.scroll import Scroll
from ..moves import mosaics
from ..muon import muon
from ..trainer import Ema, Loss, TrainStep, warmup_cosine

PAST = 24  # steps of a clip before its history, of which its mosaic is made; fewer where episodes are short
ROLLOUT = 6  # steps of a clip that are predicted, each from the predictions before it; fewer where episodes are short
RECORDED = 300  # gradient steps on recorded frames alone, before rollouts begin
LONE = 0.1  # the part of clips whose history is one frame repeated: play begins so, too
BLIND = (
    0.4  # the part of a batch without the last motion as input: else the action, which mostly repeats, would be ignored
)
STALE = 0.15  # the weight of a pixel that is static in the recording and differs in the rollout: it cannot be inferred
CHANGED, OFF = 4, 20  # differences of 255 by which a pixel changes, and differs


@dataclass(frozen=True)
class CodecClips:
    """frames uint8 [B, slots + rollout, 3, H, W] and encoded actions [B, slots + rollout, A], action t leading from frame t to the
    next; the oldest first. mosaic uint8 [B, 4, H', W']: as of the frame before the last of the history."""

    frames: torch.Tensor
    actions: torch.Tensor
    mosaic: torch.Tensor


@dataclass(frozen=True)
class Spans:
    """Steps of a clip: those of which its mosaic is made, its history, and those that are predicted."""

    past: int
    slots: int
    rollout: int

    @property
    def length(self) -> int:
        return self.past + self.slots + self.rollout

    @staticmethod
    def fitting(lengths: np.ndarray, slots: int, past: int = PAST, rollout: int = ROLLOUT) -> Spans:
        """The longest up to `past` and `rollout` for which episodes of these lengths have rows enough; DatasetError if all are too
        short."""
        rows = lambda past, rollout: lengths[lengths >= past + slots + rollout].sum()  # noqa: E731
        rollouts, pasts = (rollout, rollout // 2, max(1, rollout // 4)), (past, past // 2, 0)
        if not rows(0, rollouts[-1]):
            raise DatasetError(f"no episode has the {slots + rollouts[-1]} rows that a clip has; record longer ones.")
        rollout = next(steps for steps in rollouts if rows(0, steps) >= 0.5 * rows(0, rollouts[-1]))
        return Spans(next(past for past in pasts if rows(past, rollout) >= 0.9 * rows(0, rollout)), slots, rollout)


@dataclass(frozen=True)
class ClipMaker:
    """Makes batches of `batch` clips on the CPU; moves int64 [n, 2]; over bool [H, W], what does not scroll."""

    controls: Controls
    moves: torch.Tensor
    over: torch.Tensor
    spans: Spans
    batch: int

    def __call__(self, clips: Mapping[str, np.ndarray], now: TrainStep) -> CodecClips:
        """From clips (rgb uint8 [N, T, H, W, 3], action [N, T, ...]), preferring those that change more."""
        rgb, action = np.asarray(clips["rgb"]), np.asarray(clips["action"], np.float32)
        past, slots, batch = self.spans.past, self.spans.slots, self.batch
        some = rgb[:, past + slots - 1 :]
        differs = (np.maximum(some[:, 1:], some[:, :-1]) - np.minimum(some[:, 1:], some[:, :-1])).max(-1) > 2 * CHANGED
        weight = 0.3 + (differs.mean((2, 3)) > 0.005).mean(1)
        picks = now.rng.choice(len(rgb), batch, replace=len(rgb) < batch, p=weight / weight.sum())
        picks = now.rng.permutation(
            picks
        )  # those that change more are picked first, and the first half will be rolled out
        whole = torch.from_numpy(rgb[picks]).permute(0, 1, 4, 2, 3).contiguous()
        actions = torch.from_numpy(action[picks][:, past:]).flatten(0, 1)
        actions = self.controls.encode(actions).unflatten(0, (batch, -1))
        lone = torch.from_numpy(now.rng.random(batch) < LONE)[:, None]
        frames, first = whole[:, past:], lone[..., None, None, None]
        history = torch.where(first, frames[:, slots - 1 : slots], frames[:, :slots])
        before = torch.where(lone[..., None], 0.0, actions[:, : slots - 1])
        since = torch.from_numpy(now.rng.integers(0, past + slots, batch))[:, None]  # pasts of play differ in length
        real = (torch.arange(past + slots - 1) >= since) & ~lone
        mosaic = mosaics(whole[:, : past + slots - 1], self.moves, self.over, real)
        frames = torch.cat([history, frames[:, slots:]], 1)
        return CodecClips(frames, torch.cat([before, actions[:, slots - 1 :]], 1), mosaic)


class CodecObjective:
    """The likelihood of each pixel under a mixture of its sources and the palette, in clips of these `spans`. over: bool [H, W],
    what does not scroll; stress: the weight of pixels that change."""

    def __init__(self, codec: Codec, learning_rate: float, spans: Spans, stress: float, over: torch.Tensor):
        self.over, self.stress = over, stress
        self.spans, self.losses_per_batch = spans, spans.rollout  # gradient steps per batch
        self.generator = channels_last(codec)
        self.smooth = Ema(self.generator, 0.998)
        self.modules = {"generator": self.generator, "smooth": self.smooth}
        heads = self.generator.choice, self.generator.colour[-1], self.generator.scrolling
        rate = warmup_cosine(learning_rate, 10, 0.02)
        self.learners = {"generator": muon((self.generator,), rate, heads, self.smooth)}

    @property
    def scroll(self) -> Scroll:
        """The codec's scroll predictor, which is learned first (see scroll.py)."""
        return self.generator.scrolling

    def freeze_scroll(self) -> None:
        """Stops training of the scroll predictor, here and in the average."""
        self.smooth.module.scrolling.load_state_dict(self.scroll.requires_grad_(False).state_dict())

    def losses(self, batch: CodecClips, now: TrainStep) -> Iterator[Loss]:
        slots, over = self.generator.config.slots, self.over.to(now.device)
        recorded, actions = batch.frames.to(now.device), batch.actions.to(now.device)
        shown, mosaic, moves = recorded[:, :slots].flip(1), batch.mosaic.to(now.device), self.generator.moves
        scroll = scroll_index(shown[:, 1], shown[:, 0], moves)
        half = len(recorded) // 2 * (now.step * self.losses_per_batch >= RECORDED)  # the other half stays recorded
        for step in range(slots, recorded.shape[1]):
            truth, before = recorded[:, step], recorded[:, step - 1]
            context = torch.cat([context_thumbnail(shown[:, 0]), actions[:, step - slots : step].flip(1).flatten(1)], 1)
            mosaic = update_mosaic(mosaic, shown[:, 0], moves[scroll], over)
            scroll = scroll_index(shown[:, 0], truth, moves)
            count = half if step + 1 < recorded.shape[1] else 0
            loss, drawn = self._loss(shown, mosaic, scroll, context, truth, before, count, now)
            yield loss
            shown = torch.cat([torch.cat([drawn, truth[count:]])[:, None], shown[:, :-1]], 1)

    def _loss(
        self, shown, mosaic, move, context, truth, before, count: int, now: TrainStep
    ) -> tuple[Loss, torch.Tensor]:
        """The loss of the frames `truth`, which follow those `shown` mostly by `move`, and the first `count` of them as the codec
        draws them; `before` are the recorded frames before `truth`."""
        codec = self.generator
        seen = codec.seen(shown, mosaic, self.over.to(now.device).expand(len(shown), -1, -1), move)
        shows = torch.from_numpy(now.rng.random(len(shown)) >= BLIND).to(now.device)[:, None, None, None]
        seen = seen._replace(went=seen.went * shows)
        choices, features = codec.choices(seen, context)
        share, stays = source_shares(shown, truth, codec.moves)
        share, memory = (
            prefer_scroll(share, seen.along),
            source_shares(seen.sources[:, -1:], truth, codec.moves[:1])[0] * seen.known,
        )
        # What the last frame explains need not be fetched from the mosaic.
        within = share[:, : codec.config.moves + 1].amax(1, keepdim=True)
        share = torch.cat([share, memory * (1 - CLEAR * within)], 1)
        changes = (truth.int() - before.int()).abs().amax(1) > CHANGED
        some = changes | (stays > OFF)
        some[:, ::7, ::7] = True
        nearest = torch.cdist(truth.permute(0, 2, 3, 1)[some].float(), codec.palette.float()).argmin(1)
        colour = F.cross_entropy(codec.colours(seen, features, some), nearest, reduction="none")
        painted = torch.full_like(stays, -8.0).masked_scatter(some, -colour)
        each = torch.cat([share.clamp_min(1e-6).log(), painted[:, None]], 1) + choices.log_softmax(1)
        weight = torch.where(changes, self.stress, 1.0)
        weight = weight * torch.where(~changes & (stays > OFF), STALE, 1.0)
        pixels = -(each.logsumexp(1) * weight).sum() / weight.sum()
        if not count:
            drawn = truth[:0]
        else:
            with torch.no_grad():
                few = CodecInputs(*(part[:count] for part in seen))
                drawn = codec.drawn(few, choices[:count], features[:count])
        return Loss("generator", pixels + 0.1 * colour.mean(), {"pixels": pixels, "colour": colour.mean()}), drawn
