"""Sentence encoders: what a policy understands of an instruction. A small one learns its words with the policy."""

import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from functools import lru_cache
from typing import Protocol

import torch
from torch import nn

WORDS = 32  # of an instruction; more are left out
ALIKE = 0.8  # similarity of spelling from which an unknown word counts as a known one: "balls" is "ball"
DROPPED = 0.15  # probability in training that a word is left out, so that others may be
_WORD = re.compile(r"\w+")


class SentenceEncoder(Protocol):
    """Texts to numbers [N, WORDS] (`read`), and those to features [N, width] (called). `unknown`: the words of a text that it does
    not know and leaves out."""

    width: int

    def read(self, texts: Sequence[str]) -> torch.Tensor: ...
    def unknown(self, text: str) -> tuple[str, ...]: ...
    def __call__(self, words: torch.Tensor) -> torch.Tensor: ...


class WordEncoder(nn.Module):
    """Embeddings of the words of a vocabulary in their order, pooled by attention. Unknown words are left out; words that are
    spelled nearly as a known one are that word. Features are those of the sentence [sentence], and `picks` more, each of the words
    that its own attention picks [picks * sentence]. For that a word's neighbours say what it does: "on the blue block"."""

    def __init__(self, vocabulary: Sequence[str], sentence: int = 64, picks: int = 0):
        super().__init__()
        self.vocabulary, self.sentence, self.width = tuple(vocabulary), sentence, (1 + picks) * sentence
        width, near = sentence, 3 if picks else 1  # neighbours on either side
        self._numbers = {word: number for number, word in enumerate(self.vocabulary, 1)}
        self.embed = nn.Embedding(len(self.vocabulary) + 1, width, padding_idx=0)
        self.mix = nn.Conv1d(width, width, 2 * near + 1, padding=near)
        self.weigh = nn.Linear(width, 1)
        self.out = nn.Linear(width, width)
        self.pick = nn.Linear(width, picks) if picks else None
        self._read = lru_cache(maxsize=4096)(self._number)

    def read(self, texts: Sequence[str]) -> torch.Tensor:
        """int64 [N, WORDS]; 0 for no word and for unknown ones."""
        rows = [[number for _, number in self._read(text)][:WORDS] for text in texts]
        return torch.tensor([row + [0] * (WORDS - len(row)) for row in rows]).reshape(len(rows), WORDS)

    def unknown(self, text: str) -> tuple[str, ...]:
        return tuple(dict.fromkeys(word for word, number in self._read(text) if not number))

    def spelled(self, text: str) -> tuple[str, ...]:
        """The words of a text that it knows, as the vocabulary spells them."""
        return tuple(self.vocabulary[number - 1] for _, number in self._read(text) if number)

    def forward(self, words: torch.Tensor) -> torch.Tensor:
        """[N, width]"""
        last = (words != 0).any(0).nonzero()[-1:].sum()  # 0 where no word is known
        words = words[:, : int(last) + 1]
        if self.training:
            words = torch.where(torch.rand(words.shape, device=words.device) < DROPPED, 0, words)
        embedded = self.embed(words)
        mixed = torch.relu(embedded + self.mix(embedded.transpose(1, 2)).transpose(1, 2))
        weights = self.weigh(mixed)[..., 0].masked_fill(words == 0, -1e4).softmax(1)
        sentence = torch.relu(self.out((weights[..., None] * mixed).sum(1)))
        if self.pick is None:
            return sentence
        picked = self.pick(mixed).masked_fill((words == 0)[..., None], -1e4).softmax(1)  # [N, words, picks]
        return torch.cat([sentence, torch.einsum("nwp,nwc->npc", picked, mixed).flatten(1)], 1)

    def _number(self, text: str) -> tuple[tuple[str, int], ...]:
        return tuple((word, self._nearest(word)) for word in words_of(text))

    def _nearest(self, word: str) -> int:
        if word not in self._numbers and len(word) > 3:
            word = next(iter(get_close_matches(word, self.vocabulary, 1, ALIKE)), word)
        return self._numbers.get(word, 0)


def words_of(text: str) -> list[str]:
    """The words of a text, in lower case."""
    return _WORD.findall(text.lower())


def vocabulary_of(texts: Iterable[str]) -> tuple[str, ...]:
    """All words of the texts, sorted."""
    return tuple(sorted({word for text in texts for word in words_of(text)}))
