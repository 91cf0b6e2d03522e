"""The page of a recording: its readings, marks for bad episodes, and the export of the good ones."""

import asyncio
import contextlib
import json
import math
import threading
from collections.abc import AsyncIterator, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Protocol

import numpy as np
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from ..core.errors import ServeError, TerrellaError
from . import readings
from .http_server import application, posted, serve_page, starting_command

_LONGEST_MESSAGE = 4096  # bytes of a POST, at most
_BUCKETS = 4096  # of a series, at most


class Viewable(Protocol):
    """A recording that can be viewed. One thread calls its methods; only `export` runs beside others. Each may raise a
    TerrellaError. A sensor has a name and a kind: "image", "depth", "points" or "vector". Episodes are numbered from 0."""

    def about(self) -> dict:
        """JSON: name, robot, fps (or None), notes (sentences), can_export, and sensors, a list of: name, label, kind,
        shape, dtype, names and units (one per number of a vector or column of points), frame, rate_hz (or None), camera
        (None, or its intrinsics, size, pose and mount as in the spec), and pose: None, or the columns of x and y,
        `quaternion` [w, x, y, z] or None, `yaw` or None, and `degrees`."""
        ...

    def listing(self) -> list[dict]:
        """JSON of every episode: rows, seconds, task."""
        ...

    def episode(self, number: int) -> dict:
        """JSON: number, seconds, task, start_ns (text or None), language ([[time_s, text], ...]), and sensors: name ->
        count and fault (a sentence, "" if it can be shown), without the sensors that the episode lacks."""
        ...

    def times(self, number: int, sensor: str) -> np.ndarray:
        """float64 [n] ascending: the time of each reading, in seconds since the episode began."""
        ...

    def reading(self, number: int, sensor: str, index: int) -> np.ndarray:
        """image uint8 [H, W, 3]; depth [h, w] metres, inf without a hit; points [n, k], x, y, z first."""
        ...

    def series(self, number: int, sensor: str) -> np.ndarray:
        """All readings of a vector, float64 [n, k]."""
        ...

    def marks(self) -> list[int]:
        """Numbers of the episodes marked bad."""
        ...

    def mark(self, number: int, bad: bool) -> None:
        """Marks an episode as bad or good, and saves that."""
        ...

    def export(self, path: Path, keep: Sequence[int], report: Callable[[int, int], None]) -> tuple[int, list[str]]:
        """Writes the episodes `keep` as a new recording into the folder `path`, which does not exist. It calls
        `report(done, of)` now and then, passes on its exceptions, and leaves no half-written files. Returns the number of
        episodes written, and sentences about losses and changes."""
        ...


class Exporting:
    """One export at a time, in its own thread, into the folder that the server chose."""

    def __init__(self, viewable: Viewable, path: Path | None):
        self._viewable, self.path = viewable, path
        self._thread: threading.Thread | None = None
        self._stopped = False
        self.status: dict = {"state": "idle", "text": "", "done": 0, "of": 0}

    def start(self, keep: Sequence[int]) -> None:
        """ServeError without a folder or episodes to write, or while another export is under way."""
        if self.path is None:
            raise ServeError("this page was opened for looking only; start it with a folder to export to.")
        if self._thread is not None and self._thread.is_alive():
            raise ServeError("an export is under way; wait until it is finished.")
        if self.path.exists():
            raise ServeError(f"{self.path} exists already; move it away, or export to another folder.")
        if not keep:
            raise ServeError("every episode is marked bad: there is nothing to export.")
        self.status = {"state": "running", "text": "", "done": 0, "of": len(keep)}
        self._thread = threading.Thread(target=self._run, args=(self.path, keep), name="export")
        self._thread.start()

    def stop(self) -> None:
        """Ends the running export at its next report, and waits for it."""
        self._stopped = True
        if self._thread is not None:
            self._thread.join()

    def _report(self, done: int, of: int) -> None:
        if self._stopped:
            raise ServeError("the export was stopped with the server.")
        self.status = {**self.status, "done": int(done), "of": int(of)}

    def _run(self, path: Path, keep: Sequence[int]) -> None:
        try:
            count, notes = self._viewable.export(path, keep, self._report)
            words = f"{count} episode{'s' * (count != 1)} written to {path}"
            words += f" of {len(keep)} marked good" if count != len(keep) else ""
            text = "; ".join([words, *(note.rstrip(".") for note in notes)])
            self.status = {**self.status, "state": "done", "text": text, "done": len(keep), "of": len(keep)}
        except (TerrellaError, OSError) as error:
            self.status = {**self.status, "state": "failed", "text": str(error)}
        except Exception as error:  # shown by the page; the trace goes to the terminal
            self.status = {**self.status, "state": "failed", "text": f"{type(error).__name__}: {error}"}
            raise


class _Routes:
    """Answers the page: one method per route, run by the one thread that reads the recording."""

    def __init__(self, viewable: Viewable, exporting: Exporting):
        self._viewable, self._exporting = viewable, exporting
        self._spans: dict[tuple[int, str], tuple[float, float]] = {}
        self._kinds = {sensor["name"]: sensor["kind"] for sensor in viewable.about()["sensors"]}
        self._names = list(self._kinds)

    def about(self, request: Request) -> Response:
        path = self._exporting.path
        about = {**self._viewable.about(), "export_to": str(path) if path else ""}
        about["command"] = starting_command()
        return JSONResponse({**about, "episodes": self._viewable.listing(), "bad": self._viewable.marks()})

    def episode(self, request: Request) -> Response:
        return JSONResponse(self._viewable.episode(request.path_params["number"]))

    def times(self, request: Request) -> Response:
        return _bytes(readings.times(self._viewable.times(request.path_params["number"], self._sensor(request))))

    def series(self, request: Request) -> Response:
        number, sensor = request.path_params["number"], self._sensor(request)
        start, stop = (_number(request, name, default) for name, default in (("from", -math.inf), ("to", math.inf)))
        buckets = int(min(max(_number(request, "buckets", 1024), 1), _BUCKETS))
        time_s, values = self._viewable.times(number, sensor), self._viewable.series(number, sensor)
        return _bytes(readings.series(time_s, values, start, stop, buckets, "pick" in request.query_params))

    def reading(self, request: Request) -> Response:
        number, sensor = request.path_params["number"], self._sensor(request)
        value = self._viewable.reading(number, sensor, request.path_params["index"])
        kind = self._kinds[sensor]
        if kind == "image":
            across = int(min(max(_number(request, "across", 8192), 16), 8192))
            return Response(readings.picture(value, across), media_type="image/jpeg")
        if kind == "depth":
            return _bytes(readings.depth(value, self._span(number, sensor)))
        if kind == "points":
            return _bytes(readings.points(value))
        raise ServeError(f"{sensor} is a vector: ask for its series.")

    def mark(self, number: int, bad: bool) -> Response:
        self._viewable.mark(number, bad)
        return JSONResponse({"bad": self._viewable.marks()})

    def export(self, request: Request) -> Response:
        if request.method == "POST":
            bad = set(self._viewable.marks())
            self._exporting.start([number for number in range(len(self._viewable.listing())) if number not in bad])
        return JSONResponse(self._exporting.status)

    def _sensor(self, request: Request) -> str:
        number = request.path_params["sensor"]
        if number >= len(self._names):
            raise ServeError(f"this recording has {len(self._names)} sensors, no sensor {number}; reload the page.")
        return self._names[number]

    def _span(self, number: int, sensor: str) -> tuple[float, float]:
        """Near and far of the depth colours, from a few readings of the episode."""
        if (number, sensor) not in self._spans:
            count = len(self._viewable.times(number, sensor))
            looks = sorted({(2 * part + 1) * count // 10 for part in range(5)})
            samples = []
            for at in looks:
                with contextlib.suppress(TerrellaError):  # the page reports a broken reading when it shows it
                    samples.append(self._viewable.reading(number, sensor, at)[::4, ::4])
            if len(self._spans) > 256:
                self._spans.clear()
            self._spans[number, sensor] = readings.depth_span(samples)
        return self._spans[number, sensor]


def _bytes(content: bytes) -> Response:
    return Response(content, media_type="application/octet-stream")


def _number(request: Request, name: str, default: float) -> float:
    try:
        value = float(request.query_params.get(name, default))
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise ServeError(f"{name} must be a number; reload the page.")
    return value


def build_viewer(
    viewable: Viewable,
    host: str = "127.0.0.1",
    token: str | None = None,
    export_to: str | Path | None = None,
) -> Starlette:
    """The ASGI application of `view`."""
    exporting = Exporting(viewable, Path(export_to) if export_to is not None else None)
    answers = _Routes(viewable, exporting)
    worker = ThreadPoolExecutor(1, thread_name_prefix="recording")

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        try:
            yield
        finally:
            await asyncio.get_running_loop().run_in_executor(None, exporting.stop)
            worker.shutdown(cancel_futures=True)

    def asks(method: Callable[..., Response], read: Callable | None = None) -> Callable:
        async def route(request: Request) -> Response:
            try:
                given = (request,) if read is None else await read(request)
                return await asyncio.get_running_loop().run_in_executor(worker, method, *given)
            except TerrellaError as error:
                return PlainTextResponse(str(error), 422)

        return route

    routes = [
        Route("/about", asks(answers.about)),
        Route("/episode/{number:int}", asks(answers.episode)),
        Route("/times/{number:int}/{sensor:int}", asks(answers.times)),
        Route("/series/{number:int}/{sensor:int}", asks(answers.series)),
        Route("/reading/{number:int}/{sensor:int}/{index:int}", asks(answers.reading)),
        Route("/mark", asks(answers.mark, _mark_of), methods=["POST"]),
        Route("/export", asks(answers.export), methods=["GET", "POST"]),
    ]
    return application("view/index.html", routes, lifespan, host, token)


async def _mark_of(request: Request) -> tuple[int, bool]:
    """The episode that was posted, and whether it is bad; ServeError for another body."""
    try:
        body = json.loads(await posted(request, _LONGEST_MESSAGE))
        number, bad = body["episode"], body["bad"]
    except (ServeError, ValueError, KeyError, TypeError, RecursionError):
        number, bad = None, None
    if type(number) is not int or type(bad) is not bool:
        raise ServeError("a mark is {episode: a whole number, bad: true or false}; reload the page.")
    return number, bad


def view(
    viewable: Viewable,
    port: int = 8766,
    host: str = "127.0.0.1",
    token: str | None = None,
    on_ready: Callable[[str], None] | None = None,
    export_to: str | Path | None = None,
) -> None:
    """Serves the page of a recording until interrupted. `on_ready` gets the address; `export_to`, which must not exist, is the one
    folder into which the page may export. On any address but this machine's own a token is mandatory: one is made if none is
    given, and the address carries it. ServeError where the port is taken."""
    build = lambda token: build_viewer(viewable, host, token, export_to)  # noqa: E731
    serve_page(build, host, port, token, on_ready, websockets=False)
