"""The commands `skills learn`, `skills list`, `skills add`, `skills rename` and `skills try`."""

from typing import Annotated

from tyro.conf import Positional, arg

from ..workflows.results import command
from ..workflows.skills import (
    LearnSkillsConfig,
    TrySkillConfig,
    add_skill,
    learn_library,
    list_skills,
    rename_skill,
    try_skill,
)
from .say import Json, RecordingName, say, show

LibraryName = Annotated[str, Positional, arg(metavar="LIBRARY")]
SkillName = Annotated[str, Positional, arg(metavar="SKILL")]


def learn(data: RecordingName, config: LearnSkillsConfig, json: Json = False) -> None:
    """Learn a library of skills from a recording with instructions and a policy that imitates it: when each can begin, what it
    brings about, how likely it works and when it ends.

    Args:
        data: The recording: a folder, or an address.
    """
    show(learn_library(data, config, progress=say), json, command("terrella", "skills", "list", str(config.out)))


def list_(library: LibraryName, json: Json = False) -> None:
    """List the skills of a library.

    Args:
        library: The folder of the library.
    """
    show(list_skills(library), json)


def add(
    library: LibraryName, name: SkillName, goal: Annotated[str, Positional, arg(metavar="GOAL")], json: Json = False
) -> None:
    """Add a skill that is made of others, which goals then can name.

    Args:
        library: The folder of the library.
        name: The name of the new skill ("tidy up").
        goal: What it stands for, in words, as for `plan --skills` ("open the drawer, put the red block in, close it").
    """
    show(add_skill(library, name, goal), json)


def rename(
    library: LibraryName, name: SkillName, new: Annotated[str, Positional, arg(metavar="NEW")], json: Json = False
) -> None:
    """Give a skill another name.

    Args:
        library: The folder of the library.
        name: The name of the skill.
        new: Its new name.
    """
    show(rename_skill(library, name, new), json)


def try_(library: LibraryName, name: SkillName, config: TrySkillConfig, json: Json = False) -> None:
    """Try a skill in an environment that gives its instructions, and count in the library how often it works.

    Args:
        library: The folder of the library.
        name: The name of the skill.
    """
    show(try_skill(library, name, config, progress=say), json)
