"""Films and files of a place: a smooth path, the same on the page and in Python; downloads; exposure."""

from __future__ import annotations

import json
import math
import threading
import time
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
import torch

from terrella.cli import main
from terrella.core.errors import TerrellaError
from terrella.serve.place_page import build_place
from terrella.space.camera import rotation, tilted_pose
from terrella.workflows.editable_place import editable_place
from terrella.workflows.export_space import exported_file, glide, read_path
from terrella.worlds.splat_folder import save_splat

from .test_place_page import opened, serving, until, world  # noqa: F401  (fixtures)

PATH = [
    [1.0, 1.0, 1.6, 170.0, 0.0],
    [2.0, 1.5, 1.4, -170.0, -10.0],
    [3.0, 3.0, 1.6, 100.0, 5.0],
    [1.0, 3.0, 1.6, 20.0, 0.0],
]


@pytest.fixture
def folder(tmp_path):
    save_splat(world(1500), tmp_path / "w")
    return tmp_path / "w"


def test_a_path_passes_its_views_from_rest_to_rest(tmp_path):
    (tmp_path / "path.json").write_text(json.dumps(PATH))
    views = read_path(tmp_path / "path.json")
    poses = glide(views, 1501)
    for view in views:
        assert float((poses[:, :3] - view[:3]).norm(dim=1).min()) < 0.01
    assert torch.allclose(poses[[0, -1]].abs(), tilted_pose(*views[[0, -1]].unbind(1)).abs(), atol=1e-5)
    speed = (poses[1:, :3] - poses[:-1, :3]).norm(dim=1)
    assert float(speed[0]) < 0.05 * float(speed.max()) and float(speed[-1]) < 0.05 * float(speed.max())
    heading = torch.atan2(rotation(poses)[:, 1, 0], rotation(poses)[:, 0, 0])
    assert float(heading[:500].cos().max()) < 0  # from 170 to -170 degrees the shorter way
    assert float(tilted_pose(*torch.tensor([[0.0], [0], [0], [0], [0.3]]))[0, 4:].norm()) > 0
    assert float(rotation(tilted_pose(*torch.tensor([[0.0], [0], [0], [0], [0.3]])))[0, 2, 0]) == pytest.approx(
        math.sin(0.3)
    )


def test_a_film_is_wide_and_brighter_if_asked(folder, tmp_path, capsys):
    (tmp_path / "path.json").write_text(json.dumps(PATH))
    way = ["--seconds", "0.5", "--path", str(tmp_path / "path.json"), "--aspect", "1.78", "--exposure", "1", "--json"]
    assert main(["space", "export", str(folder), str(tmp_path / "film.mp4"), *way]) == 0
    assert json.loads(capsys.readouterr().out)["size"] == [854, 480]
    (tmp_path / "path.json").write_text("[[0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0]]")
    for wrong in (way, ["--aspect", "9"], ["--exposure", "nan"], ["--exposure", "-5"]):
        assert main(["space", "export", str(folder), str(tmp_path / "no.mp4"), *wrong]) == 2
    assert main(["space", "export", str(folder), str(tmp_path / "no.ply"), "--exposure", "1"]) == 2
    assert not (tmp_path / "no.mp4").exists()


def test_files_that_the_page_asks_for(folder):
    wish = {"kind": "mp4", "path": PATH, "seconds": 0.5, "exposure": 0}
    for kind, head in (("spz", b"\x1f\x8b"), ("ply", b"ply"), ("gaussians.glb", b"glTF"), ("mp4", b"\0\0\0")):
        assert exported_file(str(folder), {**wish, "kind": kind}).startswith(head)
    for wrong in (
        {"kind": "exe"},
        {"kind": ["spz"]},
        {**wish, "seconds": 1e9},
        {**wish, "exposure": "x"},
        {**wish, "path": [[1]]},
    ):
        with pytest.raises(TerrellaError):
            exported_file(str(folder), wrong)


def test_a_film_ends_when_nobody_waits_for_it(folder, serving):  # noqa: F811
    def stop(done: int, total: int) -> None:
        raise TerrellaError("stopped")

    with pytest.raises(TerrellaError, match="stopped"):
        exported_file(str(folder), {"kind": "mp4", "path": PATH, "seconds": 9, "exposure": 0}, stop)
    ended = threading.Event()

    def export(wish, drawing):
        try:
            for number in range(300):
                drawing(number, 300)
                time.sleep(0.05)
        except TerrellaError:
            ended.set()
            raise
        return b"film"

    url = serving(build_place(replace(editable_place(str(folder)), export=export)))
    wish = json.dumps({"kind": "mp4", "key": editable_place(str(folder)).key}).encode()
    with pytest.raises(TimeoutError):
        urllib.request.urlopen(urllib.request.Request(url + "files", data=wish), timeout=1)
    assert ended.wait(10)
    done, total = json.loads(
        urllib.request.urlopen(urllib.request.Request(url + "drawn", data=b"{}"), timeout=9).read()
    )
    assert 0 < done < total == 300


def test_a_path_is_kept_previewed_and_downloaded(folder, opened, serving):  # noqa: F811
    page = opened(serving(build_place(editable_place(str(folder)))), size=(500, 360))
    for x, heading in ((1.0, 3.0), (2.0, -3.0), (3.0, 0.5)):
        page.evaluate(f"terrella.stand([{x}, 2, 1.6], {heading}, 0.1)")
        page.keyboard.press("KeyK")
    page.keyboard.press("KeyX")
    assert page.is_visible("#film") and page.locator(".views span").count() == 3
    theirs = page.evaluate("Array.from({ length: 21 }, (_, k) => terrella.film.at(k / 20))")
    mine = glide(torch.tensor(page.evaluate("terrella.film.views")), 21)
    assert np.allclose(np.asarray(theirs)[:, :3], mine[:, :3], atol=1e-4)
    turned = tilted_pose(*torch.tensor(theirs).unbind(1))
    assert float((rotation(turned) - rotation(mine)).abs().max()) < 1e-4
    page.fill("[data-film=seconds]", "1")
    page.click("[data-film=preview]")
    until(page, "!terrella.film.playing && Math.abs(terrella.eye.place[0] - 3) < 1e-6")
    page.fill("[data-film=exposure]", "1")
    until(page, "terrella.idle")
    for kind in ("spz", "mp4", "png"):
        with page.expect_download() as download:
            page.click(f"[data-file={kind}]")
        assert download.value.suggested_filename == f"a-room.{kind}"
    page.fill("[data-film=seconds]", "1e9")
    page.click("[data-file=mp4]")
    assert page.input_value("[data-film=seconds]") == "120"
    until(
        page,
        "/^Drawing picture \\d+ of 3600, \\d+ s left/.test(document.querySelector('[data-film=state]').textContent)",
    )
    page.click("[data-file=mp4]")
    until(page, "document.querySelector('[data-film=state]').textContent === 'The film was stopped.'")
    page.focus("[data-film=exposure]")  # keys still walk
    page.keyboard.down("KeyA")
    until(page, "Math.hypot(...terrella.walker.speed) > 0")
    page.keyboard.up("KeyA")
    box = page.locator("[data-film=exposure]").bounding_box()
    page.mouse.click(box["x"] + 0.75 * box["width"], box["y"] + 0.5 * box["height"])
    assert page.evaluate("[document.activeElement.tagName, terrella.drawing.stops > 0.5]") == ["BODY", True]
    page.reload()  # the browser keeps the path and the exposure
    until(
        page, "!!window.terrella && terrella.idle && terrella.film.views.length === 3 && terrella.drawing.stops > 0.5"
    )
    page.keyboard.press("KeyX")
    page.evaluate("terrella.story.add({ select: { object: 1 }, do: 'delete' })")
    page.click("[data-file=ply]")
    assert "save the edits first" in page.inner_text("#toast")
    page.keyboard.press("KeyE")  # the editor takes its place
    assert page.is_visible("#editor") and not page.is_visible("#film")
    bad = """() => fetch('/files', { method: 'POST', body: '{"kind": "exe"}' }).then((answer) => answer.text())"""
    assert "the page writes spz" in page.evaluate(bad)


def test_a_picture_of_the_view_is_without_the_path(folder, opened, serving):  # noqa: F811
    page, pictures = opened(serving(build_place(editable_place(str(folder)))), size=(400, 300)), []
    for place in ("[3, 1.6, 1.4]", "[3, 2.4, 1.4]", "[1, 2, 1.6]"):
        page.evaluate(f"terrella.stand({place}, 0)")
        if place != "[1, 2, 1.6]":
            page.keyboard.press("KeyK")
            assert "is kept" in page.inner_text("#toast")
    page.keyboard.press("KeyX")
    for views in (2, 0):
        page.evaluate(f"terrella.film.views.length = {views}")
        assert page.evaluate("terrella.film.wires.length") == views / 2
        until(page, "terrella.idle")
        with page.expect_download() as download:
            page.click("[data-file=png]")
        pictures.append(download.value.path().read_bytes())
    assert len(set(pictures)) == 1


def test_one_begins_as_the_picture_was_taken(tmp_path, opened, serving):  # noqa: F811
    pose = torch.tensor([[2.0], [2.0], [1.6], [0.3], [-0.7]])
    tilted = world(300)
    tilted.starts = tilted_pose(*pose)
    save_splat(tilted, tmp_path / "w")
    page = opened(serving(build_place(editable_place(str(tmp_path / "w")))), size=(300, 200))
    eye = page.evaluate("terrella.eye")
    assert (eye["heading"], eye["pitch"]) == pytest.approx((0.3, -0.7), abs=1e-5)


def test_exposure_is_a_factor_of_all_pictures(folder, opened, serving, tmp_path):  # noqa: F811
    assert main(["space", "export", str(folder), str(tmp_path / "place.html")]) == 0
    page = opened((tmp_path / "place.html").as_uri() + "#webgl")  # workers draw the ground beneath, too
    offered = "[...document.querySelectorAll('[data-file]:not([hidden])')].map((one) => one.dataset.file)"
    assert page.evaluate(offered) == ["png"]
    pixels = "(stops) => { terrella.drawing.stops = stops; return terrella.pixels().then(({ data }) => data); }"
    plain, dark = (np.array(page.evaluate(pixels, stops), float).reshape(-1, 4)[:, :3] for stops in (0, -1))
    assert np.abs(dark - plain * 2 ** (-1 / 2.2)).max() <= 1.01
