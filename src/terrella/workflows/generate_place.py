"""One function for places: of words, of a layout, or of a picture."""

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
    config: BuildSpaceConfig | LiftSpaceConfig | None = None,
) -> SpaceResult:
    """Makes a place in the folder `out`, as `terrella space build` (of `text` or a `layout` file) and `terrella space lift` (of an
    `image` file) do; `terrella.load(out)` opens it. TerrellaError unless exactly one of the three is given, with its own config."""
    sources = [one for one in (text, layout, image) if one is not None]
    if len(sources) != 1:
        raise TerrellaError("give one of text=, layout= and image=.")
    if image is not None and isinstance(config, LiftSpaceConfig | None):
        return lift_space(Path(image), Path(out), config or LiftSpaceConfig())
    if image is None and isinstance(config, BuildSpaceConfig | None):
        return build_space(text if layout is None else Path(layout), Path(out), config or BuildSpaceConfig())
    raise TerrellaError("the config of an image is a LiftSpaceConfig, of text and layouts a BuildSpaceConfig.")
