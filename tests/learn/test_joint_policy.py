"""One policy of several recordings: it knows which body it drives by the embodiment, each with its own action space."""

from __future__ import annotations

import json
import re
from copy import copy
from dataclasses import replace
from shutil import copytree, ignore_patterns

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from tests.learn.stopping import quiet

import terrella
from terrella.act.embodiment import EMBODIMENT, Embodiment
from terrella.cli import main
from terrella.core.errors import ActionError, DatasetError, TrainingError
from terrella.core.world import make_rng
from terrella.data import record
from terrella.learn.demonstrations import DemonstrationRows
from terrella.learn.merged import by_body
from terrella.learn.recipes.imitation import (
    Imitation,
    embodiment_of,
    joint_config,
    open_demonstrations,
    train_imitation,
)
from terrella.learn.recipes.policy import Practice
from terrella.sim.gymnasium import GymnasiumWorld

QUICK = Practice(sees=("offset",), steps=200, batch=64, hidden=32, learning_rate=5e-3, save_every_s=1e9)
# Of two bodies with actions alike in width and limits one goes the other way; the third has two numbers and other limits.
BODIES = {"Forth": (1.0, 1, 1.0), "Back": (-1.0, 1, 1.0), "Wide": (1.0, 2, 0.5)}  # sign, width, limit


class Cart(gymnasium.Env):
    """Sees how far its goal is, and moves by the last number of its action."""

    metadata = {"render_modes": ["ansi"], "render_fps": 10}

    def __init__(self, sign=1.0, width=1, limit=1.0, render_mode=None):
        self.sign, self.load, self.offset = sign, np.zeros(width, np.float32), np.zeros(1, np.float32)
        self.action_space = spaces.Box(-limit, limit, (width,))
        self.observation_space = spaces.Dict({"offset": spaces.Box(-9, 9, (1,)), "load": spaces.Box(-1, 1, (width,))})

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.offset, self.steps = self.np_random.uniform(-0.4, 0.4, 1).astype(np.float32), 0
        return self.seen(), {}

    def step(self, action):
        self.offset, self.steps = self.offset - self.sign * action[-1:], self.steps + 1
        return self.seen(), 0.0, False, self.steps >= 5, {}

    def seen(self):
        return {"offset": self.offset.astype(np.float32), "load": self.load}


for name, (sign, width, limit) in BODIES.items():
    if f"Terrella{name}-v0" not in gymnasium.registry:
        kwargs = {"sign": sign, "width": width, "limit": limit}
        gymnasium.register(f"Terrella{name}-v0", f"{__name__}:Cart", kwargs=kwargs)


class Teacher:
    """Goes half the way to the goal, from random places."""

    sees = ("offset",)

    def __init__(self, name):
        self.sign, self.width, _ = BODIES[name]

    def begin(self, batch, rng):
        return None

    def act(self, observation, memory, rng):
        half = self.sign * observation["offset"].clamp(-0.8, 0.8) / 2
        return torch.cat([torch.zeros(len(half), self.width - 1), half], 1), None


@pytest.fixture(scope="module")
def bodies(tmp_path_factory):
    """(name -> its world, name -> its recording, the folder of both)"""
    folder = tmp_path_factory.mktemp("bodies")
    worlds = {name: GymnasiumWorld(f"Terrella{name}-v0") for name in BODIES}
    for name, world in worlds.items():
        record(world, Teacher(name), folder / name, 200, make_rng(0))
    return worlds, {name: folder / name for name in BODIES}, folder


def test_one_policy_drives_bodies_of_other_actions(bodies):
    worlds, recordings, folder = bodies
    facts = train_imitation(list(recordings.values()), folder / "run", QUICK, Imitation(history=1, chunk=1), quiet)
    assert facts["bodies"] == [f"gym:Terrella{name}-v0" for name in BODIES]
    assert all(f"{folder / name} (gym:Terrella{name}-v0): The policy" in facts["held_out_verdict"] for name in BODIES)
    offset = torch.tensor([[-0.3], [0.3]])
    for name, world in worlds.items():
        policy, rng = terrella.load_policy(facts["policy"], world.spec), make_rng(0)
        action, _ = policy.act({"offset": offset}, policy.begin(2, rng), rng)
        wanted, _ = Teacher(name).act({"offset": offset}, None, rng)
        assert action.shape == wanted.shape and torch.allclose(action, wanted, atol=0.08), name
    other = GymnasiumWorld("Pendulum-v1").spec
    with pytest.raises(ActionError, match=r"drives gym:TerrellaForth-v0 and .* gym:Pendulum-v1 is another body"):
        terrella.load_policy(facts["policy"], other)
    task = replace(worlds["Back"].spec, name="another task", embodiment="gym:TerrellaBack-v0")
    terrella.load_policy(facts["policy"], task)
    with pytest.raises(ActionError, match="other actions of gym:TerrellaBack-v0 .* mode axes and torque"):
        terrella.load_policy(facts["policy"], replace(task, action_mode="torque"))


def test_a_batch_holds_every_recording_and_which_body_acted(bodies):
    _, recordings, _ = bodies
    several = [open_demonstrations(path, ("offset",), (64, 64), quiet) for path in recordings.values()]
    config = joint_config(several, 32, Imitation(history=1))
    assert config.action_width == 2 and [body.high for body in config.bodies] == [(1.0,), (1.0,), (0.5, 0.5)]
    for at, (opened, _) in enumerate(several):
        rows = DemonstrationRows.of(opened, config, torch.device("cpu"))
        batch = rows.sample(8, np.random.default_rng(0))
        assert batch.seen[EMBODIMENT].equal(torch.eye(3)[[at] * 8]) and batch.chunk.shape[2] == 2
        assert at == 2 or not batch.chunk[..., 1].any()
    assert joint_config([several[0], several[0]], 32, Imitation()).bodies == ()  # two recordings of one body


def test_recordings_of_one_task_each_are_instructed_where_these_differ(bodies):
    several = []
    for name, task in (("Forth", "go left"), ("Back", "go right")):
        opened, sees = open_demonstrations(bodies[1][name], ("offset",), (64, 64), quiet)
        own = copy(opened.cache)
        own.tasks = (task,)
        several.append((replace(opened, cache=own), sees))
    assert {"left", "right"} <= {*joint_config(several, 32, Imitation()).vocabulary}


def test_a_body_remembers_its_own_numbers_alone(bodies, tmp_path):
    worlds, recordings, _ = bodies
    joint = [recordings["Forth"], recordings["Wide"]]
    acting = Imitation(history=2, own_actions=True)
    facts = train_imitation(joint, tmp_path / "run", replace(QUICK, steps=2), acting, quiet)
    policy, rng = terrella.load_policy(facts["policy"], worlds["Forth"].spec), make_rng(0)
    _, memory = policy.act({"offset": torch.tensor([[0.3]])}, policy.begin(1, rng), rng)
    assert memory["acted"][0, -1, 0] != 0 and memory["acted"][0, -1, 1] == 0


def test_a_merged_recording_holds_each_bodys_own_actions(bodies, tmp_path, capsys):
    worlds, recordings, _ = bodies
    merge = ["data", "merge", *map(str, recordings.values()), "--out", f"{tmp_path}/all"]
    assert not main(merge)
    one, _ = open_demonstrations(tmp_path / "all", ("offset",), (64, 64), quiet)
    for name, part in zip(BODIES, by_body(one), strict=True):
        original, _ = open_demonstrations(recordings[name], ("offset",), (64, 64), quiet)
        assert embodiment_of(part) == Embodiment.of(worlds[name].spec) == embodiment_of(original)
        rows = part.usable | np.isin(part.start, [part.cache.ranges[number, 0] for number in part.held_out])
        assert np.allclose(part.cache.action[rows], original.cache.action, atol=1e-6)
    wide = np.asarray(one.cache.arrays["embodiment"]).reshape(-1) == 2
    held_out = tuple(number for number, (first, _) in enumerate(one.cache.ranges) if wide[first])
    third = by_body(replace(one, usable=one.usable & ~wide, held_out=held_out))[2]
    assert third.usable.any() and not third.held_out, "a body whose episodes were all held out learns from them"
    facts = train_imitation(tmp_path / "all", tmp_path / "run", replace(QUICK, steps=2), Imitation(history=1), quiet)
    assert facts["bodies"] == [f"gym:Terrella{name}-v0" for name in BODIES]
    text = (tmp_path / "all.toml").read_text()
    cut = re.sub(r'\{name = "action_0", to = "[^"]*Wide[^}]*\}', '{name = "action_0", out = "not needed"}', text)
    assert cut != text
    (tmp_path / "cut.toml").write_text(cut)
    assert not main([*merge[:-1], f"{tmp_path}/cut", "--mapping", f"{tmp_path}/cut.toml"])
    with pytest.raises(DatasetError, match="does not hold the whole action of gym:TerrellaWide-v0: merge again"):
        train_imitation(tmp_path / "cut", tmp_path / "other", QUICK, Imitation(), quiet)


def test_recordings_that_one_policy_cannot_learn_from_are_refused(bodies, tmp_path, capsys):
    worlds, recordings, folder = bodies
    joint, imitation = [recordings["Forth"], recordings["Wide"]], Imitation(history=1)
    with pytest.raises(DatasetError, match="differ in load: name what they have alike, --sees offset"):
        train_imitation(joint, tmp_path / "run", replace(QUICK, sees=()), imitation, quiet)
    with pytest.raises(TrainingError, match="take one recording"):
        train_imitation(joint, tmp_path / "run", QUICK, Imitation(remember=4), quiet)
    with pytest.raises(DatasetError, match="named twice"):
        train_imitation([joint[0], joint[0]], tmp_path / "run", QUICK, imitation, quiet)
    copytree(recordings["Back"], tmp_path / "other", ignore=ignore_patterns(".cache"))
    about = json.loads((tmp_path / "other/meta/terrella.json").read_text())
    about["world"] |= {"embodiment": "gym:TerrellaForth-v0", "action_mode": "torque"}
    (tmp_path / "other/meta/terrella.json").write_text(json.dumps(about))
    with pytest.raises(DatasetError, match="other has other actions of gym:TerrellaForth-v0 .* mode axes and torque"):
        train_imitation([recordings["Forth"], tmp_path / "other"], tmp_path / "run", QUICK, imitation, quiet)
    assert main(
        ["skills", "learn", str(recordings["Back"]), "--policy", f"{folder}/run", "--out", f"{tmp_path}/skills"]
    )
    assert "gym:TerrellaWide-v0; this takes a policy of one body" in capsys.readouterr().err
    assert main(["train", "policy", "--in", "gym:Pendulum-v1", "--from", "a", "b", "--out", f"{tmp_path}/run"])
    assert "only imitation takes several" in capsys.readouterr().err
