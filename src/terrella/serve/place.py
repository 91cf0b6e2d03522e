"""A place of Gaussians as one HTML file that draws, walks and edits by itself, also from a disk; and a server that keeps its
edits."""

from __future__ import annotations

import base64
import contextlib
import gzip
import hashlib
import html
import json
import re
import threading
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from ..core.errors import ServeError, TerrellaError
from ..space.edits import Edit, merges
from ..space.files.compressed import packed_quats
from ..space.occupancy import Occupancy, Walker, samples
from ..space.raster import Gaussians
from ..space.raster.gaussians import Y0
from ..space.solids import Solids
from .door import WEB, application, posted, serve_page
from .frames import FrameRenderer

PAGE = WEB / "place"
MOST_STARTS = 64
WHOLE, FIRST = (
    150_000,
    50_000,
)  # Gaussians: of more, so many spread over all of them come first, and show the place meanwhile
LONGEST_EDITS = 1 << 22  # bytes
_IMPORT = re.compile(r"^import \{ (.+) \} from '\./(\w+)\.js';\n", re.M)
_EXPORT = re.compile(r"^export ((?:async )?(?:class|function|const) (\w+))", re.M)


@dataclass(frozen=True)
class PlaceScene:
    """What the page shows: Gaussians before all edits, of which `seen` bool [N] were observed, and objects int32 [N] says to which
    object each belongs (0: none) of those that `names` lists; starts [S, 7] poses; what is solid and who walks; pace and keep as a
    SplatConfig has them, and dt_s of a step; `other` opens the place that an edit merges."""

    name: str
    gaussians: Gaussians
    seen: torch.Tensor
    objects: torch.Tensor
    starts: torch.Tensor
    collider: Occupancy | Solids
    body: Walker
    pace: Sequence[float]
    keep: Sequence[float]
    dt_s: float
    names: Sequence[str] = ()
    other: Callable[[Edit], PlaceScene] | None = None


class PlacePage:
    """The page of a place, to compare with `beside` if that is given, and to merge with it if `merge` says how an edit does. It
    loads nothing from anywhere: `policy` is its Content-Security-Policy."""

    def __init__(self, place: PlaceScene, beside: PlaceScene | None = None, merge: Edit | None = None):
        self._place, self._beside, self._compared = place, None, ""
        self.merged: dict[tuple[str, str], tuple[dict[str, Any], str]] = {}  # what merges bring to it
        if beside is not None:
            told, self._compared = _whole(beside)
            self._beside = {**told, "name": beside.name, "merge": merge}
            if merge is not None:
                self.merged[_key(merge)] = {**told, "sha256": merge["sha256"]}, self._compared
        first = len(place.gaussians) if len(place.gaussians) <= WHOLE else FIRST
        self._packed, *parts = packed_place(place, first)
        self._data, self._rest = (base64.b64encode(part).decode() for part in parts)
        self._style = (WEB / "style.css").read_text("utf-8") + (PAGE / "place.css").read_text("utf-8")
        self._script = f"(async () => {{\n'use strict';\n{bundled(PAGE / 'app.js')}}})();"
        self.policy = (
            f"default-src 'none'; script-src {_hash(self._script)}; worker-src blob:; style-src {_hash(self._style)}; "
            "img-src data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'"
        )

    def html(self, edits: Sequence[Edit], save: str = "", watch: str = "", frames: str = "") -> bytes:
        """HTML in UTF-8, with the edits so far. `save`: the address to which it posts edits; without one it offers them as a
        file. `watch`: the address that has newer states of a place that is being made, which is not edited meanwhile. `frames`: the
        address that draws for browsers that cannot."""
        place, merged = self._place, list({_key(edit): self._brought(edit) for edit in merges(edits)}.values())
        about = {
            **self._packed, "name": place.name, "body": asdict(place.body), "save": save, "watch": watch, "frames": frames,
            "starts": place.starts[:MOST_STARTS].tolist(), "pace": list(place.pace), "keep": list(place.keep), "dt_s": place.dt_s,
            "boxes": _boxes(place), "edits": list(edits), "merged": [told for told, _ in merged],
            "objects": list(place.names), "samples": samples().tolist(), "beside": self._beside,
        }  # fmt: skip
        parts = {
            "policy": self.policy, "title": html.escape(f"{place.name} · Terrella"), "style": self._style, "script": self._script,
            "world": json.dumps(about).replace("<", "\\u003c"), "data": self._data, "rest": self._rest, "beside": self._compared,
            "merged": " ".join(data for _, data in merged),
        }  # fmt: skip
        text = (PAGE / "index.html").read_text("utf-8")
        return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], text).encode()

    def _brought(self, edit: Edit) -> tuple[dict[str, Any], str]:
        """What a merge brings, as the page has it: what is said of it, and its Gaussians."""
        key = _key(edit)
        if key not in self.merged and self._place.other:
            told, packed = _whole(self._place.other(edit))
            self.merged[key] = {**told, "sha256": key[1]}, packed
        return self.merged[key]


def _key(edit: Edit) -> tuple[str, str]:
    """What a merge brings, and how it was then."""
    return edit["place"], edit["sha256"]


def _whole(place: PlaceScene) -> tuple[dict[str, Any], str]:
    """What scene.js unpacks of a place that comes in one: what is said of it, and its columns in gzip and base64."""
    packed = gzip.compress(_packed(place, torch.ones(len(place.gaussians), dtype=torch.bool)), 6, mtime=0)
    told = {"count": len(place.gaussians), "boxes": _boxes(place), "objects": list(place.names)}
    return told, base64.b64encode(packed).decode()


def packed_place(place: PlaceScene, first: int) -> tuple[dict[str, Any], bytes, bytes]:
    """What scene.js and solid.js unpack: `count`, `first` and `solid`; what is solid and the columns of so many Gaussians,
    which are spread over all, in gzip; and the columns of the rest, empty where there is none."""
    count, (solid, cubes) = len(place.gaussians), _packed_solid(place.collider)
    chosen = torch.zeros(count, dtype=torch.bool)
    chosen[torch.arange(first) * count // max(first, 1)] = True
    parts = [cubes + _packed(place, chosen), _packed(place, ~chosen) if first < count else b""]
    early, late = (gzip.compress(part, 6, mtime=0) if part else b"" for part in parts)
    return {"count": count, "first": first, "solid": solid}, early, late


def bundled(path: Path) -> str:
    """A script and all that it imports from its own folder as one: each module a function that returns what it exports."""
    order: list[Path] = []

    def visit(file: Path) -> None:
        for _, name in _IMPORT.findall(file.read_text("utf-8")):
            visit(file.with_name(f"{name}.js"))
        if file not in order:
            order.append(file)

    visit(path)
    return "\n".join(_module(file, last=file == path) for file in order)


def _module(file: Path, last: bool) -> str:
    text = _IMPORT.sub(
        lambda found: f"const {{ {found[1].replace(' as ', ': ')} }} = m_{found[2]};\n", file.read_text("utf-8")
    )
    names = [name for _, name in _EXPORT.findall(text)]
    body = _EXPORT.sub(r"\1", text)
    return body if last else f"const m_{file.stem} = (() => {{\n{body}return {{ {', '.join(names)} }};\n}})();"


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _packed(place: PlaceScene, chosen: torch.Tensor) -> bytes:
    """The columns of some Gaussians that scene.js reads: places whole, for edits choose by them; the rest in bytes."""
    scene = place.gaussians.at(chosen)
    if place.objects.numel() and int(place.objects.max()) > 65535:
        raise ServeError(f"{place.name} has more than 65,535 objects, and a page shows no more.")
    byte = lambda part: part.round().clamp(0, 255).to(torch.uint8).contiguous().numpy().tobytes()  # noqa: E731
    return b"".join([
        _by_bytes(scene.means.numpy(), "<f4"), _by_bytes(packed_quats(scene.quats).numpy(), "<u4"),
        byte((scene.scales.clamp_min(1e-9).log() + 10) * 16), byte(204 * (0.5 + Y0 * scene.sh[:, 0])), byte(255 * scene.opacities),
        byte(place.seen[chosen].float()), _by_bytes(place.objects[chosen].clamp(0, 65535).numpy(), "<u2"),
    ])  # fmt: skip


def _packed_solid(occupancy: Occupancy | Solids) -> tuple[dict[str, Any], bytes]:
    """What solid.js reads: a bit for each cube, and for solid ones a byte that says where in it the surface is; boxes
    need nothing."""
    if isinstance(occupancy, Solids):
        return {}, b""
    solid = occupancy.solid.numpy()
    floors = occupancy.origin[2] + occupancy.cell_m * torch.arange(solid.shape[2])
    within = ((occupancy.top - floors) / occupancy.cell_m).clamp(0, 1).mul(255).round().to(torch.uint8).numpy()
    about = {
        "origin": occupancy.origin.tolist(),
        "cell": occupancy.cell_m,
        "size": list(solid.shape),
        "filled": int(solid.sum()),
    }
    return about, np.packbits(solid.ravel()).tobytes() + within[solid].tobytes()


def _boxes(place: PlaceScene) -> list[list[float]]:
    return place.collider.boxes.tolist() if isinstance(place.collider, Solids) else []


def _by_bytes(numbers: np.ndarray, kind: str) -> bytes:
    """All first bytes, then all second ones: they compress better so."""
    flat = np.ascontiguousarray(numbers).ravel().astype(kind)
    return flat.view(np.uint8).reshape(len(flat), -1).T.tobytes()


def build_place(
    place: PlaceScene,
    edits: Callable[[], Sequence[Edit]],
    save: Callable[[str], None],
    host: str = "127.0.0.1",
    token: str | None = None,
    beside: PlaceScene | None = None,
    merge: Edit | None = None,
) -> Starlette:
    """The ASGI application of a place: its page with the `edits` so far, and /edits, to which it posts those that it knows to be
    saved and those that are to be, as lines of JSON; `save` keeps them or raises a TerrellaError, whose sentence the page shows.
    `beside` is what the place can be compared with, and merged with as `merge` says."""
    page, alone, frames = (
        PlacePage(place, beside, merge),
        threading.Lock(),
        FrameRenderer(place.gaussians, place.objects, edits, place.other),
    )

    def kept(content: bytes) -> None:
        told = json.loads(content)
        with alone:
            if [json.loads(line) for line in told["saved"].splitlines() if line] != list(edits()):
                raise ServeError("the place was edited elsewhere since this page was opened; reload the page.")
            lines = [json.loads(line) for line in told["lines"].splitlines() if line]
            if any(_key(edit) not in page.merged for edit in merges(lines)):
                raise ServeError(
                    "this page merges what it was opened beside, nothing else: `terrella space view PLACE --beside OTHER`."
                )
            save(told["lines"])

    async def keep(request: Request) -> PlainTextResponse:
        try:
            await run_in_threadpool(kept, await posted(request, LONGEST_EDITS))
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
            return PlainTextResponse("edits are lines of JSON; reload the page.", 422)
        except TerrellaError as error:
            return PlainTextResponse(str(error), 422)
        return PlainTextResponse("")

    async def draw(request: Request) -> Response:
        try:
            return Response(await run_in_threadpool(frames.draw, request.query_params), media_type="image/jpeg")
        except TerrellaError as error:
            return PlainTextResponse(str(error), 422)

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        yield

    routes = [Route("/edits", keep, methods=["POST"]), Route("/frame", draw)]
    return application(
        lambda: page.html(edits(), "/edits", frames="/frame"), routes, lifespan, host, token, page.policy
    )


def serve_place(
    place: PlaceScene,
    edits: Callable[[], Sequence[Edit]],
    save: Callable[[str], None],
    port: int = 8767,
    host: str = "127.0.0.1",
    token: str | None = None,
    on_ready: Callable[[str], None] | None = None,
    beside: PlaceScene | None = None,
    merge: Edit | None = None,
) -> None:
    """Serves the page of a place until interrupted; `edits`, `save`, `beside` and `merge` as `build_place` has them.

    On any address but this machine's own a token is mandatory, for the page can change the place: where none is given one is
    made, and the address carries it. ServeError where the port is taken.
    """
    build = lambda token: build_place(place, edits, save, host, token, beside, merge)  # noqa: E731
    serve_page(build, host, port, token, on_ready, websockets=False)
