"""SOG files: what their pixels mean, and broken ones."""

from __future__ import annotations

import io
import json
import math
import zipfile

import numpy as np
import pytest
import torch
from PIL import Image

from terrella.core.errors import DatasetError
from terrella.space.camera import rotation
from terrella.space.files import AXES, read_scene

COUNT, MANY = 50, 8  # Gaussians; harmonics of degree 2 above the first
BOOK = np.linspace(-3, 1, 256).tolist()


def picture(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


def files() -> tuple[dict, dict[str, np.ndarray]]:
    """What meta.json says, and pixels: 50 Gaussians in pictures of 8 x 7."""
    rng = np.random.default_rng(0)
    names = ("means_l", "means_u", "quats", "scales", "sh0", "shN_labels")
    pixels = {name: rng.integers(0, 256, (7, 8, 4)) for name in names}
    pixels["quats"][..., 3] = rng.integers(252, 256, (7, 8))
    pixels["quats"][..., :3] = rng.integers(40, 216, (7, 8, 3))  # three that are shorter than 1
    pixels["shN_labels"][..., 1] = 0
    pixels["shN_centroids"] = rng.integers(0, 256, (4, 64 * MANY, 4))
    named = lambda *names: {"files": [f"{name}.webp" for name in names]}  # noqa: E731
    meta = {
        "version": 2, "count": COUNT, "quats": named("quats"), "scales": {**named("scales"), "codebook": BOOK},
        "means": {**named("means_l", "means_u"), "mins": [-2, -1, 0], "maxs": [2, 3, 1]},
        "sh0": {**named("sh0"), "codebook": BOOK},
        "shN": {**named("shN_centroids", "shN_labels"), "codebook": BOOK, "bands": 2, "count": 256},
    }  # fmt: skip
    return meta, pixels


def entries(meta: dict, pixels: dict[str, np.ndarray]) -> dict[str, bytes]:
    return {"meta.json": json.dumps(meta).encode(), **{f"{k}.webp": picture(part) for k, part in pixels.items()}}


def zipped(content: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return file.getvalue()


def test_every_pixel_is_what_the_format_says(tmp_path):
    meta, pixels = files()
    content = entries(meta, pixels)
    (tmp_path / "a.sog").write_bytes(zipped(content))
    for name, data in content.items():
        (tmp_path / name).write_bytes(data)
    found = read_scene(tmp_path / "a.sog", "flu")
    for again in (read_scene(tmp_path, "flu"), read_scene(tmp_path / "meta.json", "flu")):
        assert all(torch.equal(a, b) for a, b in zip(vars(found).values(), vars(again).values()))
    assert len(found) == COUNT and found.degree == 2
    px = {name: part.reshape(-1, 4).tolist() for name, part in pixels.items() if name != "shN_centroids"}
    for k in range(COUNT):
        for axis in range(3):
            low, high = meta["means"]["mins"][axis], meta["means"]["maxs"][axis]
            log = low + (high - low) * (px["means_l"][k][axis] + 256 * px["means_u"][k][axis]) / 65535
            assert math.isclose(
                found.means[k, axis], math.copysign(math.expm1(abs(log)), log), rel_tol=1e-4, abs_tol=1e-5
            )
            assert math.isclose(found.scales[k, axis], math.exp(BOOK[px["scales"][k][axis]]), rel_tol=1e-5)
            assert math.isclose(found.sh[k, 0, axis], BOOK[px["sh0"][k][axis]], abs_tol=1e-5)
            label = px["shN_labels"][k][0]
            row = pixels["shN_centroids"][label // 64, label % 64 * MANY : label % 64 * MANY + MANY, axis]
            assert np.allclose(found.sh[k, 1:, axis], [BOOK[byte] for byte in row], atol=1e-5)
        assert math.isclose(found.opacities[k], px["sh0"][k][3] / 255, abs_tol=1e-6)
        three = [(byte / 255 * 2 - 1) / 2**0.5 for byte in px["quats"][k][:3]]
        three.insert(px["quats"][k][3] - 252, math.sqrt(1 - sum(part * part for part in three)))
        assert np.allclose(found.quats[k], three, atol=1e-5)


def test_its_axes_are_those_of_ply(tmp_path):
    (tmp_path / "a.sog").write_bytes(zipped(entries(*files())))
    ours, theirs = read_scene(tmp_path / "a.sog"), read_scene(tmp_path / "a.sog", "flu")
    there = torch.tensor(AXES["rdf"]).float()
    assert torch.allclose(ours.means @ there.T, theirs.means, atol=1e-4)
    spread = [
        rotation(torch.cat([torch.zeros(COUNT, 3), one.quats], 1)) * one.scales[:, None] for one in (ours, theirs)
    ]
    one, other = (axes @ axes.transpose(1, 2) for axes in spread)
    assert torch.allclose(there @ one @ there.T, other, atol=1e-4)


def changed(**changes: object) -> dict[str, bytes]:
    meta, pixels = files()
    return entries({**meta, **changes}, pixels)


def without(name: str) -> dict[str, bytes]:
    return {key: data for key, data in changed().items() if key != name}


SMALL = picture(np.full((2, 2, 4), 255))
BAD = {
    "no meta": without("meta.json"),
    "no picture": without("quats.webp"),
    "no JSON": {**changed(), "meta.json": b"{"},
    "a list": {**changed(), "meta.json": b"[1]"},
    "version 1": changed(version=None),
    "many": changed(count=2**40),
    "a word": changed(count="many"),
    "small picture": {**changed(), "scales.webp": SMALL},
    "no picture in it": {**changed(), "scales.webp": b"RIFF nothing"},
    "cut picture": {**changed(), "scales.webp": changed()["scales.webp"][:60]},
    "no quaternion": {**changed(), "quats.webp": picture(np.zeros((7, 8, 4)))},
    "short codebook": changed(sh0={**files()[0]["sh0"], "codebook": [1.0]}),
    "words for numbers": changed(scales={**files()[0]["scales"], "codebook": ["a"] * 256}),
    "short palette": {**changed(), "shN_centroids.webp": picture(np.zeros((1, 64 * MANY, 4)))},
    "no bands": changed(shN={**files()[0]["shN"], "bands": 9}),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_broken_ones_are_one_sentence(tmp_path, name):
    (tmp_path / "bad.sog").write_bytes(zipped(BAD[name]))
    with pytest.raises(DatasetError, match="bad.sog") as said:
        read_scene(tmp_path / "bad.sog")
    assert "\n" not in str(said.value)


def test_a_folder_is_not_left(tmp_path):
    content = changed(quats={"files": ["../quats.webp"]})
    (tmp_path / "quats.webp").write_bytes(content["quats.webp"])
    (tmp_path / "in").mkdir()
    for name, data in content.items():
        (tmp_path / "in" / name).write_bytes(data)
    with pytest.raises(DatasetError, match="lacks"):
        read_scene(tmp_path / "in")
    with pytest.raises(DatasetError, match="broken"):
        (tmp_path / "cut.sog").write_bytes(zipped(content)[:-30])
        read_scene(tmp_path / "cut.sog")
