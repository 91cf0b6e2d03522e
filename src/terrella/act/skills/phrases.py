"""The language of skills: phrases with places for words, mined from instructions, and goals of several phrases."""

from __future__ import annotations

import itertools
import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from ...core.errors import PlanningError
from ..sentences import words_of

ARTICLES = ("the", "a", "an")
MOST_FILLINGS = 64  # instructions that a phrase with open places stands for, at most
_THEN = re.compile(r"[,;.]?\s*\b(?:and\s+)?(?:then|after\s+that|afterwards)\b[\s,]*|[;.]\s*")
_FIRST = re.compile(r"^after\s+(.+?),\s*(.+)$")  # "after A, B" is "B after A"
_AFTER = re.compile(r"[,]?\s*\bafter\s+(?:you\s+)?(?:have\s+)?")
_COMMA = re.compile(r"\s*,\s*(?:and\s+)?")
_AND = re.compile(r"\s+and\s+")
PRONOUNS = ("it", "them", "there")
MOST_NAMED = 4  # words of a thing that a phrase names: "the small red ball"


@dataclass(frozen=True)
class Phrase:
    """An instruction with places: at each the words that may stand there, one word where it is fixed."""

    places: tuple[tuple[str, ...], ...]

    @property
    def name(self) -> str:
        """Its fixed words, and _ for each open place."""
        return " ".join(place[0] if len(place) == 1 else "_" for place in self.places)

    def __str__(self) -> str:
        return " ".join("|".join(place) for place in self.places)

    @staticmethod
    def of(text: str) -> Phrase:
        """The phrase of its own text, the inverse of str()."""
        return Phrase(tuple(tuple(place.split("|")) for place in text.split()))

    def fillings(self, words: Sequence[str]) -> list[str]:
        """The instructions of this phrase that these words leave open; [] if they do not fit. Articles may be left out.
        PlanningError for more than MOST_FILLINGS."""
        chosen = self._fit(tuple(words), 0)
        if chosen is None:
            return []
        if (count := math.prod(map(len, chosen))) > MOST_FILLINGS:
            raise PlanningError(
                f"'{' '.join(words)}' leaves {count} instructions open, and {MOST_FILLINGS} are searched: say more of "
                f"'{self.name}'."
            )
        return [" ".join(each) for each in itertools.product(*chosen)]

    def _fit(self, words: tuple[str, ...], at: int) -> list[tuple[str, ...]] | None:
        """The words for each place from `at` on."""
        if words and (at == len(self.places) or words[0] not in self.places[at]) and words[0] in ARTICLES:
            return self._fit(words[1:], at)
        if at == len(self.places):
            return None if words else []
        place = self.places[at]
        if words and words[0] in place and (rest := self._fit(words[1:], at + 1)) is not None:
            return [words[:1], *rest]
        article = all(word in ARTICLES for word in place)
        if not article and len(place) == 1:
            return None
        rest = self._fit(words, at + 1)
        return None if rest is None else [place[-1:] if article else place, *rest]


def phrases_of(texts: Iterable[str]) -> dict[Phrase, list[str]]:
    """The phrases of instructions, with the instructions of each. Words are of one class if one may stand for the other in two
    instructions that are else the same; instructions of the same classes are one phrase."""
    texts = list(dict.fromkeys(texts))
    split = {text: words_of(text) for text in texts}
    alike: dict[tuple, set[str]] = defaultdict(set)
    for words in split.values():
        for at in range(len(words)):
            alike[(*words[:at], None, *words[at + 1 :])].add(words[at])
    of = {word: word for words in split.values() for word in words}

    def first(word: str) -> str:
        while of[word] != word:
            word = of[word]
        return word

    for group in alike.values():
        for word in group:
            of[first(word)] = first(min(group))
    grouped: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for text, words in split.items():
        grouped[tuple(first(word) for word in words)].append(text)
    phrases = {}
    for group in grouped.values():
        places = tuple(tuple(sorted(set(each))) for each in zip(*(split[text] for text in group)))
        phrases[Phrase(places)] = group
    return phrases


def goal_of(text: str, whole: Callable[[str], bool] = lambda phrase: False) -> tuple[tuple[str, ...], ...]:
    """The phrases of a goal, in groups: the groups in their order, the phrases of a group in any. "A and B, then C", "A and B, C",
    "C after you A and B" and "after you A and B, C" are ((A, B), (C,)). whole: whether a phrase with "and" is one instruction."""
    groups: list[tuple[str, ...]] = []
    for part in _THEN.split(text.strip().lower()):
        for each in reversed(_AFTER.split(_FIRST.sub(r"\2 after \1", part.strip()))):
            for one in _COMMA.split(each):
                parts = [one] if whole(one) else _AND.split(one)
                phrases = tuple(phrase.strip() for phrase in parts if words_of(phrase))
                groups += [phrases] if phrases else []
    return tuple(groups)


def things_of(phrase: str) -> list[str]:
    """What a phrase names, in its order: an article and the words after it, more of them first ("the red ball", "the red")."""
    words = words_of(phrase)
    ends = [(at, end) for at in range(len(words)) for end in range(at + MOST_NAMED, at + 1, -1) if end <= len(words)]
    return [" ".join(words[at:end]) for at, end in ends if words[at] in ARTICLES]


def completed(phrase: str, things: Iterable[str]) -> list[str]:
    """The phrase with each of these things in the place of its pronoun, or at its end ("put the ball in", "pick it up")."""
    words = words_of(phrase)
    at = next((at for at, word in enumerate(words) if word in PRONOUNS), len(words))
    before, after = words[:at], words[at + 1 :]
    return [" ".join(each) for thing in things for each in ([*before, thing, *after], [*before, *after, thing])]
