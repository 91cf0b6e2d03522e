"""Visual randomisation of a MuJoCo scene: textures and colours of surfaces, and distractor objects."""

# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping
from typing import Any

import numpy as np

from .mujoco_model import compiled, mujoco
from .mujoco_parameters import COLOURS, DISTRACTORS, TEXTURES, Parameter

PATTERNS, TEXELS = 16, 64  # number of textures, and pixels of a side
_FLAT, _ROUND = (
    "terrella_flat",
    "terrella_round",
)  # materials of planes, which cube maps cannot cover, and of other geoms
_KINDS = (mujoco.mjtTexture.mjTEXTURE_2D, mujoco.mjtTexture.mjTEXTURE_CUBE)
_PLANE, _RGB = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtTextureRole.mjTEXROLE_RGB)


def patterned(spec: Any, name: str) -> Any:
    """The model of a spec with the random materials added, which no geom uses yet."""
    spec, rng = spec.copy(), np.random.default_rng(0)
    for at in range(PATTERNS):
        texels = pattern(at, rng)
        for kind, role, faces in zip(_KINDS, (_FLAT, _ROUND), (1, 6)):
            texture = spec.add_texture(name=f"{role}{at}", type=kind, width=TEXELS, height=faces * TEXELS, nchannel=3)
            texture.data = np.tile(texels, (faces, 1, 1)).tobytes()
            material = spec.add_material(name=f"{role}{at}", texuniform=faces == 1, texrepeat=[1, 1])
            material.textures[_RGB] = texture.name
    return compiled(spec, name)


def pattern(number: int, rng: np.random.Generator) -> np.ndarray:
    """A tileable texture uint8 [TEXELS, TEXELS, 3] of squares, stripes, spots or clouds, from a colour to nearly white. A geom's
    own colour tints it."""
    row, column = np.mgrid[:TEXELS, :TEXELS] * (2 * np.pi / TEXELS)
    times = int(rng.integers(1, 5))
    wave = (
        lambda: np.sin(times * row) * np.sin(times * column) > 0,
        lambda: np.sin(times * (row + column) + np.sin(column)) > 0,
        lambda: np.sin(times * row) * np.sin(times * column) > 0.4,
        lambda: _clouds(row, column, rng),
    )[number % 4]()
    dark = rng.uniform(0.05, 0.8, 3)
    share = np.asarray(wave, np.float64)[..., None]
    return (255 * (dark + share * (rng.uniform(0.85, 1.0) - dark))).astype(np.uint8)


def _clouds(row: np.ndarray, column: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[H, W] from 0 to 1: a sum of waves whose amplitude grows with the wavelength."""
    total = np.zeros_like(row)
    for down in range(-8, 9):
        for right in range(9):
            height = 1 / max(1.0, np.hypot(down, right)) ** 1.3
            total += height * np.cos(down * row + right * column + rng.uniform(0, 2 * np.pi))
    return (total - total.min()) / np.ptp(total)


class Appearance:
    """Applies the visual parameters among `changes` (by column) to a scene. Textures need a `patterned` model."""

    def __init__(self, model: Any, changes: Mapping[int, Parameter]):
        self._model = model
        visual = (TEXTURES, COLOURS, DISTRACTORS)
        self._columns = {one.what: at for at, one in changes.items() if any(one is other for other in visual)}
        self._materials = np.zeros((2, 0), int)
        if TEXTURES.what in self._columns:
            names = [[f"{role}{at}" for at in range(PATTERNS)] for role in (_FLAT, _ROUND)]
            self._materials = np.array([[model.material(name).id for name in row] for row in names])

    def apply(self, scene: Any, values: np.ndarray) -> None:
        """Changes the scene of one world by its parameter values [n]; a value of 0 changes nothing."""
        textures, colours, distractors = (self._value_and_rng(one, values) for one in (TEXTURES, COLOURS, DISTRACTORS))
        if textures is not None or colours is not None:
            self._surfaces(scene, textures, colours)
        if distractors is not None:
            self._add_distractors(scene, *distractors)

    def _value_and_rng(self, parameter: Parameter, values: np.ndarray) -> tuple[float, np.random.Generator] | None:
        """The value of a parameter, and a random generator seeded by its bits; None for 0."""
        value = float(values[self._columns[parameter.what]]) if parameter.what in self._columns else 0.0
        return (value, np.random.default_rng(np.float64(value).view(np.uint64))) if value else None

    def _surfaces(self, scene: Any, textures: Any, colours: Any) -> None:
        count = self._model.ngeom
        textured, kinds, tints = np.zeros(count, bool), np.zeros(count, int), np.zeros((count, 3))
        if textures is not None:
            share, rng = textures
            textured, kinds = rng.uniform(size=count) < share, rng.integers(PATTERNS, size=count)
        if colours is not None:
            tints = colours[1].uniform(0.05, 1.0, (count, 3))
        for geom in scene.geoms[: scene.ngeom]:
            if geom.objtype != int(mujoco.mjtObj.mjOBJ_GEOM) or not 0 <= geom.objid < count:
                continue
            if textured[geom.objid]:
                self._set_texture(geom, int(kinds[geom.objid]))
            if colours is not None:
                geom.rgba[:3] += colours[0] * (tints[geom.objid] - geom.rgba[:3])

    def _set_texture(self, geom: Any, kind: int) -> None:
        flat = int(geom.type) == _PLANE
        geom.matid = self._materials[0 if flat else 1, kind]
        if hasattr(geom, "texid"):  # versions of MuJoCo whose scenes copy the material
            geom.texid = self._model.mat_texid[geom.matid, _RGB]
            geom.texuniform, geom.texrepeat[:] = int(flat), 1.0

    def _add_distractors(self, scene: Any, number: float, rng: np.random.Generator) -> None:
        """Adds balls and boxes around the model, without collisions. Frozen appearances depend on the order of these draws."""
        extent, centre = self._model.stat.extent, self._model.stat.center
        for _ in range(int(number)):
            kind = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_BOX)[rng.integers(2)]
            size = extent * rng.uniform(0.02, 0.08, 3)
            at = centre + extent * rng.uniform(-0.8, 0.8, 3)
            add_geom(scene, kind, size, at, (*rng.uniform(0, 1, 3), 1.0))


def add_geom(scene: Any, kind: int, size: np.ndarray, at: np.ndarray, colour: tuple[float, ...]) -> None:
    """Adds a geom of size [3] at a point [3], in m, if the scene has room for it."""
    if scene.ngeom < scene.maxgeom:
        geom, upright = scene.geoms[scene.ngeom], np.eye(3).ravel()
        mujoco.mjv_initGeom(geom, kind, size, np.asarray(at, np.float64), upright, np.asarray(colour, np.float32))
        scene.ngeom += 1
