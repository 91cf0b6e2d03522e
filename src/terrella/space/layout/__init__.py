"""Places from words and plans: rooms, doors, windows, stairs and furniture become boxes, light and Gaussians."""

from .bake import Built, build
from .room_layout import RoomLayout, read_layout
from .words import Understood, understood

__all__ = ["Built", "RoomLayout", "Understood", "build", "read_layout", "understood"]
