"""One function for places: of words, of a layout, of one or several pictures, of a panorama or of a video."""

from dataclasses import replace
from pathlib import Path

from ..core.errors import TerrellaError
from ..learn.recipes.splat_views import SplatFit
from .build_space import BuildSpaceConfig, build_space, fit_space
from .lift_space import LiftSpaceConfig, lift_space
from .splat_places import SpaceResult

KINDS: dict[str, type[BuildSpaceConfig | LiftSpaceConfig | SplatFit]] = {
    "text": BuildSpaceConfig, "layout": BuildSpaceConfig, "image": LiftSpaceConfig, "panorama": LiftSpaceConfig,
    "images": SplatFit, "video": SplatFit,
}  # fmt: skip


def generate_place(
    out: str | Path,
    *,
    text: str | None = None,
    layout: str | Path | None = None,
    image: str | Path | None = None,
    panorama: str | Path | None = None,
    images: str | Path | None = None,
    video: str | Path | None = None,
    config: BuildSpaceConfig | LiftSpaceConfig | SplatFit | None = None,
) -> SpaceResult:
    """Makes a place in the folder `out`, as `terrella space build` (of `text` or a `layout` file), `terrella space lift` (of an
    `image` or `panorama` file) and `terrella space fit` (of `images`, a folder, or a `video` file: the place is OUT/world) do;
    `terrella.load(out)` opens it. Fits that were stopped go on. TerrellaError unless exactly one of them is given, with its own
    config: BuildSpaceConfig, LiftSpaceConfig or SplatFit."""
    sources = {
        "text": text, "layout": layout, "image": image, "panorama": panorama, "images": images, "video": video,
    }  # fmt: skip
    given = [name for name, source in sources.items() if source is not None]
    if len(given) != 1:
        raise TerrellaError(f"give one of {', '.join(f'{name}=' for name in sources)}; got {len(given)} of them.")
    (name,), settings, out = given, config or KINDS[given[0]](), Path(out)
    if not isinstance(settings, KINDS[name]):
        raise TerrellaError(f"the config of {name}= is a {KINDS[name].__name__}, not a {type(settings).__name__}.")
    source = sources[name]
    if isinstance(settings, SplatFit):
        return fit_space(str(source), str(out), settings)
    if isinstance(settings, LiftSpaceConfig):
        settings = replace(settings, panorama=name == "panorama" or settings.panorama)
        return lift_space(Path(str(source)), out, settings)
    return build_space(text if layout is None else Path(layout), out, settings)
