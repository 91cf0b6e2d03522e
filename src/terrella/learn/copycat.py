"""Is an imitating policy more than a copy of its last action? (de Haan et al., "Causal Confusion in Imitation Learning", 2019)"""

from typing import Any

import numpy as np
import torch

from ..act.imitation_network import AXES, ImitationConfig, ImitationNetwork
from .demonstrations import DemonstrationRows
from .objectives.imitation import condition

CHANGES = 0.2  # the part of the axes' rows that change most


@torch.no_grad()
def copycat(network: ImitationNetwork, rows: DemonstrationRows, count: int) -> dict[str, Any]:
    """How well the policy predicts actions of the teacher, over all moments and over those at which the teacher changes its action,
    beside copying the last one and the most frequent (of axes the mean). Figures, and `held_out_verdict`, a sentence.

    Of choices and buttons the share of actions that are right, of axes the share of their variance that is explained."""
    inside = rows.rows[rows.rows > rows.recording.start[rows.rows]]  # with an action before
    picked = np.sort(np.random.default_rng(0).permutation(inside)[:count])
    if len(picked) < 8:
        return {"held_out_verdict": "Too few moments are held out to test the policy; record more episodes."}
    predicted = []
    for part in np.array_split(picked, -(-len(picked) // 256)):
        batch = rows.at(part)
        out = condition(network, batch, batch.acted, rows.beginnings(part) if network.waypoints else None)
        out = out if batch.requested is None else out[batch.requested]
        noise = torch.zeros(len(part), network.config.chunk * network.config.action_width, device=out.device)
        predicted.append(network.chunk(out, noise)[:, 0].cpu())
    now, before = torch.from_numpy(picked), torch.from_numpy(picked - 1)
    mine, truth = torch.cat(predicted), rows.actions[now]
    last = (rows.actions if rows.taken is None else rows.taken)[before]  # which the policy could copy
    axes = network.config.actor.mode == AXES
    change = (truth - rows.actions[before]).abs().sum(1)
    changes = change > (change.quantile(1 - CHANGES) if axes else 0)
    usual = truth.mean(0).expand_as(truth) if axes else truth.unique(dim=0, return_counts=True)
    usual = usual if isinstance(usual, torch.Tensor) else usual[0][usual[1].argmax()].expand_as(truth)
    score = _explained if axes else _right
    if not changes.any():
        right = f"The policy predicts {score(mine, truth):.0%} of the actions of held-out episodes"
        return {
            "held_out_verdict": f"{right}, in which the teacher never changes its action: so does a copy of the last."
        }
    figures = {
        "held_out": score(mine, truth), "held_out_copy_last": score(last, truth), "held_out_usual": score(usual, truth),
        "at_changes": score(mine[changes], truth[changes]),
        "at_changes_copy_last": score(last[changes], truth[changes]),
    }  # fmt: skip
    figures = {name: round(value, 4) for name, value in figures.items()}
    copies = score(mine[changes], last[changes])
    return {
        **figures,
        "copies_at_changes": round(copies, 4),
        "held_out_verdict": _verdict(figures, copies, network.config),
    }


def _verdict(figures: dict[str, float], copies: float, config: ImitationConfig) -> str:
    axes = config.actor.mode == AXES
    right = "explains {:.0%} of the variance of" if axes else "predicts {:.0%} of"
    words = right.format(figures["held_out"]) + " the actions of held-out episodes"
    words += f" (copying the last: {figures['held_out_copy_last']:.0%})"
    words += f", and {figures['at_changes']:.0%} of those at which the teacher changes its action."
    if copies > max(0.5, figures["at_changes"]):
        fewer = "Try --no-own-actions." if config.own_actions else "Try --history 1." if config.history > 1 else ""
        return f"The policy copies its last action where the teacher changes it: it {words} {fewer}".rstrip()
    if figures["held_out"] <= max(figures["held_out_copy_last"], figures["held_out_usual"]):
        usual = "the mean" if axes else "the most frequent one"
        return f"The policy predicts no better than a copy of the last action or {usual}: it {words}"
    return f"The policy is more than a copy of its last action: it {words}"


def _right(mine: torch.Tensor, truth: torch.Tensor) -> float:
    return float((mine - truth).abs().amax(1).lt(0.5).float().mean())


def _explained(mine: torch.Tensor, truth: torch.Tensor) -> float:
    spread = (truth - truth.mean(0)).square().mean()
    return 1 - float((mine - truth).square().mean() / spread.clamp_min(1e-9))
