"""Latent prediction: the next latents from the last ones and the actions, kept from collapsing by SIGReg.

The encoder makes its own targets, without a moving average or a stopped gradient: collapse is prevented by a penalty on
projections of the latents that are not standard normal (LeJEPA, Balestriero & LeCun 2025; LeWorldModel, Maes et al. 2026). Latents
of pictures are decoded, too, so that they hold what one sees.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from ...worlds.controls import AXES, BUTTONS, Controls
from ...worlds.latent_network import LatentConfig, LatentNetwork, Looks
from ..learners import adamw, warmup_cosine
from ..train_step import TrainStep
from ..trainer import Loss
from .outcome import two_hot

KNOTS, REACH = 17, 3.0  # points at which characteristic functions are compared, from 0 to REACH
PROJECTIONS, SAMPLE = 128, 256  # random directions, and latents, of one evaluation of SIGReg
SIGREG = 0.09  # weight
NO_PAST, NO_VECTORS = (
    0.2,
    0.3,
)  # parts of the clips that begin without a past, and whose vectors are hidden beside pictures
BAGGING = 0.75  # the part of the clips from which an ensemble member learns
LEAST_UNIT = 1e-3  # standard deviations: the smallest change in a step by which errors are scaled
DECODED = 24  # latents a step that the decoder learns from
NUMBERS_WEIGHT, OUTCOME_WEIGHT, INVERSE_WEIGHT, LAWS_WEIGHT = 1.0, 0.3, 1.0, 0.1


@dataclass(frozen=True)
class LatentClips:
    """B clips of L rows: rgb uint8 [B, L, 3, H, W] or None; numbers [B, L, V], the state vectors; actions [B, L, A], encoded for
    networks, action t leading from row t to row t + 1; reward [B, L]; done [B, L]."""

    rgb: torch.Tensor | None
    numbers: torch.Tensor
    actions: torch.Tensor
    reward: torch.Tensor
    done: torch.Tensor


def latent_clips(
    clips: Mapping[str, np.ndarray], controls: Controls, config: LatentConfig, device: torch.device
) -> LatentClips:
    """A batch of `data.Clips` as a latent world of this config trains on it."""
    actions = torch.from_numpy(np.asarray(clips["action"], np.float32))
    shape = actions.shape[:2]
    rgb = None
    if "rgb" in clips:
        rgb = torch.from_numpy(clips["rgb"]).to(device).permute(0, 1, 4, 2, 3)
    parts = [torch.from_numpy(np.array(clips[name], np.float32)).reshape(*shape, -1) for name, _ in config.vectors]
    numbers = torch.cat([torch.zeros(*shape, 0), *parts], 2).nan_to_num(0.0, 0.0, 0.0)
    reward, done = (
        torch.from_numpy(np.array(clips[name], np.float32)).reshape(shape) if name in clips else torch.zeros(shape)
        for name in ("reward", "done")
    )
    encoded = controls.encode(actions.flatten(0, 1)).unflatten(0, shape)
    return LatentClips(rgb, *(part.to(device) for part in (numbers, encoded, reward, done)))


def clip_looks(network: LatentNetwork, rgb: torch.Tensor) -> Looks:
    """Features of the pictures of clips, uint8 [B, L, 3, H, W], and of those before each in its clip: [B, L, ...]."""
    count, length = rgb.shape[:2]
    newest = network.look(rgb.flatten(0, 1))
    glance, newest = network.glance(newest).unflatten(0, (count, length)), newest.unflatten(0, (count, length))
    before = range(1, network.config.frames)
    past = [F.pad(glance, (0, 0, back, 0))[:, :length] for back in before]
    known = [(torch.arange(length, device=rgb.device) >= back).float().expand(count, -1) for back in before]
    empty = newest.new_zeros(count, length, 0)
    return Looks(newest, torch.stack(past, 2) if past else empty[..., None], torch.stack(known, 2) if known else empty)


def sigreg(latents: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """The Epps-Pulley statistic (1983) of latents [N, D], projected on unit directions [D, P], against a standard normal: N times
    the squared distance of the characteristic functions under a Gaussian window; its mean over directions."""
    knots = torch.linspace(0, REACH, KNOTS, dtype=latents.dtype, device=latents.device)
    normal = (-knots.square() / 2).exp()
    weights = torch.full_like(knots, 2 * REACH / (KNOTS - 1)) * normal  # both halves of a symmetric integral
    weights[[0, -1]] /= 2
    angles = (latents @ directions)[..., None] * knots
    away = (angles.cos().mean(0) - normal).square() + angles.sin().mean(0).square()
    return len(latents) * (away @ weights).mean()


class LatentPrediction:
    """Predicts `steps` steps beyond the history, each from the predictions before it. laws: the loss of rollouts of the vectors
    [B, T + 1, V] that break a law."""

    def __init__(
        self,
        network: LatentNetwork,
        controls: Controls,
        learning_rate: float,
        steps: int,
        laws: Callable[[torch.Tensor], torch.Tensor] | None = None,
    ):
        self.network, self.controls, self.steps, self.laws = network, controls, steps, laws
        self.modules = {"network": network}
        parts = (network.encoder, network.predictor, network.heads, network.leaper, network.decoder)
        trained = [part for part in parts if parameters(part)]
        self.learners = {"latent": adamw(trained, warmup_cosine(learning_rate, 100, 0.02))}

    def losses(self, batch: LatentClips, now: TrainStep) -> Iterator[Loss]:
        config = self.network.config
        latents, blind = self._encode(batch, now)
        windows, predicted, error = self._rollout(latents, blind, batch, now)
        parts = {"prediction": error}
        if config.pictured and config.frames > 1:  # a single picture, such as a goal, is near the same one in motion
            parts["blind"] = (blind - latents[:, config.history - 1].detach()).square().mean()
        if not config.identity:  # which cannot collapse
            parts["sigreg"] = self._sigreg(latents, now)
        if config.leap:
            parts["leap"] = self._leap_error(latents, blind, batch, now)
        if batch.rgb is not None:
            decoded = latents if config.pictured else latents.detach()  # of numbers, pictures are for people alone
            parts["picture"] = self._picture_loss(decoded, batch.rgb, now)
        real = latents.unfold(1, config.history, 1).movedim(-1, 2)  # [B, T + 1, K, D]
        parts |= self._head_losses(real, torch.stack(windows, 1), torch.stack(predicted, 1), latents, batch)
        if self.laws is not None:
            numbers = self.network.numbers(torch.stack(windows, 1).flatten(0, 1)).unflatten(0, (len(latents), -1))
            parts["laws"] = self.laws(numbers * self.network.scale + self.network.mean)
        weights = {"laws": LAWS_WEIGHT, "sigreg": SIGREG, "numbers": NUMBERS_WEIGHT, "inverse": INVERSE_WEIGHT}
        weights |= {"reward": OUTCOME_WEIGHT, "done": OUTCOME_WEIGHT}
        terms = (weights.get(name, 1.0) * part for name, part in parts.items())
        yield Loss("latent", sum(terms, error.new_zeros(())), parts)

    def _picture_loss(self, latents: torch.Tensor, rgb: torch.Tensor, now: TrainStep) -> torch.Tensor:
        """Of some latents [B, L, D], decoded, in shares of what pictures [B, L, 3, H, W] differ by: a latent without what one sees
        of a thing that moves predicts as well, and cannot be planned with."""
        some = torch.from_numpy(now.rng.permutation(latents.shape[0] * latents.shape[1])[:DECODED]).to(now.device)
        shown, varies = (part.float() / 255 for part in (rgb.flatten(0, 1)[some], rgb[:, 0]))
        error = picture_loss(self.network.decoder(latents.flatten(0, 1)[some]), shown)
        return error / varies.var(0).mean().clamp_min(1e-4)

    def _encode(self, batch: LatentClips, now: TrainStep) -> tuple[torch.Tensor, torch.Tensor]:
        """Latents [B, L, D], and those [B, D] of the last row of the history without the pictures before it; beside pictures the
        vectors of some clips are hidden."""
        (count, length), config = batch.reward.shape, self.network.config
        rows = [*range(length), self.network.config.history - 1]
        visible = None
        if config.pictured and config.columns:
            given = torch.from_numpy(now.rng.random(count) >= NO_VECTORS).to(now.device)
            visible = given[:, None].expand(count, len(rows)).flatten()
        looks = None
        if config.pictured:
            assert batch.rgb is not None
            seen = Looks(*(part[:, rows] for part in clip_looks(self.network, batch.rgb)))
            seen.known[:, -1] = 0
            looks = Looks(*(part.flatten(0, 1) for part in seen))
        latents = self.network.encode(looks, batch.numbers[:, rows].flatten(0, 1), visible).unflatten(0, (count, -1))
        return latents[:, :-1], latents[:, -1]

    def _rollout(
        self, latents: torch.Tensor, blind: torch.Tensor, batch: LatentClips, now: TrainStep
    ) -> tuple[list[torch.Tensor], list[torch.Tensor], torch.Tensor]:
        """The windows [B, K, D] before each step and after the last, the ensemble's mean prediction [B, D] of each step, and the
        mean error of the members. Each member learns from clips of its own draw, so that members differ where data is scarce."""
        network, history = self.network, self.network.config.history
        alone = torch.from_numpy(now.rng.random((len(latents), 1, 1)) < NO_PAST).to(now.device)
        window = torch.where(alone, blind[:, None], latents[:, :history])
        past = torch.where(alone, 0.0, batch.actions[:, : history - 1])
        members = network.config.members
        mask = torch.from_numpy(now.rng.random((members, len(latents), 1)) < BAGGING).to(now.device).float()
        windows, predicted, error = [], [], latents.new_zeros(())
        for step in range(self.steps):
            actions = torch.cat([past, batch.actions[:, history - 1 + step, None]], 1)
            prediction = network.predict(window, actions)
            error = error + (mask * self._errors(prediction, latents[:, history + step])).mean() / BAGGING
            windows.append(window)
            predicted.append(prediction.mean(0))
            window, past = torch.cat([window[:, 1:], predicted[-1][:, None]], 1), actions[:, 1:]
        windows.append(window)
        return windows, predicted, error / self.steps

    def _leap_error(
        self, latents: torch.Tensor, blind: torch.Tensor, batch: LatentClips, now: TrainStep
    ) -> torch.Tensor:
        """The mean error of a leap from one row of each clip."""
        network, config = self.network, self.network.config
        length = config.history + config.leap
        at = int(now.rng.integers(latents.shape[1] - length + 1))
        spans, actions = latents[:, at : at + length], batch.actions[:, at : at + length - 1]
        alone = torch.from_numpy(now.rng.random((len(spans), 1, 1)) < NO_PAST).to(now.device)
        first = config.history - 1
        lone = spans[:, first] if at else blind
        window = torch.where(alone, lone[:, None], spans[:, : config.history])
        actions = torch.cat([torch.where(alone, 0.0, actions[:, :first]), actions[:, first:]], 1)
        return self._errors(network.leap(window, actions), spans[:, config.leap :]).mean()

    def _errors(self, prediction: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        """Squared errors. Where the latent is the vectors themselves, Huber losses in units of the usual change in a step: there a
        rollout that has diverged should not dominate."""
        if not self.network.config.identity:
            return (prediction - truth).square()
        unit = self.network.unit
        return F.smooth_l1_loss(prediction / unit, (truth / unit).expand_as(prediction), reduction="none")

    def _sigreg(self, latents: torch.Tensor, now: TrainStep) -> torch.Tensor:
        flat = latents.flatten(0, 1)
        some = torch.from_numpy(now.rng.permutation(len(flat))[:SAMPLE]).to(now.device)
        return sigreg(flat[some].float(), F.normalize(now.randn(flat.shape[1], PROJECTIONS), dim=0))

    def _head_losses(
        self,
        real: torch.Tensor,
        windows: torch.Tensor,
        predicted: torch.Tensor,
        latents: torch.Tensor,
        batch: LatentClips,
    ) -> dict[str, torch.Tensor]:
        """Losses of the heads for vectors, reward, termination and inverse dynamics, on encoded windows and on predicted ones
        [B, T + 1, K, D]."""
        network, first = self.network, self.network.config.history - 1
        actions = batch.actions[:, first:-1].flatten(0, 1)
        reward, done = (part[:, first:-1].flatten() for part in (batch.reward, batch.done))
        parts: dict[str, torch.Tensor] = {}
        if network.config.width and not network.config.identity:
            target = network.scaled(batch.numbers[:, first:])
            numbers = network.numbers(torch.stack([real, windows]).flatten(0, 2)).view(2, *target.shape)
            parts["numbers"] = F.smooth_l1_loss(numbers, target.expand_as(numbers))
        after = latents[:, first + 1 :]
        for before, next_ in ((real[:, :-1], after), (windows[:, :-1], predicted)):
            outcome = network.outcome(before.flatten(0, 1), actions, next_.flatten(0, 1))
            costs = {"reward": -(two_hot(reward, network.rewards) * outcome.reward.log_softmax(1)).sum(1).mean()}
            costs["done"] = F.binary_cross_entropy_with_logits(outcome.done, done)
            parts |= {name: parts.get(name, 0.0) + cost / 2 for name, cost in costs.items()}
        inferred = network.inverse(real[:, :-1].flatten(0, 1), after.flatten(0, 1))
        return parts | {"inverse": action_loss(inferred, actions, self.controls) / self._baseline(actions)}

    def _baseline(self, actions: torch.Tensor) -> torch.Tensor | float:
        """The `action_loss` of the mean action, for axes; by it the loss of small actions is scaled."""
        return actions.var(0).mean().clamp_min(1e-4) if self.controls.kind == AXES else 1.0


def action_loss(prediction: torch.Tensor, actions: torch.Tensor, controls: Controls) -> torch.Tensor:
    """The loss of predicted actions [N, A], encoded for networks: mean squared error of axes, cross-entropy of the rest."""
    if controls.kind == AXES:
        return F.mse_loss(prediction, actions)
    if controls.kind == BUTTONS:
        return F.binary_cross_entropy_with_logits(prediction, actions)
    counts = controls.counts
    pairs = zip(prediction.split(counts, 1), actions.split(counts, 1))
    costs = [F.cross_entropy(logits, chosen.argmax(1)) for logits, chosen in pairs]
    return torch.stack(costs).sum()


def picture_loss(decoded: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Squared error of pictures [N, 3, H, W]; pixels that differ from the mean picture weigh more, for they are few."""
    differs = (truth - truth.mean(0)).abs().amax(1, keepdim=True)
    return ((1 + 8 * differs) * (decoded - truth).square()).mean()


def set_scale(network: LatentNetwork, numbers: np.ndarray, follows: np.ndarray) -> None:
    """Sets the mean and standard deviation of the network's vectors, and their usual change in a step, from numbers [N, width];
    follows bool [N - 1]: whether a row and the next are consecutive steps."""
    if not network.config.width:
        return
    values = torch.from_numpy(np.nan_to_num(numbers.astype(np.float64), posinf=0.0, neginf=0.0))
    network.mean.copy_(values.mean(0))
    deviation = values.std(0, correction=0)
    constant = deviation <= 1e-6 * values.abs().amax(0).clamp_min(1e-6)
    network.scale.copy_(torch.where(constant, 1.0, deviation))
    if network.config.identity:
        scaled = values / network.scale
        network.unit.copy_(scaled.diff(dim=0)[torch.from_numpy(follows)].square().mean(0).sqrt().clamp_min(LEAST_UNIT))


def parameters(module: nn.Module) -> int:
    return sum(weight.numel() for weight in module.parameters())
