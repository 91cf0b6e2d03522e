"""SkillLibrary: a folder of skills, instructions that a policy follows: when they can begin, what they bring about, how likely
they work."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

from ...core.errors import CheckpointError, PlanningError
from ...core.files import remedy_of, replacing, write_text
from ...core.similar import did_you_mean
from ...core.world import Observation
from ..actor import DAMAGE, POLICY_FILE, load_network, read_policy, write_policy
from ..imitation import ImitationActor, load_imitation_network
from ..imitation_network import ImitationNetwork
from .phrases import Phrase
from .predictor import SkillOutlook, SkillPredictor

KIND, VERSION = "skills", 1
FAST_FOLDER, ENDS_FILE = (
    "fast",
    "ends.safetensors",
)  # the policy that carries skills out; observations at which they ended


@dataclass(frozen=True)
class Skill:
    """What a policy does at instructions of one phrase."""

    name: str
    phrase: Phrase
    tries: int  # segments of recordings
    successes: int  # of these
    steps: float  # median of the successful ones
    least_steps: int  # after fewer it is not over, whatever it looks like
    most_steps: int  # 95% of the successful ones take no more
    own_tries: int = 0  # of the policy itself, by `skills try`
    own_successes: int = 0

    @property
    def works(self) -> float:
        """The probability that it works where it can begin: the mean of a beta distribution. Recordings, which are of a teacher,
        count as two tries beside those of the policy itself."""
        recorded = (self.successes + 1) / (self.tries + 2)
        return (self.own_successes + 2 * recorded) / (self.own_tries + 2)


@dataclass(frozen=True)
class SkillLibrary:
    """Skills, the policy that carries them out, and observations at which they ended: what they bring about."""

    skills: tuple[Skill, ...]
    network: ImitationNetwork
    predictor: SkillPredictor
    ends: Mapping[str, torch.Tensor]  # channel -> [E, ...]
    end_texts: tuple[str, ...]  # the instruction of each end; "" for the starts of any instruction, which come last
    threshold: float = 0.0  # log odds of `done` from which an instruction counts as done
    hold: int = 1  # moments in a row above it
    card: Mapping[str, Any] | None = None
    composed: Mapping[str, str] = field(default_factory=dict)  # name -> the goal, in words, that it stands for

    def named(self, name: str) -> Skill:
        """The skill of a name; PlanningError if there is none."""
        for skill in self.skills:
            if skill.name == name:
                return skill
        names = [skill.name for skill in self.skills]
        raise PlanningError(
            f"there is no skill '{name}'{did_you_mean(name, names) or '.'} There are: {', '.join(names)}."
        )

    def renamed(self, name: str, new: str) -> SkillLibrary:
        """The library with another name for a skill; PlanningError if there is none, or the new name is taken."""
        if new.lower() != name.lower():
            self._check_free(new)
        if name in self.composed:
            return replace(self, composed={new if one == name else one: goal for one, goal in self.composed.items()})
        return self._with(replace(self.named(name), name=new), name)

    def added(self, name: str, goal: str) -> SkillLibrary:
        """The library with a name for a goal in words; PlanningError if the name is taken, or an instruction."""
        self._check_free(name)
        return replace(self, composed={**self.composed, name: self.spelled_out(goal)})

    def _check_free(self, name: str) -> None:
        taken = {one.lower() for one in (*(skill.name for skill in self.skills), *self.composed)}
        if not name.strip() or name.lower() in taken or self.skill_of(name):
            raise PlanningError(f"'{name}' is no free name for a skill; choose another.")

    def spelled_out(self, goal: str) -> str:
        """A goal in words, with the goals that names in it stand for."""
        if not self.composed:
            return goal
        names = "|".join(re.escape(name) for name in sorted(self.composed, key=len, reverse=True))
        meant = {name.lower(): text for name, text in self.composed.items()}
        return re.sub(rf"(?<!\w)({names})(?!\w)", lambda match: meant[match[0].lower()], goal, flags=re.IGNORECASE)

    def named_as(self, folder: str | Path) -> SkillLibrary:
        """The library with the names that a folder's library has for the same phrases and for goals; itself where there is
        none."""
        try:
            before = SkillLibrary.load(folder)
        except CheckpointError:
            return self
        earlier = {skill.phrase: skill.name for skill in before.skills}
        named, names = replace(self, composed=before.composed), {skill.name for skill in self.skills}
        for skill in self.skills:
            name = earlier.get(skill.phrase, skill.name)
            if name not in names:
                named = named.renamed(skill.name, name)
        return named

    def tried(self, name: str, tries: int, successes: int) -> SkillLibrary:
        """The library with further attempts of a skill."""
        skill = self.named(name)
        own = {"own_tries": skill.own_tries + tries, "own_successes": skill.own_successes + successes}
        return self._with(replace(skill, **own), name)

    def _with(self, skill: Skill, name: str) -> SkillLibrary:
        return replace(self, skills=tuple(skill if one.name == name else one for one in self.skills))

    @torch.no_grad()
    def outlook(
        self,
        seen: Observation,
        texts: Sequence[str],
        memory: torch.Tensor | None = None,
        waypoints: torch.Tensor | None = None,
    ) -> SkillOutlook:
        """What observations [N, ...] promise for N instructions. memory: the policy's [N, hidden], and its waypoints
        [N, waypoints, D]; None where they begin."""
        words = self.network.words
        assert words is not None
        spoken = words(words.read(texts).to(self.network.mean.device))
        features = self.network.features(seen, spoken)[:, None]
        waypoints = self.network.foreseen(features, spoken) if waypoints is None else waypoints
        return self.predictor(self.network.recall(features, memory)[0][:, 0], spoken, waypoints)

    def skill_of(self, text: str) -> Skill | None:
        """The skill of a whole instruction."""
        words = text.split()
        fits = (skill for skill in self.skills if len(skill.phrase.places) == len(words))
        return next((one for one in fits if all(w in place for w, place in zip(words, one.phrase.places))), None)

    def write(self, folder: str | Path) -> None:
        """Writes the folder, each file atomically; CheckpointError if it cannot be written."""
        folder = Path(folder)
        skills = [{**asdict(skill), "phrase": skill.phrase.places} for skill in self.skills]
        config = {"skills": skills, "end_texts": self.end_texts, "threshold": self.threshold, "hold": self.hold}
        config["composed"] = dict(self.composed)
        ImitationActor.write(self.network, folder / FAST_FOLDER, {})
        write_policy(
            folder, {"kind": KIND, "version": VERSION, "config": config, "card": self.card or {}}, self.predictor
        )
        try:
            with replacing(folder / ENDS_FILE) as staged:
                save_file({name: value.contiguous() for name, value in self.ends.items()}, staged)
        except OSError as error:
            raise CheckpointError(f"{folder} cannot be written ({error}); {remedy_of(error)}.") from error

    def write_names(self, folder: str | Path) -> None:
        """Writes only what `renamed`, `added` and `tried` change."""
        saved = read_policy(folder)
        saved["config"]["composed"] = dict(self.composed)
        saved["config"]["skills"] = [{**asdict(skill), "phrase": skill.phrase.places} for skill in self.skills]
        write_text(Path(folder) / POLICY_FILE, json.dumps(saved, indent=1) + "\n")

    @staticmethod
    def load(folder: str | Path) -> SkillLibrary:
        """The library of a folder; CheckpointError if it is missing, foreign or damaged."""
        folder = Path(folder)
        if not (folder / POLICY_FILE).is_file() or read_policy(folder).get("kind") != KIND:
            raise CheckpointError(f"{folder} holds no skills; make a library of them with: terrella skills learn.")
        network, _ = load_imitation_network(folder / FAST_FOLDER)
        predictor, card = load_network(folder, KIND, VERSION, lambda _: SkillPredictor(network))
        try:
            config, ends = read_policy(folder)["config"], load_file(folder / ENDS_FILE)
            skills = tuple(
                Skill(**{**one, "phrase": Phrase(tuple(map(tuple, one["phrase"])))}) for one in config["skills"]
            )
            texts, cut, hold = tuple(config["end_texts"]), config["threshold"], config.get("hold", 1)
            return SkillLibrary(skills, network, predictor, ends, texts, cut, hold, card, config.get("composed", {}))
        except DAMAGE as error:
            raise CheckpointError(f"{folder} is damaged or incomplete ({error}); copy or learn it again.") from error
