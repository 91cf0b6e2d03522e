"""The command `terrella play`: a world, or a game and a world side by side, on a page in the browser."""

from ..core.world import World
from ..serve import ServeConfig
from ..workflows import play as workflow
from ..workflows.opening import ControlsConfig
from .say import Host, Json, Port, Seed, Token, WorldName, result, say


def play(
    name: WorldName,
    controls: ControlsConfig,
    config: workflow.PlayConfig,
    port: Port = 8765,
    host: Host = "127.0.0.1",
    token: Token = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Play a world in the browser: a learned world or a real game.

    Args:
        name: A name of `terrella list`, the path of a checkpoint or run, or an environment (gym:ID).
    """

    def ready(address: str, worlds: list[World]) -> None:
        names = [world.spec.name for world in worlds]
        result({"address": address, "worlds": names}, json, f"{' and '.join(names)}: open {address}")
        if worlds[-1].spec.card.get("kind") == "splat":
            say(f"`terrella space view {name}` draws it in your browser, sharper, and edits it.")

    workflow.play(name, config, controls, ServeConfig(host, port, token, seed), on_ready=ready, progress=say)
