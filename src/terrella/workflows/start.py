"""`play` without a name: a start page of the bundled worlds, and of the worlds, places and recordings below a folder."""

import io
import json
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from PIL import Image

from .. import library
from ..care import repair
from ..core.errors import ServeError, TerrellaError
from ..core.world import make_rng
from ..exchange.browse import browse
from ..serve import ServeConfig
from ..serve.place_page import build_place
from ..serve.server import Sessions, build_app
from ..serve.start_page import Build, StartCard, serve_start
from ..serve.viewer import build_viewer
from .build_space import BuildSpaceConfig, amount, build_plan, build_space
from .editable_place import editable_place
from .lift_space import LiftSpaceConfig, lift_space
from .opening import ControlsConfig
from .play import PlayConfig, first_seed, prepared
from .progress import Progress, silent

DEPTH = 3  # folders below the working directory that are searched
MOST_FOLDERS = 2000  # that are searched
HIDDEN = re.compile(
    r"[._]|(node_modules|venv|build|dist|src|tests)$"
)  # folders that are left out, by the start of their name
LONGEST_NAME = 40  # of the folder of a place that is built
TITLES = {
    "doom-maze": "Nine rooms to get lost in. It remembers them.",
    "doom-corridor": "Six monsters that shoot and fall. Space shoots back.",
    "islet": "A small island, seen from above.",
}


class FolderShelf:
    """The bundled worlds and the simulators, and what lies below `folder`."""

    def __init__(
        self, folder: Path, config: PlayConfig, controls: ControlsConfig, page: ServeConfig, progress: Progress
    ):
        self._folder, self._config, self._controls, self._page, self._progress = (
            folder,
            config,
            controls,
            page,
            progress,
        )
        self._doing = ""

    def cards(self) -> list[StartCard]:
        cards = []
        for entry in library.worlds():
            text = TITLES.get(entry.name) or str(entry.card.get("what", ""))
            cards.append(StartCard(entry.name, entry.name, "bundled" if entry.source == "bundled" else "game", text))
        for folder in _folders(self._folder):
            if card := _card_of(folder, self._folder):
                cards.append(card)
        return cards

    def thumbnail(self, name: str) -> bytes:
        still = library.BUNDLED / name / "thumbnail.jpg"
        if still.is_file():
            return still.read_bytes()
        if self._section(name) == "recording":
            return _jpeg(_picture_of_recording(name))
        world = library.load(name)
        return _jpeg(world.render(world.start(1, make_rng(first_seed(world))), ("rgb",))["rgb"][0].cpu().numpy())

    def open(self, name: str) -> Build:
        section = self._section(name)
        self._note("opening the place" if section == "place" else "")
        if section == "place":
            place = editable_place(name)
            return lambda host, token: build_place(place, host, token)
        if section == "recording":
            out = Path(name).resolve()
            return lambda host, token: build_viewer(
                browse(name, carry=repair), host, token, out.with_name(f"{out.name}-good")
            )
        worlds, page, options = prepared(name, self._config, self._controls, self._page, self._progress)
        sessions = Sessions(worlds, page, **options)
        return lambda host, token: build_app(sessions, host, token)

    def build(self, words: str) -> str:
        return self._made(words, lambda out: build_space(None, out, BuildSpaceConfig(text=words), progress=self._note))

    def build_plan(self, plan: Mapping[str, Any]) -> str:
        words = str(plan.get("words") or "a drawn plan")
        return self._made(words, lambda out: build_plan(plan, out, progress=self._note))

    def lift(self, name: str, picture: bytes) -> str:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / (re.sub(r"[^\w.-]+", "-", Path(name).name).lstrip(".-") or "picture")
            file.write_bytes(picture)
            try:
                return self._made(file.stem, lambda out: lift_space(file, out, LiftSpaceConfig(), progress=self._note))
            except TerrellaError as error:  # its folder is gone by the time that a person reads this
                raise ServeError(str(error).replace(str(file), file.name)) from error

    def progress(self) -> str:
        return self._doing

    def _note(self, text: str) -> None:
        self._doing = text

    def _made(self, words: str, make: Callable[[Path], object]) -> str:
        """Makes a place in a free folder that is named after words."""
        stem = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")
        stem = (stem if len(stem) <= LONGEST_NAME else stem[:LONGEST_NAME].rpartition("-")[0]) or "place"
        names = (f"{stem}-{number}" if number > 1 else stem for number in range(1, 1000))
        out = next(out for name in names if not (out := self._folder / "places" / name).exists())
        self._note("")
        make(out)
        return str(out)

    def _section(self, name: str) -> str:
        return next((card.section for card in self.cards() if card.name == name), "")


def start(
    config: PlayConfig | None = None,
    controls: ControlsConfig | None = None,
    page: ServeConfig | None = None,
    *,
    folder: Path = Path(),
    on_ready: Callable[[str], None] | None = None,
    progress: Progress = silent,
) -> None:
    """Serves the start page until interrupted. The settings are those of every world that is opened from it.

    folder: where worlds, places and recordings are searched, three folders deep; built places go to its folder "places".
    """
    page = page or ServeConfig()
    shelf = FolderShelf(folder, config or PlayConfig(), controls or ControlsConfig(), page, progress)
    serve_start(shelf, page.host, page.port, page.token, on_ready)


def _folders(root: Path) -> Iterator[Path]:
    """Folders that may hold a world or a recording, nearest first."""
    level, count = [root], 0
    for _ in range(DEPTH):
        below = []
        for folder in level:
            try:
                below += sorted(one for one in folder.iterdir() if one.is_dir() and not HIDDEN.match(one.name))
            except OSError:  # a folder that may not be read
                continue
        count += len(below)
        if count > MOST_FOLDERS:
            return
        yield from below
        level = [
            one for one in below if not (one / "world.json").exists() and not (one / "meta" / "info.json").exists()
        ]


def _card_of(folder: Path, root: Path) -> StartCard | None:
    """The card of a world, a place or a recording; None for other folders."""
    for file, read in ((folder / "meta" / "info.json", _recording_text), (folder / "world.json", _world_text)):
        if file.is_file():
            try:
                section, text = read(json.loads(file.read_text(encoding="utf-8")))
            except (OSError, ValueError, AttributeError, TypeError):
                return None
            title = str((folder if folder.name != "world" else folder.parent).relative_to(root))
            return StartCard(
                str(folder), *((text, section, title) if section == "place" and text else (title, section, text))
            )
    return None


def _recording_text(info: dict) -> tuple[str, str]:
    return "recording", ", ".join(amount(int(info[f"total_{what}s"]), what) for what in ("episode", "frame"))


def _world_text(about: dict) -> tuple[str, str]:
    """(section, text); of a place its name."""
    what = (about.get("about") or about).get("card") or about.get("card") or {}
    if about.get("kind") == "splat":
        return "place", str(about.get("name", ""))
    return "world", str(what.get("what", ""))


def _picture_of_recording(name: str):
    """A picture from the middle of the first episode: uint8 [H, W, 3]."""
    viewable = browse(name)
    sensor = next((one["name"] for one in viewable.about()["sensors"] if one["kind"] == "image"), None)
    if sensor is None:
        raise ServeError(f"{name} has no pictures.")
    return viewable.reading(0, sensor, len(viewable.times(0, sensor)) // 2)


def _jpeg(picture) -> bytes:
    image, data = Image.fromarray(picture), io.BytesIO()
    image.thumbnail((480, 360))
    image.save(data, "JPEG", quality=88)
    return data.getvalue()
