"""Flow of frames: a FlowNetwork learns the next frame from recorded frames and from frames of its own, by flow matching."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from ...space.matching import scroll_index
from ...space.recall import EMPTY, KEPT, keys_of
from ...worlds.controls import Controls
from ...worlds.flow import LATEST, FlowFeatures, FlowNetwork, carry
from ...worlds.generator import channels_last, context_thumbnail, pixels
from ..devices import Compiled
from ..learners import Ema, warmup_cosine
from ..losses import PatchCritic, critic_learner, scaled_pull
from ..moves import StitchedEpisodes
from ..muon import muon
from ..train_step import TrainStep
from ..trainer import Loss

NOISED, MOST_NOISE = 0.5, 0.15  # the part of histories with added noise, and its largest deviation, of colours in -1..1
CHANGED = 8  # difference of 255 by which a pixel changes
DRAFTS = 0.4  # the part of the training that learns drafts alone
FRAMES_JUDGED = 3  # what the critic sees: a frame, its change, and the change before
CRITIC_WEIGHT = 0.5  # of the critic's gradient, relative to the loss
# Parts of the clips that see no memory, and all of it; the others see what the last frame showed.
BLIND, WHOLE = 0.4, 0.3
RECORDED = 400  # gradient steps on recorded frames alone, before rollouts begin
WARMUP = 300  # gradient steps
PAST = 128  # rows before a clip of which frames may be recalled
LONE = 0.1  # the part of clips whose history is one frame repeated: play begins so, too


@dataclass(frozen=True)
class FlowClips:
    """frames uint8 [B, slots + rollout, 3, H, W] and encoded actions [B, slots + rollout, A], action t leading from frame t to the
    next; the oldest first. memory uint8 [B, rollout, 4, H, W]: what is known of the frames after the history, colour and votes;
    None in a world that does not scroll. kept uint8 [B, K, 3, H, W] and kept_keys [B, K, n]: frames before the history; None in
    a world that recalls none."""

    frames: torch.Tensor
    actions: torch.Tensor
    memory: torch.Tensor | None
    kept: torch.Tensor | None = None
    kept_keys: torch.Tensor | None = None


@dataclass(frozen=True)
class FlowClipMaker:
    """Makes batches of `batch` clips on the CPU, preferring those that change more. over: bool [H, W], what does not scroll."""

    controls: Controls
    slots: int
    batch: int
    stitched: StitchedEpisodes | None
    over: torch.Tensor
    past: EarlierFrames | None = None

    def __call__(self, clips: Mapping[str, np.ndarray], now: TrainStep) -> FlowClips:
        """From clips (rgb uint8 [N, T, H, W, 3], action [N, T, ...], row [N, T])."""
        rgb, action = np.asarray(clips["rgb"]), np.asarray(clips["action"], np.float32)
        one, other = rgb[:, self.slots - 1 : -1], rgb[:, self.slots :]
        differs = ((np.maximum(one, other) - np.minimum(one, other)).max(-1) > CHANGED).mean((2, 3)).max(1)
        weight = preference(differs)
        picks = now.rng.choice(len(rgb), self.batch, replace=len(rgb) < self.batch, p=weight / weight.sum())
        picks = now.rng.permutation(picks)
        frames = torch.from_numpy(rgb[picks]).permute(0, 1, 4, 2, 3).contiguous()
        actions = self.controls.encode(torch.from_numpy(action[picks]).flatten(0, 1)).unflatten(0, (self.batch, -1))
        lone = torch.from_numpy(now.rng.random(self.batch) < LONE)
        frames[lone, : self.slots - 1] = frames[lone, self.slots - 1 : self.slots]
        actions[lone, : self.slots - 1] = 0
        rows = np.asarray(clips["row"])[picks]
        kept = ()
        if self.past is not None:
            draw = torch.from_numpy(now.rng.random((self.batch, KEPT + 1)))
            kept = self.past.before(torch.from_numpy(rows[:, 0]), draw)
        return FlowClips(frames, actions, self._memory(rows[:, self.slots :], now), *kept)

    def _memory(self, rows: np.ndarray, now: TrainStep) -> torch.Tensor | None:
        """Of rows [B, rollout]."""
        if self.stitched is None:
            return None
        size, after = (self.over.shape[0], self.over.shape[1]), torch.from_numpy(rows)
        known = self.stitched.memory(after.flatten(), size).unflatten(0, after.shape)
        kind = torch.from_numpy(now.rng.random(len(rows)))
        return known * memory_shown(self.stitched.place, after, self.over, kind)[:, :, None]


@dataclass(frozen=True)
class EarlierFrames:
    """Frames of a recording that were seen before a clip. start int64 [N]: the first row of the episode of each row; read: rows
    int64 [n] to frames uint8 [n, 3, H, W]."""

    start: torch.Tensor
    read: Callable[[torch.Tensor], torch.Tensor]

    def before(self, first: torch.Tensor, draw: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """KEPT frames of the same episode before the rows `first` int64 [B], up to PAST before, and their keys; of BLIND of the
        clips none. draw [B, KEPT + 1]: uniform in 0..1."""
        early = torch.maximum(self.start[first], first - PAST)
        some = (first > early) & (draw[:, KEPT] >= BLIND)
        rows = early[:, None] + (draw[:, :KEPT] * (first - early)[:, None]).long()
        frames = self.read(rows.flatten()).unflatten(0, rows.shape)
        return frames, torch.where(some[:, None, None], keys_of(frames / 255), EMPTY)


def _after(frames: torch.Tensor, last: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    """What the critic sees of frames [B, 3, H, W] after the last frame and its change."""
    return torch.cat([frames, frames - last[0], last[1]], 1)


def _mean_of(maps: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
    """The mean of the maps [B, ...] `which` (bool [B]); 0 of none."""
    weight = which.float()
    return (maps.flatten(1).mean(1) * weight).sum() / weight.sum().clamp_min(1)


def preference(changed):
    """The sampling weight of clips by the largest part of the pixels that a step of them changes."""
    return 0.2 + 1.0 * (changed > 0.005) + 2.0 * (changed > 0.2)


def memory_shown(place: torch.Tensor, rows: torch.Tensor, over: torch.Tensor, kind: torch.Tensor) -> torch.Tensor:
    """Which pixels of the pictures of `rows` int64 [B, T] training may remember, bool [B, T, H, W], by kind [B], uniform in 0..1:
    none, all, or what the picture before showed. place, over: see StitchedEpisodes and FlowClipMaker."""
    height, width = over.shape
    move = place[rows - 1] - place[rows]
    x = torch.arange(width, device=rows.device) - move[..., :1]
    y = torch.arange(height, device=rows.device) - move[..., 1:]
    shown = ((x >= 0) & (x < width))[:, :, None] & ((y >= 0) & (y < height))[..., None]  # by the last frame
    kind = kind[:, None, None, None]
    return ~over & (kind >= BLIND) & (shown | (kind < BLIND + WHOLE))


class FlowFrames:
    """x-prediction with absolute and squared errors. Each frame is learned at t = 0, as a draft without noise, and later also at a
    random t. Pictures are carried along by the true scroll. Where pictures change as a whole, a critic, which sees the last two
    frames, too, sharpens what is drawn at later t; the draft stays a mean. stress: the additional weight of pixels that change
    otherwise. teacher: a trained network, whose predictions from the same inputs are learned as well, with the weight `teaching`
    of 0 to 1 against the recorded frames."""

    def __init__(
        self,
        network: FlowNetwork,
        learning_rate: float,
        rollout: int,
        stress: float,
        teacher: FlowNetwork | None = None,
        teaching: float = 0.0,
    ):
        self.stress, self.losses_per_batch = stress, rollout  # gradient steps per batch
        self.teaching, self._teacher = teaching, None if teacher is None else (teacher.encode, teacher.clean)
        self.generator = channels_last(network)
        self._encode, self._clean = self.generator.encode, self.generator.clean
        self.smooth = Ema(self.generator, 0.995)
        self.modules = {"generator": self.generator, "smooth": self.smooth}
        rate = warmup_cosine(learning_rate, WARMUP // rollout, 0.02)
        self.learners = {"generator": muon((self.generator,), rate, (self.generator.output,), self.smooth)}
        self.critic = PatchCritic(3 * FRAMES_JUDGED) if network.config.recalls else None
        if self.critic is not None:
            self.modules["critic"], self.learners["critic"] = self.critic, critic_learner(self.critic)

    def compile(self) -> None:
        """Has both halves of the network compiled at their first call."""
        self._encode, self._clean = Compiled(self.generator.encode), Compiled(self.generator.clean)
        if self._teacher is not None:
            self._teacher = Compiled(self._teacher[0]), Compiled(self._teacher[1])

    def losses(self, batch: FlowClips, now: TrainStep) -> Iterator[Loss]:
        slots = self.generator.config.slots
        recorded, actions = batch.frames.to(now.device), batch.actions.to(now.device)
        shown = recorded[:, :slots].flip(1)
        kept = None
        if batch.kept is not None and batch.kept_keys is not None:
            kept = batch.kept.to(now.device), batch.kept_keys.to(now.device)
        half = len(recorded) // 2 * (now.step * self.losses_per_batch >= RECORDED)  # the other half stays recorded
        for step in range(slots, recorded.shape[1]):
            truth, before = recorded[:, step], recorded[:, step - 1]
            context = torch.cat([context_thumbnail(shown[:, 0]), actions[:, step - slots : step].flip(1).flatten(1)], 1)
            memory = None if batch.memory is None else batch.memory[:, step - slots].to(now.device)
            scroll = None
            if self.generator.scrolling is not None:
                scroll = scroll_index(shown[:, 0], truth, self.generator.moves)
            drawn = yield from self._losses(shown, context, memory, scroll, kept, truth, before, now)
            shown = torch.cat([torch.cat([drawn[:half], truth[half:]])[:, None], shown[:, :-1]], 1)

    def _losses(
        self, shown, context, memory, scroll, kept, truth, before, now: TrainStep
    ) -> Generator[Loss, None, torch.Tensor]:
        """The losses of the frames `truth` (uint8 [B, 3, H, W]), which follow those `shown`; `before`: the recorded ones before.
        Returns what was drawn, uint8 [B, 3, H, W]: of chance it knows the truth, by x_t, so that a rollout goes on as it does."""
        batch, network = len(truth), self.generator
        clean, frames = truth.float() / 127.5 - 1, shown.float() / 127.5 - 1
        base, was = frames[:, 0], before.float() / 127.5 - 1
        if scroll is not None:
            base, was = (carry(one, scroll, network.moves, network.over, memory) for one in (base, was))
        changes = (clean - was).abs().amax(1, keepdim=True) > CHANGED / 127.5
        level = MOST_NOISE * now.rand(batch, 1, 1, 1, 1) * (now.rand(batch, 1, 1, 1, 1) < NOISED)
        noise = level * now.randn(*frames.shape)
        with now.half():
            seen = self._encode(frames, context, scroll, memory, noise)
            draft = self._clean(seen, seen.base, torch.zeros(batch, device=now.device))
        taught = self._taught(frames, context, scroll, memory, noise, now)
        target = self._target(clean, taught, None, torch.zeros(batch, device=now.device), now)
        parts = {"draft": self._error(draft, target, base, changes)}
        samples = now.share >= DRAFTS
        if not samples and kept is None:
            yield Loss("generator", parts["draft"], parts)
            return self._frames(draft, seen, memory)
        t = LATEST * now.rand(batch)
        if kept is not None:  # at later times x_t shows more than memory does
            seen = network.recalling(seen, kept[0], kept[1], draft.detach())
            taught = None if taught is None else network.recalling(taught, kept[0], kept[1], draft.detach())
            t = t * (now.rand(batch) < 0.5 * samples)
        share = t[:, None, None, None]
        noisy = torch.where(share > 0, (1 - share) * now.randn(*clean.shape) + share * clean, seen.base)
        with now.half():
            drawn = self._clean(seen, noisy, t)
        parts["drawn"] = self._error(drawn, self._target(clean, taught, noisy, t, now), base, changes)
        loss = parts["draft"] + parts["drawn"]
        if self.critic is None or not samples:
            yield Loss("generator", loss, parts)
            return self._frames(drawn, seen, memory)
        last = seen.base, seen.base - seen.older
        pull = self._pull(self.critic, drawn.detach(), last, t > 0, now)
        yield Loss("generator", loss + scaled_pull(drawn, loss, pull, CRITIC_WEIGHT), parts)
        hinge = self._hinge(self.critic, clean, drawn.detach(), last, t > 0, now)
        yield Loss("critic", hinge, {"critic": hinge})
        return self._frames(drawn, seen, memory)

    @torch.no_grad()
    def _frames(self, drawn, seen: FlowFeatures, memory) -> torch.Tensor:
        """The frames uint8 [B, 3, H, W] that are shown of those `drawn`."""
        return pixels(self.generator.shown(drawn, seen, memory).float())

    def _pull(self, critic: PatchCritic, drawn, last, sampled, now: TrainStep) -> torch.Tensor:
        """The gradient by the frames `drawn` [B, 3, H, W] by which those that are `sampled` (bool [B]) look less recorded."""
        drawn = drawn.requires_grad_()
        with now.half():
            realness = critic(_after(drawn, last)).float()
        (pull,) = torch.autograd.grad(-_mean_of(realness, sampled), drawn)
        return pull

    def _hinge(self, critic: PatchCritic, clean, drawn, last, sampled, now: TrainStep) -> torch.Tensor:
        """The critic's loss of the recorded frames `clean` and of those that are `sampled` of the frames `drawn`."""
        with now.half():
            recorded, generated = (critic(_after(frames, last)).float() for frames in (clean, drawn))
        return F.relu(1 - recorded).mean() + _mean_of(F.relu(1 + generated), sampled)

    @torch.no_grad()
    def _taught(self, frames, context, scroll, memory, noise, now: TrainStep) -> FlowFeatures | None:
        """What the teacher sees; None without one."""
        if self._teacher is None:
            return None
        with now.half():
            return self._teacher[0](frames, context, scroll, memory, noise)

    @torch.no_grad()
    def _target(self, clean, taught: FlowFeatures | None, noisy, t, now: TrainStep) -> torch.Tensor:
        """The recorded frames `clean`, moved towards what the teacher makes of `noisy` at t (None: its draft)."""
        if self._teacher is None or taught is None:
            return clean
        with now.half():
            wanted = self._teacher[1](taught, taught.base if noisy is None else noisy, t)
        return torch.lerp(clean, wanted.float(), self.teaching)

    def _error(self, drawn, clean, base, changes) -> torch.Tensor:
        """The mean of absolute and squared errors [B, 3, H, W]. Pixels that change, in the recording (bool [B, 1, H, W]) or in what
        is drawn, weigh more: otherwise a ball of two pixels would be ignored."""
        changed = changes | ((drawn.detach() - base).abs().amax(1, keepdim=True) > CHANGED / 127.5)
        weight = 1 + self.stress * changed.float()
        away = drawn - clean
        return (weight * (away.abs() + away.square())).mean() / (1 + self.stress * changes.float().mean())

    def freeze_scroll(self) -> None:
        """Stops training of the scroll predictor, here and in the average."""
        if self.generator.scrolling is not None:
            self.smooth.module.scrolling.load_state_dict(self.generator.scrolling.requires_grad_(False).state_dict())
