"""Finds the known name that is most like a misspelt one, for messages."""

from collections.abc import Iterable
from difflib import get_close_matches


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """ "; did you mean 'play'?" where one of the known names is like it, else an empty string."""
    names = {one.lower(): one for one in known}
    close = get_close_matches(name.lower(), list(names), n=1, cutoff=0.6)
    return f"; did you mean '{names[close[0]]}'?" if close else ""
