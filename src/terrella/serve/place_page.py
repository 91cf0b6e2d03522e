"""A place of Gaussians as one HTML file that draws, walks and edits without a server, and a server that saves its edits."""

from __future__ import annotations

import asyncio
import base64
import gzip
import hashlib
import html
import json
import re
import threading
from collections.abc import Awaitable, Callable, Mapping, Sequence
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
from ..space.edits import Edit, merges_of
from ..space.files.compressed import packed_quats
from ..space.occupancy import Occupancy, samples
from ..space.raster import Gaussians
from ..space.raster.gaussians import Y0
from ..space.solids import Solids
from .http_server import WEB, application, posted, serve_page, starting_command
from .place_scene import PlaceScene
from .thing_page import PutThings, Spot, read_spot

PAGE = WEB / "place"
MOST_STARTS = 64
WHOLE = 150_000  # a place of at most this many Gaussians is sent in one part
FIRST = 50_000  # of a larger place this many, spread evenly, are sent first; the page shows them while the rest arrives
LONGEST_EDITS = 1 << 22  # bytes
LONGEST_WISH = 1 << 14  # bytes of a request for things or for a file
WATCH_S = 0.3  # between two looks whether a page still waits
Gone = Callable[[], bool]  # whether nobody waits for an answer any longer
_IMPORT = re.compile(r"^import \{ (.+) \} from '\./(\w+)\.js';\n", re.M)
_OWN = re.compile(r"things/[\w-]+")  # a thing that was put into this place, perhaps before the server was started anew
_EXPORT = re.compile(r"^export ((?:async )?(?:class|function|const) (\w+))", re.M)


class PlacePage:
    """The page of a place. It can be compared with the place `beside`, and merged with it by the edit `merge`. It loads nothing
    from anywhere: `policy` is its Content-Security-Policy."""

    def __init__(self, place: PlaceScene, beside: PlaceScene | None = None, merge: Edit | None = None):
        self._place, self._beside, self._compared = place, None, ""
        self.merged: dict[tuple[str, str], tuple[dict[str, Any], str]] = {}  # the places that merges add
        if beside is not None:
            about, self._compared = _packed_whole(beside)
            self._beside = {**about, "name": beside.name, "merge": merge}
            if merge is not None:
                self.merged[_merge_key(merge)] = {**about, "sha256": merge["sha256"]}, self._compared
        first = len(place.gaussians) if len(place.gaussians) <= WHOLE else FIRST
        self._packed, *parts = packed_place(place, first)
        self._data, self._rest = (base64.b64encode(part).decode() for part in parts)
        self._style = (WEB / "style.css").read_text("utf-8") + (PAGE / "place.css").read_text("utf-8")
        self._script = f"(async () => {{\n'use strict';\n{bundle_script(PAGE / 'app.js')}}})();"
        self.policy = (
            f"default-src 'none'; script-src {hash_of(self._script)}; worker-src blob:; style-src {hash_of(self._style)}; "
            "img-src data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'"
        )

    def html(
        self,
        edits: Sequence[Edit],
        save: str = "",
        watch: str = "",
        more: Mapping[str, Any] | None = None,
    ) -> bytes:
        """The page with these edits, as HTML in UTF-8. save: the address to which it posts edits, else it offers a file; watch:
        the address of newer states of a place that is being fitted, without editing; more: other addresses of a server: `things`,
        which builds what words name, `files`, which writes files, `relight`, which bakes another `light`, and `collider`, what
        stops walkers after edits; `key` goes with all that the page posts."""
        place, merged = self._place, list({_merge_key(edit): self._opened(edit) for edit in merges_of(edits)}.values())
        about = {
            **self._packed, "name": place.name, "body": asdict(place.body), "save": save, "watch": watch,
            **(more or {}),
            "starts": place.starts[:MOST_STARTS].tolist(), "pace": list(place.pace), "keep": list(place.keep), "dt_s": place.dt_s,
            "boxes": _boxes(place), "edits": list(edits), "merged": [about for about, _ in merged],
            "objects": list(place.names), "samples": samples().tolist(), "beside": self._beside, "note": place.note,
            "closed": place.closed, "after": None if save or watch else self._collider_after(edits),
            "command": starting_command() if save or watch else "",
        }  # fmt: skip
        parts = {
            "policy": self.policy, "title": html.escape(f"{place.name} · Terrella"), "style": self._style, "script": self._script,
            "world": json.dumps(about).replace("<", "\\u003c"), "data": self._data, "rest": self._rest, "beside": self._compared,
            "merged": " ".join(data for _, data in merged),
        }  # fmt: skip
        text = (PAGE / "index.html").read_text("utf-8")
        return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], text).encode()

    def add(self, put: PutThings) -> bytes:
        """Makes things known that the page may merge from now on; their merges and packed Gaussians, as JSON for put.js."""
        things = []
        for edit, scene, stands in zip(put.edits, put.scenes, put.stands):
            about, packed = _packed_whole(scene)
            self.merged[_merge_key(edit)] = {**about, "sha256": edit["sha256"]}, packed
            things.append({"edit": edit, "about": about, "data": packed, "stands": stands})
        return json.dumps({"things": things, "unknown": put.unknown}).encode()

    def _collider_after(self, edits: Sequence[Edit]) -> dict[str, Any] | None:
        """What stops walkers after edits that merge a place, for pages that cannot ask for it; None: the page reads it off the
        Gaussians."""
        if self._place.collider_after is None or all(_OWN.fullmatch(edit["place"]) for edit in merges_of(edits)):
            return None
        return packed_collider(self._place.collider_after(edits))

    def _opened(self, edit: Edit) -> tuple[dict[str, Any], str]:
        """The place that a merge adds, as the page reads it: its description and its packed Gaussians."""
        key = _merge_key(edit)
        if key not in self.merged and self._place.other:
            about, packed = _packed_whole(self._place.other(edit))
            self.merged[key] = {**about, "sha256": key[1]}, packed
        return self.merged[key]


def _merge_key(edit: Edit) -> tuple[str, str]:
    """The place that a merge adds, and its version."""
    return edit["place"], edit["sha256"]


def _packed_whole(place: PlaceScene) -> tuple[dict[str, Any], str]:
    """A place in one part, as scene.js unpacks it: its description, and its columns in gzip and base64."""
    packed = gzip.compress(_packed(place, torch.ones(len(place.gaussians), dtype=torch.bool)), 6, mtime=0)
    about = {
        "count": len(place.gaussians), "boxes": _boxes(place), "objects": list(place.names), "closed": place.closed,
    }  # fmt: skip
    return about, base64.b64encode(packed).decode()


def packed_place(place: PlaceScene, first: int) -> tuple[dict[str, Any], bytes, bytes]:
    """A place as scene.js and solid.js unpack it: a description with `count`, `first` and `solid`; in gzip, what is solid and the
    columns of `first` Gaussians, spread over all surfaces; and in gzip the columns of the rest, empty if there is none."""
    count, (solid, cubes) = len(place.gaussians), _packed_solid(place.collider)
    chosen = spread_over(place.gaussians, first)
    parts = [cubes + _packed(place, chosen), _packed(place, ~chosen) if first < count else b""]
    early, late = (gzip.compress(part, 6, mtime=0) if part else b"" for part in parts)
    return {"count": count, "first": first, "solid": solid}, early, late


def spread_over(gaussians: Gaussians, many: int) -> torch.Tensor:
    """`many` of the Gaussians, bool [N]: one in each cube of the finest grid that has no more cubes than that, then others."""
    chosen, left = torch.zeros(len(gaussians), dtype=torch.bool), gaussians.opacities > 0
    if many >= len(gaussians):
        return ~chosen
    for cell in 20.0 / 2.0 ** torch.arange(12):
        cubes = (gaussians.means[left] / cell).floor().long() & 0xFFFFF
        _, one = np.unique(cubes @ torch.tensor([1 << 40, 1 << 20, 1]), return_index=True)
        if len(one) > many:
            break
        chosen[:] = False
        chosen[left.nonzero()[one, 0]] = True
    others = (~chosen).nonzero()[:, 0]
    more = many - int(chosen.sum())
    chosen[others[torch.arange(more) * len(others) // max(more, 1)]] = True
    return chosen


def bundle_script(path: Path) -> str:
    """A script with all its imports from its own folder as one script: each module is a function that returns its exports."""
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
        lambda match: f"const {{ {match[1].replace(' as ', ': ')} }} = m_{match[2]};\n", file.read_text("utf-8")
    )
    names = [name for _, name in _EXPORT.findall(text)]
    body = _EXPORT.sub(r"\1", text)
    return body if last else f"const m_{file.stem} = (() => {{\n{body}return {{ {', '.join(names)} }};\n}})();"


def hash_of(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _packed(place: PlaceScene, chosen: torch.Tensor) -> bytes:
    """The columns of some Gaussians that scene.js reads: means in float32, because edits select by them, the rest in bytes."""
    scene = place.gaussians.at(chosen)
    if place.objects.numel() and int(place.objects.abs().max()) > 65535:
        raise ServeError(f"{place.name} has more than 65,535 objects, and a page shows no more.")
    byte = lambda part: part.round().clamp(0, 255).to(torch.uint8).contiguous().numpy().tobytes()  # noqa: E731
    return b"".join([
        _by_bytes(scene.means.numpy(), "<f4"), _by_bytes(packed_quats(scene.quats).numpy(), "<u4"),
        byte((scene.scales.clamp_min(1e-9).log() + 10) * 16), byte(204 * (0.5 + Y0 * scene.sh[:, 0])), byte(255 * scene.opacities),
        byte(place.seen[chosen].float()), _by_bytes(place.objects[chosen].numpy(), "<i4"),
    ])  # fmt: skip


def _packed_solid(occupancy: Occupancy | Solids) -> tuple[dict[str, Any], bytes]:
    """A collider as solid.js reads it: a bit for each cell, and for a solid cell a byte, the height of the surface in it. Boxes
    are sent as numbers instead."""
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


def packed_collider(collider: Occupancy | Solids) -> dict[str, Any]:
    """A collider as solid.js unpacks it by itself: boxes, or a description and its cells in gzip and base64."""
    if isinstance(collider, Solids):
        return {"boxes": collider.boxes.tolist()}
    about, cells = _packed_solid(collider)
    return {"boxes": [], "solid": about, "data": base64.b64encode(gzip.compress(cells, 6, mtime=0)).decode()}


def _boxes(place: PlaceScene) -> list[list[float]]:
    return place.collider.boxes.tolist() if isinstance(place.collider, Solids) else []


def _by_bytes(numbers: np.ndarray, kind: str) -> bytes:
    """All first bytes, then all second bytes, ...: this compresses better."""
    flat = np.ascontiguousarray(numbers).ravel().astype(kind)
    return flat.view(np.uint8).reshape(len(flat), -1).T.tobytes()


@dataclass(frozen=True)
class EditablePlace:
    """A place with the edits that its page shows and changes."""

    scene: PlaceScene
    edits: Callable[[], Sequence[Edit]]  # those in force now
    save: Callable[
        [str], None
    ]  # replaces them with lines of JSON, or raises a TerrellaError, whose sentence the page shows
    beside: PlaceScene | None = None  # a place to compare it with
    merge: Edit | None = None  # the edit that merges that place; None where it cannot be merged
    put: Callable[[str, Spot], PutThings] | None = None  # builds what words name; may raise a TerrellaError
    # Writes a file; calls a function before each of its pictures with their number so far and in all. May raise a TerrellaError.
    export: Callable[[Mapping[str, Any], Callable[[int, int], None]], bytes] | None = None
    light: Callable[[], Mapping[str, Any] | None] | None = (
        None  # of a built place: time, sun, and the times that there are
    )
    relight: Callable[[Mapping[str, Any]], PlaceScene] | None = None  # bakes another light; may raise a TerrellaError
    key: str = ""  # tells its page's requests from those of a page whose place the server showed before


def build_place(place: EditablePlace, host: str = "127.0.0.1", token: str | None = None) -> Starlette:
    """The ASGI application of a place: its page with the edits so far; /edits, to which the page posts the edits that it believes
    to be saved and those to save; /things, which builds furniture by words; /files, which writes the place; /drawn, how many
    pictures of a film are drawn; /relight, which bakes another light; and /collider, what stops walkers after edits."""
    scene, page, lock = place.scene, PlacePage(place.scene, place.beside, place.merge), threading.Lock()
    writing, drawn = threading.Lock(), [0, 0]  # one file at a time, while edits go on; pictures so far and in all

    def save(content: bytes, _: Gone) -> None:
        posted_edits = _wished(place, content)
        with lock:
            if [json.loads(line) for line in posted_edits["saved"].splitlines() if line] != list(place.edits()):
                raise ServeError("the place was edited elsewhere since this page was opened; reload the page.")
            _edits_of(page, posted_edits["lines"])
            place.save(posted_edits["lines"])

    def write_file(content: bytes, gone: Gone) -> bytes:
        wish = _wished(place, content)
        assert place.export is not None
        with writing:
            return place.export(wish, _counting(drawn, gone))

    def build_things(content: bytes, _: Gone) -> bytes:
        wish = _wished(place, content)
        assert place.put is not None
        with lock:
            return page.add(place.put(str(wish["words"]), read_spot(wish["spot"])))

    def relight(content: bytes, _: Gone) -> None:
        nonlocal page
        wish = _wished(place, content)
        assert place.relight is not None
        with lock:
            page = PlacePage(place.relight(wish), place.beside, place.merge)

    def close(content: bytes, _: Gone) -> bytes:
        edits, after = _edits_of(page, _wished(place, content)["lines"]), scene.collider_after
        assert after is not None
        with lock:
            return json.dumps(packed_collider(after(edits))).encode()

    offered = [
        ("edits", save, LONGEST_EDITS, "edits are lines of JSON"),
        ("things", build_things if place.put else None, LONGEST_WISH, "a thing has words and a spot"),
        ("files", write_file if place.export else None, LONGEST_WISH, "a file has a kind"),
        ("drawn", lambda *_: json.dumps(drawn).encode(), LONGEST_WISH, "no content is read"),
        ("relight", relight if place.relight else None, LONGEST_WISH, "a light has a time of day"),
        ("collider", close if scene.collider_after else None, LONGEST_EDITS, "edits are lines of JSON"),
    ]
    routes = [
        Route(f"/{name}", _posting(work, most, form), methods=["POST"]) for name, work, most, form in offered if work
    ]
    more = {"key": place.key} | {name: f"/{name}" for name, work, *_ in offered[1:] if work}
    light = place.light or (lambda: None)
    html = lambda: page.html(place.edits(), "/edits", more={**more, "light": light()})  # noqa: E731
    return application(html, routes, None, host, token, page.policy)


def _counting(drawn: list[int], gone: Gone) -> Callable[[int, int], None]:
    """Keeps the pictures so far and in all in `drawn`; ServeError once nobody waits for them."""
    drawn[:] = 0, 0

    def count(done: int, total: int) -> None:
        if gone():
            raise ServeError("the film was stopped.")
        drawn[:] = done, total

    return count


def _edits_of(page: PlacePage, lines: str) -> list[Edit]:
    """The edits in lines of JSON; ServeError where they merge a place that the page does not know."""
    edits = [json.loads(line) for line in lines.splitlines() if line]
    if any(_merge_key(edit) not in page.merged and not _OWN.fullmatch(edit["place"]) for edit in merges_of(edits)):
        raise ServeError(
            "this page merges only the place that it was opened beside: `terrella space view PLACE --beside OTHER`."
        )
    return edits


def _wished(place: EditablePlace, content: bytes) -> Mapping[str, Any]:
    """What a page posts, if it is the page of this place."""
    wish = json.loads(content)
    if wish.get("key", place.key) != place.key:
        raise ServeError(
            "the server has opened another place since; open this one from the start page in a new tab, then try again here."
        )
    return wish


def _posting(
    work: Callable[[bytes, Gone], bytes | None], most: int, form: str
) -> Callable[[Request], Awaitable[Response]]:
    """Answers POSTs with what `work` makes of a body of `most` bytes at most; a sentence where it cannot. form: what a body is."""

    async def answer(request: Request) -> Response:
        gone, watch = threading.Event(), None
        try:
            body = await posted(request, most)
            watch = asyncio.create_task(_watch(request, gone))
            content = await run_in_threadpool(work, body, gone.is_set)
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
            return PlainTextResponse(f"{form}; reload the page.", 422)
        except TerrellaError as error:
            return PlainTextResponse(str(error), 422)
        finally:
            if watch is not None:
                watch.cancel()
        return Response(content or b"", media_type="application/json" if content else "text/plain")

    return answer


async def _watch(request: Request, gone: threading.Event) -> None:
    """Sets `gone` once the page that asked is closed, or has stopped waiting."""
    while not await request.is_disconnected():
        await asyncio.sleep(WATCH_S)
    gone.set()


def serve_place(
    place: EditablePlace,
    port: int = 8767,
    host: str = "127.0.0.1",
    token: str | None = None,
    on_ready: Callable[[str], None] | None = None,
) -> None:
    """Serves the page of a place until interrupted. On any address but this machine's own a token is mandatory, because the page
    can change the place: one is made if none is given; `on_ready` gets the address with it. ServeError where the port is taken."""
    serve_page(lambda token: build_place(place, host, token), host, port, token, on_ready, websockets=False)
