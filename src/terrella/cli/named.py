"""Worlds by the names and on the devices that the commands take."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from .say import say

if TYPE_CHECKING:
    from ..core.world import World

Device = Annotated[str, arg(help="cpu, cuda, or auto: a GPU where there is one.")]


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
    import torch

    from ..core.errors import TerrellaError

    if name != "auto":
        if name.startswith("cuda") and not torch.cuda.is_available():
            raise TerrellaError(f"--device {name}: this PyTorch finds no GPU here; use --device cpu, or auto.")
        return name
    return "cuda" if torch.cuda.is_available() else "cpu"
