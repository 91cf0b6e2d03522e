"""Latent prediction: the next latents foretold from the last ones and the actions, kept from collapsing by SIGReg.

The encoder makes its own targets, without a moving average and without a stopped gradient: what keeps all latents from being
one is that their projections are held to be normal (LeJEPA, Balestriero & LeCun 2025; LeWorldModel, Maes et al. 2026).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from ...worlds.controls import AXES, BUTTONS, Controls
from ...worlds.latent_network import LatentConfig, LatentNetwork
from ..trainer import Loss, Now, adamw, warmed
from .outcome import two_hot

KNOTS, REACH = 17, 3.0  # where the characteristic function is compared, from 0 to so many
PROJECTIONS, SAMPLE = 128, 256  # of latents, of which SIGReg takes as many as these at a time
SIGREG = 0.09
LONE, BLIND = 0.2, 0.3  # shares of clips that begin without a past, and of those whose numbers are not seen
LEAST_UNIT = 1e-3  # deviations, that a number counts as changing in a step
DRAWN = 24  # latents a step that the decoder learns from
# Shares of the loss.
OF_NUMBERS, OF_OUTCOME, OF_INVERSE = 1.0, 0.3, 1.0


@dataclass(frozen=True)
class LatentClips:
    """B clips of L rows: rgb uint8 [B, L, 3, H, W] or None; numbers [B, L, V]; actions [B, L, A] as networks are given them, of
    row t those that led to row t + 1; reward [B, L]; done [B, L]."""

    rgb: torch.Tensor | None
    numbers: torch.Tensor
    actions: torch.Tensor
    reward: torch.Tensor
    done: torch.Tensor


def latent_clips(
    found: Mapping[str, np.ndarray], controls: Controls, config: LatentConfig, device: torch.device
) -> LatentClips:
    """Clips of a recording, as `Clips` gives them, for a latent world of this make."""
    actions = torch.from_numpy(np.asarray(found["action"], np.float32))
    shape = actions.shape[:2]
    rgb = None
    if "rgb" in found:
        rgb = torch.from_numpy(found["rgb"]).to(device).permute(0, 1, 4, 2, 3)
    parts = [torch.from_numpy(np.array(found[name], np.float32)).reshape(*shape, -1) for name, _ in config.vectors]
    numbers = torch.cat([torch.zeros(*shape, 0), *parts], 2).nan_to_num(0.0, 0.0, 0.0)
    reward, done = (
        torch.from_numpy(np.array(found[name], np.float32)).reshape(shape) if name in found else torch.zeros(shape)
        for name in ("reward", "done")
    )
    encoded = controls.encode(actions.flatten(0, 1)).unflatten(0, shape)
    return LatentClips(rgb, *(part.to(device) for part in (numbers, encoded, reward, done)))


def sigreg(latents: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """How far projections of latents [N, D] on directions [D, P] of length 1 are from standard normal: the Epps-Pulley statistic
    (1983), N times the squared distance of the characteristic functions under a normal window; its mean over directions."""
    knots = torch.linspace(0, REACH, KNOTS, dtype=latents.dtype, device=latents.device)
    normal = (-knots.square() / 2).exp()
    weights = torch.full_like(knots, 2 * REACH / (KNOTS - 1)) * normal  # both halves of a symmetric integral
    weights[[0, -1]] /= 2
    angles = (latents @ directions)[..., None] * knots
    away = (angles.cos().mean(0) - normal).square() + angles.sin().mean(0).square()
    return len(latents) * (away @ weights).mean()


class LatentPrediction:
    """Foretells `steps` steps beyond the history, each from what was foretold before it."""

    def __init__(self, network: LatentNetwork, controls: Controls, learning_rate: float, steps: int):
        self.network, self.controls, self.steps = network, controls, steps
        self.modules = {"network": network}
        parts = (network.encoder, network.predictor, network.heads, network.leaper)
        trained = [part for part in parts if parameters(part)]
        self.learners = {"latent": adamw(trained, warmed(learning_rate, 100, 0.02))}
        if network.config.size:
            self.learners["decoder"] = adamw((network.decoder,), warmed(learning_rate, 100, 0.02))

    def losses(self, batch: LatentClips, now: Now) -> Iterator[Loss]:
        network, config = self.network, self.network.config
        latents = self._encoded(batch, now)
        windows, foretold, away = self._rolled(latents, batch, now)
        parts = {"prediction": away}
        if not config.identity:  # which cannot collapse
            parts["sigreg"] = self._regular(latents, now)
        if config.leap:
            parts["leap"] = self._leapt(latents, batch, now)
        real = latents.unfold(1, config.history, 1).movedim(-1, 2)  # [B, T + 1, K, D]
        parts |= self._read(real, torch.stack(windows, 1), torch.stack(foretold, 1), latents, batch)
        shares = {
            "sigreg": SIGREG,
            "numbers": OF_NUMBERS,
            "reward": OF_OUTCOME,
            "done": OF_OUTCOME,
            "inverse": OF_INVERSE,
        }
        yield Loss(
            "latent", sum((shares.get(name, 1.0) * part for name, part in parts.items()), away.new_zeros(())), parts
        )
        if batch.rgb is not None:
            some = now.rng.permutation(latents.shape[0] * latents.shape[1])[:DRAWN]
            picked = torch.from_numpy(some).to(now.device)
            drawn = network.decoder(latents.detach().flatten(0, 1)[picked])
            parts = {"picture": picture_loss(drawn, batch.rgb.flatten(0, 1)[picked].float() / 255)}
            yield Loss("decoder", parts["picture"], parts)

    def _encoded(self, batch: LatentClips, now: Now) -> torch.Tensor:
        """Latents [B, L, D]; beside pictures the numbers of some clips are not seen."""
        shape, config = batch.reward.shape, self.network.config
        there = None
        if config.pictured and config.columns:
            seen = torch.from_numpy(now.rng.random(shape[0]) >= BLIND).to(now.device)
            there = seen[:, None].expand(shape).flatten()
        rgb = None if batch.rgb is None else batch.rgb.flatten(0, 1)
        return self.network.encode(rgb, batch.numbers.flatten(0, 1), there).unflatten(0, shape)

    def _rolled(
        self, latents: torch.Tensor, batch: LatentClips, now: Now
    ) -> tuple[list[torch.Tensor], list[torch.Tensor], torch.Tensor]:
        """The windows [B, K, D] before each step, the latents [B, D] foretold by it, and how far all members were from the truth;
        a member does not learn from every clip, so that members differ where recordings say little."""
        network, history = self.network, self.network.config.history
        lone = torch.from_numpy(now.rng.random((len(latents), 1, 1)) < LONE).to(now.device)
        window = torch.where(lone, latents[:, history - 1 : history], latents[:, :history])
        past = torch.where(lone, 0.0, batch.actions[:, : history - 1])
        members = network.config.members
        learns = torch.from_numpy(now.rng.random((members, len(latents), 1)) < 0.75).to(now.device).float()
        windows, foretold, away = [], [], latents.new_zeros(())
        for step in range(self.steps):
            actions = torch.cat([past, batch.actions[:, history - 1 + step, None]], 1)
            found = network.predict(window, actions)
            away = away + (learns * self._missed(found, latents[:, history + step])).mean() / 0.75
            windows.append(window)
            foretold.append(found.mean(0))
            window, past = torch.cat([window[:, 1:], foretold[-1][:, None]], 1), actions[:, 1:]
        windows.append(window)
        return windows, foretold, away / self.steps

    def _leapt(self, latents: torch.Tensor, batch: LatentClips, now: Now) -> torch.Tensor:
        """How far a leap from one row of each clip is from the truth."""
        network, config = self.network, self.network.config
        long = config.history + config.leap
        at = int(now.rng.integers(latents.shape[1] - long + 1))
        spans, acts = latents[:, at : at + long], batch.actions[:, at : at + long - 1]
        lone = torch.from_numpy(now.rng.random((len(spans), 1, 1)) < LONE).to(now.device)
        first = config.history - 1
        window = torch.where(lone, spans[:, first : first + 1], spans[:, : config.history])
        acts = torch.cat([torch.where(lone, 0.0, acts[:, :first]), acts[:, first:]], 1)
        return self._missed(network.leap(window, acts), spans[:, config.leap :]).mean()

    def _missed(self, found: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        """The error of each number: squared; where the latent is the vectors themselves, in units of a step, and less steep where
        it is large (Huber), for a rollout that went astray says little."""
        if not self.network.config.identity:
            return (found - truth).square()
        unit = self.network.unit
        return F.smooth_l1_loss(found / unit, (truth / unit).expand_as(found), reduction="none")

    def _regular(self, latents: torch.Tensor, now: Now) -> torch.Tensor:
        flat = latents.flatten(0, 1)
        some = torch.from_numpy(now.rng.permutation(len(flat))[:SAMPLE]).to(now.device)
        return sigreg(flat[some].float(), F.normalize(now.randn(flat.shape[1], PROJECTIONS), dim=0))

    def _read(
        self,
        real: torch.Tensor,
        windows: torch.Tensor,
        foretold: torch.Tensor,
        latents: torch.Tensor,
        batch: LatentClips,
    ) -> dict[str, torch.Tensor]:
        """What heads read off real windows and off foretold ones [B, T + 1, K, D], held to what was recorded."""
        network, first = self.network, self.network.config.history - 1
        acts = batch.actions[:, first:-1].flatten(0, 1)
        reward, done = (part[:, first:-1].flatten() for part in (batch.reward, batch.done))
        parts: dict[str, torch.Tensor] = {}
        if network.config.width and not network.config.identity:
            told = network.scaled(batch.numbers[:, first:])
            found = network.numbers(torch.stack([real, windows]).flatten(0, 2)).view(2, *told.shape)
            parts["numbers"] = F.smooth_l1_loss(found, told.expand_as(found))
        after = latents[:, first + 1 :]
        for before, next_ in ((real[:, :-1], after), (windows[:, :-1], foretold)):
            found = network.outcome(before.flatten(0, 1), acts, next_.flatten(0, 1))
            costs = {"reward": -(two_hot(reward, network.rewards) * found.reward.log_softmax(1)).sum(1).mean()}
            costs["done"] = F.binary_cross_entropy_with_logits(found.done, done)
            parts |= {name: parts.get(name, 0.0) + cost / 2 for name, cost in costs.items()}
        found = network.inverse(real[:, :-1].flatten(0, 1), after.flatten(0, 1))
        return parts | {"inverse": action_loss(found, acts, self.controls) / self._blind(acts)}

    def _blind(self, acts: torch.Tensor) -> torch.Tensor | float:
        """What `action_loss` is of axes for who does not look: small where actions are, and yet all there is to know of them."""
        return acts.var(0).mean().clamp_min(1e-4) if self.controls.kind == AXES else 1.0


def action_loss(found: torch.Tensor, acts: torch.Tensor, controls: Controls) -> torch.Tensor:
    """How far `found` [N, A] is from actions [N, A], both as networks have them: of axes the square, of the rest in nats."""
    if controls.kind == AXES:
        return F.mse_loss(found, acts)
    if controls.kind == BUTTONS:
        return F.binary_cross_entropy_with_logits(found, acts)
    counts = controls.counts
    pairs = zip(found.split(counts, 1), acts.split(counts, 1))
    costs = [F.cross_entropy(logits, picked.argmax(1)) for logits, picked in pairs]
    return torch.stack(costs).sum()


def picture_loss(drawn: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Squared error of pictures [N, 3, H, W]; what differs from one to the other counts more, for it is little and matters."""
    differs = (truth - truth.mean(0)).abs().amax(1, keepdim=True)
    return ((1 + 8 * differs) * (drawn - truth).square()).mean()


def settle_scale(network: LatentNetwork, numbers: np.ndarray, follows: np.ndarray) -> None:
    """Tells the network the mean and the standard deviation of the numbers [N, width] of its vectors, and by how much they change
    in a step; follows bool [N - 1]: whether the next row comes after the row."""
    if not network.config.width:
        return
    found = torch.from_numpy(np.nan_to_num(numbers.astype(np.float64), posinf=0.0, neginf=0.0))
    network.mean.copy_(found.mean(0))
    spread = found.std(0, correction=0)
    network.scale.copy_(torch.where(spread <= 1e-6 * found.abs().amax(0).clamp_min(1e-6), 1.0, spread))
    if network.config.identity:
        scaled = found / network.scale
        network.unit.copy_(scaled.diff(dim=0)[torch.from_numpy(follows)].square().mean(0).sqrt().clamp_min(LEAST_UNIT))


def parameters(module: nn.Module) -> int:
    return sum(weight.numel() for weight in module.parameters())
