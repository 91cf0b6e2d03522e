"""SplatWorld: the laws, walking and flying; worlds from files and back, by the command line."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

import terrella
from terrella.cli import main
from terrella.core import check_world
from terrella.core.errors import CheckpointError, DatasetError, ObservationError
from terrella.space.camera import planar_pose, rotation
from terrella.space.files import read_scene, write_scene
from terrella.worlds import splat_folder
from terrella.worlds.splat import BUTTONS, SplatConfig, SplatWorld
from terrella.worlds.splat_folder import UNDONE_FILE, read_edits, save_splat, world_of, write_edits

from ..space.test_fitting import LENS, SIZE, room


def splat() -> SplatWorld:
    two = torch.full((2,), 2.0)
    starts = planar_pose(two, two, torch.full((2,), 1.6), torch.tensor([0.0, 2.0]))
    return SplatWorld("room", room(count=6000), torch.ones(6000, dtype=torch.uint8), starts, SplatConfig(LENS, SIZE))


def test_the_laws_hold():
    assert "a_batch_equals_its_singles" in check_world(splat(), steps=5)


def test_it_is_an_environment():
    env = terrella.as_env(splat(), num_envs=2, seed=0, max_steps=3)
    assert env.reset()[0].shape == (2, *SIZE, 3)  # pyright: ignore[reportAttributeAccessIssue]
    for _ in range(3):
        pictures, _, _, truncated, _ = env.step(env.action_space.sample())
    assert truncated.all() and pictures.std() > 5  # pyright: ignore[reportAttributeAccessIssue]


def test_one_walks_to_the_wall_flies_and_falls():
    world, rng = splat(), terrella.make_rng(0)
    press = lambda *names: torch.tensor([[int(one in names) for one in BUTTONS]], dtype=torch.int8)  # noqa: E731
    state = world.observe({"pose": world.starts[:1]}, None, rng)
    for _ in range(60):
        state = world.imagine(state, press("MOVE_FORWARD"), rng)
    assert 3.4 < state["pose"][0, 0] < 3.9 and abs(state["pose"][0, 2] - 1.6) < 0.2
    for _ in range(8):
        state = world.imagine(state, press("UP"), rng)
    assert state["flying"] and state["pose"][0, 2] > 1.8
    for _ in range(60):
        state = world.imagine(state, press("DOWN"), rng)
    assert not state["flying"] and abs(state["pose"][0, 2] - 1.6) < 0.2
    seen = world.render(state, ("known", "uncertainty", "ids"))
    assert seen["known"].mean() > 0.9 and seen["uncertainty"] < 0.1 and seen["ids"].max() < 6000


def test_a_picture_changes_the_place_of_its_episode_alone(tmp_path):
    made, rng = splat(), terrella.make_rng(0)
    world = SplatWorld("room", room(count=600), torch.ones(600, dtype=torch.uint8), made.starts, made.config)
    state = world.start(2, rng)
    before = world.render(state, ("rgb", "depth"))
    red = before["rgb"].clone()
    red[0] = torch.tensor([255, 0, 0], dtype=torch.uint8)
    for _ in range(6):
        state = world.observe({"rgb": red, "depth": before["depth"], "pose": state["pose"]}, state, rng)
    off = (world.render(state, ("rgb",))["rgb"].float() - before["rgb"].float()).abs().mean((1, 2, 3))
    assert off[0] > 15 and off[1] < 4
    elsewhere = world.render(world.start(2, rng), ("rgb", "pose"))
    assert torch.equal(elsewhere["rgb"], world.render(world.observe(elsewhere, None, rng), ("rgb",))["rgb"])
    gone_on = world.imagine(state.at([0, 0]), torch.zeros(2, len(BUTTONS), dtype=torch.int8), rng)
    gone_on.save(tmp_path / "state.safetensors")
    again = terrella.State.load(tmp_path / "state.safetensors")
    seen = [world.render(one, ("rgb", "known")) for one in (gone_on, again)]
    assert all(torch.equal(seen[0][name], seen[1][name]) for name in seen[0])
    more = world.observe(
        {"rgb": red[:1], "depth": before["depth"][:1, ::2, ::2], "pose": again["pose"][:1]}, again.at(0), rng
    )
    assert more.batch == 1
    with pytest.raises(ObservationError, match="depth"):
        world.observe({"rgb": red, "depth": before["depth"][:1], "pose": state["pose"]}, state, rng)


@pytest.mark.exact
def test_a_file_becomes_a_world_and_a_file_again(tmp_path, capsys):
    write_scene(room(), tmp_path / "room.ply")
    assert (
        main(["space", "import", str(tmp_path / "room.ply"), "--out", str(tmp_path / "w"), "--size", "24", "32"]) == 0
    )
    world = terrella.load(tmp_path / "w")
    assert "states_are_values" in check_world(world)
    x, y, z = world.render(world.start(1, terrella.make_rng(0)), ("pose",))["pose"][0, :3].tolist()
    assert 0.2 < x < 3.8 and 0.2 < y < 3.8 and 1.4 < z < 1.8  # inside, on its feet
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / "out.spz"), "--json"]) == 0
    assert json.loads("{" + capsys.readouterr().out.partition("{")[2])["gaussians"] == 1500
    assert len(read_scene(tmp_path / "out.spz")) == 1500
    for name, more in (("again.spz", []), ("again.4.spz", ["--spz", "4"]), ("again.ply", [])):  # and ours come back
        assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / name), *more]) == 0
        assert (
            main(["space", "import", str(tmp_path / name), "--out", str(tmp_path / f"of {name}"), "--size", "24", "32"])
            == 0
        )
        again = terrella.load(tmp_path / f"of {name}")
        assert isinstance(again, SplatWorld) and isinstance(world, SplatWorld)
        off = again.gaussians.means - world.gaussians.means
        assert off.abs().max() < 1e-3
    lift = torch.tensor([0, 0, 2.0])
    write_scene(replace(room(), means=room().means + lift), tmp_path / "up.ply")
    assert main(["space", "import", str(tmp_path / "up.ply"), "--out", str(tmp_path / "up"), "--size", "24", "32"]) == 0
    assert main(["space", "export", str(tmp_path / "up"), str(tmp_path / "down.ply"), "--ground"]) == 0
    down = read_scene(tmp_path / "up.ply").means - read_scene(tmp_path / "down.ply").means
    assert torch.allclose(down, lift.expand_as(down), atol=0.1)
    (tmp_path / "bad.ply").write_bytes(b"ply\n")
    assert main(["space", "import", str(tmp_path / "bad.ply"), "--out", str(tmp_path / "b")]) == 2
    assert not (tmp_path / "b").exists()


def test_nothing_else_is_overwritten(tmp_path):
    (tmp_path / "README.md").write_text("mine")
    with pytest.raises(CheckpointError, match="something else"):
        save_splat(world_of(room(count=600), "room", {}, SplatConfig(LENS, SIZE)), tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["README.md"]


def test_one_stands_on_a_bare_floor_and_not_in_the_air():
    flat = room(count=4000)
    flat = replace(flat, means=flat.means * torch.tensor([1.0, 1.0, 0.0]))
    start = world_of(flat, "floor", {}, SplatConfig(LENS, SIZE)).starts[0]
    assert 1.4 < float(start[2]) < 1.75


def test_what_is_empty_is_not_written(tmp_path):
    nothing = room(count=600).at(torch.zeros(600, dtype=torch.bool))
    for name in ("x.ply", "x.spz"):
        with pytest.raises(DatasetError, match="no Gaussian left"):
            write_scene(nothing, tmp_path / name)
    with pytest.raises(DatasetError, match="compressed kind"):
        write_scene(room(count=600), tmp_path / "x.spz", kind="compressed")


def test_damaged_folders_are_refused(tmp_path):
    save_splat(world_of(room(count=600), "room", {}, SplatConfig(LENS, SIZE)), tmp_path)
    (tmp_path / "scene.safetensors").write_bytes(b"no")
    with pytest.raises(CheckpointError, match="damaged"):
        terrella.load(tmp_path)


def test_a_crash_between_two_files_loses_no_edit(tmp_path, monkeypatch):
    one, two = ({"select": {"all": True}, "do": "turn", "degrees": angle} for angle in (10, 20))
    replace_whole = splat_folder.replace_whole
    for edits, undone in (([one], [two]), ([one, two], []), ([one, two, one], [])):  # undo, redo, another
        write_edits(tmp_path, [one, two] if undone else [one], [] if undone else [two])
        written = []

        def crash(path, write, written=written):
            if written:
                raise KeyboardInterrupt
            written.append(replace_whole(path, write))

        monkeypatch.setattr(splat_folder, "replace_whole", crash)
        with pytest.raises(KeyboardInterrupt):
            write_edits(tmp_path, edits, undone)
        monkeypatch.setattr(splat_folder, "replace_whole", replace_whole)
        left = read_edits(tmp_path) + read_edits(tmp_path, UNDONE_FILE)
        assert one in left and two in left


def test_an_imported_room_begins_looking_where_most_is_seen():
    hall = room(count=6000)
    long = replace(hall, means=hall.means * torch.tensor([1.0, 3.0, 1.0]))  # 12 m along y
    world = world_of(long, "long", {}, SplatConfig(LENS, SIZE))
    ahead = rotation(world.starts)[:, :, 0]
    assert 1 <= len(world.starts) < 8 and bool((ahead[:, 1].abs() > 0.6).all()) and abs(float(ahead[0, 1])) > 0.9
