"""One function for places: of words, of a layout, of a picture or of a panorama."""

from dataclasses import replace
from pathlib import Path

from ..core.errors import TerrellaError
from .build_space import BuildSpaceConfig, build_space
from .lift_space import LiftSpaceConfig, lift_space
from .splat_places import SpaceResult


def generate_place(
    out: str | Path,
    *,
    text: str | None = None,
    layout: str | Path | None = None,
    image: str | Path | None = None,
    panorama: str | Path | None = None,
    config: BuildSpaceConfig | LiftSpaceConfig | None = None,
) -> SpaceResult:
    """Makes a place in the folder `out`, as `terrella space build` (of `text` or a `layout` file) and `terrella space lift` (of an
    `image` or `panorama` file) do; `terrella.load(out)` opens it. TerrellaError unless exactly one of them is given, with its own
    config."""
    picture = panorama if image is None else image
    if sum(one is not None for one in (text, layout, image, panorama)) != 1:
        raise TerrellaError("give one of text=, layout=, image= and panorama=.")
    if picture is not None and isinstance(config, LiftSpaceConfig | None):
        settings = config or LiftSpaceConfig()
        return lift_space(
            Path(picture), Path(out), replace(settings, panorama=panorama is not None or settings.panorama)
        )
    if picture is None and isinstance(config, BuildSpaceConfig | None):
        return build_space(text if layout is None else Path(layout), Path(out), config or BuildSpaceConfig())
    raise TerrellaError(
        "the config of an image or a panorama is a LiftSpaceConfig, of text and layouts a BuildSpaceConfig."
    )
