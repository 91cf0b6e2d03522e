"""Codec: where each pixel of the next frame comes from, learned on recorded frames and on the codec's own dreams of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from ...core.errors import DatasetError
from ...space.matching import CLEAR, explained, preferred, scrolled
from ...space.mosaic import remembered
from ...worlds.codec import Codec, CodecInputs, Scroll
from ...worlds.controls import Controls
from ...worlds.generator import channels_last, context_thumbnail
from ..moves import mosaics
from ..muon import muon
from ..trainer import Average, Loss, Now, warmed

PAST = 24  # steps of a clip before those that are shown, of which its mosaic is made; fewer where episodes are short
DREAM = 6  # steps of a clip that are dreamt, each from those before it, and descended; fewer where episodes are short
RECORDED = 300  # training steps with recorded frames alone
STILL = 0.1  # the share of clips that are shown as if an episode began with them: play begins with a lone frame, too
BLIND = (
    0.4  # the share of a batch that is not shown how things went on: else what is done, mostly as before, goes unheard
)
# How much a pixel counts that stands still in the recording, and is another in the dream: nobody can know it.
STALE = 0.15
CHANGED, OFF = 4, 20  # differences of 255


@dataclass(frozen=True)
class Clip:
    """frames uint8 [B, slots + dream, 3, H, W] and actions [B, slots + dream, A] as networks take them, action t leading from
    frame t to the next; the oldest first. mosaic uint8 [B, 4, H', W']: as of the frame before the last of the slots."""

    frames: torch.Tensor
    actions: torch.Tensor
    mosaic: torch.Tensor


@dataclass(frozen=True)
class Spans:
    """Steps of a clip: those of which its mosaic is made, those that are shown, and those that are dreamt."""

    past: int
    slots: int
    dream: int

    @property
    def length(self) -> int:
        return self.past + self.slots + self.dream

    @staticmethod
    def fitting(lengths: np.ndarray, slots: int) -> Spans:
        """The longest for which there are rows enough in episodes of these lengths; DatasetError where all are too short."""
        rows = lambda past, dream: lengths[lengths >= past + slots + dream].sum()  # noqa: E731
        dreams, pasts = (DREAM, DREAM // 2, DREAM // 4), (PAST, PAST // 2, 0)
        if not rows(0, dreams[-1]):
            raise DatasetError(f"no episode has the {slots + dreams[-1]} rows that a clip has; record longer ones.")
        dream = next(dream for dream in dreams if rows(0, dream) >= 0.5 * rows(0, dreams[-1]))
        return Spans(next(past for past in pasts if rows(past, dream) >= 0.9 * rows(0, dream)), slots, dream)


def clip(
    found: Mapping[str, np.ndarray], controls: Controls, moves: torch.Tensor, over: torch.Tensor, spans: Spans, batch: int,
    now: Now,
) -> Clip:  # fmt: skip
    """`batch` of the clips `found` (rgb uint8 [N, T, H, W, 3], action [N, T, ...]), those that change more the likelier."""
    rgb, action = np.asarray(found["rgb"]), np.asarray(found["action"], np.float32)
    past, slots = spans.past, spans.slots
    some = rgb[:, past + slots - 1 :]
    differs = (np.maximum(some[:, 1:], some[:, :-1]) - np.minimum(some[:, 1:], some[:, :-1])).max(-1) > 2 * CHANGED
    weight = 0.3 + (differs.mean((2, 3)) > 0.005).mean(1)
    picks = now.rng.choice(len(rgb), batch, replace=len(rgb) < batch, p=weight / weight.sum())
    picks = now.rng.permutation(picks)  # those that change more are picked first, and the first half will be dreamt
    whole = torch.from_numpy(rgb[picks]).permute(0, 1, 4, 2, 3).contiguous()
    actions = controls.encode(torch.from_numpy(action[picks][:, past:]).flatten(0, 1)).unflatten(0, (batch, -1))
    begins = torch.from_numpy(now.rng.random(batch) < STILL)[:, None]
    frames, lone = whole[:, past:], begins[..., None, None, None]
    first = torch.where(lone, frames[:, slots - 1 : slots], frames[:, :slots])
    before = torch.where(begins[..., None], 0.0, actions[:, : slots - 1])
    since = torch.from_numpy(now.rng.integers(0, past + slots, batch))[:, None]  # play has a longer or a shorter past
    real = (torch.arange(past + slots - 1) >= since) & ~begins
    mosaic = mosaics(whole[:, : past + slots - 1], moves, over, real)
    return Clip(torch.cat([first, frames[:, slots:]], 1), torch.cat([before, actions[:, slots - 1 :]], 1), mosaic)


class CodecObjective:
    """The likelihood of each pixel under the mixture of its sources and of the palette, in clips of these `spans`."""

    def __init__(self, codec: Codec, learning_rate: float, spans: Spans, stress: float, over: torch.Tensor):
        self.over = over  # bool [H, W], what stays while the picture scrolls
        self.spans, self.strides = spans, spans.dream  # losses of a batch, each of which is descended
        self.stress = stress  # how many times as much pixels count that change
        self.generator = channels_last(codec)
        self.smooth = Average(self.generator, 0.998)
        self.modules = {"generator": self.generator, "smooth": self.smooth}
        heads = self.generator.choice, self.generator.colour[-1], self.generator.scrolling
        rate = warmed(learning_rate, 10, 0.02)
        self.learners = {"generator": muon((self.generator,), rate, heads, self.smooth)}

    @property
    def scroll(self) -> Scroll:
        """The codec's own, which is learned before it (see scroll.py)."""
        return self.generator.scrolling

    def knows_scroll(self) -> None:
        """From now on the scroll learns no more."""
        self.smooth.module.scrolling.load_state_dict(self.scroll.requires_grad_(False).state_dict())

    def losses(self, batch: Clip, now: Now) -> Iterator[Loss]:
        slots, over = self.generator.config.slots, self.over.to(now.device)
        recorded, actions = batch.frames.to(now.device), batch.actions.to(now.device)
        shown, mosaic, moves = recorded[:, :slots].flip(1), batch.mosaic.to(now.device), self.generator.moves
        scroll = scrolled(shown[:, 1], shown[:, 0], moves)
        half = len(recorded) // 2 * (now.step * self.strides >= RECORDED)  # the other half is never dreamt
        for step in range(slots, recorded.shape[1]):
            truth, before = recorded[:, step], recorded[:, step - 1]
            context = torch.cat([context_thumbnail(shown[:, 0]), actions[:, step - slots : step].flip(1).flatten(1)], 1)
            mosaic = remembered(mosaic, shown[:, 0], moves[scroll], over)
            scroll = scrolled(shown[:, 0], truth, moves)
            dreamt = half if step + 1 < recorded.shape[1] else 0
            loss, drawn = self._loss(shown, mosaic, scroll, context, truth, before, dreamt, now)
            yield loss
            shown = torch.cat([torch.cat([drawn, truth[dreamt:]])[:, None], shown[:, :-1]], 1)

    def _loss(self, shown, mosaic, move, context, truth, before, dreamt: int, now: Now) -> tuple[Loss, torch.Tensor]:
        """Of the frames `truth` after those `shown`, to which most goes on by `move`, `before` being the recorded frames before
        them; and the first `dreamt` of them as they are drawn now."""
        codec = self.generator
        seen = codec.seen(shown, mosaic, self.over.to(now.device).expand(len(shown), -1, -1), move)
        shows = torch.from_numpy(now.rng.random(len(shown)) >= BLIND).to(now.device)[:, None, None, None]
        seen = seen._replace(went=seen.went * shows)
        choices, features = codec.choices(seen, context)
        share, stays = explained(shown, truth, codec.moves)
        share, memory = (
            preferred(share, seen.along),
            explained(seen.sources[:, -1:], truth, codec.moves[:1])[0] * seen.known,
        )
        # What the last frame explains need not be recalled.
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
        if not dreamt:
            drawn = truth[:0]
        else:
            with torch.no_grad():
                few = CodecInputs(*(part[:dreamt] for part in seen))
                drawn = codec.drawn(few, choices[:dreamt], features[:dreamt])
        return Loss("generator", pixels + 0.1 * colour.mean(), {"pixels": pixels, "colour": colour.mean()}), drawn
