"""skills learn: a library of skills from a recording and a policy that imitates it; see objectives/skills.py."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from ...act.actor import POLICY_FILE, RUN_SUBFOLDER, read_policy
from ...act.imitation import load_imitation_network
from ...act.imitation_network import ImitationNetwork
from ...act.sentences import words_of
from ...act.skills.library import KIND, Skill, SkillLibrary
from ...act.skills.phrases import Phrase, phrases_of
from ...act.skills.predictor import SkillPredictor
from ...core.errors import DatasetError, TrainingError
from ..demonstrations import DemonstrationRows
from ..feeds import RandomBatches
from ..objectives.skills import SkillMoments, SkillPrediction, recalled_moments
from ..recording import Recording
from ..sized_feed import SizedFeed
from ..trainer import Report, Run, Trainer

STAGE = "skills"
MOST_HOLD, HOLD_COST = (
    6,
    0.01,
)  # moments in a row that look done, at most; what one more must gain in segments that end rightly
ALIKE = 0.5  # of the median: where four in five last longer, an end that comes sooner than they do is a false one
AT_ONCE = 256  # moments of which features are computed
MOST_ENDS = 256  # ends that a library keeps of a skill
MOST_MOMENTS = 64  # of a segment: the last ones
TESTED = 2048  # segments on which the end is tested
LEAST_EFFECT = 0.1  # by which the end must be recognised more often than a way to it is cut short


@dataclass(frozen=True)
class SkillTraining:
    """Settings of the predictor of a skill library."""

    steps: int = 1000  # Training steps.
    batch: int = 48  # Segments per step.
    learning_rate: float = 2e-3  # Peak learning rate.
    save_every_s: float = 60.0  # Seconds between saves.
    seed: int = 0  # Random seed.


@dataclass(frozen=True)
class Segments:
    """Spans of a recording in which one instruction was followed; an instruction that another follows was carried out."""

    first: np.ndarray  # [S], rows
    end: np.ndarray  # [S], the row of the last observation
    task: np.ndarray  # [S], numbers of instructions
    success: np.ndarray  # bool [S]
    held_out: np.ndarray  # bool [S]

    @property
    def follow(self) -> bool:
        """Whether some instruction follows another within an episode."""
        return bool(np.isin(self.first, self.end).any())

    def beginnings(self, segments: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Rows [N] at which these could be begun: their first where instructions follow one another, which shows them after others.
        Else any before their end, for what others leave behind is seen on the way alone."""
        length = (self.end - self.first)[segments] * (not self.follow)
        return self.first[segments] + (rng.random(len(segments)) * length).astype(np.int64)

    @staticmethod
    def of(recording: Recording) -> Segments:
        """All segments of two rows or more."""
        cache, spans = recording.cache, []
        task, held = np.array(cache.arrays["task"]).reshape(-1), set(recording.held_out)
        reward = None if cache.reward is None else np.nan_to_num(np.array(cache.reward).reshape(-1))
        rewarded = reward is not None and bool((reward > 0).any())
        for number, (first, stop) in enumerate(cache.episodes):
            cuts = [first, *(first + 1 + np.flatnonzero(np.diff(task[first:stop]))), stop - 1]
            for a, b in zip(cuts, cuts[1:]):
                earned = reward is not None and reward[a:b].sum() > 0
                spans.append((a, b, task[a], b < stop - 1 or earned or not rewarded, number in held))
        columns = np.array([one for one in spans if one[1] > one[0]], np.int64).reshape(-1, 5).T
        return Segments(*columns[:3], *columns[3:].astype(bool))


@dataclass(frozen=True)
class SegmentFeatures:
    """What the policy sees at the moments of segments, each under the segment's instruction."""

    rows: torch.Tensor  # [moments of all segments, width]
    offset: np.ndarray  # [S]: where each segment's first moment is

    @staticmethod
    @torch.no_grad()
    def of(network: ImitationNetwork, rows: DemonstrationRows, segments: Segments, report: Report) -> SegmentFeatures:
        assert network.words is not None
        lengths = segments.end - segments.first + 1
        offset = np.cumsum(lengths) - lengths
        of_segment = np.repeat(np.arange(len(lengths)), lengths)
        moments = segments.first[of_segment] + np.arange(len(of_segment)) - offset[of_segment]
        spoken = network.words(network.words.read(rows.recording.cache.tasks))
        parts = []
        for part in np.array_split(np.arange(len(moments)), -(-len(moments) // AT_ONCE)):
            words = spoken[torch.from_numpy(segments.task[of_segment[part]])]
            parts.append(network.features(rows.observations(moments[part]), words).cpu())
            report(int(part[-1]) + 1, len(moments), "features")
        return SegmentFeatures(torch.cat(parts), offset - segments.first)

    def at(self, segments: np.ndarray, moments: np.ndarray) -> torch.Tensor:
        """[..., width] of rows [...] within segments [...]."""
        return self.rows[torch.from_numpy(self.offset[segments] + moments)]


@dataclass(frozen=True)
class SkillRows:
    """Moments of segments, drawn for training or for a test."""

    rows: DemonstrationRows
    segments: Segments
    features: SegmentFeatures
    texts: torch.Tensor  # int64 [tasks, WORDS]
    picked: np.ndarray  # the segments to draw from

    def sample(self, count: int, rng: np.random.Generator) -> SkillMoments:
        """`count` segments, and a moment of as many others."""
        return self.at(rng.choice(self.picked, count), rng)

    def at(self, mine: np.ndarray, rng: np.random.Generator) -> SkillMoments:
        """These segments; of long ones the last moments."""
        s, other = self.segments, rng.choice(self.picked, len(mine))
        first = np.maximum(s.first[mine], s.end[mine] - MOST_MOMENTS + 1)
        moments, device = np.arange(int((s.end[mine] - first).max()) + 1), self.rows.device
        left = (s.end[mine] - first)[:, None] - moments
        shown = np.minimum(first[:, None] + moments, s.end[mine][:, None])
        return SkillMoments(
            self.features.at(mine[:, None], shown).to(device),
            self.features.at(mine, s.first[mine]).to(device),
            self.features.at(mine, s.beginnings(mine, rng)).to(device),
            self.rows.observations(s.beginnings(other, rng)),
            self.rows.observations(s.end[other]),
            torch.from_numpy(s.task[mine] != s.task[other]).to(device),
            self.texts[torch.from_numpy(s.task[mine])].to(device),
            torch.from_numpy(left).float().to(device),
            torch.from_numpy(s.success[mine]).to(device),
        )


def learn_skills(
    recording: Recording, policy: str | Path, out: str | Path, config: SkillTraining, report: Report
) -> tuple[SkillLibrary, dict[str, Any]]:
    """Learns, or resumes, the library in `out`. Returns it with the facts of the run. Skills whose end looks like any other
    moment are left out. DatasetError or TrainingError where nothing can be learned."""
    if min(config.steps, config.batch) < 1:
        raise TrainingError("--steps and --batch are 1 or more.")
    _check_folder(Path(out))
    network, _ = load_imitation_network(policy)
    if network.words is None:
        raise TrainingError(f"{policy} follows no instructions; train it on a recording with several tasks.")
    segments, tasks = Segments.of(recording), recording.cache.tasks
    phrases = phrases_of(tasks[number] for number in np.unique(segments.task[segments.success]))
    if not phrases:
        raise DatasetError(f"{recording.name} holds no instruction that was carried out; record some, with rewards.")
    run = Run.of(Path(out) / "training", config, report, recording=recording.name, policy=str(policy))
    run.saved_facts(STAGE)
    torch.manual_seed(config.seed)
    predictor = SkillPredictor(network)
    rows = DemonstrationRows.of(recording, network.config, torch.device("cpu"))
    picks = [np.flatnonzero(segments.held_out == held) for held in (False, True)]
    features = SegmentFeatures.of(network, rows, segments, report)
    train, test = (SkillRows(rows, segments, features, network.words.read(tasks), pick) for pick in picks)
    feed = SizedFeed(lambda size: RandomBatches(lambda now: train.sample(size, now.rng)), config.batch)
    trainer = Trainer(run, STAGE, feed, SkillPrediction(network, predictor, config.learning_rate), config.steps)
    trainer.train(lambda: None)
    card = {"what": f"Skills of {recording.name}", "learned_from": recording.name}
    bare = SkillLibrary((), network, predictor.eval(), {}, (), card=card)
    tested = EndTest.of(bare, test if segments.success[test.picked].any() else train)
    library, without = _library(bare, tested, phrases, train)
    library = replace(library, card={**card, "without_effect": without}).named_as(out)
    library.write(out)
    return library, {**trainer.summary, **tested.facts(), "without_effect": without}


def _check_folder(out: Path) -> None:
    """TrainingError for a folder that holds something else than a library."""
    other = (out / POLICY_FILE).is_file() and read_policy(out).get("kind") != KIND
    for is_there, what in (
        (other or (out / RUN_SUBFOLDER / POLICY_FILE).is_file(), "another policy"),
        ((out / "meta" / "info.json").exists(), "a recording"),
    ):
        if is_there:
            raise TrainingError(f"{out} holds {what}; give another --out.")


def _library(
    bare: SkillLibrary, tested: EndTest, phrases: Mapping[Phrase, list[str]], train: SkillRows
) -> tuple[SkillLibrary, list[str]]:
    """The library, and the phrases that are left out. DatasetError if no skill has an effect."""
    tasks = train.rows.recording.cache.tasks
    numbered = {phrase: _numbers(tasks, texts) for phrase, texts in phrases.items()}
    without = [str(phrase) for phrase, numbers in numbered.items() if tested.effect(numbers) < LEAST_EFFECT]
    kept = {phrase: numbers for phrase, numbers in numbered.items() if str(phrase) not in without}
    if not kept:
        raise DatasetError(
            f"no instruction of {train.rows.recording.name} has a visible effect: the last observations of '{without[0]}' are as "
            "those on the way."
        )
    skills, names = [], Counter[str]()
    for phrase, numbers in kept.items():
        names[phrase.name] += 1
        name = phrase.name if names[phrase.name] == 1 else f"{phrase.name} {names[phrase.name]}"
        skills.append(_skill(phrase, name, numbers, train.segments))
    ends, texts = _ends(train, list(kept.values()))
    return replace(
        bare, skills=tuple(skills), threshold=tested.threshold, ends=ends, end_texts=texts, hold=tested.hold
    ), without


def _numbers(tasks: Sequence[str], texts: Sequence[str]) -> np.ndarray:
    """The numbers of the tasks with these texts."""
    return np.array([number for number, task in enumerate(tasks) if task in texts])


@dataclass(frozen=True)
class EndTest:
    """How well the ends of instructions are recognised among moments on the way, on segments that training did not see."""

    threshold: float  # log odds at which most segments are ended at their end and not before
    hold: int  # moments in a row that it takes
    task: np.ndarray  # [n], of each tested segment
    on_way: np.ndarray  # bool [n]: that many moments on the way are taken for the end
    at_end: np.ndarray  # bool [n]: the end is recognised

    @staticmethod
    @torch.no_grad()
    def of(library: SkillLibrary, test: SkillRows) -> EndTest:
        s, rng = test.segments, np.random.default_rng(0)
        won = test.picked[s.success[test.picked]]
        won, parts = rng.permutation(won)[:TESTED], []
        for part in np.array_split(won, -(-len(won) // 64)):
            batch = test.at(part, rng)
            done = library.predictor(*recalled_moments(library.network, batch)).done.view(batch.left.shape)
            end = (batch.left == 0).float().argmax(1)
            lasted = lasting(done.masked_fill(batch.left <= 0, -torch.inf), MOST_HOLD)
            parts.append(torch.cat([done[torch.arange(len(part)), end][None], lasted]).cpu())
        end, *ways = torch.cat(parts, 1).numpy()
        cuts = np.quantile(np.concatenate([ways[0], end]), np.linspace(0.01, 0.99, 99))
        right = np.array([[((end > cut) & (way <= cut)).mean() for cut in cuts] for way in ways])
        right -= HOLD_COST * np.arange(len(ways))[:, None]
        hold, best = np.unravel_index(int(right.argmax()), right.shape)
        cut, way = float(cuts[best]), ways[hold]
        return EndTest(cut, int(hold) + 1, s.task[won], way > cut, end > cut)

    def effect(self, tasks: np.ndarray) -> float:
        """By how much more often their ends are taken for the end than a whole way to it; 1 where none was tested."""
        mine = np.isin(self.task, tasks)
        return float(self.at_end[mine].mean() - self.on_way[mine].mean()) if mine.any() else 1.0

    def facts(self) -> dict[str, Any]:
        return {
            "ends_recognised": round(float(self.at_end.mean()), 4),
            "ended_too_early": round(float(self.on_way.mean()), 4),
            "tested_segments": len(self.task),
            "hold": self.hold,
        }


def lasting(looks: torch.Tensor, most: int) -> torch.Tensor:
    """Of values [n, T] the highest that 1, 2, ... `most` moments in a row reach: [most, n]; minus infinity beyond T."""
    rows, current, length = list[torch.Tensor](), looks, looks.shape[1]
    for number in range(1, most + 1):
        rows.append(current.amax(1))
        later = F.pad(looks[:, number:], (0, min(number, length)), value=-torch.inf)
        current = torch.minimum(current, later)
    return torch.stack(rows)


def _skill(phrase: Phrase, name: str, tasks: np.ndarray, segments: Segments) -> Skill:
    mine = np.isin(segments.task, tasks)
    steps = (segments.end - segments.first)[mine & segments.success]
    won = int((mine & segments.success).sum())
    shortest, short, median, most = np.quantile(steps, (0.01, 0.2, 0.5, 0.95))
    least = short if short > ALIKE * median else shortest
    return Skill(name, phrase, int(mine.sum()), won, float(median), int(least), int(most))


def _ends(rows: SkillRows, kept: Sequence[np.ndarray]) -> tuple[dict[str, torch.Tensor], tuple[str, ...]]:
    """Some observations at which instructions of each skill ended and starts of any, and the instructions; "" for the starts."""
    s, rng = rows.segments, np.random.default_rng(0)
    won = rows.picked[s.success[rows.picked]]
    every = np.concatenate([rng.permutation(won[np.isin(s.task[won], tasks)])[:MOST_ENDS] for tasks in kept])
    starts = s.first[rng.permutation(rows.picked)[:MOST_ENDS]]
    texts = [" ".join(words_of(rows.rows.recording.cache.tasks[number])) for number in s.task[every]]
    return rows.rows.observations(np.concatenate([s.end[every], starts])), (*texts, *[""] * len(starts))
