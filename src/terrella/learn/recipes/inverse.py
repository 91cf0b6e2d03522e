"""train inverse: an inverse-dynamics model names the action between observations (VPT, Baker et al. 2022). It learns from a part of
a recording that is labelled, sees several steps before and after, and says how sure it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...act.imitation import ImitationActor
from ...act.imitation_network import AXES, ImitationNetwork
from ...core.errors import DatasetError, TrainingError
from ...core.spec import BUTTONS
from ..calibration import Isotonic, calibration_error
from ..demonstrations import DemonstrationRows
from ..devices import device_named
from ..feeds import RandomBatches
from ..objectives.imitation import BehaviourCloning, condition
from ..recording import Recording
from ..sized_feed import SizedFeed
from ..trainer import Report, Run, Trainer
from .imitation import Imitation, config_of

STAGE, SUBFOLDER = "inverse", "inverse"
KEPT_BACK = 0.2  # of the labelled episodes: for the calibration of the confidence
DRAWS = 16  # chunks drawn from a flow, whose spread is the confidence of axes
NEAR = 0.1  # share of an axis's range within which its number is right
PART = 256  # rows labelled at once
CANDIDATES = 512  # actions among which the most frequent one is looked for


@dataclass(frozen=True)
class InverseTraining:
    """Settings of an inverse-dynamics model."""

    sees: tuple[str, ...] = ()  # Channels that it sees. Default: all cameras, numbers and grids of codes.
    picture_size: tuple[int, int] = (64, 64)  # Height and width to which pictures are resized.
    before: int = 1  # Observations before the one in which the action was taken.
    after: int = 2  # Observations after it.
    hidden: int = 128  # Width of the networks' layers.
    steps: int = 2000  # Training steps.
    batch: int = 128  # Moments per step.
    learning_rate: float = 1e-3  # Peak learning rate.
    save_every_s: float = 60.0  # Seconds between saves.
    seed: int = 0  # Random seed.


@dataclass(frozen=True)
class InverseDynamics:
    """A trained inverse-dynamics model, and how its confidence follows from what it computes."""

    network: ImitationNetwork
    after: int
    calibration: Isotonic
    facts: dict[
        str, Any
    ]  # accuracy, calibration error and their baseline, on labelled episodes that training did not see

    def label(self, rows: DemonstrationRows, which: np.ndarray) -> tuple[torch.Tensor, np.ndarray]:
        """(encoded actions [n, A], the calibrated probability [n] that each is right) of the rows `which`."""
        actions, raw = raw_labels(self.network, replace(rows, config=self.network.config, ahead=self.after), which)
        return actions, self.calibration(raw)


def train_inverse(
    opened: Recording, sees: tuple[str, ...], labelled: np.ndarray, out: str | Path, config: InverseTraining,
    report: Report, device: str = "auto",
) -> InverseDynamics:  # fmt: skip
    """Trains, or resumes, a model on the episodes `labelled` of a recording; part of them calibrate its confidence. DatasetError or
    TrainingError for what cannot be learned."""
    if config.before < 0 or min(config.after, config.hidden) < 1:
        raise TrainingError("--before is 0 or more; --after and --hidden are 1 or more.")
    if len(labelled) < 4:
        raise DatasetError(
            f"{len(labelled)} labelled episodes are too few: 4 or more, one of which calibrates; label more."
        )
    history = config.before + 1 + config.after
    run = Run.of(out, config, report, device_named(device), recording=opened.name, episodes=labelled.tolist())
    run.saved_facts(STAGE)
    torch.manual_seed(config.seed)
    network_config = config_of(opened, sees, config.hidden, Imitation(config.picture_size, history=history, chunk=1))
    network = ImitationNetwork(replace(network_config, vocabulary=(), waypoint=0, differences=True)).to(run.device)
    rows = replace(DemonstrationRows.of(opened, network.config, run.device), ahead=config.after)
    back = max(1, round(KEPT_BACK * len(labelled)))
    order = np.random.default_rng(config.seed).permutation(labelled)
    learned, kept = (rows.of_episodes(part) for part in (order[back:], order[:back]))
    network.fit_normalization(learned.sample(4096, np.random.default_rng(0)).seen)
    objective = BehaviourCloning(network, config.learning_rate, STAGE)
    feed = SizedFeed(lambda size: RandomBatches(lambda now: learned.sample(size, now.rng)), config.batch)
    trainer = Trainer(run, STAGE, feed, objective, config.steps)
    trainer.train(lambda: None)
    network.eval()
    ImitationActor.write(network, Path(out) / SUBFOLDER, {"what": f"An inverse-dynamics model of {opened.name}"})
    calibration, facts = _calibrated(network, kept, learned)
    return InverseDynamics(network, config.after, calibration, {**trainer.summary, **facts})


def _calibrated(
    network: ImitationNetwork, kept: DemonstrationRows, learned: DemonstrationRows
) -> tuple[Isotonic, dict[str, Any]]:
    """The calibration by episodes that training did not see, tested on every second moment of theirs."""
    actions, raw = raw_labels(network, kept, kept.rows)
    truth = kept.actions[torch.from_numpy(kept.rows)]
    right = right_labels(network, actions, truth)
    usual = most_frequent(network, learned.actions[torch.from_numpy(learned.rows)])
    half = Isotonic.fit(raw[::2], right[::2])
    facts = {
        "label_accuracy": round(float(right.mean()), 4),
        "usual_accuracy": round(float(right_labels(network, usual.expand_as(truth), truth).mean()), 4),
        "calibration_error": round(calibration_error(half(raw[1::2]), right[1::2]), 4),
        "uncalibrated_error": round(calibration_error(raw[1::2], right[1::2]), 4),
        "tested_labels": len(raw),
    }
    return Isotonic.fit(raw, right), facts


@torch.no_grad()
def raw_labels(
    network: ImitationNetwork, rows: DemonstrationRows, which: np.ndarray
) -> tuple[torch.Tensor, np.ndarray]:
    """(encoded actions [n, A], uncalibrated confidence [n]): of choices and buttons their probability, of axes the share of draws
    near the median."""
    labels, sure = [torch.zeros(0, network.config.action_width)], [np.zeros(0)]
    noise = torch.Generator().manual_seed(0)
    for part in np.array_split(which, max(1, -(-len(which) // PART))):
        batch = rows.at(part)
        out = condition(network, batch, batch.acted)
        count, width = len(part), network.config.action_width
        if network.config.actor.mode == AXES:
            draws = [
                network.chunk(out, torch.randn(count, width, generator=noise).to(out.device))[:, 0]
                for _ in range(DRAWS)
            ]
            every = torch.stack(draws).cpu()
            label = every.median(0).values
            confidence = ((every - label).abs().amax(2) <= 2 * NEAR).float().mean(0)
        else:
            label, confidence = (
                network.chunk(out, out.new_zeros(count, width))[:, 0].cpu(),
                _probability(network, out).cpu(),
            )
        labels.append(label)
        sure.append(confidence.numpy())
    return torch.cat(labels), np.concatenate(sure)


def _probability(network: ImitationNetwork, logits: torch.Tensor) -> torch.Tensor:
    """The probability [N] of the most likely action."""
    actor = network.config.actor
    if actor.mode == BUTTONS:
        pressed = logits.sigmoid()
        return torch.maximum(pressed, 1 - pressed).prod(1)
    return torch.stack([part.softmax(1).amax(1) for part in logits.split(list(actor.counts), 1)]).prod(0)


def right_labels(network: ImitationNetwork, actions: torch.Tensor, truth: torch.Tensor) -> np.ndarray:
    """bool [n]: the same choice and buttons; every axis within NEAR of its range."""
    limit = 2 * NEAR if network.config.actor.mode == AXES else 0.5
    return ((actions - truth).abs().amax(1) <= limit).numpy()


def most_frequent(network: ImitationNetwork, actions: torch.Tensor) -> torch.Tensor:
    """The one [A] of about CANDIDATES actions [n, A] that is right for most of these."""
    some = actions[:: -(-len(actions) // CANDIDATES)]
    return some[np.argmax([right_labels(network, one.expand_as(some), some).sum() for one in some])]
