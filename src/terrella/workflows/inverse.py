"""`train inverse`: a model that names the actions of clips, learned from a few labelled episodes, and the policies that learn from
its labels."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..act.belief import load_learned_policy
from ..act.planning import PlaySettings, play
from ..core.errors import DatasetError, TerrellaError
from ..core.policy import Policy, Random, observed_channels
from ..core.world import World, make_rng
from ..exchange import write_source
from ..exchange.formats.lerobot import LeRobotRows
from ..learn.action_labels import decoded, labelled_source
from ..learn.demonstrations import DemonstrationRows
from ..learn.recipes import inverse as recipe
from ..learn.recipes.imitation import Imitation, config_of, open_demonstrations, train_imitation
from ..learn.recipes.inverse import InverseDynamics, InverseTraining
from ..learn.recipes.policy import Practice
from ..learn.recording import Recording
from ..measure.statistics import Figure, mean_interval
from .opening import Device, EnvironmentConfig
from .progress import Progress, Report, silent, stage
from .real_environment import STEPS
from .results import changed_settings, jsonable, table_lines

LEAST = 4  # labelled episodes
ARMS = ("labelled only", "pseudo-labelled", "all labelled")


@dataclass(frozen=True)
class InverseConfig:
    """Settings of `train inverse`."""

    out: Path  # Folder of the run: the model, its log, and the labelled copy of the recording in OUT/recording.
    training: InverseTraining = InverseTraining()
    labels: Path | None = None  # A recording of the same environment with actions, from which the model learns.
    labelled: float = 0.05  # Without --labels: share of the recording's own episodes whose actions are used.
    compare: bool = False
    """Train policies by imitation on the labelled episodes only, on all with the model's labels, and on all with the true ones;
    play them in --real. The recording needs all its actions."""
    real: str | None = None  # The environment of --compare (gym:CartPole-v1).
    policy_steps: int = 2000  # Training steps of each policy of --compare.
    episodes: int = 50  # Episodes of each policy of --compare.
    environment: EnvironmentConfig = EnvironmentConfig()
    device: Device = "auto"


@dataclass(frozen=True)
class InverseResult:
    """An inverse-dynamics model, the labels that it gave, and what policies learn from them."""

    facts: Mapping[str, Any]  # label_accuracy, calibration_error, and the folders.
    returns: Mapping[
        str, Figure
    ]  # With --compare: the return of each arm and of random actions, in the real environment.
    share_of_oracle: float | None = None  # Gain over random of pseudo-labels, as a share of that of the true labels.

    @property
    def learned(self) -> bool:
        """Whether the labels are better than always the most frequent action."""
        return self.facts["label_accuracy"] > self.facts["usual_accuracy"]

    def to_json(self) -> dict[str, Any]:
        returns = {name: asdict(figure) for name, figure in self.returns.items()}
        return jsonable({**self.facts, "returns": returns, "share_of_oracle": self.share_of_oracle})

    def summary(self) -> str:
        facts = self.facts
        model, usual = f"{facts['label_accuracy']:.1%}", f"{facts['usual_accuracy']:.1%}"
        error, raw = f"{100 * facts['calibration_error']:.1f}", f"{100 * facts['uncalibrated_error']:.1f}"
        lines = [
            f"The model names {model} of {facts['tested_labels']} actions of labelled episodes that it did not learn from "
            f"(the most frequent action alone: {usual}). Its confidence is off by {error} points (before calibration {raw})."
        ]
        if not self.learned:
            lines.insert(
                0,
                "The labels are no better than always the most frequent action: label more episodes, or train longer (--steps).",
            )
        if "true_accuracy" in facts:
            lines.append(
                f"Of the {facts['labels']} labels that it gave, {facts['true_accuracy']:.1%} are the recorded actions."
            )
        if self.returns:
            lines += table_lines(
                ["policy of", "return"], [[name, str(figure)] for name, figure in self.returns.items()]
            )
            if self.share_of_oracle is not None:
                lines.append(
                    f"Its labels gain {self.share_of_oracle:.0%} of what the true ones gain over random actions."
                )
        if "recording" in facts:
            lines.append(f"the labelled recording: {facts['recording']}")
        elif not self.returns:
            lines.append("No labelled recording is written.")
        return "\n".join(lines)


def train_inverse(data: str | Path, config: InverseConfig, *, progress: Progress = silent) -> InverseResult:
    """Learns what action lies between observations from a few labelled episodes, and labels the other episodes of `data` with it.

    The same call continues where an earlier one was stopped. TerrellaError where clips and labels do not fit together.
    """
    _check(config)
    real = config.environment.open(config.real) if config.compare and config.real else None
    training, source = config.training, config.labels or data
    with stage("learning actions", progress) as report:
        opened, sees = open_demonstrations(source, training.sees, training.picture_size, report)
        if real is not None:
            config_of(opened, sees, training.hidden, Imitation(training.picture_size)).check(real.spec)
        labelled = _labelled(opened, config)
        clips = opened if config.labels is None else _clips(data, opened, sees, config, report)
        inverse = recipe.train_inverse(opened, sees, labelled, config.out, training, report, config.device)
        facts, actions, sure = _label(
            inverse, clips, opened, labelled if config.labels is None else np.zeros(0, np.int64)
        )
    facts = {**inverse.facts, **facts, "run": str(config.out), "labelled_episodes": len(labelled)}
    if real is not None:
        returns = _compare(data, config, real, labelled, actions, sure, progress)
        figures = {name: mean_interval(each, make_rng(0)) for name, each in returns.items()}
        gains = [float((returns[arm] - returns["random"]).mean()) for arm in ARMS[1:]]
        return InverseResult(facts, figures, gains[0] / gains[1] if gains[1] > 0 else None)
    out = Path(config.out) / "recording"
    shutil.rmtree(out, ignore_errors=True)  # of an earlier call
    if not (result := InverseResult(facts, {})).learned:
        return result
    made = labelled_source(clips, opened, decoded(actions, opened), sure)
    about = clips.dataset.features.get(clips.dataset.rgb_key or "", {}) if clips.dataset else {}
    pictures = "png" if about.get("dtype") == "image" else "video"  # exact ones stay exact
    notes = write_source(made, out, "lerobot", LeRobotRows(pictures=pictures))
    return InverseResult({**facts, "recording": str(out), "notes": notes}, {})


def _check(config: InverseConfig) -> None:
    """TerrellaError for settings that exclude each other, or that nothing uses."""
    if not 0 < config.labelled < 1 or min(config.episodes, config.policy_steps) < 1:
        raise TerrellaError("--labelled is between 0 and 1; --episodes and --policy-steps are 1 or more.")
    given = {f"--{name.replace('_', '-')}" for name in changed_settings(replace(config, training=InverseTraining()))}
    if config.labels is not None and (useless := sorted(given & {"--labelled", "--compare"})):
        raise TerrellaError(f"--labels names the recording with actions; leave {', '.join(useless)} out.")
    if config.compare and config.real is None:
        raise TerrellaError("--compare plays policies in an environment: name it, as in --real gym:CartPole-v1.")
    if not config.compare and (useless := sorted(given & {"--real", "--policy-steps", "--episodes"})):
        raise TerrellaError(f"{', '.join(useless)}: only --compare has a use for that.")


def _labelled(opened: Recording, config: InverseConfig) -> np.ndarray:
    """The numbers of the labelled episodes."""
    seen = np.array(opened.seen, np.int64)
    if config.labels is not None:
        return seen
    count = max(LEAST, round(config.labelled * len(seen)))
    return np.sort(np.random.default_rng(config.training.seed).permutation(seen)[:count])


def _clips(
    data: str | Path, labels: Recording, sees: tuple[str, ...], config: InverseConfig, report: Report
) -> Recording:
    """The clips to label. DatasetError where they are of another game than the labels."""
    clips, _ = open_demonstrations(data, sees, config.training.picture_size, report, needs=())
    mine, theirs = (one.dataset.world if one.dataset else one.cache.world for one in (clips, labels))
    if mine.get("name") and theirs.get("name") and mine["name"] != theirs["name"]:
        raise DatasetError(
            f"{clips.name} is of {mine['name']}, and the labels of {labels.name} are of {theirs['name']}: "
            "label clips of the same environment."
        )
    if clips.cache.action is not None and mine.get("action_space") != theirs.get("action_space"):
        spaces = mine.get("action_space"), theirs.get("action_space")
        raise DatasetError(
            f"{clips.name} has actions in {spaces[0]}, and the labels of {labels.name} are in {spaces[1]}: "
            "record both with the same actions."
        )
    return clips


def _label(
    inverse: InverseDynamics, clips: Recording, labels: Recording, labelled: np.ndarray
) -> tuple[dict[str, Any], torch.Tensor, np.ndarray]:
    """(facts, encoded actions [R, A] of all rows, confidence [R]): true ones with confidence 1 in the episodes `labelled`."""
    rows = DemonstrationRows.of(
        replace(clips, controls=labels.controls), inverse.network.config, inverse.network.mean.device
    )
    actions, sure, known = (
        rows.actions.clone(),
        np.ones(clips.cache.length, np.float32),
        rows.of_episodes(labelled).rows,
    )
    which = np.setdiff1d(np.flatnonzero(rows.valid), known)
    actions[torch.from_numpy(which)], sure[which] = inverse.label(rows, which)
    facts: dict[str, Any] = {"labels": len(which), "mean_confidence": round(float(sure[which].mean()), 4)}
    if clips.cache.action is not None:
        right = recipe.right_labels(inverse.network, actions[which], rows.actions[which])
        facts["true_accuracy"] = round(float(right.mean()), 4)
    return facts, actions, sure


def _compare(
    data: str | Path,
    config: InverseConfig,
    real: World,
    labelled: np.ndarray,
    actions: torch.Tensor,
    sure: np.ndarray,
    progress: Progress,
) -> dict[str, torch.Tensor]:
    """Returns [episodes] in the real environment, of random actions and of a policy of each arm."""
    training, weight = config.training, torch.from_numpy(sure)
    practice = Practice(
        sees=training.sees,
        steps=config.policy_steps,
        batch=training.batch,
        hidden=training.hidden,
        seed=training.seed,
    )
    arms: dict[str, Callable[[DemonstrationRows], DemonstrationRows]] = {
        "labelled only": lambda rows: rows.of_episodes(labelled),
        "pseudo-labelled": lambda rows: replace(rows, actions=actions, weight=weight),
        "all labelled": lambda rows: rows,
    }
    returns = {}
    steps = real.spec.max_episode_steps or STEPS

    def played(policy: Policy, what: str) -> torch.Tensor:
        settings = PlaySettings(steps, sees=observed_channels(policy, real.spec))
        with stage(what, progress) as report:
            episodes = play(real, policy, config.episodes, settings, training.seed, report).episodes
        return torch.tensor([episode.reward for episode in episodes])

    for arm, relabel in arms.items():
        folder = Path(config.out) / arm.replace(" ", "-")
        with stage(f"imitating: {arm}", progress) as report:
            imitation = Imitation(training.picture_size)
            train_imitation(data, folder, practice, imitation, report, config.device, relabel)
        returns[arm] = played(load_learned_policy(folder, real.spec), f"acting: {arm}")
    returns["random"] = played(Random(real.spec), "acting at random")
    return returns
