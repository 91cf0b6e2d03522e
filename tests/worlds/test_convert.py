"""A world of format version 2, made by hand, is converted without loss; one sentence says so where it is not."""

from __future__ import annotations

import json

import pytest
import torch
from safetensors.torch import load_file, save_file

from terrella.cli import main
from terrella.core import make_rng
from terrella.core.errors import CheckpointError
from terrella.worlds.controls import Controls
from terrella.worlds.convert import convert_world
from terrella.worlds.folder import load_world, save_world
from terrella.worlds.uncertainty import UncertaintyConfig, UncertaintyNetwork

from .made import place

OLD_PARTS = {"body": "motion", "objects": "cast", "uncertainty": "doubt"}
OLD_LAYERS = {"output": "leave", "context": "time"}


def old_folder(path, new) -> None:
    """The world in the folder `new` as release 2 would have saved it: one config, other names."""
    about = json.loads((new / "world.json").read_text())
    parts = {name: part["config"] for name, part in about["parts"].items()}
    body, scene, drawn, outcome = (parts[name] for name in ("body", "scene", "generator", "outcome"))
    begins = outcome.pop("begins", ())
    config = {
        **scene, "actions": body["actions"], "channels": drawn["channels"], "history": body["history"],
        "body_m": body["body_m"], "short": body["short"], "geometry": True, "steps": drawn["steps"],
        "residual": drawn["residual"], "vitals": list(begins), "cast": parts["objects"] is not None, "own_keyframes": 9,
    }  # fmt: skip
    reads = about["parts"]["outcome"]["kind"] == "frames"
    old = {
        "kind": "video", "version": 2, "name": about["name"], "config": config,
        "rewards": [0.0, 0.0] if reads else [outcome["usual"], outcome["ending"]],
        "controls": {name: about["about"]["controls"][name] for name in ("kind", "low", "high")},
        "outcome": outcome if reads else None, "cast": parts["objects"], "eye": None, "doubt": parts["uncertainty"],
        "dt_s": about["about"]["dt_s"], "action_names": [], "keys": {}, "card": {**about["card"], "cast_looks": 4},
    }  # fmt: skip

    def renamed(name: str) -> str:
        part, *rest = name.split(".")
        rest = [OLD_LAYERS.get(word, word) if part in ("generator", "uncertainty") else word for word in rest]
        return ".".join([OLD_PARTS.get(part, part), *rest])

    path.mkdir()
    (path / "world.json").write_text(json.dumps(old))
    (path / "memory.safetensors").write_bytes((new / "memory.safetensors").read_bytes())
    weights = load_file(new / "weights.safetensors")
    save_file({renamed(name): value for name, value in weights.items()}, path / "weights.safetensors")


@pytest.mark.parametrize("more", [{}, {"moving": True, "objects": True}], ids=["still", "things"])
def test_an_old_world_is_converted_without_loss(tmp_path, capsys, more):
    made = place(Controls.buttons(3), **more).replaced(uncertainty=UncertaintyNetwork(UncertaintyConfig()))
    save_world(made, tmp_path / "made")
    world = load_world(tmp_path / "made")
    old_folder(tmp_path / "old", tmp_path / "made")
    with pytest.raises(CheckpointError, match=r"convert it: terrella convert-world .*old NEW"):
        load_world(tmp_path / "old")
    assert main(["play", str(tmp_path / "old")]) == 2 and "terrella convert-world" in capsys.readouterr().err
    assert main(["convert-world", str(tmp_path / "old"), str(tmp_path / "new")]) == 0
    converted = load_world(tmp_path / "new")
    assert (tmp_path / "new" / "memory.safetensors").read_bytes() == (
        tmp_path / "old" / "memory.safetensors"
    ).read_bytes()
    assert converted.config == world.config and converted.spec.channels == world.spec.channels
    assert converted.spec.card == {**world.spec.card, "objects_looks": 4}
    for part in ("generator", "outcome", "objects", "uncertainty"):
        mine, theirs = getattr(converted, part), getattr(world, part)
        assert mine.config == theirs.config
        if isinstance(mine, torch.nn.Module):
            assert all(torch.equal(value, theirs.state_dict()[name]) for name, value in mine.state_dict().items())
    ways = []
    for one in (converted, world):
        state = one.start(2, make_rng(0))
        state = one.imagine(state, one.spec.sample_action(2, make_rng(1)), make_rng(2))
        ways.append(one.render(state, ("rgb", "pose", "reward", "uncertainty")))
    assert all(torch.equal(ways[0][name], ways[1][name]) for name in ways[0])


def test_what_is_no_old_world_is_refused(tmp_path):
    save_world(place(Controls.buttons(2)), tmp_path / "made")
    with pytest.raises(CheckpointError, match="only kind 'video' of version 2 needs converting"):
        convert_world(tmp_path / "made", tmp_path / "new")
    old_folder(tmp_path / "old", tmp_path / "made")
    with pytest.raises(CheckpointError, match="is not empty; name a new folder"):
        convert_world(tmp_path / "old", tmp_path / "made")
    (tmp_path / "old" / "weights.safetensors").write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match="cannot be converted"):
        convert_world(tmp_path / "old", tmp_path / "new")
    with pytest.raises(CheckpointError, match="in place; name a new folder"):
        convert_world(tmp_path / "old", tmp_path / "old" / ".." / "old")
