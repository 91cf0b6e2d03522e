"""One place merged into another: it looks, stops bodies and remembers there as it did at home; and what is refused."""

from __future__ import annotations

import json
import shutil

import pytest
import torch

from terrella.cli import main
from terrella.core.errors import CheckpointError, ContractError
from terrella.library import load
from terrella.space.camera import planar_pose
from terrella.space.edits import apply_edits
from terrella.space.occupancy import Walker
from terrella.space.raster import rasterise
from terrella.space.solids import Solids
from terrella.worlds.splat import SolidBoxes, SplatConfig, SplatWorld
from terrella.worlds.splat_folder import load_source, merged_loader, save_splat

from ..space.test_raster import cloud

LENS, SIZE = (0.5, 0.5, 0.5, 0.5), (24, 24)
ONE, TWO = torch.ones(1), torch.full((1,), 2.0)


def made(path, degree=0, seed=0, objects=2, boxes=True) -> SplatWorld:
    """A cloud that is a room's, on a floor with a wall at x = 2, with objects 1, 2, ..., every third Gaussian seen."""
    scene = cloud(60, degree, seed)
    solids = torch.tensor([[-1.0, -3, -0.1, 9, 5, 0], [2.0, -1, 0, 2.2, 5, 2.5]]) if boxes else None
    world = SplatWorld(
        path.name, scene, (torch.arange(60) % 3 == 0).to(torch.uint8), planar_pose(ONE, 0 * ONE, 1.6 * ONE, 0 * ONE),
        SplatConfig(LENS, SIZE), {"objects": [f"{path.name} {one}" for one in range(objects)]},
        (torch.arange(60) % (objects + 1)).int(), SolidBoxes.of(solids),
    )  # fmt: skip
    save_splat(world, path)
    return world


@pytest.fixture
def two(tmp_path):
    return made(tmp_path / "a"), made(tmp_path / "b", 2, 1, 3), tmp_path


def edit(path, *asked: str) -> int:
    return main(["space", "edit", str(path), *asked])


def opened(path) -> SplatWorld:
    world = load(path)
    assert isinstance(world, SplatWorld)
    return world


def test_it_is_there_what_it_was_at_home(two):
    one, other, path = two
    assert edit(path / "a", "--merge", str(path / "b"), "--turn", "30", "--move", "40", "5", "1") == 0
    world = opened(path / "a")
    assert len(world.gaussians) == 120 and world.gaussians.degree == 2
    assert torch.equal(world.provenance, torch.cat([one.provenance, other.provenance]))
    assert torch.equal(world.objects[60:], torch.where(other.objects > 0, other.objects + 2, 0))
    assert world.object_names == ["a 0", "a 1", "b 0", "b 1", "b 2"]
    home = planar_pose(0.5 * ONE, 0.2 * ONE, 0.3 * ONE, 0.4 * ONE)
    turn = torch.tensor(30.0).deg2rad()
    x, y = 0.5 * turn.cos() - 0.2 * turn.sin(), 0.5 * turn.sin() + 0.2 * turn.cos()
    there = planar_pose(40 + x * ONE, 5 + y * ONE, 1.3 * ONE, 0.4 * ONE + turn)
    seen, again = (rasterise(w.gaussians, p, LENS, SIZE).rgb for w, p in ((other, home), (world, there)))
    assert seen.amax() > 0.3 and (seen - again).abs().amax() < 1e-3


@pytest.mark.parametrize("turn", [0, 90, 180, -90, 37])
def test_bodies_meet_what_was_merged(two, turn):
    _, other, path = two
    assert edit(path / "a", "--merge", str(path / "b"), "--turn", str(turn), "--move", "20", "0", "0") == 0
    world, body = opened(path / "a"), Walker()
    assert len(world.solids) == (0 if turn == 37 else 4)  # then the Gaussians stop bodies
    if turn == 37:
        return
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([4.0, 6, 0.2])
    points += torch.tensor([0.5, -2, 1.6])
    x, y, z = points.unbind(1)
    for _ in range(turn // 90 % 4):
        x, y = -y, x
    there = torch.stack([x + 20, y, z], 1)
    depth = Solids(other.solids).depth(points, body)
    assert torch.allclose(Solids(world.solids).depth(there, body), depth, atol=1e-5) and 0 < (depth > 0).sum() < 200
    assert torch.allclose(world.collider.floor(there, body), other.collider.floor(points, body))


def test_walkable_floor_goes_on(tmp_path):
    made(tmp_path / "a", boxes=True)
    made(tmp_path / "b", boxes=True)
    alone = opened(tmp_path / "a").places
    assert edit(tmp_path / "a", "--merge", str(tmp_path / "b"), "--move", "10", "0", "0") == 0
    both = opened(tmp_path / "a").places
    assert alone[:, 0].amax() < 10 < both[:, 0].amax() and (both[:, 3] > 0).sum() > 1.5 * (alone[:, 3] > 0).sum()


def test_it_is_undone_redone_and_edited_as_anything_else(two):
    _, other, path = two
    assert edit(path / "b", "--sphere", "3", "0", "0", "1", "--delete") == 0
    there = opened(path / "b")
    assert len(there.gaussians) < 60
    assert edit(path / "a", "--merge", str(path / "b"), "--move", "20", "0", "0") == 0
    merged, first = opened(path / "a"), (path / "a" / "world.edits.jsonl").read_bytes()
    assert len(merged.gaussians) == 60 + len(there.gaussians)
    eye = planar_pose(14 * ONE, 0 * ONE, 0 * ONE, 0 * ONE)
    with_it, without = (
        rasterise(one, eye, LENS, SIZE).rgb for one in (merged.gaussians, load_source(path / "a").gaussians)
    )
    assert not torch.equal(with_it, without)
    assert edit(path / "a", "--undo") == 0 and len(opened(path / "a").gaussians) == 60
    assert edit(path / "a", "--redo") == 0
    again = opened(path / "a")
    assert first == (path / "a" / "world.edits.jsonl").read_bytes()
    assert all(torch.equal(x, y) for x, y in zip(vars(merged.gaussians).values(), vars(again.gaussians).values()))
    assert edit(path / "a", "--object", "4", "--delete") == 0  # the second one of b
    after, gone = opened(path / "a"), merged.objects == 4
    assert gone.any() and torch.equal(after.objects, merged.objects[~gone])
    assert torch.equal(after.provenance, merged.provenance[~gone]) and not len(after.solids)


def test_the_folders_may_move_together(two):
    _, _, path = two
    assert edit(path / "a", "--merge", str(path / "b")) == 0
    assert json.loads((path / "a" / "world.edits.jsonl").read_text())["place"] == "../b"
    made(path / "c")
    assert edit(path / "c", "--merge", str(path / "a")) == 0  # and b with it
    for name in "abc":
        shutil.move(path / name, path / "elsewhere" / name)
    assert len(opened(path / "elsewhere" / "c").gaussians) == 180


def test_what_was_changed_or_is_gone_is_said(two, capsys):
    _, _, path = two
    assert edit(path / "a", "--merge", str(path / "b")) == 0
    assert edit(path / "b", "--recolour", "1", "0", "0") == 0
    capsys.readouterr()
    assert main(["space", "export", str(path / "a"), str(path / "a.ply")]) == 2
    assert "b, which" in (said := capsys.readouterr().err) and "was changed; put it back" in said and "--undo" in said
    assert edit(path / "b", "--undo") == 0 and len(opened(path / "a").gaussians) == 120
    assert edit(path / "a", "--box", "-90", "-90", "-90", "90", "90", "90", "--recolour", "1", "0", "0") == 0
    shutil.rmtree(path / "b")
    with pytest.raises(CheckpointError, match="is not there; put it back"):
        load(path / "a")
    assert (
        edit(path / "a", "--undo") == 0 and edit(path / "a", "--undo") == 0 and len(opened(path / "a").gaussians) == 60
    )
    assert edit(path / "a", "--redo") == 2 and not (path / "a" / "world.edits.jsonl").read_text()


def test_what_cannot_be_merged(two, capsys):
    _, _, path = two
    (path / "scene.ply").write_text("ply")
    for bad in ("a", "scene.ply", "nowhere"):
        assert edit(path / "a", "--merge", str(path / bad)) == 2
    assert edit(path / "a", "--merge", str(path / "b"), "--object", "1") == 2
    assert edit(path / "a", "--merge", str(path / "b"), "--delete") == 2
    assert edit(path / "a", "--merge", str(path / "b"), "--move", "nan", "0", "0") == 2
    assert edit(path / "a", "--merge", str(path / "b"), "--move", "1e7", "0", "0") == 2
    assert "farther than 10 km" in capsys.readouterr().err
    assert not (path / "a" / "world.edits.jsonl").exists()
    made(path / "c", boxes=False)
    assert edit(path / "a", "--merge", str(path / "c"), "--move", "900", "900", "900") == 0
    assert "have cells of" in capsys.readouterr().err
    assert edit(path / "a", "--undo") == 0
    assert edit(path / "b", "--merge", str(path / "a")) == 0
    assert edit(path / "a", "--merge", str(path / "b")) == 2  # a within b within a
    assert "has it merged" in capsys.readouterr().err
    line = {"do": "merge", "place": 7, "by": [0, 0, 0], "degrees": 0}
    source = load_source(path / "a")
    with pytest.raises(ContractError, match="names a `place`"):
        apply_edits(source.gaussians, [line], source.objects, merged_loader(path / "a"))
    with pytest.raises(ContractError, match="needs the other place"):
        apply_edits(source.gaussians, [line])
