"""WorldWrapper: the base class of worlds around worlds."""

from typing import Generic, TypeVar

from ..core.world import World

Inner = TypeVar("Inner", bound=World)


class WorldWrapper(Generic[Inner]):
    """A World around another one, as gymnasium.Wrapper is."""

    world: Inner  # The world inside.

    def close(self) -> None:
        close = getattr(self.world, "close", None)
        if close is not None:
            close()


def unwrapped(world: World) -> World:
    """The world inside all wrappers."""
    while isinstance(world, WorldWrapper):
        world = world.world
    return world
