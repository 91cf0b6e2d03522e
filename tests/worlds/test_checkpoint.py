"""A checkpoint is replaced as a whole: whoever reads it finds the old world or the new one, whenever its writer was killed."""

from __future__ import annotations

import json
import os
import sys
import threading
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from terrella.core.errors import CheckpointError
from terrella.worlds import checkpoint
from terrella.worlds.checkpoint import data_file, read_about, read_data, write_checkpoint
from terrella.worlds.controls import Controls
from terrella.worlds.folder import load_world, open_world, save_keys, save_world
from terrella.worlds.splat import SplatConfig
from terrella.worlds.splat_folder import load_source, save_splat, world_of

from ..space.test_fitting import room
from .made import place

CHANGES = {"open", "os.mkdir", "os.rename", "os.remove", "os.truncate", "os.link", "os.symlink"}
KILLED = 9


def numbered(number: int):
    """A world with its number in the card, in the weights and in the memory."""
    world = place(Controls.buttons(2)).replaced(card={"number": number})
    world.generator.output.bias.data.fill_(number)
    world.memory.pose[:, 2] = number
    return world


def number_of(folder: Path) -> int:
    """The number of a saved world, which is the same in all its files."""
    world = load_world(folder)
    numbers = {world.spec.card["number"], float(world.generator.output.bias[0]), float(world.memory.pose[0, 2])}
    assert len(numbers) == 1, f"a mixture of worlds: {numbers}"
    return int(numbers.pop())


def killed_before(number: int, write: Callable[[], object]) -> bool:
    """Whether a child process that dies before its `number`-th change of the file system died in `write`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of threads that a fork leaves behind
        child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == KILLED
    left = [number]

    def watch(event: str, given: tuple) -> None:
        writes = event != "open" or not isinstance(given[1], str) or any(mode in given[1] for mode in "wax+")
        if event in CHANGES and writes:
            left[0] -= 1
            if left[0] < 0:
                os._exit(KILLED)

    sys.addaudithook(watch)
    try:
        write()
    finally:
        os._exit(0)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system that forks")
def test_a_writer_that_is_killed_at_any_point_leaves_the_old_world_or_the_new_one(tmp_path):
    folder, worlds = tmp_path / "world", {1: numbered(1), 2: numbered(2)}
    save_world(worlds[1], folder)
    outcomes, point, now = [], 0, 1
    while True:
        other = 3 - now
        died = killed_before(point, lambda other=other: save_world(worlds[other], folder))
        after = number_of(folder)
        assert after in (now, other)
        outcomes.append((died, after == other))
        if not died:
            break
        now, point = after, point + 1
    assert after == other and len(outcomes) > 10, "it was killed at every change that it makes"
    assert outcomes[0] == (True, False) and (True, True) in outcomes, "before the new world.json, and behind it"
    save_world(worlds[1], folder)
    assert number_of(folder) == 1
    data = [path.name for path in folder.iterdir() if path.suffix == ".safetensors"]
    assert len(data) == 2, f"what killed writers left is removed by the next one: {data}"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system that forks")
def test_a_place_of_gaussians_is_replaced_whole_too(tmp_path):
    folder = tmp_path / "place"
    config = SplatConfig((0.5, 0.667, 0.5, 0.5), (24, 32))
    worlds = [world_of(room(count=count), "place", {"count": count}, config) for count in (200, 300)]
    save_splat(worlds[0], folder)
    seen, point, died = set(), 0, True
    while died:
        died = killed_before(point, lambda: save_splat(worlds[1], folder))
        place = load_source(folder)
        assert len(place.gaussians) == place.card["count"], "a mixture of places"
        seen.add(place.card["count"])
        if died and place.card["count"] == 300:
            save_splat(worlds[0], folder)
        point += 1
    assert seen == {200, 300}


def test_a_reader_beside_a_writer_finds_one_world_or_another(tmp_path):
    folder, worlds = tmp_path / "world", (numbered(1), numbered(2))
    save_world(worlds[0], folder)
    writer = threading.Thread(target=lambda: [save_world(worlds[turn % 2], folder) for turn in range(12)])
    writer.start()
    read = [number_of(folder)]
    while writer.is_alive():
        read.append(number_of(folder))
    writer.join()
    assert set(read) <= {1, 2}


def test_a_reader_follows_a_checkpoint_that_was_replaced_after_it_read_what_it_says(tmp_path):
    for number in (1, 2):
        about_before = read_about(tmp_path) if number == 2 else None
        write_checkpoint(tmp_path, {"number": number}, {"weights": {"x": torch.full((2,), number)}}, "# read me\n")
    about, (tensors,) = read_data(tmp_path, about_before, "weights")
    assert about["number"] == 2 and tensors["x"].tolist() == [2, 2]
    data_file(tmp_path, "weights").unlink()
    with pytest.raises(FileNotFoundError):
        read_data(tmp_path, about, "weights")


def test_a_new_folder_has_plain_names_and_nothing_else_of_a_folder_is_removed(tmp_path):
    save_world(numbered(1), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        "world.json", "README.md", "weights.safetensors", "memory.safetensors"
    }  # fmt: skip
    others = ("weights-mine.safetensors", "notes.safetensors", "memory.safetensors.txt")
    for name in others:
        (tmp_path / name).write_bytes(b"kept")
    save_world(numbered(2), tmp_path)
    names = {data_file(tmp_path, name).name for name in ("weights", "memory")}
    assert {path.name for path in tmp_path.iterdir()} == {"world.json", "README.md", *names, *others}
    save_keys(tmp_path, open_world(tmp_path).spec)
    assert number_of(tmp_path) == 2, "new keys leave the data where it is"


def test_an_error_while_it_is_written_leaves_the_old_world(tmp_path, monkeypatch):
    save_world(numbered(1), tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(path, text):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "write_text", full)
    with pytest.raises(CheckpointError, match="free some space"):
        save_world(numbered(2), tmp_path)
    assert number_of(tmp_path) == 1 and before.items() <= {p.name: p.read_bytes() for p in tmp_path.iterdir()}.items()


@pytest.mark.parametrize("file", ["../weights.safetensors", "/etc/passwd", "a/b.safetensors", "", 3])
def test_a_folder_names_no_file_outside_of_itself(tmp_path, file):
    save_world(numbered(1), tmp_path)
    about = json.loads((tmp_path / "world.json").read_text())
    (tmp_path / "world.json").write_text(json.dumps({**about, "files": {"weights": file}}))
    with pytest.raises(CheckpointError):
        load_world(tmp_path)
