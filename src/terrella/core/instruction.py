"""Task texts as vectors: a fixed embedding of any sentence that needs no training, the channel `instruction`.

Words and their letter trigrams are hashed to signed places of a short vector (Weinberger et al., "Feature Hashing for Large
Scale Multitask Learning", 2009; Bojanowski et al., "Enriching Word Vectors with Subword Information", 2017), so that the
same text is the same vector on every machine, texts that share words are near, and no model is needed.
"""

import hashlib
import re
from collections.abc import Iterable, Iterator
from functools import lru_cache

import numpy as np

INSTRUCTION_SIZE = 64
TEXT_BYTES = 1024  # of the channel `text`
TASK_NAMES = ("mission", "task", "instruction", "language_instruction", "prompt")  # of texts that say what to do
_WORD = re.compile(r"\w+")
_PART = 0.4  # weight of a trigram; a word has 1


def embed(text: str, size: int = INSTRUCTION_SIZE) -> np.ndarray:
    """float32 [size], of length 1; zeros for a text without words. Ignores case and punctuation."""
    return _embed(text, size).copy()


@lru_cache(maxsize=1024)
def _embed(text: str, size: int) -> np.ndarray:
    vector = np.zeros(size, np.float64)
    for feature, weight in _features(text):
        mark = int.from_bytes(hashlib.blake2b(feature.encode(), digest_size=8).digest(), "little")
        vector[(mark >> 1) % size] += weight if mark & 1 else -weight
    length = float(np.linalg.norm(vector))
    return (vector / length if length else vector).astype(np.float32)


def embed_all(texts: Iterable[str], size: int = INSTRUCTION_SIZE) -> np.ndarray:
    """float32 [n, size] of n texts."""
    return np.stack([np.zeros(size, np.float32), *(embed(text, size) for text in texts)])[1:]


def text_to_bytes(text: str) -> np.ndarray:
    """uint8 [TEXT_BYTES], the text in UTF-8, padded with zeros; whole letters of a longer one."""
    whole = text.encode("utf-8", "replace")[:TEXT_BYTES].decode("utf-8", "ignore").encode()
    return np.frombuffer(whole.ljust(TEXT_BYTES, b"\0"), np.uint8)


def bytes_to_text(padded: np.ndarray) -> str:
    """The inverse of `text_to_bytes`."""
    return bytes(np.asarray(padded, np.uint8)).rstrip(b"\0").decode("utf-8", "replace")


def _features(text: str) -> Iterator[tuple[str, float]]:
    before = ""
    for word in _WORD.findall(text.lower()):
        yield f"word {word}", 1.0
        yield f"pair {before} {word}", _PART  # "red on blue" is not "blue on red"
        framed = f"<{word}>"
        for at in range(len(framed) - 2):
            yield f"part {framed[at : at + 3]}", _PART
        before = word
