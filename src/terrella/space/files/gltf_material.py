"""Materials of a glTF file: base colour, glow and their pictures, by metallic roughness or specular glossiness."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from .gltf import CLAMP, MIRROR, REPEAT, Gltf

MOST_PICTURES = 256


@dataclass(frozen=True)
class MaterialPicture:
    """pixels uint8 [h, w, 4], sRGB; wrap: how it goes on along u and v."""

    pixels: np.ndarray
    wrap: tuple[int, int] = (REPEAT, REPEAT)

    def sample(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Linear colours and opacities, float32 [..., 4], at u and v of any shape."""
        height, width = self.pixels.shape[:2]
        at = (_wrapped(v, self.wrap[1], height), _wrapped(u, self.wrap[0], width))
        texels = (self.pixels[at] / np.float32(255)).astype(np.float32)
        texels[..., :3] **= 2.2
        return texels


@dataclass(frozen=True)
class Material:
    """colour (red, green, blue, opacity) and glow (red, green, blue), linear, which the pictures multiply; unlit: colours include
    light; see_through: opacity counts; cut: what is less opaque is invisible."""

    colour: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    glow: tuple[float, ...] = (0.0, 0.0, 0.0)
    picture: MaterialPicture | None = None
    glow_picture: MaterialPicture | None = None
    unlit: bool = False
    see_through: bool = False
    cut: float = 0.0


def transformed_uv(uv: np.ndarray, about: dict[str, Any]) -> np.ndarray:
    """u v [N, 2] by KHR_texture_transform: scaled, then turned counter-clockwise in a picture whose v goes down, then moved."""
    turn = float(about.get("rotation", 0.0))
    u, v = (uv * np.array(about.get("scale", (1, 1)), np.float32)).T
    turned = np.stack([np.cos(turn) * u + np.sin(turn) * v, np.cos(turn) * v - np.sin(turn) * u], 1)
    return turned + np.array(about.get("offset", (0, 0)), np.float32)


def _wrapped(part: np.ndarray, wrap: int, side: int) -> np.ndarray:
    """The rows or columns of a picture of `side` pixels at u or v."""
    part = np.nan_to_num(part)
    if wrap == MIRROR:
        part = 1 - np.abs(part % 2 - 1)
    elif wrap != CLAMP:
        part = part % 1
    return np.clip(part * side, 0, side - 1).astype(int)


def base_of(about: dict[str, Any]) -> tuple[tuple[float, ...], dict[str, Any]]:
    """The colour of a material, and its texture; where it has none, that of its glow."""
    plain = about.get("pbrMetallicRoughness", {})
    glossy = about.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    factor, texture = plain.get("baseColorFactor"), plain.get("baseColorTexture")
    if glossy is not None:
        factor, texture = glossy.get("diffuseFactor"), glossy.get("diffuseTexture")
    return tuple(map(float, factor or (1, 1, 1, 1))), texture or about.get("emissiveTexture", {})


def material_of(
    file: Gltf, about: dict[str, Any], pictures: dict[int, MaterialPicture | None], left_out: list[str]
) -> Material:
    """The material of an entry; `pictures` caches decoded pictures; absent ones are named in `left_out`."""

    def picture_of(index: Any) -> MaterialPicture | None:
        if index is None:
            return None
        if index in pictures:
            return pictures[index]
        if len(pictures) == MOST_PICTURES:
            raise ValueError(f"it has more than {MOST_PICTURES} pictures: join some")
        try:
            pictures[index] = MaterialPicture(file.picture(index), file.wrap(index))
        except FileNotFoundError as error:
            pictures[index] = None
            left_out.append(f"a picture: {error}")
        return pictures[index]

    more, (colour, texture), shining = about.get("extensions", {}), base_of(about), about.get("emissiveTexture", {})
    glow = float(more.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
    glow = np.array(about.get("emissiveFactor", (0, 0, 0)), np.float64).reshape(3) * glow
    glowing, base = picture_of(shining.get("index")) if glow.any() else None, None
    if texture is not shining:
        base = picture_of(texture.get("index"))
        if glowing is not None and {**texture, "index": 0} != {**shining, "index": 0}:  # of other u v: evenly
            low = np.linspace(0, 1, 64, endpoint=False)
            glow, glowing = glow * glowing.sample(*np.meshgrid(low, low))[..., :3].mean((0, 1)), None
    mode = about.get("alphaMode", "OPAQUE")
    cut = float(about.get("alphaCutoff", 0.5)) if mode == "MASK" else 0.0
    unlit = "KHR_materials_unlit" in more
    return Material(colour, tuple(glow.tolist()), base, glowing, unlit, mode == "BLEND", cut)
