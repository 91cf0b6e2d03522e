"""What every command prints, and the options that many share."""

import json as json_text
from collections.abc import Mapping
from typing import Annotated
from urllib.parse import urlsplit

from tyro.conf import Positional, arg

from ..library import is_truth
from ..serve.guard import is_loopback
from ..serve.qr_code import qr_text
from ..workflows.opening import EnvironmentConfig
from ..workflows.progress import Terminal
from ..workflows.results import Result, changed_settings, command

# Positional arguments, by what they name.
WorldName = Annotated[str, Positional, arg(metavar="WORLD")]
RecordingName = Annotated[str, Positional, arg(metavar="RECORDING")]
PlaceName = Annotated[str, Positional, arg(metavar="PLACE")]
Json = Annotated[bool, arg(help="Print one JSON document on stdout instead of text.")]
Seed = Annotated[int, arg(help="The same seed gives the same result.")]
Port = Annotated[int, arg(help="Port of the page; 0 picks a free one.")]
Host = Annotated[
    str,
    arg(
        help="Address to listen on. 0.0.0.0: other devices of the network may open the page, at the address that is printed; it "
        "carries a token."
    ),
]
Token = Annotated[
    str | None,
    arg(
        help="Secret that the address of the page must contain; default: none, or a generated one if --host is not this machine."
    ),
]

say = Terminal()  # the progress of every command


def show(workflow: Result, json: bool, following: str = "") -> None:
    """Prints the result of a workflow on stdout, with the command that usually follows."""
    result({} if not json else workflow.to_json(), json, None if json else workflow.summary(), following)


def playing(world: str, agent: object, environment: EnvironmentConfig) -> str:
    """The command that plays a world with an agent; "" for a simulator with settings that `play` does not have."""
    settings = changed_settings(environment) if is_truth(world) else {}
    task, file = settings.pop("task", None), settings.pop("randomise", None)
    name = f"{world}:{task}" if task else world
    return "" if settings else command("terrella", "play", name, agent=agent, randomise=file)


def opened(what: str, address: str, facts: Mapping[str, object], json: bool) -> None:
    """Prints the address of a page, and for other devices of the network its QR code."""
    elsewhere = not is_loopback(urlsplit(address).hostname or "")
    code = qr_text(address) if elsewhere else ""
    result({"address": address, **facts}, json, "\n".join(filter(None, [f"{what}: open {address}", code])))


def result(facts: Mapping[str, object], json: bool, text: str | None = None, following: str = "") -> None:
    """One JSON document, or the same for people, on stdout, with the command that usually follows."""
    after = {"next": following} if following else {}
    if json:
        print(json_text.dumps({**facts, **after}, indent=1, default=str), flush=True)
        return
    lines = [text] if text else [f"{name}: {value}" for name, value in facts.items()]
    print("\n".join([*lines, *(f"{name}: {value}" for name, value in after.items())]), flush=True)
