"""Our files in Spark, three.js, PlayCanvas and splat-transform, and theirs in ours. `make test-splats` installs them."""

from __future__ import annotations

import csv
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from terrella.cli import main
from terrella.space.camera import planar_pose, rotation
from terrella.space.files import AXES, read_scene
from terrella.space.raster import Gaussians, rasterise
from terrella.space.raster.gaussians import Y0, plain_sh
from terrella.space.raster.move import transform
from terrella.worlds.folder import open_world
from terrella.worlds.splat import SplatConfig, SplatWorld
from terrella.worlds.splat_folder import save_splat

from .test_fitting import room

FOLDER = os.environ.get("TERRELLA_SPLAT_TOOLS", "")
pytestmark = pytest.mark.skipif(
    not FOLDER, reason="Spark, three.js, PlayCanvas, splat-transform and gsply are not installed: make test-splats"
)
MODULES = {
    "three": "three/build/three.module.js", "three/webgpu": "three/build/three.webgpu.js", "three/tsl": "three/build/three.tsl.js",
    "three/addons/": "three/examples/jsm/", "playcanvas": "playcanvas/build/playcanvas.mjs",
    "playcanvas/": "playcanvas/",
    "@sparkjsdev/spark": "@sparkjsdev/spark/dist/spark.module.js",
}  # fmt: skip
SITE = "http://tools.test/"
KINDS = {".js": "text/javascript", ".mjs": "text/javascript", ".html": "text/html"}
COUNT = 900
# Our files: the axes of each, and how far places (m) and colours (0..1) may be off
OURS = {
    "a.ply": ("rdf", 1e-4, 0.01),
    "a.compressed.ply": ("rdf", 0.01, 0.012),
    "a.spz": ("rub", 1e-3, 0.012),
    "a.4.spz": ("rub", 1e-3, 0.012),
    "a.glb": ("rub", 1e-4, 0.01),
}
KINDS_OF = {"compressed": ["--compressed"], ".4.": ["--spz", "4"], "glb": ["--kind", "gaussians"]}
OPENED = [
    ("spark", "a.ply"), ("spark", "a.compressed.ply"), ("spark", "a.spz"),
    ("three", "a.ply"), ("three", "a.spz"), ("three", "a.4.spz"), ("three", "a.glb"),
    ("playcanvas", "a.ply"), ("playcanvas", "a.compressed.ply"), ("playcanvas", "a.4.spz"),
]  # fmt: skip


def place() -> SplatWorld:
    full = room(count=COUNT)
    rng = torch.Generator().manual_seed(3)
    scales = 0.04 + 0.2 * torch.rand(COUNT, 3, generator=rng)
    quats = torch.randn(COUNT, 4, generator=rng)
    shades = plain_sh(torch.rand(COUNT, 3, generator=rng))
    opacities = 0.3 + 0.6 * torch.rand(COUNT, generator=rng)
    scene = Gaussians(full.means, quats, scales, opacities, shades)
    one = torch.ones(1)
    return SplatWorld(
        "place", scene, torch.ones(COUNT, dtype=torch.uint8), planar_pose(one, one, one, one), SplatConfig()
    )


@pytest.fixture(scope="module")
def ours(tmp_path_factory) -> Path:
    """A folder with our files of one place, as `terrella space export` writes them."""
    folder = tmp_path_factory.mktemp("ours")
    save_splat(place(), folder / "world")
    for name in OURS:
        more = [words for part, words in KINDS_OF.items() if part in name]
        assert main(["space", "export", str(folder / "world"), str(folder / name), *(more[0] if more else [])]) == 0
    return folder


@pytest.fixture(scope="module")
def readers(browser, ours):
    """A page in which tests/space/other_tools.js runs, with the packages of npm and our files at hand."""
    context = browser.new_context()
    page = context.new_page()
    imports = json.dumps({"imports": {name: f"{SITE}npm/{path}" for name, path in MODULES.items()}})
    index = f'<script type="importmap">{imports}</script><script type="module" src="/other_tools.js"></script>'
    roots = {"npm": Path(FOLDER) / "node_modules", "files": ours}

    def answer(route):
        path = route.request.url.removeprefix(SITE)
        first, _, rest = path.partition("/")
        if not path:
            return route.fulfill(body=f"<!doctype html>{index}", content_type="text/html")
        file = roots[first] / rest if first in roots else Path(__file__).with_name(first)
        if not file.is_file():
            return route.fulfill(status=404)
        route.fulfill(body=file.read_bytes(), content_type=KINDS.get(file.suffix, "application/octet-stream"))

    page.route("**/*", answer)
    page.goto(SITE)
    page.wait_for_function("!!window.readers")
    yield page
    context.close()


def spread(found: dict) -> torch.Tensor:
    """Covariances [N, 6] of what a tool read: xx, xy, xz, yy, yz, zz."""
    if "covariances" in found:
        return torch.tensor(found["covariances"]).view(-1, 6)
    quats, scales = torch.tensor(found["quats"]).view(-1, 4), torch.tensor(found["scales"]).view(-1, 3)
    axes = (
        rotation(torch.cat([torch.zeros(len(quats), 3), quats / quats.norm(dim=1, keepdim=True)], 1)) * scales[:, None]
    )
    return (axes @ axes.transpose(1, 2))[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]


def nearest(mine: torch.Tensor, theirs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """How far the nearest of theirs [M, 3] is from each of mine [N, 3], and which it is."""
    away, row = torch.cdist(mine, theirs, compute_mode="donot_use_mm_for_euclid_dist").min(1)
    return away, row


def agree(found: dict, axes: str, off_m: float, off_colour: float) -> None:
    """What a tool found is our place: each of our Gaussians lies beside one of theirs, alike in colour, opacity and spread."""
    mine = transform(place().gaussians, torch.tensor(AXES[axes]).float())
    means = torch.tensor(found["means"]).view(-1, 3)
    assert len(means) == COUNT
    away, row = nearest(mine.means, means)
    assert away.max() < off_m and len(row.unique()) == COUNT
    colours = torch.tensor(found["colours"]).view(-1, 3)[row]
    assert (colours - mine.colours).abs().max() < off_colour
    assert (torch.tensor(found["opacities"])[row] - mine.opacities).abs().max() < 0.01
    if not {"quats", "covariances"} & found.keys():
        return
    truth = spread({"quats": mine.quats.flatten().tolist(), "scales": mine.scales.flatten().tolist()})
    assert ((spread(found)[row] - truth).norm(dim=1) / truth.norm(dim=1)).max() < 0.1


@pytest.mark.parametrize("tool, name", OPENED)
def test_their_loaders_find_our_gaussians(readers, tool, name):
    agree(readers.evaluate("([tool, url]) => readers[tool](url)", [tool, f"/files/{name}"]), *OURS[name])


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz"])
def test_spark_draws_what_we_draw(readers, name):
    size, place_, heading = (240, 320), (0.8, 1.0, 1.3), 0.6
    pose = planar_pose(*(torch.tensor([v]) for v in (*place_, heading)))
    lens = (0.5 / 0.8, 0.5 / 0.6, 0.5, 0.5)  # half the width is 0.8 of the distance, half the height 0.6
    truth = rasterise(place().gaussians, pose, lens, size).rgb[0].clamp(0, 1)
    there = torch.tensor(AXES[OURS[name][0]]).float()
    turn = lambda way: (there @ torch.tensor(way)).tolist()  # noqa: E731
    view = {
        "place": turn(place_), "ahead": turn((math.cos(heading), math.sin(heading), 0.0)), "up": turn((0.0, 0.0, 1.0)),
        "fov": 2 * math.degrees(math.atan(0.6)), "size": size[::-1],
    }  # fmt: skip
    shown = readers.evaluate("([url, view]) => readers.drawn(url, view)", [f"/files/{name}", view])
    drawn = torch.tensor(np.array(shown, np.uint8).reshape(*size, 4)[::-1, :, :3] / 255).permute(2, 0, 1)
    assert truth.std() > 0.1 and -10 * math.log10(float((drawn - truth).square().mean())) > 30


def convert(source: Path, target: Path, *options: str) -> None:
    """PlayCanvas' splat-transform."""
    tool = Path(FOLDER) / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    subprocess.run(["node", tool, "-q", "-w", "-g", "cpu", *options, source, target], check=True, capture_output=True)


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz", "a.4.spz"])
def test_splat_transform_finds_our_gaussians(ours, tmp_path, name):
    convert(ours / name, tmp_path / "table.csv")
    with (tmp_path / "table.csv").open() as file:
        columns = {key: np.array(values, np.float32) for key, *values in zip(*csv.reader(file))}
    take = lambda *names: torch.tensor(np.stack([columns[one] for one in names], 1))  # noqa: E731
    found = {
        "means": take("x", "y", "z"), "colours": (0.5 + Y0 * take("f_dc_0", "f_dc_1", "f_dc_2")).clamp(0, 1),
        "opacities": take("opacity")[:, 0].sigmoid(), "scales": take("scale_0", "scale_1", "scale_2").exp(),
        "quats": take("rot_0", "rot_1", "rot_2", "rot_3"),
    }  # fmt: skip
    agree({key: part.flatten().tolist() for key, part in found.items()}, "rdf", *OURS[name][1:])


def looks_right(file: Path, off_m: float = 0.012, axes: str | None = None) -> None:
    """A file opens in ours, at the same places and looking the same."""
    mine, theirs = place().gaussians, read_scene(file, axes)
    assert len(theirs) == COUNT and nearest(mine.means, theirs.means)[0].max() < off_m
    pose = planar_pose(*(torch.tensor([v]) for v in (0.8, 1.0, 1.3, 0.6)))
    one, other = (rasterise(scene, pose, (0.6, 0.8, 0.5, 0.5), (120, 160)).rgb for scene in (mine, theirs))
    assert one.std() > 0.1 and -10 * math.log10(float((one - other).square().mean()) + 1e-9) > 30


THEIRS = {"b.ply": (), "b.compressed.ply": (), "b.spz": ("--spz-version", "3"), "b.4.spz": (), "b.sog": ()}


@pytest.mark.parametrize("name", THEIRS)
def test_files_of_splat_transform_open_in_ours(ours, tmp_path, name):
    convert(ours / "a.ply", tmp_path / name, *THEIRS[name])
    looks_right(tmp_path / name)
    assert main(["space", "import", str(tmp_path / name), "--out", str(tmp_path / "w")]) == 0
    again = open_world(tmp_path / "w")
    assert isinstance(again, SplatWorld) and len(again.gaussians) == COUNT


WRITE = """import sys, gsply
source, target = sys.argv[1:]
data = gsply.read_spz(source) if source.endswith("spz") else gsply.plyread(source)
write = lambda: gsply.write_spz(target, data, version=4 if ".4." in target else 3)
write() if target.endswith("spz") else gsply.plywrite(target, data)"""


def through_gsply(source: Path, target: Path) -> None:
    env = {**os.environ, "PYTHONPATH": str(Path(FOLDER) / "python")}
    subprocess.run([sys.executable, "-c", WRITE, source, target], check=True, env=env)


@pytest.mark.parametrize("name", ["a.compressed.ply", "a.spz", "a.4.spz"])
def test_gsply_finds_our_gaussians(ours, tmp_path, name):
    through_gsply(ours / name, tmp_path / "c.ply")
    looks_right(tmp_path / "c.ply", axes=OURS[name][0])  # gsply turns nothing


@pytest.mark.parametrize("name", ["c.ply", "c.compressed.ply", "c.spz", "c.4.spz"])
def test_files_of_gsply_open_in_ours(ours, tmp_path, name):
    through_gsply(ours / "a.ply", tmp_path / name)
    looks_right(tmp_path / name, axes="rdf")  # gsply turns nothing: its SPZ is in the axes of the PLY


def test_a_ply_in_gsplats_layout_opens_in_ours(tmp_path):
    """As gsplat's `export_splats` writes it: no normals, harmonics channel by channel, logits, logarithms, turns not normed."""
    scene = transform(place().gaussians, torch.tensor(AXES["rdf"]).float())
    rest = torch.zeros(COUNT, 45)
    names = [
        "x", "y", "z", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(45)), "opacity",
        *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)),
    ]  # fmt: skip
    body = torch.cat(
        [scene.means, scene.sh[:, 0], rest, scene.opacities.logit()[:, None], scene.scales.log(), 3 * scene.quats], 1
    )
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {COUNT}",
        *(f"property float {name}" for name in names),
    ]
    (tmp_path / "d.ply").write_bytes("\n".join([*head, "end_header\n"]).encode() + body.numpy().astype("<f4").tobytes())
    looks_right(tmp_path / "d.ply", 1e-4)
