"""Worlds by the names and on the devices that the commands take."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from .say import say

if TYPE_CHECKING:
    from ..core.spec import Spec
    from ..core.world import World
    from ..data import Layout

Device = Annotated[str, arg(help="cpu, cuda, mps, or auto: a GPU if there is one.")]
Fast = Annotated[bool, arg(help="Draw with ONNX Runtime, or with a compiled graph on a GPU, if that is faster here.")]


@dataclass(frozen=True)
class Controls:
    """What a person says of a world's actions; the rest the world says, or it is chosen.

    Args:
        keys: Keys and their actions, by name or number: a=left d=right space=2, up+space=5 for both at once, w=0,1,0 of axes.
        action_names: A name for every action, in order.
        idle: The action that does nothing.
    """

    keys: tuple[str, ...] = ()
    action_names: tuple[str, ...] = ()
    idle: str | None = None

    def of(self, world: World) -> World:
        """The world with what was said in its spec; the one that was given stays as it is."""
        if self == Controls():
            return world
        from ..core.keys import with_controls

        said = copy(world)
        said.spec = with_controls(world.spec, self.keys, self.action_names, self.idle)
        return said


class Keeper:
    """The spec with the keys and names that a person last set on the page. A folder that may keep them does (library.py): what is
    changed of `spec`, with which the page begins, is changed of `own`, the world's; what else `spec` says was said for once."""

    def __init__(self, spec: Spec, folder: Path | None = None, own: Spec | None = None):
        self.spec, self.folder = spec, folder
        self._first, self._own = spec, own or spec

    @property
    def place(self) -> str:
        """Where they are kept, for people; "" where only the browser keeps them."""
        return f"in the world's folder, {self.folder}" if self.folder else ""

    def noted(self, layout: Layout) -> Layout:
        """The layout of a recording that says the keys of now."""
        from ..data.channels import facts_of

        return replace(layout, world=facts_of(self.spec))

    def __call__(self, spec: Spec) -> None:
        from ..core.keys import with_changes
        from ..worlds.folder import save_keys

        self.spec = spec
        if self.folder:
            save_keys(self.folder, with_changes(self._own, self._first, spec))


@dataclass(frozen=True)
class Environment:
    """What a person says of a Gymnasium environment; the rest it says itself.

    Args:
        size: Height and width of the pictures of a Gymnasium environment; default: as drawn, Atari 64 64.
        fps: Steps a second of a Gymnasium environment, before gym:ID@N holds actions; default: as it says, or 10.
        adapter: A Python file (FILE.py or FILE.py:NAME) with an Adapter that says where depth, poses and more are found.
        randomise: A TOML or JSON file of distributions, of which each episode draws masses, friction, delay and more.
    """

    size: tuple[int, int] | None = None
    fps: float | None = None
    adapter: str | None = None
    randomise: str | None = None

    def open(self, name: str, forkable: bool = False, rgb: bool = True) -> World:
        """The world of this name, as was said. `forkable`: an environment that can be copied, or TerrellaError. `rgb`: with
        pictures."""
        from .. import library
        from ..core.errors import TerrellaError
        from ..sim import randomised

        if self.fps is not None and not 0 < self.fps < 10_000:
            raise TerrellaError(
                f"--fps {self.fps:g} is no number of steps a second; say how many a person plays, as in --fps 15."
            )
        if name.startswith("gym:ALE/") and (self.fps or self.adapter):
            raise TerrellaError("Atari games have a clock and names of their own; leave --fps and --adapter out.")
        options: dict[str, Any] = {"size": self.size} if self.size else {}
        options |= {"dt_s": 1 / self.fps} if self.fps else {}
        options |= {"adapter": library.load_adapter(self.adapter)} if self.adapter else {}
        if self.randomise is not None:
            world: World = replace(self, randomise=None).open(name, forkable, rgb)
            return randomised.Randomised(world, randomised.read(self.randomise))
        if name.startswith("mujoco:"):
            if self.adapter:
                raise TerrellaError("a MuJoCo model says itself what it shows; leave --adapter out.")
            if "dt_s" in options:
                options["control_s"] = options.pop("dt_s")
            options |= {} if rgb else {"cameras": ()}
            return library.load(name, **options)
        if options and not name.startswith("gym:"):
            raise TerrellaError(
                "--size, --fps and --adapter are for environments and MuJoCo; other worlds are as they are."
            )
        if forkable:
            options["forkable"] = True
        if not rgb:
            options["rgb"] = False
        return library.load(name, **options)


def load_named(name: str, device: str, memory: bool = True, fast: bool = False, **remembering: Any) -> World:
    """A world by name; only learned worlds have a device, a memory and a faster way of drawing."""
    from .. import library

    options: dict[str, Any] = {**remembering, **({"fast": True} if fast else {})}
    if not library.is_truth(name):
        options |= {"device": device_of(device), "memory": memory}
    world = library.load(name, **options)
    if fast:
        say(f"{name}: {world.spec.card.get('fast')}")
    return world


def device_of(name: str) -> str:
    """A device that this machine has, as torch spells it; TerrellaError where it has none of that name."""
    import torch

    from ..core.errors import TerrellaError

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        if name.startswith("cuda") and not torch.cuda.is_available():
            raise RuntimeError
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError, ValueError) as error:
        here = ["cpu", *(["cuda"] if torch.cuda.is_available() else []), *(["mps"] if torch.mps.is_available() else [])]
        what = "finds no GPU" if name.startswith("cuda") else "has no such device"
        raise TerrellaError(f"--device {name}: PyTorch {what} here; use {', '.join(here)} or auto.") from error
    return name
