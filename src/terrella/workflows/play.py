"""Serves the page of a world, or of a game and a learned world side by side, with an agent that may drive."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from .. import library
from ..act.explorer import Explorer
from ..core.errors import ServeError, TerrellaError
from ..core.policy import Policy, Random
from ..core.spec import neutral_action
from ..core.world import World, make_rng
from ..data import Layout, Recorder
from ..measure.costs import EnergyMeter
from ..serve import ServeConfig, SinkFactory, read_picture, serve
from ..serve.agent import Agents
from ..serve.guard import is_loopback
from .key_keeper import KeyKeeper
from .opening import ControlsConfig, Device, Fast, device_of, load_named
from .pace import at_pace, say_memory
from .page_agents import PageAgents
from .progress import Progress, silent

FIRST_SEEDS = 12  # of which the one with the best first view is taken
PEOPLE_SIZES = (480, 640), (240, 320)  # of pictures that are drawn for people, where the machine is quick enough
SLOWEST_S = 0.1  # to draw one of them


@dataclass(frozen=True)
class PlayConfig:
    """How a world is played."""

    image: Path | None = None  # Start from this picture (any image file). Pictures can also be dropped on the page.
    compare: bool = False
    """Show the real game beside the learned world, under the same actions. --truth GAME names the game."""
    truth: str | None = None
    """The real game that --compare shows; default: the game that the world learned, else doom:my_way_home."""
    memory: bool = True  # --no-memory: play a learned world without its keyframes.
    remember: bool = False  # Add a spatial memory to a world that has none.
    estimator: str | None = None
    """Depth and motion estimator for --remember: a file of `terrella train estimator`, or a world that has one."""
    memory_mb: float | None = None  # Size limit of the spatial memory in MiB; default: as the world was saved, or 16.
    randomise: Path | None = None
    """A TOML or JSON file of distributions, from which each episode draws masses, friction, delay and more."""
    agent: str = ""
    """Agent that acts after G is pressed: plan, explorer, random, the folder of a learned policy, or MODULE:NAME; default: a
    planner if the world has a reward, else the explorer. A planner seeks the goals that are set on the page."""
    agent_ms: float = 30.0  # Time for a planner's decision, in milliseconds.
    policy: Literal["explore", "random"] | None = None
    """Script that acts while the controls are not touched."""
    watts: float | None = None
    """Power that play may take, in watts: steps are made slower to keep it, and the page says by how much. Without an energy
    counter that may be read, watts are estimated from processor time."""
    fps: float | None = None
    """Frames a second to keep: a world of frames is drawn in fewer steps where this machine needs it, which is said."""
    record: Path | None = None  # Folder of a dataset to which the page can record.
    device: Device = "auto"
    fast: Fast = False


def play(
    name: str,
    config: PlayConfig | None = None,
    controls: ControlsConfig | None = None,
    page: ServeConfig | None = None,
    *,
    on_ready: Callable[[str, list[World]], None] | None = None,
    progress: Progress = silent,
) -> None:
    """Serves the page of a world until interrupted.

    name:     as `terrella list` shows it, or the path of a checkpoint.
    on_ready: called with the address to open, and the worlds on the page, the learned world last.
    """
    worlds, page, options = prepared(name, config, controls, page, progress)
    serve(worlds, page, **options, on_ready=lambda address: on_ready and on_ready(address, worlds))


def prepared(
    name: str,
    config: PlayConfig | None = None,
    controls: ControlsConfig | None = None,
    page: ServeConfig | None = None,
    progress: Progress = silent,
) -> tuple[list[World], ServeConfig, dict[str, Any]]:
    """The worlds of a page, its settings, and the further arguments of serve.Sessions."""
    config, controls, page = config or PlayConfig(), controls or ControlsConfig(), page or ServeConfig()
    _check(config)
    learned = _loaded(name, config, progress)
    picture = None if config.image is None else _first_picture(config.image, learned)
    worlds = [_game_beside(learned, config.truth, progress), learned] if config.compare else [learned]
    worlds = [controls.of(world) for world in worlds]
    folder = library.folder_for_keys(name) if is_loopback(page.host) and not config.compare else None
    keeper = KeyKeeper(worlds[0].spec, folder, learned.spec)
    options = {
        "policy": _driver(worlds, config), "picture": picture, "sink_factory": _sink(worlds[0], keeper, config.record),
        "keep": keeper, "kept_in": keeper.place,
    }  # fmt: skip
    meter = EnergyMeter(device_of(config.device).startswith("cuda"))
    page = replace(page, record_in=str(config.record or ""), meter=meter, watts=config.watts)
    if page.seed is None:
        page = replace(page, seed=first_seed(worlds[0]))
    return worlds, page, options


def _loaded(name: str, config: PlayConfig, progress: Progress) -> World:
    """The world. The pictures of a robot are large, for people, unless they are recorded or the machine draws them too slowly."""
    options: dict[str, Any] = {
        "progress": progress, "remember": config.remember, "estimator": config.estimator, "memory_mb": config.memory_mb,
        "randomise": config.randomise,
    }  # fmt: skip
    if name.startswith("mujoco:") and config.record is None and not config.agent:
        for size in PEOPLE_SIZES:
            world = load_named(name, config.device, config.memory, config.fast, size=size, **options)
            if "rgb" in world.spec.channels and _drawing_s(world) < SLOWEST_S:
                options["size"] = size
                break
    world = load_named(name, config.device, config.memory, config.fast, **options)
    if config.memory_mb is not None:
        say_memory(world, config.memory_mb, progress)
    return world if config.fps is None else at_pace(world, config.fps, progress)


def _drawing_s(world: World) -> float:
    """Seconds to draw a picture; of three the quickest."""
    state, took = world.start(1, make_rng(0)), []
    for _ in range(3):
        state = world.imagine(state, torch.as_tensor(neutral_action(world.spec))[None], make_rng(0))
        began = time.perf_counter()
        world.render(state, ("rgb",))
        took.append(time.perf_counter() - began)
    return min(took)


def first_seed(world: World) -> int:
    """The seed whose episode begins with a good view: that on a learned world's card, else, of a learned world or a running game
    with depth, of a few the one with the widest and most varied view. 0 for other worlds."""
    named, spec = world.spec.card.get("seed"), world.spec
    if isinstance(named, int):
        return named
    game = not spec.forkable and "depth" in spec.channels
    if not game and spec.card.get("kind") not in ("learned", "latent") or "rgb" not in spec.channels:
        return 0
    return max(range(FIRST_SEEDS), key=lambda seed: _variety(world, seed))


@torch.inference_mode()
def _variety(world: World, seed: int) -> float:
    """The entropy of the colours of the first picture of an episode, in nats; times the logarithm of its median depth, if any."""
    names = [name for name in ("rgb", "depth") if name in world.spec.channels]
    seen = world.render(world.start(1, make_rng(seed)), names)
    colours = (seen["rgb"][0].cpu() // 32).long() @ torch.tensor([64, 8, 1])
    shares = torch.bincount(colours.flatten(), minlength=512) / colours.numel()
    entropy = float(-(shares * shares.clamp_min(1e-9).log()).sum())
    return entropy * math.log1p(float(seen["depth"].median())) if "depth" in seen else entropy


def _check(config: PlayConfig) -> None:
    if config.policy is not None and config.agent:
        raise TerrellaError("--policy and --agent both say who drives; give one of them.")
    if config.watts is not None and not config.watts > 0:
        raise TerrellaError(f"--watts {config.watts:g} is no power to play with; give watts above 0, as in --watts 5.")
    if config.memory_mb is not None and not config.memory_mb >= 0:
        raise TerrellaError(f"--memory-mb {config.memory_mb:g} is no memory; give 0 or more MiB, as in --memory-mb 8.")
    if not config.agent_ms > 0:
        raise TerrellaError("--agent-ms is a time above 0.")
    if config.compare and config.image is not None:
        raise TerrellaError("--image cannot be compared with a game, which cannot start from it; leave --compare out.")
    if config.record is not None and config.record.exists() and not config.record.is_dir():
        raise TerrellaError(f"--record {config.record}: that is a file; give a folder.")


def _driver(worlds: list[World], config: PlayConfig) -> Policy | Agents:
    if config.policy is not None:
        return Explorer(worlds[0].spec) if config.policy == "explore" else Random(worlds[0].spec, (3, 40))
    return PageAgents(worlds[0], worlds[1] if config.compare else None, config.agent, config.agent_ms).agents()


def _sink(world: World, keeper: KeyKeeper, folder: Path | None) -> SinkFactory | None:
    if folder is None:
        return None
    return lambda: Recorder(folder, keeper.with_keys(Layout.of(world.spec)), "play")


def _first_picture(path: Path, world: World) -> torch.Tensor:
    """The picture of an image file at the world's size. The world observes it once, so that errors are raised now."""
    if "rgb" not in world.spec.observes:
        raise ServeError(f"{world.spec.name} takes no pictures, so it cannot start from one; leave --image out.")
    height, width = world.spec.channels["rgb"].shape[:2]
    picture = read_picture(path, (height, width))
    world.observe({"rgb": picture[None]}, None, make_rng(0))
    return picture


def _game_beside(learned: World, name: str | None, progress: Progress) -> World:
    """The real game, at the picture size of the learned world; by default the game that it learned."""
    known = str(learned.spec.card.get("game"))
    name = name or (known if library.is_truth(known) else library.GAME)
    shape = learned.spec.channels["rgb"].shape if "rgb" in learned.spec.channels else None
    sizes = ("size", "depth_size") if name.startswith("doom") else ("size",)
    if library.is_truth(known) and name != known:
        progress(f"{learned.spec.name} learned {known}, and is compared with {name}.")
    return library.load(name, **(dict.fromkeys(sizes, shape[:2]) if shape and library.is_truth(name) else {}))
