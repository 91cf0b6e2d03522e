"""The command `terrella play`: a world, or a game and a world side by side, on a page in the browser."""

from typing import Annotated

from tyro.conf import Positional, arg

from .. import library
from ..core.world import World
from ..serve import ServeConfig
from ..workflows import play as workflow
from ..workflows import start
from ..workflows.opening import ControlsConfig
from ..workflows.results import command, folder_name
from .say import Host, Json, Port, Token, opened, say

AnyWorld = Annotated[Positional[str | None], arg(metavar="WORLD")]
FirstSeed = Annotated[int | None, arg(help="Seed of the first episode. Default: one that begins with a good view.")]


def play(
    controls: ControlsConfig,
    config: workflow.PlayConfig,
    name: AnyWorld = None,
    port: Port = 8765,
    host: Host = "127.0.0.1",
    token: Token = None,
    seed: FirstSeed = None,
    json: Json = False,
) -> None:
    """Play a world in the browser: a learned world or a real game. Without a name, a page to choose from.

    Args:
        name: A name of `terrella list`, the path of a checkpoint or run, or an environment (gym:ID).
    """
    page = ServeConfig(host, port, token, seed)

    def begun(address: str) -> None:
        opened("Choose a world", address, {}, json)

    def ready(address: str, worlds: list[World]) -> None:
        names = [world.spec.name for world in worlds]
        opened(" and ".join(names), address, {"worlds": names}, json)
        if worlds[-1].spec.card.get("kind") == "splat":
            say(f"`{command('terrella', 'space', 'view', name)}` draws it in your browser, sharper, and edits it.")
        elif name and "reward" in worlds[-1].spec.channels and not library.is_truth(name):
            after = command("terrella", "train", "policy", out=f"runs/{folder_name(name)}-policy", **{"in": name})
            say(f"After playing, train an agent in it: {after}")

    if name is None:
        start.start(config, controls, page, on_ready=begun, progress=say)
    else:
        workflow.play(name, config, controls, page, on_ready=ready, progress=say)
