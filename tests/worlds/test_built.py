"""Places built of layouts: bodies climb stairs, fall, and enter no wall; folders and commands."""

from __future__ import annotations

import json
import shutil

import pytest
import torch

from terrella.cli import main
from terrella.core import check_world, make_rng
from terrella.space.camera import planar_pose
from terrella.space.occupancy import Walker
from terrella.space.solids import Solids
from terrella.workflows.splat_places import unedited_scene
from terrella.worlds.folder import open_world
from terrella.worlds.splat_folder import save_splat

LAYOUT = {
    "rooms": [{"name": "hall", "at": [0, 0], "size": [8, 4, 3.4]}, {"name": "den", "at": [8.2, 0], "size": [3, 4, 3]}],
    "doors": [{"room": "hall", "wall": "east"}],
    "stairs": [{"at": [2, 3, 0], "size": [2.2, 1, 1.08], "up": "east"}],
    "things": [{"label": "platform", "at": [5, 3.5], "size": [1.6, 1, 1.08]},
        {"label": "table", "at": [3, 1.2]}, {"label": "chair", "at": [6.5, 0.4]}],
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("built")
    (path / "layout.json").write_text(json.dumps(LAYOUT))
    command = [
        "space",
        "build",
        str(path / "layout.json"),
        "--out",
        str(path / "w"),
        "--gaussians",
        "4000",
        "--size",
        "24",
        "32",
    ]
    assert main(command) == 0
    return path / "w"


def walk(world, state, steps, *names):
    action = torch.tensor([[int(one in names) for one in world.spec.action_names]], dtype=torch.int8).repeat(
        state.batch, 1
    )
    for _ in range(steps):
        state = world.imagine(state, action, make_rng(0))
    return state


def put(world, x, y, feet, heading):
    pose = planar_pose(*(torch.tensor([float(v)]) for v in (x, y, feet + world.config.body.eye_m, heading)))
    return world.observe({"pose": pose}, None, make_rng(0))


def test_the_laws_hold(folder):
    check_world(open_world(folder), steps=4)


def test_one_climbs_stairs_and_falls_off_the_platform(folder):
    world = open_world(folder)
    eye = world.config.body.eye_m
    state = walk(world, put(world, 1.2, 3.5, 0, 0.0), 45, "MOVE_FORWARD")
    assert abs(float(state["pose"][0, 2]) - 1.08 - eye) < 0.03 and 4.2 < state["pose"][0, 0] < 5.9
    state = walk(world, state, 40, "MOVE_FORWARD")
    assert abs(float(state["pose"][0, 2]) - eye) < 0.03 and state["pose"][0, 0] > 6


def test_one_goes_through_the_door_and_nowhere_else(folder):
    world = open_world(folder)
    assert walk(world, put(world, 6.5, 2.0, 0, 0.0), 60, "MOVE_FORWARD")["pose"][0, 0] > 10
    stopped = walk(world, put(world, 6.5, 3.6, 0, 0.0), 60, "MOVE_FORWARD")["pose"]
    assert abs(float(stopped[0, 0]) - 7.75) < 0.03


def test_nobody_enters_a_wall(folder):
    world, body, rng = open_world(folder), Walker(eye_m=1.65, step_m=0.35), torch.Generator().manual_seed(0)
    state = world.start(64, make_rng(0))
    for step in range(60):
        if step % 6 == 0:
            action = (torch.rand(64, len(world.spec.action_names), generator=rng) < 0.4).to(torch.int8)
        state = world.imagine(state, action, make_rng(0))
    assert Solids(world.solids).depth(state["pose"], body).max() < 0.03
    assert (state["pose"][:, :3] - world.starts[0, :3]).norm(dim=1).max() > 1


def test_solids_are_met_exactly():
    body, wall = Walker(0.25, 1.6, 0.35, 0.15), Solids(torch.tensor([[1.0, -5, 0, 1.1, 5, 3], [-9, -9, -0.1, 9, 9, 0]]))
    at = torch.tensor([[0.74, 0, 1.6], [0.76, 0, 1.6], [1.05, 0, 1.6], [1.36, 0, 1.6]])
    assert wall.blocked(at, body).tolist() == [False, True, True, False]
    assert torch.allclose(wall.depth(at, body)[1:3], torch.tensor([0.01, 0.3]), atol=1e-5)
    assert wall.floor(at, body).tolist() == [0, 0, 0, 0]
    assert wall.floor(at + torch.tensor([0, 0, 3.1]), body).tolist() == [0, 0, 3, 0]


def test_edits_take_the_collider_from_the_gaussians(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "w")
    assert len(open_world(copy).solids) and "table" in open_world(copy).card["objects"]
    assert main(["space", "edit", str(copy), "--object", "3", "--delete"]) == 0
    assert not len(open_world(copy).solids) and not (open_world(copy).objects == 3).any()


def test_the_command_says_what_it_did_not_understand(tmp_path, capsys):
    assert (
        main(["space", "build", "--text", "a tiny quux room", "--out", str(tmp_path / "w"), "--gaussians", "1000"]) == 0
    )
    assert "not understood: quux" in capsys.readouterr().out and (tmp_path / "w" / "layout.json").exists()
    assert unedited_scene(str(tmp_path / "w")).note == "not understood: quux"
    for wrong in (["--text", "quux"], [], [str(tmp_path / "none.json")], ["--text", "room", "--gaussians", "3"]):
        assert main(["space", "build", *wrong, "--out", str(tmp_path / "no")]) != 0
        assert not (tmp_path / "no").exists() and len(capsys.readouterr().err.splitlines()) == 1


def test_a_built_place_has_a_name_and_is_known(tmp_path):
    words, out = "a small room with a pillar", tmp_path / "w"
    assert main(["space", "build", words, "--out", str(out), "--gaussians", "1500"]) == 0
    world = open_world(out)
    assert world.name == words and (tmp_path / "w" / "layout.json").exists()
    shown = world.render(world.start(1, rng := torch.Generator().manual_seed(0)), ("uncertainty",))["uncertainty"]
    sure = world.spec.card["uncertainty"]["sure"]
    assert float(shown) < sure
    assert main(["space", "edit", str(out), "--object", "1", "--delete"]) == 0
    edited = open_world(out)
    assert not edited.provenance.bool().all()  # what the pillar hid counts as invented
    plain = {"rooms": LAYOUT["rooms"][:1]}
    (tmp_path / "den.json").write_text(json.dumps(plain))
    assert (
        main(["space", "build", str(tmp_path / "den.json"), "--out", str(tmp_path / "d"), "--gaussians", "1500"]) == 0
    )
    assert open_world(tmp_path / "d").name == "den"
    world.provenance.zero_()  # as an older release saved what words built
    save_splat(world, tmp_path / "old")
    old = open_world(tmp_path / "old")
    assert float(old.render(old.start(1, rng), ("uncertainty",))["uncertainty"]) < sure


def test_it_is_exported_to_other_tools(folder, tmp_path, capsys):
    (tmp_path / "path.json").write_text(json.dumps([[1, 1, 1.6, 0], [2, 1, 1.6, 90]]))
    way = ["--seconds", "0.5", "--path", str(tmp_path / "path.json")]
    for name, more, head in (("c.glb", ["--kind", "collider"], b"glTF"), ("g.glb", ["--kind", "gaussians"], b"glTF"),
                             ("p.png", [], b"\x89PNG"), ("f.mp4", way, b"\0\0\0")):  # fmt: skip
        assert main(["space", "export", str(folder), str(tmp_path / name), *more]) == 0
        assert (tmp_path / name).read_bytes().startswith(head)
    (tmp_path / "path.json").write_text("[[1, 2]]")
    for name, more in (("no.mp4", way), ("no.mp4", ["--seconds", "-1"]), ("no.glb", ["--cell", "nan"]), ("no.obj", [])):
        assert main(["space", "export", str(folder), str(tmp_path / name), *more]) != 0
    assert not [path for path in tmp_path.iterdir() if "no." in path.name]


PUSHED = {"rooms": [{"name": "hall", "at": [0, 0], "size": [8, 4, 3]}],
          "things": [{"label": "crate", "at": [3, 2]}, {"label": "stool", "at": [3, 2, 0.7]}, {"label": "table", "at": [6, 0.6]},
                     {"label": "crate", "at": [6, 3.4], "movable": False}]}  # fmt: skip


@pytest.fixture(scope="module")
def pushable(tmp_path_factory):
    pytest.importorskip("mujoco")
    path = tmp_path_factory.mktemp("pushed")
    (path / "layout.json").write_text(json.dumps(PUSHED))
    small = ["--gaussians", "4000", "--size", "24", "32"]
    assert main(["space", "build", str(path / "layout.json"), "--out", str(path / "w"), *small]) == 0
    return open_world(path / "w")


def test_the_laws_hold_among_things_that_can_be_pushed(pushable):
    check_world(pushable, steps=3)
    assert pushable.things == [1, 2] and pushable.spec.channels["bodies"].shape == (2, 7)


def test_who_walks_pushes_what_stands_there_and_the_rest_rides_and_falls(pushable):
    start = put(pushable, 1.2, 2, 0, 0.0)
    rest = pushable.render(start, ("bodies",))["bodies"]
    pushed = walk(pushable, start, 45, "MOVE_FORWARD")
    gone = pushable.render(pushed, ("bodies",))["bodies"] - rest
    assert gone[0, 0, 0] > 1 and abs(gone[0, 0, 2]) < 0.05 and gone[0, 1, 0] > 0.7  # the crate, and the stool on it
    assert (
        pushed["pose"][0, 0] < pushable.render(pushed, ("bodies",))["bodies"][0, 0, 0] - 0.5
    )  # nobody walks through it
    eye = pushed["pose"][:, :3].tolist()[0]
    seen = [
        pushable.render(state, ("rgb",))["rgb"].float()
        for state in (start, pushable.observe(start, pushed, make_rng(0)))
    ]
    assert (seen[0] - seen[1]).abs().mean() > 1 and eye[0] > 2  # the picture from the same place is another
    tipped = pushed.replace(
        body_speeds=pushed["body_speeds"] + torch.tensor([0, 3.0, 0, 0, 0, 0]) * torch.tensor([[[0.0], [1.0]]])
    )
    assert float(walk(pushable, tipped, 60)["bodies"][0, 1, 2]) < 0.5  # a stool shoved off the crate lies on the floor


def test_nobody_is_pushed_through_a_wall_and_what_is_far_rests(pushable):
    state = walk(pushable, put(pushable, 1.2, 2, 0, 0.0), 150, "MOVE_FORWARD")
    assert state["bodies"][0, 0, 0] < 8 - 0.3 and state["pose"][0, 0] < 7.1
    away = walk(pushable, put(pushable, 1.2, 3.4, 0, 3.1), 20, "MOVE_FORWARD")
    assert torch.equal(away["bodies"][0], pushable.rigid.rest)


def test_one_knows_where_one_can_walk_to_and_a_goal_in_another_room_is_walked_to(folder, tmp_path):
    world = open_world(folder)
    state = put(world, 6.0, 2.0, 0, 0)
    told = world.render(state, ("places", "pose"))["places"][0]
    places = told[told[:, 3] > 0]
    assert len(places) > 100 and (places[:, 3] == 4).all() and (places[:, 0] > 9).any()
    assert ((places[:, :2] - torch.tensor([5.8, 3.6])).norm(dim=1) < 0.5).any(), "up the stairs, on the platform"
    assert not ((places[:, :2] - torch.tensor([3.0, 1.2])).norm(dim=1) < 0.5).any(), "not in the table"


@pytest.mark.slow
def test_a_goal_in_another_room_is_walked_to(tmp_path, capsys):
    (tmp_path / "layout.json").write_text(json.dumps({**LAYOUT, "start": [5.6, 2.5, 0]}))
    built = ["--gaussians", "1000", "--size", "24", "32"]
    assert main(["space", "build", str(tmp_path / "layout.json"), "--out", str(tmp_path / "w"), *built]) == 0
    short = ["--episodes", "1", "--steps", "90", "--no-curve", "--out", str(tmp_path / "plan")]
    assert main(["plan", str(tmp_path / "w"), "--goal", "pose=9.3,1,_,_,_,_,_", *short]) == 0
    told = capsys.readouterr().out
    assert "reached in 100%" in told and "at random 0%" in told, told
