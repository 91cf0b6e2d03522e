"""One function for places: of words, of a layout, of one or several pictures, of a panorama or of a video."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from ..core.errors import TerrellaError
from ..learn.recipes.splat_views import SplatFit
from .build_space import BuildSpaceConfig, build_space, fit_space
from .lift_space import LiftSpaceConfig, lift_space
from .progress import Progress, silent
from .splat_places import SpaceResult

PlaceConfig = BuildSpaceConfig | LiftSpaceConfig | SplatFit
KINDS: dict[str, type[PlaceConfig]] = {
    "text": BuildSpaceConfig, "layout": BuildSpaceConfig, "image": LiftSpaceConfig, "panorama": LiftSpaceConfig,
    "images": SplatFit, "video": SplatFit,
}  # fmt: skip


Source = str | Path | None


def generate_place(
    out: str | Path,
    *,
    text: str | None = None,
    layout: Source = None,
    image: Source = None,
    panorama: Source = None,
    images: Source = None,
    video: Source = None,
    config: PlaceConfig | None = None,
) -> SpaceResult:
    """Makes a place in the folder `out`, as `terrella space build` (of `text` or a `layout` file), `terrella space lift` (of an
    `image` or `panorama` file) and `terrella space fit` (of `images`, a folder, or a `video` file: the place is OUT/world) do;
    `terrella.load(out)` opens it. Fits that were stopped go on. TerrellaError unless exactly one of them is given, with its own
    config: BuildSpaceConfig, LiftSpaceConfig or SplatFit. `terrella.start_place` does the same in the background."""
    sources = {"text": text, "layout": layout, "image": image, "panorama": panorama, "images": images, "video": video}
    return make_place(Path(out), *checked_source(sources, config), silent)


def checked_source(sources: Mapping[str, Source], config: PlaceConfig | None) -> tuple[str, str, PlaceConfig]:
    """The kind of the source that is given, the source, and its settings. TerrellaError unless one is given, with its config."""
    given = [name for name, source in sources.items() if source is not None]
    unknown = sorted(set(given) - set(KINDS))
    if len(given) != 1 or unknown:
        wrong = f"there is no {unknown[0]}=" if unknown else f"got {len(given)} of them"
        raise TerrellaError(f"give one of {', '.join(f'{name}=' for name in KINDS)}; {wrong}.")
    (name,), settings = given, config or KINDS[given[0]]()
    if not isinstance(settings, KINDS[name]):
        raise TerrellaError(f"the config of {name}= is a {KINDS[name].__name__}, not a {type(settings).__name__}.")
    return name, str(sources[name]), settings


def make_place(out: Path, name: str, source: str, settings: PlaceConfig, progress: Progress) -> SpaceResult:
    """Makes the place of a source of one of the KINDS, with its own settings."""
    if isinstance(settings, SplatFit):
        return fit_space(source, str(out), settings, progress=progress)
    if isinstance(settings, LiftSpaceConfig):
        settings = replace(settings, panorama=name == "panorama" or settings.panorama)
        return lift_space(Path(source), out, settings, progress=progress)
    return build_space(source if name == "text" else Path(source), out, settings, progress=progress)
