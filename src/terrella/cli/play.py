"""The command `terrella play`: a world, or a game and a world side by side, on a page in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from ..workflows.key_keeper import KeyKeeper
from ..workflows.opening import ControlsConfig, Device, Fast, load_named
from .say import Host, Json, Port, Seed, Token, result, say

if TYPE_CHECKING:
    from ..core.world import World


def play(
    name: Positional[str],
    controls: ControlsConfig,
    image: Path | None = None,
    compare: bool = False,
    truth: str | None = None,
    memory: bool = True,
    remember: bool = False,
    estimator: str | None = None,
    memory_mb: float | None = None,
    randomise: Path | None = None,
    agent: str = "",
    agent_ms: float = 30.0,
    policy: Literal["explore", "random"] | None = None,
    record: Path | None = None,
    port: Port = 8765,
    host: Host = "127.0.0.1",
    token: Token = None,
    device: Device = "auto",
    fast: Fast = False,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Play a world in the browser: a learned world or a real game.

    Args:
        name: A name that `terrella list` shows, or the path of a checkpoint.
        image: Start from this picture (any image file). Pictures can also be dropped on the page.
        compare: Show the real game beside the learned world, under the same actions.
        truth: The real game that --compare shows; default: the one that the world learned, else doom:my_way_home.
        memory: --no-memory plays a learned world without its keyframes.
        remember: Add a spatial memory to a world that has none.
        estimator: Depth and motion estimator for --remember: a file of `terrella train estimator`, or a world that has one.
        memory_mb: Size limit of the spatial memory in MiB; default: as the world was saved, or 16.
        randomise: A TOML or JSON file of distributions, of which each episode draws masses, friction, delay and more.
        agent: Who drives when the page lets it: plan, explorer, random, the folder of a learned policy, MODULE:NAME; default: a
            planner where there is a reward to plan for, else the explorer. Goals that are set on the page are always planned for.
        agent_ms: Milliseconds that a planner may take for a decision.
        policy: Who acts from the beginning, whenever nobody touches the controls: a script that explores, or random actions.
        record: Folder of a dataset to which the page can record.
    """
    from .. import library
    from ..core.errors import TerrellaError
    from ..serve import ServeConfig, serve
    from ..serve.guard import is_loopback
    from ..workflows.page_agents import PageAgents

    if policy is not None and agent:
        raise TerrellaError("--policy and --agent both say who drives; give one of them.")
    if not agent_ms > 0:
        raise TerrellaError("--agent-ms is a time above 0.")
    learned = load_named(
        name, device, memory, fast, remember=remember, estimator=estimator, memory_mb=memory_mb, randomise=randomise
    )
    worlds = [learned]
    picture = _first_picture(image, learned) if image is not None else None
    if compare and picture is not None:
        raise TerrellaError("--image cannot be compared with a game, which cannot go on from it; leave --compare out.")
    if compare:
        worlds = [_game_like(learned, truth), learned]
    worlds = [controls.of(world) for world in worlds]
    own = library.folder_for_keys(name) if is_loopback(host) and not compare else None
    keeper, sink = KeyKeeper(worlds[0].spec, own, learned.spec), None
    if record is not None:
        from ..data import Layout, Recorder

        if record.exists() and not record.is_dir():
            raise TerrellaError(f"--record {record}: that is a file; give a folder.")

        layout, folder = Layout.of(worlds[0].spec), record
        sink = lambda: Recorder(folder, keeper.with_keys(layout), "play")  # noqa: E731
    names = [world.spec.name for world in worlds]
    driver: Any = PageAgents(worlds[0], worlds[1] if compare else None, agent, agent_ms).agents()
    if policy is not None:
        from ..act.explorer import Explorer
        from ..core.policy import Random

        driver = Explorer(worlds[0].spec) if policy == "explore" else Random(worlds[0].spec, (3, 40))

    def ready(address: str) -> None:
        result({"address": address, "worlds": names}, json, f"{' and '.join(names)}: open {address}")
        if learned.spec.card.get("kind") == "splat":
            say(f"`terrella space view {name}` draws it in your browser, sharper, and edits it.")

    keeping: dict[str, Any] = {"keep": keeper, "kept_in": keeper.place}
    config = ServeConfig(host, port, token, seed)
    serve(worlds, config, policy=driver, picture=picture, sink_factory=sink, on_ready=ready, **keeping)


def _first_picture(path: Path, world: World) -> Any:
    """The picture of an image file as the world would see it, after it was seen once: what is refused is refused now."""
    from ..core.errors import ServeError
    from ..core.world import make_rng
    from ..serve import read_picture

    if "rgb" not in world.spec.observes:
        raise ServeError(f"{world.spec.name} takes no pictures, so it cannot begin with one; leave --image out.")
    height, width = world.spec.channels["rgb"].shape[:2]
    picture = read_picture(path, (height, width))
    world.observe({"rgb": picture[None]}, None, make_rng(0))
    return picture


def _game_like(learned: World, name: str | None) -> World:
    """The real game, with pictures of the size that the learned world shows; by default the one that it learned."""
    from .. import library

    known = str(learned.spec.card.get("game"))
    name = name or (known if library.is_truth(known) else library.GAME)
    shape = learned.spec.channels["rgb"].shape if "rgb" in learned.spec.channels else None
    sizes = ("size", "depth_size") if name.startswith("doom") else ("size",)
    if library.is_truth(known) and name != known:
        say(f"{learned.spec.name} learned {known}, and is compared with {name}.")
    return library.load(name, **(dict.fromkeys(sizes, shape[:2]) if shape and library.is_truth(name) else {}))
