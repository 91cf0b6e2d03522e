"""Places from words and plans: rooms, doors, windows, stairs and furniture become boxes, light and Gaussians."""

from .bake import BuiltPlace, build
from .room_layout import RoomLayout, read_layout
from .text_layout import ParsedText, parse_text

__all__ = ["BuiltPlace", "ParsedText", "RoomLayout", "build", "parse_text", "read_layout"]
