"""Opens worlds and environments by name, as a person sets them up: the device, the size of pictures, keys, randomisation."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from .progress import Progress, silent

if TYPE_CHECKING:
    from ..core.world import World

Device = Annotated[str, arg(help="cpu, cuda, mps, or auto: CUDA if there is one, else the CPU.")]
Fast = Annotated[
    bool, arg(help="Draw with ONNX Runtime, or with a compiled graph on a GPU, if that is faster on this machine.")
]


@dataclass(frozen=True)
class ControlsConfig:
    """Names and keys of the actions; default: as the world declares them."""

    keys: tuple[str, ...] = ()
    """Keys and their actions, by name or number: a=left d=right space=2, up+space=5 for both at once, w=0,1,0 of axes."""
    action_names: tuple[str, ...] = ()  # A name for every action, in order.
    idle: str | None = None  # The action that does nothing.

    def of(self, world: World) -> World:
        """A copy of the world with these settings in its spec."""
        if self == ControlsConfig():
            return world
        from ..core.keys import with_controls

        changed = copy(world)
        changed.spec = with_controls(world.spec, self.keys, self.action_names, self.idle)
        return changed


@dataclass(frozen=True)
class EnvironmentConfig:
    """Settings of the environment; default: as it declares them."""

    size: tuple[int, int] | None = None
    """Height and width of the pictures of a Gymnasium environment; default: as drawn, Atari 64 64."""
    fps: float | None = None
    """Steps per second of a Gymnasium environment, not counting the action repeat N of gym:ID@N; default: as declared, or 10."""
    adapter: str | None = None
    """A Python file (FILE.py or FILE.py:NAME) with an Adapter that finds depth, poses and more."""
    task: str | None = None
    """A task of a ready robot: `road` or `road:SEED` (another town) of mujoco:car, `stack` and others of mujoco:table; the same
    as the name mujoco:car:road. `rooms` of doom:my_way_home: instructions that name a room."""
    randomise: str | None = None
    """A TOML or JSON file of distributions, from which each episode of a simulator draws masses, friction, delay and more."""

    def open(self, name: str, forkable: bool = False, rgb: bool = True) -> World:
        """The world of this name with these settings. `forkable`: its states can be copied, or TerrellaError. `rgb`: it
        renders pictures."""
        from .. import library
        from ..core.errors import TerrellaError
        from ..sim import randomised

        if self.task is not None:
            if not name.startswith(("mujoco:", "doom:")) and name != "doom":
                raise TerrellaError(
                    "--task is for the robots of MuJoCo and for maps of Doom; other worlds have one task."
                )
            name = f"{'doom:my_way_home' if name == 'doom' else name}:{self.task}"
        if self.fps is not None and not 0 < self.fps < 10_000:
            raise TerrellaError(
                f"--fps {self.fps:g} is no number of steps per second; give the rate at which a person plays, as in --fps 15."
            )
        if name.startswith("gym:ALE/") and (self.fps or self.adapter):
            raise TerrellaError("Atari games have a clock and names of their own; leave --fps and --adapter out.")
        if self.randomise is not None:
            world: World = replace(self, randomise=None, task=None).open(name, forkable, rgb)
            return randomised.Randomised(world, randomised.read(self.randomise))
        options: dict[str, Any] = {"size": self.size} if self.size else {}
        options |= {"dt_s": 1 / self.fps} if self.fps else {}
        options |= {"adapter": library.load_adapter(self.adapter)} if self.adapter else {}
        if name.startswith("mujoco:"):
            if self.adapter:
                raise TerrellaError("a MuJoCo model declares its own channels; leave --adapter out.")
            if "dt_s" in options:
                options["control_s"] = options.pop("dt_s")
            return library.load(name, **options) if rgb else library.load(name, cameras=(), **options)
        if name.startswith("physics:") and not options:
            return library.load(name, pictures=rgb)
        if options and not name.startswith("gym:"):
            raise TerrellaError(
                "--size, --fps and --adapter are for environments and MuJoCo; other worlds are as they are."
            )
        if forkable:
            options["forkable"] = True
        if not rgb:
            if not name.startswith("gym:") or name.startswith("gym:ALE/"):
                raise TerrellaError(
                    f"{name} always draws its pictures; only other gym:, mujoco: and physics: environments go without."
                )
            options["rgb"] = False
        return library.load(name, **options)


def load_named(
    name: str, device: str, memory: bool = True, fast: bool = False, *, progress: Progress = silent, **remembering: Any
) -> World:
    """A world by name. Only learned worlds have a device, a memory and a faster way of drawing."""
    from .. import library
    from ..learn.devices import describe_device

    options: dict[str, Any] = {**remembering, **({"fast": True} if fast else {})}
    if not library.is_truth(name):
        options |= {"device": device_of(device), "memory": memory}
        if options["device"] != "cpu":
            progress(f"{name} runs on {describe_device(options['device'])}")
    world = library.load(name, **options)
    if fast:
        progress(f"{name}: {world.spec.card.get('fast')}")
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
