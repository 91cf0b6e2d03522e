"""Growing places: the box of a room, cameras that see known and unknown, and `terrella space grow` with undo and resuming."""

from __future__ import annotations

import json
import math

import pytest
import torch
from tests.space.test_panorama import SIZE, room

from terrella.cli import main
from terrella.space import growing
from terrella.space.camera import planar_pose, rotation
from terrella.space.growing import (
    CAMERA,
    coverage,
    grow_step,
    known_around,
    next_view,
    planar_fill,
    psnr_of,
)  # fmt: skip
from terrella.space.lifting.panorama import panorama_gaussians
from terrella.space.raster import Gaussians, join, rasterise
from terrella.space.raster.gaussians import plain_sh
from terrella.space.raster.move import transform
from terrella.space.room_planes import room_planes
from terrella.workflows.grow_space import depth_error, fill_of
from terrella.workflows.splat_places import open_splat
from terrella.worlds.additions import INVENTED
from terrella.worlds.splat import SplatConfig, SplatWorld
from terrella.worlds.splat_folder import load_source, read_edits, save_splat

EYE = torch.tensor([0.0, 0.0, 1.2])
ZERO = torch.tensor(0.0)


def front() -> Gaussians:
    """What a camera in the middle of a room sees ahead."""
    gaussians = panorama_gaussians(room(96))[0]
    off = gaussians.means - EYE
    return gaussians.at((off[:, 0] > 0) & (off[:, 1:].abs().amax(1) < off[:, 0] * 1.2))


def half_room(path) -> SplatWorld:
    scene = front()
    config = SplatConfig((0.5, 0.5, 0.5, 0.5), (64, 64))
    start = planar_pose(ZERO, ZERO, EYE[2], ZERO)[None]
    save_splat(SplatWorld("half", scene, torch.ones(len(scene), dtype=torch.uint8), start, config), path)
    return open_splat(str(path))


def test_the_planes_of_a_room_are_measured_where_they_are_seen():
    planes = room_planes(front(), EYE)
    assert planes.heading % (math.pi / 2) == pytest.approx(0, abs=0.03) or planes.heading == pytest.approx(
        math.pi / 2, abs=0.03
    )
    ahead = planes.hit(
        EYE, torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, 0, 1.0], [0, 0, -1.0], [-1.0, 0, 0]])
    )
    assert ahead[0][:5].tolist() == pytest.approx(SIZE[[0, 1, 1, 2, 2]].tolist(), abs=0.06)
    assert sum(planes.seen) == 5 and 1.4 < float(ahead[0][5]) < 4.1  # behind the camera nothing was seen
    assert bool((ahead[1] >= 0).all()) and bool((ahead[1] <= 1).all())


def test_away_from_what_was_seen_planes_lie_farther_out_by_the_error_of_depth():
    ways = torch.tensor([[1.0, 0, 0], [-0.3, 1.0, 0], [-0.4, 0, 1.0], [-0.4, 0, -1.0]])
    sure, unsure = (room_planes(front(), EYE, error).hit(EYE, ways)[0] for error in (0.0, 0.2))
    assert (unsure / sure).tolist() == pytest.approx([1, 1.2, 1.2, 1.2], abs=1e-3)
    beside = torch.tensor([[x, 1.0, 0.0] for x in (0.9, 0.7, 0.5, 0.2)])  # from the seen part of a wall on
    bulge = room_planes(front(), EYE, 0.2).hit(EYE, beside)[0] - room_planes(front(), EYE).hit(EYE, beside)[0]
    assert (
        float(bulge[0]) == pytest.approx(0, abs=1e-3) and bool((bulge.diff() > -1e-3).all()) and float(bulge[3]) > 0.2
    )


def test_the_expected_error_of_a_place_says_how_far_out_its_planes_lie(tmp_path):
    place = half_room(tmp_path / "place")
    for error, share in ((0.2, 0.2), (7.0, 0.3), (-1, 0.0), (math.nan, 0.0), ("no", 0.0), (None, 0.0)):
        place.card["depth_error"] = error
        assert depth_error(place) == share
    place.card["depth_error"] = 0.2
    near, far = (fill_of(one) for one in (open_splat(str(tmp_path / "place")), place))
    pose = planar_pose(ZERO, ZERO, EYE[2], torch.tensor(math.atan2(1.0, -0.3)))
    drawn = rasterise(place.gaussians, pose[None], CAMERA, (9, 9))
    assert float(far(drawn, pose)[0][4, 4] / near(drawn, pose)[0][4, 4]) == pytest.approx(
        1.25, abs=0.01
    )  # 1.25 times 0.2


def test_walls_are_measured_at_any_heading():
    turn = torch.tensor([math.cos(0.25), 0, 0, math.sin(0.25)])
    spun = transform(front(), rotation(torch.cat([EYE, turn])), shift=None)
    planes = room_planes(spun, EYE)
    way = torch.tensor([[math.cos(0.5), math.sin(0.5), 0]])
    assert float(planes.hit(EYE, way)[0]) == pytest.approx(float(SIZE[0]), abs=0.08)


def test_a_step_sees_known_and_unknown_and_adds_only_where_nothing_was():
    scene = front()
    known = known_around(scene, EYE[None])
    view = next_view(known, EYE[None])
    assert 0.4 < view.unknown <= 0.6
    step = grow_step(
        scene, view, planar_fill(room_planes(scene, EYE)), [(planar_pose(ZERO, ZERO, EYE[2], ZERO), CAMERA)]
    )
    assert len(step.gaussians) > 1000 and step.seam < 0.05
    whole = join([scene, step.gaussians])
    assert coverage(known_around(whole, EYE[None])) > coverage(known) + 0.1
    start = planar_pose(ZERO, ZERO, EYE[2], ZERO)[None]
    before, after = (rasterise(one, start, CAMERA, (64, 64)) for one in (scene, whole))
    assert psnr_of(after.rgb[0], before.rgb[0], before.alpha[0] > 0.5) > 40
    fine = rasterise(whole, view.pose[None], CAMERA, (768, 768)).alpha[0, 16:-16, 16:-16]
    assert float((fine < 0.8).float().mean()) < 1e-4  # no dark line between known and new


def test_what_would_cover_a_seen_surface_is_left_out():
    cameras = [(planar_pose(ZERO, ZERO, EYE[2], ZERO), CAMERA)]
    points = EYE + torch.tensor([[[1.0, 0, 0], [2.5, 0.5, 0], [3.1, 0, 0], [5.0, 0, 0], [-1.0, 0, 0]]])
    assert growing._covers(front(), points, cameras)[0].tolist() == [True, True, False, False, False]


@pytest.mark.exact
def test_a_place_grows_is_undone_and_goes_on(tmp_path, capsys):
    place = half_room(tmp_path / "place")
    name = str(tmp_path / "place")
    assert main(["space", "grow", name, "--steps", "2", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    steps = facts["steps"]
    assert [step["number"] for step in steps] == [1, 2] and facts["coverage_before"] < steps[0]["coverage"] < facts[
        "coverage"
    ]
    assert len(read_edits(tmp_path / "place")) == 2 and len(load_source(tmp_path / "place").gaussians) == len(
        place.gaussians
    )
    grown = open_splat(str(tmp_path / "place"))
    new = len(place.gaussians)
    assert len(grown.gaussians) == new + sum(step["added"] for step in steps)
    assert bool((grown.provenance[new:] == INVENTED).all()) and grown.object_names == [
        "invented, step 1",
        "invented, step 2",
    ]
    assert main(["space", "edit", name, "--undo"]) == 0
    assert len(open_splat(str(tmp_path / "place")).gaussians) == new + steps[0]["added"]
    capsys.readouterr()
    assert main(["space", "grow", name, "--to", "0.9", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (
        facts["coverage"] >= 0.9
        and facts["steps"][-1]["closure_db"] > 30
        and max(s["away_deg"] for s in facts["steps"]) > 90
    )
    assert len(read_edits(tmp_path / "place")) == 1 + len(facts["steps"])
    assert main(["space", "grow", name, "--to", "0.9"]) == 0
    assert "after 0 steps" in capsys.readouterr().out


def test_the_same_seed_grows_the_same_place(tmp_path):
    places = [half_room(tmp_path / name) and str(tmp_path / name) for name in "ab"]
    for name in places:
        assert main(["space", "grow", name, "--steps", "1", "--seed", "3"]) == 0
    one, other = (open_splat(str(name)).gaussians for name in places)
    assert torch.equal(one.means, other.means) and torch.equal(one.sh, other.sh)


def test_growth_that_cannot_be_is_refused(tmp_path, capsys):
    half_room(tmp_path / "place")
    for options in (["--to", "0"], ["--to", "1.5"], ["--steps", "0"], ["--seed", "-1"]):
        assert main(["space", "grow", str(tmp_path / "place"), *options]) == 2
        assert "--to is above 0" in capsys.readouterr().err
    assert main(["space", "grow", str(tmp_path / "none")]) == 2
    assert not (tmp_path / "place" / "world.edits.jsonl").exists()
    quat, scale = torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1)
    dot = Gaussians(torch.tensor([[3.0, 0, 1]]), quat, scale, torch.ones(1), plain_sh(torch.ones(1, 3)))
    planes = room_planes(dot, EYE)  # nothing to measure: a plain box
    assert not any(planes.seen) and bool((planes.high > planes.low).all())
