"""The page that `--help` prints: arguments and options by their names, with a default only where one is a value."""

import argparse
import re
import shutil
import textwrap

WIDTH, INDENT = 110, 26
VALUES = {  # of options that take a text: what it names, where the option itself does not say it
    "--adapter": "FILE.py", "--agent": "POLICY", "--beside": "WORLD", "--data": "RECORDING", "--estimator": "FILE",
    "--from": "RECORDING",
    "--idle": "ACTION", "--in": "WORLD", "--live-mcap": "FILE", "--merge": "PLACE", "--out": "PATH", "--proposal": "POLICY",
    "--randomise": "PATH", "--real": "ENVIRONMENT", "--reference": "POLICY", "--sees": "CHANNEL", "--success": "CHANNEL",
    "--teacher": "WORLD", "--truth": "GAME", "--channels": "CHANNEL", "--sim": "WORLD", "--keys": "KEY=ACTION", "--arms": "ARM",
    "--action-names": "NAME",
}  # fmt: skip
_NOTHING = re.compile(r" ?\(default: (None|False|True|''|)\)")  # of a flag, or of what is chosen elsewhere


def help_page(parser: argparse.ArgumentParser) -> str:
    """The help of a command: usage, what it does, its arguments and options, and a paragraph for each further group."""
    width = max(60, min(WIDTH, shutil.get_terminal_size((WIDTH, 24)).columns))
    arguments: list[argparse.Action] = []
    options: list[argparse.Action] = []
    groups: list[tuple[str, list[argparse.Action]]] = []
    for group in parser._action_groups:
        actions = [action for action in group._group_actions if action.dest != "help"]
        if group.title == "positional arguments":
            arguments += actions
        elif group.title in ("options", "config options"):
            options += actions
        else:
            groups.append((f"{str(group.description).strip().rstrip('.')}:", actions))
    options.sort(key=lambda option: (not option.required, option.option_strings == ["--json"]))
    needed = [_name(option) for option in options if option.required]
    usage = " ".join([f"usage: {parser.prog}", *map(_name, arguments), *needed, "[OPTIONS]"])
    parts = [textwrap.fill(usage, width, subsequent_indent="    ")]
    parts += [textwrap.fill(" ".join(text.split()), width) for text in str(parser.description or "").split("\n\n")]
    for title, actions in (("", arguments), ("options:", options), *groups):
        if actions:
            parts.append("\n".join(filter(None, [title, *(_paragraph(action, width) for action in actions)])))
    return "\n\n".join(parts)


def _name(action: argparse.Action) -> str:
    """An option with a name for its value: --goal GOAL where the type is {None}|STR."""
    value = re.sub(r"\{None\}\|", "", str(action.metavar or "")).replace("{None,", "{")
    value = re.sub(r"\[?\[(\w+) \[\1 \.\.\.\]\]\]?", r"[\1 ...]", value)
    if not action.option_strings:
        return value
    option = action.option_strings[-1]
    value = re.sub(r"\bSTR\b", VALUES.get(option, option.rpartition("-")[2].upper()), value)
    return f"{option} {value[1:-1] if re.fullmatch('{[A-Z ]+}', value) else value}".rstrip()


def _paragraph(action: argparse.Action, width: int) -> str:
    text = _NOTHING.sub("", " ".join(str(action.help).split()))
    if not action.option_strings:
        text = text.removesuffix(" (required)")
    elif action.option_strings[-1].startswith("--no-"):
        text = text.partition(f"{action.option_strings[-1]}: ")[2]
        text = text[:1].upper() + text[1:]
    first, lines = f"  {_name(action)} ".ljust(INDENT), textwrap.wrap(text, width - INDENT)
    if len(first) > INDENT:
        return "\n".join([first.rstrip(), *(" " * INDENT + line for line in lines)])
    return "\n".join([first + lines[0], *(" " * INDENT + line for line in lines[1:])])
