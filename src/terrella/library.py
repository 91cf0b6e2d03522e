"""Finds and opens worlds by name or path: the composition root for Python, which the command line imports too."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from .core.errors import TerrellaError
from .core.similar import did_you_mean
from .core.world import World
from .space.estimator import Estimator

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

    from .core.policy import Policy
    from .core.spec import Spec
    from .sim.gymnasium import Adapter

BUNDLED = Path(__file__).parent / "bundled"
GAME = "doom:my_way_home"
# games and environments to begin with: the packages that each needs, the command that installs them, and what it is
GAMES: dict[str, tuple[tuple[str, ...], str, str]] = {
    GAME: (("vizdoom",), "pip install 'terrella[sim]'", "ViZDoom with Freedoom's art: the game that doom-maze learned"),
    "gym:Islet-v0": ((), "", "a walk over an island, a small game of our own"),
    "gym:CartPole-v1": (("pygame",), "pip install 'terrella[sim]'", "any Gymnasium environment, by its id"),
    "gym:ALE/Pong-v5": (("ale_py",), "pip install 'terrella[atari]'", "any Atari game, by its id"),
    "physics:bouncing": (
        (), "", "a ball that bounces; also uniform, parabola, collision, pendulum, rolling, and stacking (with MuJoCo)",
    ),
    "mujoco:arm": (
        ("mujoco",), "pip install 'terrella[mujoco]'",
        "an arm; also table (an arm with blocks and a drawer, by instructions), car (car:road: in a town), drone, ant, "
        "humanoid, or any MJCF or URDF: mujoco:FILE.xml",
    ),
    "mujoco:go1": (
        ("mujoco", "mjlab"), "pip install 'terrella[mujoco]' && pip install --no-deps mjlab==1.6.0",
        "a quadruped; also g1 and yam",
    ),
}  # fmt: skip


class Entry(NamedTuple):
    """One available world: `load(name)` opens it. source: "bundled", "game" or "checkpoint"; card: facts for people."""

    name: str
    source: str
    card: Mapping[str, object]


def load(
    name: str | Path,
    *,
    remember: bool = False,
    estimator: str | Path | None = None,
    memory_mb: float | None = None,
    randomise: str | Path | None = None,
    **options: Any,
) -> World:
    """Opens a world.

    name:      a bundled world ("doom-maze"), the real game ("doom:my_way_home"), a Gymnasium environment ("gym:CartPole-v1"), a
               robot in MuJoCo ("mujoco:go1", "mujoco:car:road", "mujoco:FILE.xml"), or the path of a checkpoint folder or of a
               training run.
    remember:  adds a spatial memory (space/remembering.py) to a world without one.
    estimator: a file of `terrella train estimator`, or a world that has one: it estimates pose and depth for the memory, which
               it implies.
    memory_mb: the memory's budget in MiB per episode; default: as the world was saved, or 16.
    randomise: a TOML or JSON file of distributions, from which each episode draws (sim/randomised.py).
    options:   of a learned world those of its `load` (memory=False, device="cuda") and fast=True (ONNX Runtime or a compiled
               graph, where that is faster here: worlds/fast.py); of the game the fields of DoomConfig (size=(192, 256)); of
               MuJoCo those of MujocoWorld; of Gymnasium those of GymnasiumWorld (forkable=True makes states that can be copied).
    Raises TerrellaError (no such world, a missing optional package) or CheckpointError (a foreign or damaged folder).
    """
    if randomise is not None:
        from .sim import randomised

        distributions = randomised.read(randomise)
        same: dict[str, Any] = {"remember": remember, "estimator": estimator, "memory_mb": memory_mb, **options}
        return randomised.Randomised(load(name, **same), distributions)
    if remember or estimator is not None:
        from .space import remembering

        inner = load(name, memory_mb=None if is_truth(name) else memory_mb, **options)
        opened = None if estimator is None else open_estimator(estimator)
        return remembering.remember(inner, 16.0 if memory_mb is None else memory_mb, opened)
    text = str(name)
    if memory_mb is not None and is_truth(name):
        raise TerrellaError(
            f"{text} is the truth itself and remembers nothing; leave `memory_mb` out, or pass remember=True."
        )
    if options.get("fast") and is_truth(name):
        raise TerrellaError(f"{text} is the truth itself: only a learned world can be drawn faster; leave `fast` out.")
    if text == "doom" or text.startswith("doom:"):
        _require("vizdoom", "The real game needs ViZDoom", "sim")
        return _open_doom(text.partition(":")[2] or GAME.partition(":")[2], options)
    if text.startswith("mujoco:"):
        _require("mujoco", "MuJoCo's worlds need mujoco", "mujoco")
        from .sim.mujoco_world import MujocoConfig, MujocoWorld

        robot, _, task = text.partition(":")[2].partition(":")
        return MujocoWorld(robot, MujocoConfig(**({"task": task} if task else {}), **options))
    if text.startswith("physics:"):
        return _open_bodies(*text.split(":")[1:], **options)
    if text.startswith("gym:"):
        return _open_gymnasium(*_id_and_repeat(text), options)
    return _open_checkpoint(folder_of(name), options | {"memory_mb": memory_mb})


def _id_and_repeat(name: str) -> tuple[str, int]:
    """Of gym:ID@N the environment's id, and the number of steps for which each action is held."""
    match = re.fullmatch(r"gym:(.+)@(\d+)", name)
    if match is None:
        return name.partition(":")[2], 1
    if not 1 <= int(match[2]) <= 100:
        raise TerrellaError(f"{name}: the number after @ is for how many steps each action is held, 1 to 100.")
    return match[1], int(match[2])


def _open_doom(name: str, options: dict[str, Any]) -> World:
    """By "SCENARIO" or "SCENARIO:TASK"."""
    from .sim.doom import Doom, DoomConfig

    scenario, _, task = name.partition(":")
    config = DoomConfig(scenario=scenario, **options)
    if not task:
        return Doom(config)
    from .sim.doom_rooms import DoomRooms

    return DoomRooms(config, task)


def _open_gymnasium(env: str, repeat: int, options: dict[str, Any]) -> World:
    if env.startswith("ALE/"):
        _require("ale_py", "Atari games need ale-py", "atari")
        from .sim.atari import AtariWorld

        return AtariWorld(env, repeat=repeat, **options)
    from .sim.gymnasium import GymnasiumConfig, GymnasiumWorld

    if options.get("forkable") and _over_mujoco(env):
        from .sim.mujoco import MujocoSnapshots

        options = {"snapshots": MujocoSnapshots, **options}
    return GymnasiumWorld(env, GymnasiumConfig.of(repeat=repeat, **options))


def _open_bodies(family: str, split: str = "in", *rest: str, **options: Any) -> World:
    """physics:FAMILY or physics:FAMILY:out, a family of moving bodies."""
    from .sim.bodies import BodiesConfig, BodiesWorld

    if rest:
        raise TerrellaError("a family of bodies is physics:NAME, or physics:NAME:out beyond the ranges of training.")
    if family == "stacking":
        _require("mujoco", "Stacking needs mujoco", "mujoco")
        from .sim.stacking import stacking

        return stacking(split, **options)
    return BodiesWorld(family, BodiesConfig(**{"split": split, **options}))


def as_sb3(world: World, num_envs: int = 1, **options: Any) -> VecEnv:
    """`num_envs` episodes of a world as a VecEnv of Stable-Baselines3, with the options of `as_env`. TerrellaError where that is
    not installed."""
    _require("stable_baselines3", "as_sb3 needs Stable-Baselines3", "sb3")
    from .core.stable_baselines3 import WorldVecEnv

    return WorldVecEnv(world, num_envs, **options)


def load_policy(name: str | Path, spec: Spec, world: World | None = None) -> Policy:
    """A policy for the actions of `spec`, by its name.

    name:  random, idle, explorer; constant:VALUE (a number for each axis, or the action's name); plan, or with settings
           plan:samples=16,horizon=12, which plans for reward in `world`; the folder of a learned policy; MODULE:NAME or
           FILE.py:NAME of your own (a Policy, a function (observation, rng) -> actions, or a function of a Spec that returns
           one of these). With @0.3 after the name each action is replaced by a random one with probability 0.3.
    Raises TerrellaError for an unknown name, or a policy for other actions.
    """
    from .act.policies_by_name import policy_of

    return policy_of(str(name), spec, world)


def load_adapter(source: str) -> Adapter:
    """The `adapter` of a Python file, or the object NAME of "FILE.py:NAME": it finds an environment's depth, poses and more
    (sim/gymnasium.py)."""
    from .sim.environment_loading import load_adapter

    return load_adapter(source)


def is_truth(name: str | Path) -> bool:
    """Whether this is the name of a game or an environment, not of a learned world."""
    return str(name).partition(":")[0] in ("doom", "gym", "mujoco", "physics")


def folder_of(name: str | Path) -> Path:
    """The folder of a learned world: a bundled world by its name, a checkpoint, or the world of a training run."""
    text = str(name)
    if (BUNDLED / text / "world.json").is_file():
        return BUNDLED / text
    if Path(text).exists():
        runs = Path(text) / "world", Path(text) / "run" / "world"  # of `terrella train`, and of `terrella learn`
        if (Path(text) / "learn.json").is_file() and not (runs[1] / "world.json").is_file():
            raise TerrellaError(f"{text} has no world yet: `learn` saves the first one soon after its training begins.")
        return next((run for run in runs if (run / "world.json").is_file()), Path(text))
    bundled = sorted(_bundled())
    environment = f"; did you mean 'gym:{text}'?" if re.search(r"-v\d+$", text) else ""
    hint = environment or did_you_mean(text, [*bundled, GAME]) or "."
    raise TerrellaError(
        f"There is no world '{text}'{hint} Bundled are {', '.join(bundled) or 'none'}; the real game is {GAME}, an "
        "environment gym:CartPole-v1, a robot mujoco:go1; or give the path of a checkpoint folder."
    )


def folder_for_keys(name: str | Path) -> Path | None:
    """The folder of a learned world in which changed keys may be saved (worlds/folder.py); None for games, for bundled worlds, and
    for a folder that cannot be written."""
    folder = None if is_truth(name) else folder_of(name)
    if folder is None or folder.parent == BUNDLED:
        return None
    return folder if os.access(folder, os.W_OK) and os.access(folder / "world.json", os.W_OK) else None


def not_installed() -> dict[str, str]:
    """The games for which a package is missing, and the command that installs it."""
    return {name: install for name, (packages, install, _) in GAMES.items() if not all(map(find_spec, packages))}


def worlds(folders: Sequence[str | Path] = ()) -> list[Entry]:
    """The bundled worlds, the real games that are installed, and the checkpoints in or directly below `folders`."""
    entries = [Entry(name, "bundled", _read_card(BUNDLED / name)) for name in sorted(_bundled())]
    absent = not_installed()
    entries += [Entry(name, "game", {"what": what}) for name, (_, _, what) in GAMES.items() if name not in absent]
    for folder in map(Path, folders):
        if not folder.is_dir():
            raise TerrellaError(f"{folder} is not a folder; give one that holds checkpoints (each has a world.json).")
        patterns = ("world.json", "world/world.json", "*/world.json", "*/world/world.json")  # checkpoints, and runs
        paths = sorted({file.parent for pattern in patterns for file in folder.glob(pattern)})
        entries += [Entry(str(path), "checkpoint", _read_card(path)) for path in paths]
    return entries


def _over_mujoco(name: str) -> bool:
    """Whether an environment is one of Gymnasium's own over MuJoCo, by its id."""
    import gymnasium

    known = gymnasium.registry.get(name)
    return known is not None and "envs.mujoco" in str(known.entry_point) and find_spec("mujoco") is not None


def _bundled() -> list[str]:
    return [file.parent.name for file in BUNDLED.glob("*/world.json")]


def _read_card(folder: Path) -> Mapping[str, object]:
    from .worlds.checkpoint import read_about

    card = read_about(folder).get("card")
    return card if isinstance(card, dict) else {}


def _open_checkpoint(folder: Path, options: Mapping[str, Any]) -> World:
    from .worlds.folder import load_world, open_world

    rest = {name: value for name, value in options.items() if name != "fast"}
    if not options.get("fast"):
        return open_world(folder, **rest)
    from .worlds.fast import faster

    return faster(load_world(folder, **rest))[0]


def _require(module: str, need: str, extra: str) -> None:
    if not find_spec(module):
        raise TerrellaError(f"{need}, which is not installed: pip install 'terrella[{extra}]'.")


def open_estimator(source: str | Path) -> Estimator:
    """The estimator in a file of `terrella train estimator`, or of a world that has one."""
    from .space.estimator import Estimator, load_estimator

    if Path(source).is_file():
        return load_estimator(source)
    estimator = getattr(load(source), "estimator", None)
    if not isinstance(estimator, Estimator):
        raise TerrellaError(f"{source} has no estimator; give a file that `terrella train estimator` wrote.")
    return estimator
