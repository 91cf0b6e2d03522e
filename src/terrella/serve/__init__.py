"""Serving: any World played in a browser, over one WebSocket."""

from .picture import read_picture
from .recording import SinkFactory
from .server import ServeConfig, serve
from .timeline import TimelineConfig

__all__ = ["ServeConfig", "SinkFactory", "TimelineConfig", "read_picture", "serve"]
