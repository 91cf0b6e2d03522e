"""Serving: any World played in a browser, over one WebSocket."""

from .picture import read_picture
from .server import ServeConfig, serve
from .story import SinkFactory, StoryConfig

__all__ = ["ServeConfig", "SinkFactory", "StoryConfig", "read_picture", "serve"]
