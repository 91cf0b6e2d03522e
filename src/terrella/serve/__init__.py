"""Serving: any World played in a browser, over one WebSocket."""

from .picture import read_picture
from .recording import SinkFactory
from .server import ServeConfig, serve

__all__ = ["ServeConfig", "SinkFactory", "read_picture", "serve"]
