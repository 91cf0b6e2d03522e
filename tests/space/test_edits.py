"""Edits of a place: what they change, what they leave, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from terrella.cli import main
from terrella.core.errors import CheckpointError, ContractError
from terrella.library import load
from terrella.space.edits import apply_edits, select
from terrella.space.raster import Gaussians
from terrella.space.raster.gaussians import plain_sh
from terrella.workflows.splat_places import unedited_scene
from terrella.worlds.splat import SplatConfig, SplatWorld
from terrella.worlds.splat_folder import load_source, save_splat, world_of, write_edits

from .test_fitting import LENS, SIZE, room
from .test_raster import cloud, parts

BOX = {"box": [3.0, -9, -9, 9, 9, 9]}


def test_what_is_not_selected_stays():
    scene = cloud(60)
    chosen = scene.means[:, 0] >= 3
    for deed in ({"do": "move", "by": [1, 0, 0]}, {"do": "turn", "degrees": 30}, {"do": "scale", "factor": 2},
                 {"do": "recolour", "colour": [1, 0, 0]}, {"do": "delete"}):  # fmt: skip
        done = apply_edits(scene, [{"select": BOX, **deed}])
        after, origin, kept = done.gaussians, done.origin, done.origin >= 0
        assert torch.equal(origin[kept], (~chosen).nonzero()[:, 0])
        assert all(torch.equal(a[kept], b[~chosen]) for a, b in zip(parts(after), parts(scene)))
        assert len(after) == (60 - int(chosen.sum()) if deed["do"] == "delete" else 60)


def test_there_and_back_is_nothing():
    scene = cloud(60, 2)
    for there, back in (({"do": "move", "by": [1, 2, 0]}, {"do": "move", "by": [-1, -2, 0]}),
                        ({"do": "turn", "degrees": 70}, {"do": "turn", "degrees": -70})):  # fmt: skip
        moved = apply_edits(scene, [{"select": {"all": True}, **there}]).gaussians
        after = apply_edits(moved, [{"select": {"all": True}, **back}]).gaussians
        offset = after.means - scene.means
        assert not torch.allclose(moved.means, scene.means, atol=0.1)
        assert (offset - offset.mean(0)).abs().max() < 1e-4  # a turn's middle is that of what is turned
        assert torch.allclose(after.sh, scene.sh, atol=1e-4) and torch.allclose(after.scales, scene.scales)
    both = apply_edits(scene, [{"select": BOX, "do": "duplicate", "by": [0, 5, 0]}])
    assert len(both.gaussians) == 60 + int((both.origin < 0).sum())
    assert torch.equal(both.gaussians.means[:60], scene.means)


def test_objects_and_brushes_are_selected():
    scene, objects = cloud(60), torch.arange(60, dtype=torch.int32) % 3
    twice = apply_edits(scene, [{"select": {"object": 2}, "do": "duplicate", "by": [0, 0, 9]}], objects)
    assert (twice.objects == 3).sum() == 20 and torch.equal(twice.objects[:60], objects)
    less = apply_edits(scene, [{"select": {"object": 2}, "do": "delete"}], objects)
    assert len(less.gaussians) == 40 and not (less.objects == 2).any()
    dabs = [[*scene.means[k].tolist(), 0.01] for k in (3, 5)]
    apart = apply_edits(scene, [{"select": {"sphere": dab}, "do": "recolour", "colour": [1, 0, 0]} for dab in dabs])
    brush = apply_edits(scene, [{"select": {"brush": sum(dabs, [])}, "do": "recolour", "colour": [1, 0, 0]}])
    assert set((brush.origin < 0).nonzero()[:, 0].tolist()) == {58, 59} and len(brush.gaussians) == 60
    assert sorted(brush.gaussians.means[58:, 0].tolist()) == sorted(apart.gaussians.means[58:, 0].tolist())
    with pytest.raises(ContractError):
        apply_edits(scene, [{"select": {"object": 0}, "do": "delete"}], objects)


def standing(sides: int = 4) -> Gaussians:
    """A post on a floor that reaches beyond `sides` of the post's four sides, without a floor beneath it."""
    rng = torch.Generator().manual_seed(3)
    low = torch.tensor([0.0 if sides > 3 else 1.28, 0.0 if sides > 2 else 1.28, 0.0])
    floor = low + torch.rand(4000, 3, generator=rng) * (torch.tensor([3.0, 3.0, 0.0]) - low)
    floor = floor[~((floor[:, :2] > 1.28) & (floor[:, :2] < 1.62)).all(1)]
    post = torch.tensor([1.3, 1.3, 0.05]) + torch.rand(300, 3, generator=rng) * torch.tensor([0.3, 0.3, 1.5])
    means, count = torch.cat([floor, post]), len(floor) + 300
    quats, scales = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.tensor([0.03, 0.03, 0.002]).repeat(count, 1)
    return Gaussians(means, quats, scales, torch.full((count,), 0.9), plain_sh(means / 3))


POST = {"select": {"box": [1.29, 1.29, 0.02, 1.61, 1.61, 2.0]}}


@pytest.mark.parametrize("deed", [{"do": "delete"}, {"do": "move", "by": [0, 0, 3]}, {"do": "turn", "degrees": 45}])
def test_a_floor_goes_on_beneath_what_is_taken_away(deed):
    place = standing()
    done = apply_edits(place, [{**POST, **deed}])
    kept = len(place) - (300 if deed["do"] == "delete" else 0)
    new, origin = done.gaussians.means[kept:], done.origin[kept:]
    assert (
        30 < len(new) < 100 and (origin == -1).all() and not done.objects.any()
    )  # as dense as the floor: 444 a square metre
    assert (new[:, 2].abs() < 1e-6).all() and new[:, :2].min() > 1.29 and new[:, :2].max() < 1.61
    spots = 1.3 + 0.3 * torch.rand(200, 2, generator=torch.Generator().manual_seed(4))
    assert torch.cdist(spots, new[:, :2]).amin(1).max() < 0.08


def test_a_cut_a_hole_in_a_surface_and_a_paint_stay_as_they_are():
    for place, edit in ((standing(2), {**POST, "do": "delete"}), (standing(), {**POST, "do": "recolour", "colour": [1, 0, 0]}),
                        (standing(), {"select": {"sphere": [2.3, 2.3, 0, 0.3]}, "do": "delete"})):  # fmt: skip
        done = apply_edits(place, [edit])
        taken = int(select(place, edit, torch.zeros(len(place), dtype=torch.int32)).sum())
        assert len(done.gaussians) == len(place) - (taken if edit["do"] == "delete" else 0)


@pytest.mark.parametrize("radius", [0.5, 2.0])
@pytest.mark.parametrize("kind", ["sphere", "brush"])
def test_a_brush_selects_what_is_nearer_than_its_radius(kind, radius):
    scene = cloud(2)
    scene = replace(scene, means=torch.tensor([[0.99 * radius, 0, 0], [0, 1.01 * radius, 0]]))
    edit = {"select": {kind: [0, 0, 0, radius]}, "do": "delete"}
    assert apply_edits(scene, [edit]).origin.tolist() == [1]


@pytest.mark.parametrize("edit", [
    {"select": {"ring": [1]}, "do": "delete"}, {"select": BOX, "do": "paint"}, {"select": {"box": [1, 2]}, "do": "delete"},
    {"select": {"sphere": [99, 99, 99, 1]}, "do": "delete"}, {"select": BOX, "do": "move", "by": "far"},
    {"select": {"brush": [1, 2, 3]}, "do": "delete"}, {"select": {"brush": [1, 2, 3, 1, 4]}, "do": "delete"},
    {"select": BOX, "do": "scale", "factor": -1}, {"select": BOX, "do": "move", "by": [0, 0, float("nan")]}, {"do": "delete"},
    {"select": BOX, "do": "move", "by": [1e300, 0, 0]}, {"select": BOX, "do": "recolour", "colour": [9, 9, 9]},
    {"select": BOX, "do": []}, {"select": BOX, "do": "scale", "factor": True}, {"select": BOX, "do": "scale", "factor": 10**400},
])  # fmt: skip
def test_what_is_no_edit(edit):
    with pytest.raises(ContractError):
        apply_edits(cloud(60), [edit])


def test_edits_that_ruin_a_place_together_are_refused(monkeypatch):
    monkeypatch.setattr("terrella.space.edits.MOST_GAUSSIANS", 10_000)
    grow = {"select": {"all": True}, "do": "scale", "factor": 1e25}
    with pytest.raises(ContractError, match="out of all numbers"):
        apply_edits(cloud(60), [grow, grow])
    twice = {"select": {"all": True}, "do": "duplicate", "by": [0, 0, 0]}
    with pytest.raises(ContractError, match="at most"):
        apply_edits(cloud(60), [twice] * 30)


def test_a_wrong_edit_is_named_and_its_place_is_not_called_damaged(tmp_path):
    good, wrong = ({"select": BOX, "do": "move", "by": [x, 0, 0]} for x in (1.0, float("nan")))
    save_splat(world_of(room(count=800), "room", {}, SplatConfig(LENS, SIZE)), tmp_path / "w")
    with pytest.raises(ContractError, match="^edit 2 of 2: 'by' takes 3 finite numbers"):
        load_source(tmp_path / "w", [good, wrong])
    after = unedited_scene(str(tmp_path / "w")).collider_after  # what the page asks for
    assert after is not None
    with pytest.raises(ContractError, match="^'by' takes"):
        after([wrong])
    write_edits(tmp_path / "w", [good, wrong])
    with pytest.raises(
        CheckpointError, match="world.edits.jsonl holds an edit that does not fit the place .edit 2 of 2"
    ):
        load(str(tmp_path / "w"))
    write_edits(tmp_path / "w", [{"do": "merge", "place": "../w"}])
    with pytest.raises(CheckpointError, match="world.edits.jsonl holds an edit .* names a `place` and its `sha256`"):
        load(str(tmp_path / "w"))


def test_edits_are_lines_that_can_be_undone(tmp_path, capsys):
    save_splat(world_of(room(count=800), "room", {}, SplatConfig(LENS, SIZE)), tmp_path / "w")
    place = str(tmp_path / "w")
    assert main(["space", "edit", place, "--sphere", "0", "2", "1", "0.8", "--delete"]) == 0
    assert main(["space", "edit", place, "--box", "3", "0", "0", "5", "4", "3", "--recolour", "1", "0", "0"]) == 0
    world = load(place)
    assert isinstance(world, SplatWorld) and len(world.gaussians) < 800
    assert 0 < (world.provenance == 0).sum() < len(world.gaussians)
    assert len((tmp_path / "w" / "world.edits.jsonl").read_text().splitlines()) == 2
    assert main(["space", "edit", place, "--sphere", "90", "2", "1", "0.8", "--delete"]) == 2
    assert main(["space", "edit", place, "--redo"]) == 2
    capsys.readouterr()
    assert main(["space", "edit", place, "--object", "3", "--delete"]) == 2
    assert "has no object 3; its objects: none" in capsys.readouterr().err
    assert main(["space", "edit", place, "--delete"]) == 2  # of what?
    assert main(["space", "edit", place, "--undo", "--sphere", "0", "2", "1", "0.8"]) == 2
    with pytest.raises(CheckpointError, match="has edits"):
        save_splat(world_of(room(count=800), "room", {}, SplatConfig(LENS, SIZE)), place)
    before = load(place)
    assert main(["space", "edit", place, "--undo"]) == 0 and main(["space", "edit", place, "--undo"]) == 0
    (tmp_path / "saved.jsonl").write_text((tmp_path / "w" / "world.undone.jsonl").read_text())
    assert main(["space", "edit", place, "--redo"]) == 0 and main(["space", "edit", place, "--redo"]) == 0
    again = load(place)
    assert isinstance(before, SplatWorld) and isinstance(again, SplatWorld)
    assert all(torch.equal(a, b) for a, b in zip(parts(before.gaussians), parts(again.gaussians)))
    assert main(["space", "edit", place, "--replay", str(tmp_path / "saved.jsonl")]) == 0  # in the other order
    assert len((tmp_path / "w" / "world.edits.jsonl").read_text().splitlines()) == 2
    (tmp_path / "saved.jsonl").write_text('[1]\n{"select"')
    assert main(["space", "edit", place, "--replay", str(tmp_path / "saved.jsonl")]) == 2
    assert main(["space", "edit", place, "--undo"]) == 0 and main(["space", "edit", place, "--undo"]) == 0
    assert main(["space", "edit", place, "--undo"]) == 2
    world = load(place)
    assert isinstance(world, SplatWorld) and len(world.gaussians) == 800 and (world.provenance == 1).all()
