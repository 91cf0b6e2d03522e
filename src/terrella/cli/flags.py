"""Says what is wrong with options: a flag that was given a value, an option that was given twice, a path taken for one."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from tyro.conf import Positional

# What to write instead of a value behind the flag.
INSTEAD = {
    "--compare": "--truth GAME names the game",
    "--remember": "--estimator FILE names the estimator",
    "--fast": "--device DEVICE names the device",
    "--watch": "--port PORT chooses the port",
    "--human": "--port PORT chooses the port",
    "--delete": "--box, --sphere, --plane or --object selects a part",
    "--repair": "--out FOLDER names the folder",
}


def value_of_flag(command: Callable[..., Any], words: Sequence[str]) -> str:
    """One sentence if a flag of `command` was given a value ("--compare GAME" or "--compare=GAME"), else ""."""
    flags, positionals = set(_flags(command)), sum(map(_is_positional, _hints(command, include_extras=True)))
    first = next((at for at, word in enumerate(words) if word.startswith("-")), len(words))
    for word, following in zip(words, [*words[1:], "-"]):
        flag, equals, _ = word.partition("=")
        if flag in flags and (equals or (first >= positionals and not following.startswith("-"))):
            instead = f"; {INSTEAD[flag]}" if flag in INSTEAD else "; leave the value out"
            return f"{flag} takes no value{instead}."
    return ""


def given_twice(command: Callable[..., Any], words: Sequence[str]) -> str:
    """One sentence if an option of any number of values is there twice, of which only the last would count, else ""."""
    options = [word.partition("=")[0].replace("_", "-") for word in words if word[:2] == "--"]
    twice = next((one for one in _lists(command) if options.count(one) > 1), "")
    return f"{twice} is given twice; give it once, with all of its values behind it." if twice else ""


def dashed_path(words: Sequence[str]) -> str:
    """One sentence if a word is a path that begins with a dash, which is taken for an option, else ""."""
    return next(
        (f"the name {one} begins with a dash: write ./{one}" for one in words if one[:1] == "-" and Path(one).exists()),
        "",
    )


def _hints(command: Callable[..., Any], **options: Any) -> list[Any]:
    return list(get_type_hints(command, **options).values())


def _flags(command: Any) -> Iterator[str]:
    """The options of a command, or of a dataclass among its parameters, that take no value."""
    for name, kind in get_type_hints(command).items():
        if is_dataclass(kind):
            yield from _flags(kind)
        elif kind is bool:
            yield from (f"--{name.replace('_', '-')}", f"--no-{name.replace('_', '-')}")


def _lists(command: Any) -> Iterator[str]:
    """The options of a command, or of a dataclass among its parameters, that take any number of values."""
    for name, kind in get_type_hints(command).items():
        if is_dataclass(kind):
            yield from _lists(kind)
        elif any(Ellipsis in get_args(one) or get_origin(one) is list for one in (kind, *get_args(kind))):
            yield f"--{name.replace('_', '-')}"


def _is_positional(hint: Any) -> bool:
    return get_args(Positional[int])[1] in getattr(hint, "__metadata__", ())
