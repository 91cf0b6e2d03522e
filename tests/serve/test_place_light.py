"""Another light of a built place: baked by the server, saved with the layout; objects and edits stay."""

from __future__ import annotations

import json

import pytest
import torch

from terrella.core.errors import TerrellaError
from terrella.serve.place_page import build_place
from terrella.serve.thing_page import Spot
from terrella.workflows.build_space import BuildSpaceConfig, build_space
from terrella.workflows.editable_place import editable_place
from terrella.workflows.put_things import put_things
from terrella.workflows.relight_space import light_of, name_at, relight_space
from terrella.worlds.splat_folder import UNDONE_FILE, load_source, read_edits, save_splat, write_edits

from .test_place_page import opened, serving, until, world  # noqa: F401  (fixtures)

LAYOUT = {
    "rooms": [{"name": "hall", "at": [0, 0], "size": [3, 3, 2.5], "walls": "white plaster"}],
    "windows": [{"room": "hall", "wall": "south", "at": 1.5, "sill": 0.9}],
    "things": [{"label": "chair", "at": [1, 2]}],
    "name": "a hall at noon",
    "time": "noon",
}
EDIT = {"select": {"object": 2}, "do": "move", "by": [0.5, 0, 0]}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "layout.json").write_text(json.dumps(LAYOUT))
    build_space(tmp_path / "layout.json", tmp_path / "w", BuildSpaceConfig(gaussians=1000, size=(24, 32)))
    write_edits(tmp_path / "w", [EDIT])
    return tmp_path / "w"


def brightness(folder) -> float:
    return float(load_source(folder).gaussians.sh[:, 0].mean())


def test_another_light_is_baked_and_objects_and_edits_stay(folder, tmp_path):
    names, noon = load_source(folder).object_names, brightness(folder)
    relight_space(str(folder), {"time": "night", "sun": None})
    light = light_of(str(folder))
    assert light and (light["time"], light["sun"], light["times"]["noon"]) == ("night", None, (200.0, 50.0))
    assert load_source(folder).name == "a hall at night" == json.loads((folder / "layout.json").read_text())["name"]
    assert brightness(folder) < noon - 0.1 and load_source(folder).object_names == names
    assert read_edits(folder) == [EDIT] and (folder / "layout.json").exists()
    relight_space(str(folder), {"time": "noon", "sun": None})
    assert brightness(folder) == pytest.approx(noon)  # the same light, the same place
    relight_space(str(folder), {"time": "noon", "sun": [150, 20]})
    light = light_of(str(folder))
    assert light and light["sun"] == (150.0, 20.0) and brightness(folder) != noon


def test_what_was_put_is_lit_anew_too(folder):
    (chair,) = put_things(folder, "a red chair", Spot((2, 1, 0), floor=0, degrees=90)).edits
    write_edits(folder, [EDIT, chair], [chair])
    whole = [load_source(folder, None).gaussians.sh[:, 0]]
    for time in ("night", "noon"):
        relight_space(str(folder), {"time": time, "sun": None})
        whole.append(load_source(folder, None).gaussians.sh[:, 0])
    put = [one[len(load_source(folder).gaussians) :].mean() for one in whole]
    assert put[1] < put[0] - 0.1 and put[2] == put[0]
    assert read_edits(folder) == [EDIT, chair] and read_edits(folder, UNDONE_FILE) == [chair]


@pytest.mark.parametrize(
    ("name", "later"),
    [
        ("a bright kitchen at noon", "a bright kitchen in the evening"),
        ("an overcast loft with a lamp", "a loft with a lamp in the evening"),
        ("a sunny attic", "an attic in the evening"),
        ("a library on a cloudy day", "a library in the evening"),
        ("flat", "flat"),
        ("a sunny bedroom with two night tables", "a bedroom with two night tables in the evening"),
        ("the evening star hotel", "the evening star hotel"),
        ("a room by day and by night", "a room by day and by night"),
    ],
)
def test_a_time_in_the_name_changes_with_the_light(name, later):
    assert name_at(name, "evening") == later


def test_what_cannot_be_lit_anew_stays_as_it_is(folder, tmp_path):
    before = brightness(folder)
    for light, why in (({"time": "teatime"}, "teatime"), ({}, "time"), ({"time": "noon", "sun": [1]}, "sun")):
        with pytest.raises(TerrellaError, match=why):
            relight_space(str(folder), light)
    document = json.loads((folder / "layout.json").read_text())
    (folder / "layout.json").write_text(json.dumps(document | {"things": []}))
    with pytest.raises(TerrellaError, match="was changed since"):
        relight_space(str(folder), {"time": "night"})
    assert brightness(folder) == before
    save_splat(world(300), tmp_path / "other")
    assert light_of(str(tmp_path / "other")) is None and editable_place(str(tmp_path / "other")).relight is None
    with pytest.raises(TerrellaError, match="not built of words"):
        relight_space(str(tmp_path / "other"), {"time": "night"})


def test_the_page_bakes_another_light_and_opens_it_where_one_stood(folder, opened, serving):  # noqa: F811
    page = opened(serving(build_place(editable_place(str(folder)))), size=(500, 500))
    page.evaluate("terrella.stand([1, 1, 1.5], 0.5, 0.1)")
    colour = "terrella.story.scene.colours.reduce((sum, one) => sum + one, 0)"
    noon = page.evaluate(colour)
    page.keyboard.press("KeyX")
    assert page.input_value("[data-light=time]") == "noon" and page.input_value("[data-light=heading]") == "200"
    page.select_option("[data-light=time]", "night")
    assert page.is_disabled("[data-light=height]")  # no sun
    page.evaluate("terrella.story.undo()")
    page.click("[data-light=bake]")
    assert "save the edits first" in page.inner_text("#toast")
    page.evaluate("terrella.story.redo()")
    with page.expect_navigation(timeout=120_000):
        page.click("[data-light=bake]")
    until(page, f"!!window.terrella && terrella.idle && {colour} < 0.8 * {noon}")
    assert page.evaluate("terrella.eye.place") == pytest.approx([1, 1, 1.5], abs=0.01) and page.is_visible("#light")
    assert page.input_value("[data-light=time]") == "night" and page.evaluate("terrella.story.edits") == [EDIT]
    assert torch.allclose(
        load_source(folder).starts[0, :2], torch.tensor(page.evaluate("terrella.walker.world.starts[0].slice(0, 2)"))
    )


def test_words_are_words_though_a_folder_has_their_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny room").mkdir()
    assert build_space("tiny room", tmp_path / "w", BuildSpaceConfig(gaussians=1000, size=(24, 32))).facts["rooms"] == 1
