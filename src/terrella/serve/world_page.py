"""A learned world as one HTML file that runs in a browser: its network, its memory and its keys, without a server."""

import base64
import gzip
import html
import json
import re
from collections.abc import Mapping
from typing import Any

from ..core.spec import Spec, neutral_action
from .http_server import WEB
from .keys import KeyBook
from .place_page import bundle_script, hash_of

PAGE = WEB / "world"


def world_html(spec: Spec, network: Mapping[str, Any], weights: bytes, world: Mapping[str, Any], data: bytes) -> bytes:
    """The page as HTML in UTF-8. network, weights: see web/world/network.js; world, data: see web/world/world.js. Keys are those of
    the spec; it loads nothing from anywhere."""
    script = f"(async () => {{\n'use strict';\n{bundle_script(PAGE / 'app.js')}}})();"
    style = (PAGE / "world.css").read_text("utf-8")
    allowed = f"script-src {hash_of(script)} 'wasm-unsafe-eval'; style-src {hash_of(style)}"
    book = KeyBook(spec).described()
    named = {code: book["actions"][index] for code, index in book["keys"].items()}
    about = {
        "network": network,
        "world": world,
        "dt_s": spec.dt_s,
        "rest": neutral_action(spec).ravel().tolist(),
        "keys": {code: [float(number) for number in value] for code, value in spec.keys.items()},
        "names": {code: action["name"] + action["sign"] for code, action in named.items()},
    }
    parts = {
        "policy": f"default-src 'none'; {allowed}; base-uri 'none'; form-action 'none'",
        "title": html.escape(f"{spec.name} · Terrella"),
        "name": html.escape(spec.name),
        "what": html.escape(str(spec.card.get("what", ""))) + ". A neural network draws every frame, in this browser.",
        "style": style,
        "script": script,
        "about": json.dumps(about).replace("<", "\\u003c"),
        "kernels": _packed((PAGE / "kernels.wasm").read_bytes()),
        "weights": _packed(weights),
        "bytes": _packed(data),
    }
    text = (PAGE / "index.html").read_text("utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], text).encode()


def _packed(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, mtime=0)).decode()
