"""Serving: any World played in a browser, over one WebSocket."""

from .server import ServeConfig, serve
from .story import SinkFactory, StoryConfig

__all__ = ["ServeConfig", "SinkFactory", "StoryConfig", "serve"]
