"""Pictures as people have them: read whatever their mode, posed ones undistorted, depth found, what is no place refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from terrella import load
from terrella.cli import main
from terrella.core.errors import DatasetError
from terrella.learn.recipes.splat import doubts
from terrella.space.camera import FAR_M, rotation
from terrella.space.fitting import PosedViews
from terrella.space.pictures import is_pictures, posed_pictures
from terrella.space.pictures.colmap import read_colmap
from terrella.space.pictures.posed import shown_name, to_views
from terrella.space.pictures.reading import blurred, read_picture, sharpness
from terrella.space.pictures.transforms import read_transforms
from terrella.space.raster import rasterise
from terrella.space.stereo import with_depth
from terrella.worlds.splat import SplatWorld

from .test_fitting import room, views

LENS, SIZE = (0.5, 0.5, 0.5, 0.5), (48, 48)


def bright_room():
    """A room with much to see on its walls."""
    scene = room(count=5000)
    speckle = torch.rand(scene.sh.shape, generator=torch.Generator().manual_seed(1)) - 0.5
    return type(scene)(scene.means, scene.quats, scene.scales * 0.8, scene.opacities, scene.sh + 2 * speckle)


def walk(count=20) -> torch.Tensor:
    """Poses side by side that look at one wall."""
    pose = views(count).pose.clone()
    at = torch.arange(count)
    pose[:, 0], pose[:, 1], pose[:, 2] = 1.0, 1.2 + 1.6 * at / count, 1.0 + 0.2 * (at % 3)
    pose[:, 3:] = torch.tensor([1.0, 0, 0, 0])
    return pose


def written(folder, pose=None, names="{:03d}.png", **camera):
    """A folder with transforms.json of the room, as nerfstudio writes it."""
    pose = walk() if pose is None else pose
    seen = (rasterise(bright_room(), pose, LENS, SIZE).rgb.clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1)
    folder.mkdir()
    frames = []
    for number, (picture, one) in enumerate(zip(seen, pose)):
        rot, matrix = rotation(one), torch.eye(4)
        matrix[:3, :3] = torch.stack([-rot[:, 1], rot[:, 2], -rot[:, 0]], 1)
        matrix[:3, 3] = one[:3]
        Image.fromarray(picture.numpy()).save(folder / names.format(number))
        frames.append({"file_path": names.format(number), "transform_matrix": matrix.tolist()})
    doc = {"fl_x": 24, "fl_y": 24, "cx": 24, "cy": 24, "w": 48, "h": 48, **camera, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(doc))
    return folder, doc


def test_depth_is_found_where_pictures_show_something():
    pose = walk()
    seen = rasterise(bright_room(), pose, LENS, SIZE)
    truth = seen.depth / seen.alpha.clamp_min(0.5)
    blank = torch.full((20, 1, 1), FAR_M)
    given = PosedViews((seen.rgb.clamp(0, 1) * 255).byte(), blank, pose, LENS)
    found = with_depth(given).depth
    known = found < FAR_M
    assert known.float().mean() > 0.3
    assert ((found / truth - 1).abs()[known] < 0.2).float().mean() > 0.8
    mixed = PosedViews(given.rgb, blank, pose[torch.randperm(20, generator=torch.Generator().manual_seed(0))], LENS)
    wrong = with_depth(mixed).depth
    assert (wrong < FAR_M).float().mean() < 0.3 * known.float().mean()  # poses that do not fit the pictures


def test_posed_pictures_become_views_and_a_world(tmp_path, capsys):
    folder, doc = written(tmp_path / "set")
    shots, out = posed_pictures(folder, tmp_path / "work", 100)
    got, dull = to_views(shots, 480)
    assert not out and not dull and got.size == (48, 48) and torch.allclose(got.pose, walk(), atol=1e-5)
    assert got.camera == pytest.approx(LENS)
    truth = rasterise(bright_room(), walk(), LENS, SIZE).rgb.clamp(0, 1) * 255
    assert (got.rgb.float() - truth).abs().mean() < 3
    fit = ["space", "fit", str(folder), "--steps", "60", "--gaussians", "1500", "--frames", "20", "--json"]
    assert main([*fit, "--out", str(tmp_path / "run"), "--scale", "2"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["held_out_db"][0] > facts["nearest_picture_db"][0]
    before = (tmp_path / "run" / "resume.safetensors").read_bytes()
    assert main([*fit, "--out", str(tmp_path / "run"), "--scale", "2"]) == 0
    assert (tmp_path / "run" / "resume.safetensors").read_bytes() == before
    again = [*fit, "--out", str(tmp_path / "run"), "--scale", "2", "--collider"]
    for kind in ("indoor", "open"):  # of a finished fit, too
        assert main([*again, kind]) == 0
        world = load(tmp_path / "run")
        assert isinstance(world, SplatWorld) and world.config.collider == kind
        assert world.card["doubts"] == facts["doubts"]  # the page says them


def test_few_pictures_take_lifted_depth_and_keep_enough_out_for_an_interval(tmp_path, capsys, monkeypatch):
    folder, _ = written(tmp_path / "set", walk(9))
    lifted = []
    monkeypatch.setattr(
        "terrella.learn.recipes.splat_views.with_prior", lambda views, _: lifted.append(len(views)) or views
    )
    fit = ["space", "fit", str(folder), "--steps", "5", "--gaussians", "500", "--out", str(tmp_path / "run"), "--json"]
    assert main(fit) == 0
    facts = json.loads(capsys.readouterr().out)
    assert lifted == [9] and facts["held_out"] == 2 and facts["pictures"] == 7
    assert np.isfinite(facts["held_out_db"]).all() and np.isfinite(facts["nearest_picture_db"]).all()


def test_a_bent_lens_is_straightened(tmp_path):
    folder, doc = written(tmp_path / "set", k1=-0.2, k2=0.03)
    shots, _ = posed_pictures(folder, tmp_path / "work", 100)
    lens = shots.lenses[0]
    at = lens.pixels(np.array([[0.0, 0.0], [0.5, 0.0]]))
    assert at[0] == pytest.approx([24, 24]) and at[1, 0] == pytest.approx(
        24 + 24 * 0.5 * (1 - 0.2 * 0.25 + 0.03 * 0.0625)
    )
    left, top, right, bottom = lens.extent()
    assert right > 0.9 and (lens.pixels(np.array([[right, bottom]])) <= 48.6).all()


MODES = {
    "16 bits": lambda rgb: Image.fromarray(rgb[..., 0].astype(np.uint16) * 257),
    "CMYK": lambda rgb: Image.fromarray(rgb).convert("CMYK"),
    "palette": lambda rgb: Image.fromarray(rgb).quantize(64),
    "grey and alpha": lambda rgb: Image.fromarray(rgb).convert("LA"),
    "float": lambda rgb: Image.fromarray(rgb[..., 0].astype(np.float32) / 255),
}


@pytest.mark.parametrize("mode", MODES)
def test_pictures_of_any_mode(tmp_path, mode):
    rgb = np.full((40, 60, 3), 200, np.uint8)
    rgb[:20] = 100
    MODES[mode](rgb).save(tmp_path / "a.tif" if mode != "palette" else tmp_path / "a.png")
    read = read_picture(tmp_path / "a.tif" if mode != "palette" else tmp_path / "a.png")
    assert read.shape == (40, 60, 3) and read.dtype == np.uint8
    assert 1.5 < read[30:].mean() / read[:10].mean() < 2.5


def test_exif_turns_pictures_and_lenses_say_which_way(tmp_path):
    rgb = np.zeros((40, 60, 3), np.uint8)
    rgb[:20] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned by a quarter
    Image.fromarray(rgb).save(tmp_path / "a.jpg", exif=exif, quality=95)
    assert read_picture(tmp_path / "a.jpg").shape == (60, 40, 3)
    assert read_picture(tmp_path / "a.jpg", upright=False).shape == (40, 60, 3)
    assert read_picture(tmp_path / "a.jpg")[:, 30:].mean() > 200  # what was above is at the right now


def test_blur_is_told_from_little_to_see():
    rng = np.random.default_rng(0)
    sharp = np.repeat(np.repeat(rng.integers(0, 255, (30, 30, 3)), 4, 0), 4, 1).astype(np.uint8)
    faint = (128 + (sharp.astype(float) - 128) * 0.2).astype(np.uint8)
    from PIL import ImageFilter

    shaken = np.asarray(Image.fromarray(sharp).filter(ImageFilter.GaussianBlur(6)))
    assert blurred([sharpness(one) for one in (sharp, faint, sharp, shaken)]) == [False, False, False, True]


def listed(folder, *names, **top):
    """A transforms.json that lists these names."""
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in names]
    folder.mkdir(exist_ok=True)
    (folder / "transforms.json").write_text(
        json.dumps({"fl_x": 60, "w": 64, "h": 48, **top, "frames": frames}), "utf-8-sig"
    )


def saved(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (64, 48), (90, 90, 90)).save(folder / name)


PLY = "ply\nformat {} 1.0\nelement vertex 2\n{}end_header\n"
PLY_XYZ = "".join(f"property double {axis}\n" for axis in "xyz")
POINTS = {
    "text": PLY.format("ascii", PLY_XYZ + "element face 1\nproperty list uchar int v\n").encode()
    + b"1 2 3\r\n\r\n4 5 6\r\n3 0 1 1",
    "big endian": PLY.format("binary_big_endian", PLY_XYZ).encode() + np.arange(1, 7).astype(">f8").tobytes(),
}


@pytest.mark.parametrize("kind", POINTS)
def test_known_points_in_any_form_of_ply(tmp_path, kind):
    saved(tmp_path, "a.png")
    (tmp_path / "sfm").mkdir()
    (tmp_path / "sfm/my points.ply").write_bytes(POINTS[kind])
    listed(tmp_path, "a.png", ply_file_path="sfm\\my%20points.ply")
    shots = read_transforms(tmp_path)
    assert shots.points.tolist() == [[1, 2, 3], [4, 5, 6]] and not shots.left_out


def test_help_that_is_absent_or_broken_is_left_out_by_name(tmp_path):
    saved(tmp_path, "a.png", "c.png")
    (tmp_path / "points.ply").write_bytes(b"ply\nnothing of the kind")
    listed(tmp_path, "a.png", "b.png", "c.png", ply_file_path="points.ply")
    shots, out = posed_pictures(tmp_path, tmp_path / "work", 100)
    assert [file.name for file in shots.files] == ["a.png", "c.png"] and len(shots.pose) == len(shots.lenses) == 2
    assert out == ["points.ply (its header has no end)", "b.png (absent)"]
    listed(tmp_path, "a.png", ply_file_path="gone.ply")
    assert read_transforms(tmp_path).left_out == ("gone.ply (absent)",)
    with pytest.raises(DatasetError, match="b.png is not there"):
        read_picture(tmp_path / "b.png")


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("images\\my picture.png", "images/my picture.png"),
        ("images/my%20picture.png", "images/my picture.png"),
        (r"C:\Users\me\set\images\a.png", "images/a.png"),
        ("/home/me/set/images/a.png", "rgb/a.png"),
        ("./images/A.JPG", "images_2/a.jpg"),
        ("./train/r_0", "train/r_0.png"),
    ],
)
def test_names_of_other_machines(tmp_path, name, place):
    saved(tmp_path, place, "masks/a.png", "depth/a.png", "images_8/A.jpg")
    listed(tmp_path, name)
    assert read_transforms(tmp_path).files == [tmp_path / place]


def test_a_picture_of_another_name_is_not_taken_for_one_that_is_absent(tmp_path):
    saved(tmp_path, "left/1.png", "right/1.png", "right/2.png")
    listed(tmp_path, "left/1.png", "right/1.png", "left/2.png", "right/2.png", "left/3.png", "right/3.png")
    shots = read_transforms(tmp_path)
    assert len(shots.files) == 3 and shots.left_out == tuple(
        f"{one} (absent)" for one in ("left/2.png", "left/3.png", "right/3.png")
    )
    saved(tmp_path, "other/3.png")
    assert len(read_transforms(tmp_path).files) == 3


def test_blenders_sets_of_pictures_for_training(tmp_path):
    saved(tmp_path, "train/r_0.png")
    listed(tmp_path, "./train/r_0")
    (tmp_path / "transforms.json").rename(tmp_path / "transforms_train.json")
    for path in (tmp_path, tmp_path / "transforms_train.json"):
        assert is_pictures(path) and posed_pictures(path, tmp_path / "work", 9)[0].files == [tmp_path / "train/r_0.png"]


def test_lenses_of_each_picture_their_own(tmp_path):
    saved(tmp_path, "a.png", "b.png")
    listed(tmp_path, "a.png", "b.png")
    doc = json.loads((tmp_path / "transforms.json").read_text("utf-8-sig"))
    doc["frames"][1] |= {"fl_x": 80, "cx": 30, "mask_path": "gone.png", "depth_file_path": "gone too.png"}
    (tmp_path / "transforms.json").write_text(json.dumps(doc))
    shots = read_transforms(tmp_path)
    assert [lens.focal for lens in shots.lenses] == [(60, 60, 32, 24), (80, 80, 30, 24)]
    assert shots.left_out == (
        "1 masks (mask_path), which are not read",
        "1 depth pictures (depth_file_path), which are not read",
    )


def test_models_of_colmap_without_pictures_and_points(tmp_path):
    pytest.importorskip("pycolmap")
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    saved(tmp_path, "images/a/0.png", "images/a/1.png", "images/3.png")
    names = ("a/0.png", "a\\1.png", "a/2.png", "old/3.png")
    (model / "cameras.txt").write_text("1 PINHOLE 64 48 60 60 32 24\n")
    lines = [f"{k + 1} 1 0 0 0 {k} 0 0 1 {name}\n10 10 7\n" for k, name in enumerate(names)]
    (model / "images.txt").write_text("".join(lines))
    shots = read_colmap(tmp_path)
    assert [file.relative_to(tmp_path / "images").as_posix() for file in shots.files] == ["a/0.png", "a/1.png", "3.png"]
    assert shots.left_out == ("points3D.txt (absent)", "a/2.png (absent)") and not len(shots.points)


@pytest.mark.parametrize(("kind", "level"), [("float32", 0.4), ("float32", 102), ("uint16", 0.4 * 65535)])
def test_brightness_of_pictures_does_not_depend_on_what_they_show(tmp_path, kind, level):
    for name, bright in (("dim", 0.5), ("bright", 1)):
        Image.fromarray(np.full((40, 40), level * bright, kind)).save(tmp_path / f"{name}.tif")
    assert read_picture(tmp_path / "dim.tif").mean() == pytest.approx(51, abs=1)
    assert read_picture(tmp_path / "bright.tif").mean() == pytest.approx(102, abs=1)


def bad_json(folder, doc):
    (folder / "transforms.json").write_text('{"frames": [')


def no_rotation(folder, doc):
    doc["frames"][3]["transform_matrix"][0][0] = 5.0


def not_finite(folder, doc):
    doc["frames"][3]["transform_matrix"][2][3] = float("nan")


def no_focus(folder, doc):
    doc["fl_x"] = 0


def unknown_model(folder, doc):
    doc["camera_model"] = "ORTHOPHOTO"


def all_lost(folder, doc):
    for file in folder.glob("*.png"):
        file.unlink()


def some_lost(folder, doc):
    for number in range(3, 16):
        (folder / f"{number:03d}.png").unlink()


def no_picture(folder, doc):
    (folder / "003.png").write_bytes(b"nothing of the kind")


def cut(folder, doc):
    (folder / "003.png").write_bytes((folder / "003.png").read_bytes()[:300])


def tiny(folder, doc):
    Image.new("RGB", (5, 5)).save(folder / "003.png")


def other_shape(folder, doc):
    Image.new("RGB", (90, 40)).save(folder / "003.png")


def few(folder, doc):
    doc["frames"] = doc["frames"][:5]


def wrong_poses(folder, doc):
    for k, one in enumerate(doc["frames"]):  # each looks elsewhere, from far away
        c, s = np.cos(2.4 * k), np.sin(2.4 * k)
        one["transform_matrix"] = [[-s, 0, c, 10.0 * k], [c, 0, s, 3.0 * k * k], [0, 1, 0, 1], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (bad_json, "cannot be read as posed pictures"),
        (no_rotation, "003.png: its pose is no rotation"),
        (not_finite, "003.png: its pose is no rotation"),
        (no_focus, "no sensible size or focal length"),
        (unknown_model, "ORTHOPHOTO"),
        (all_lost, "none of its 20 pictures is there, such as 000.png"),
        (some_lost, "7 posed pictures (left out: 003.png (absent), 004.png (absent)"),
        (no_picture, "003.png cannot be read as a picture"),
        (cut, "003.png is incomplete"),
        (tiny, "003.png is 5 x 5 pixels"),
        (other_shape, "003.png is 90 x 40"),
        (few, "there are 5 posed pictures"),
        (wrong_poses, "do not agree on any surface"),
    ],
)
def test_bad_pictures_are_one_sentence_and_leave_no_world(tmp_path, capsys, damage, why):
    folder, doc = written(tmp_path / "set")
    damage(folder, doc)
    if damage is not bad_json:
        (folder / "transforms.json").write_text(json.dumps(doc))
    assert (
        main(["space", "fit", str(folder), "--out", str(tmp_path / "run"), "--steps", "5", "--gaussians", "200"]) == 2
    )
    said = capsys.readouterr().err
    assert why in said and "Traceback" not in said and not (tmp_path / "run" / "world").exists()


def test_a_folder_of_another_tool_is_told_how_it_becomes_posed_pictures(tmp_path, capsys):
    saved(tmp_path, "keyframes/images/1.jpg")  # as Polycam exports
    assert main(["space", "fit", str(tmp_path), "--out", str(tmp_path / "run")]) == 2
    assert "transforms.json names them (nerfstudio's ns-process-data" in capsys.readouterr().err


def test_huge_pictures_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("terrella.space.pictures.reading.MOST_PIXELS", 1000)
    Image.new("RGB", (60, 60)).save(tmp_path / "a.png")
    with pytest.raises(DatasetError, match="60 x 60"):
        read_picture(tmp_path / "a.png")


def test_plain_pictures_without_overlap(tmp_path, capsys):
    pytest.importorskip("pycolmap")
    rng = np.random.default_rng(0)
    (tmp_path / "set").mkdir()
    for k in range(16):
        noise = rng.integers(0, 255, (12, 16, 3), np.uint8)
        Image.fromarray(noise).resize((96, 72), Image.Resampling.BICUBIC).save(tmp_path / "set" / f"{k}.png")
    assert main(["space", "fit", str(tmp_path / "set"), "--out", str(tmp_path / "run")]) == 2
    assert "overlap too little" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_what_is_no_set_of_pictures_is_refused_before_anything_is_written(tmp_path, capsys):
    (tmp_path / "dark").mkdir()
    for k in range(9):
        Image.new("RGB", (96, 72)).save(tmp_path / "dark" / f"{k}.png")
    Image.new("RGB", (96, 72)).save(tmp_path / "one.png")
    for name, why in (
        ("dark", "0 sharp pictures (9 of 9 are of one colour)"),
        ("one.png", "is one file; of a single picture `terrella space lift`"),
        ("none", "does not exist; check the path"),
    ):
        assert main(["space", "fit", str(tmp_path / name), "--out", str(tmp_path / "run")]) == 2
        assert why in capsys.readouterr().err and not (tmp_path / "run").exists()


def test_copies_are_named_as_their_sources():
    assert [shown_name(Path(name)) for name in ("a.JPG.png", "a.png", "00005.png")] == ["a.JPG", "a.png", "00005.png"]


@pytest.mark.parametrize(
    ("ours", "copied", "poor"), [(14.7, 13.6, True), (24, 23, True), (24, 15, False), (36, 33.5, False)]
)
def test_a_poor_fit_is_called_poor(ours, copied, poor):
    notes = doubts({"held_out_db": [ours, 1.0], "nearest_picture_db": [copied, 1.0]})
    assert [f"by {ours:.1f} dB" in one for one in notes] == [True] * poor


def test_a_recording_with_a_picture_beside_its_data_is_no_folder_of_pictures(tmp_path):
    Image.new("RGB", (60, 60)).save(tmp_path / "look.jpg")
    assert is_pictures(tmp_path)
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text("{}")
    assert not is_pictures(tmp_path)
