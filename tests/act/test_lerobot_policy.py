"""Policies of LeRobot, in files: what its process answers reaches the world, memories stay what they were, bad folders are named.

A stand-in for lerobot (lerobot_stand_in) answers here; tests/data/test_lerobot.py runs the real one.
"""

from __future__ import annotations

import gc
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium import spaces
from safetensors.torch import save_file
from tests.act.reach import NAME

import terrella
from terrella.act.lerobot_policy import PYTHON, LerobotConfig, LerobotPolicy, _end, lerobot_folder
from terrella.act.lerobot_program import HostedPolicy
from terrella.act.planning import PlaySettings, play
from terrella.cli import main
from terrella.core.errors import ActionError, ChannelError, CheckpointError, TerrellaError
from terrella.core.policy import act
from terrella.core.spec import Spec
from terrella.core.world import make_rng
from terrella.workflows.page_agents import PageAgents

WEIGHTS = torch.tensor([[-0.5, 0.0, 0.2], [0.0, -0.5, 0.1]])
STATS = {
    "observation.state": (torch.tensor([1.0, -1.0]), torch.tensor([2.0, 0.5])),
    "observation.images.rgb": (torch.tensor([[[0.5]]]), torch.tensor([[[0.25]]])),
    "action": (torch.tensor([0.1, 0.0]), torch.tensor([0.5, 0.25])),
}
PICTURE, STATE = {"type": "VISUAL", "shape": [3, 32, 32]}, {"type": "STATE", "shape": [2]}
STAND_IN = str(Path(__file__).parent / "lerobot_stand_in")
KINDS = dict.fromkeys(("VISUAL", "STATE", "ACTION"), "MEAN_STD")


@pytest.fixture(autouse=True)
def stand_in(monkeypatch):
    monkeypatch.setenv(PYTHON, sys.executable)
    monkeypatch.setenv("PYTHONPATH", STAND_IN)


def saved(folder, stats=STATS, after=STATS, rename=None, **changes):
    """A folder as LeRobot 0.4 saves it."""
    folder.mkdir(parents=True)
    inputs = {"observation.images.rgb": PICTURE, "observation.state": STATE}
    config = {"type": "act", "input_features": inputs, "output_features": {"action": {"type": "ACTION", "shape": [2]}}}
    config |= {"normalization_mapping": KINDS, "device": "cpu", "use_amp": False, **changes}
    (folder / "config.json").write_text(json.dumps(config))
    save_file({"weights": WEIGHTS}, folder / "model.safetensors")
    renames = {"config": {"rename_map": rename or {}}}
    for name, numbers in (("policy_preprocessor", stats), ("policy_postprocessor", after)):
        steps = [renames, {"config": {"norm_map": KINDS}, "state_file": f"{name}_1.safetensors"}]
        (folder / f"{name}.json").write_text(json.dumps({"name": name, "steps": steps}))
        flat = {f"{key}.{what}": x for key, pair in numbers.items() for what, x in zip(("mean", "std"), pair)}
        save_file(flat, folder / f"{name}_1.safetensors")
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("lerobot") / "policy")


@pytest.fixture
def world():
    return terrella.load(NAME)


def expected(rgb, state):
    """The first action of a chunk, by hand."""
    (mean, std), (dark, spread), (shift, scale) = STATS.values()
    unit = rgb.float().mean((1, 2, 3)) / 255
    seen = torch.cat([(state - mean) / std, ((unit - dark.item()) / spread.item())[:, None]], 1)
    return seen @ WEIGHTS.T, lambda raw: (raw * scale + shift).clamp(-1, 1)


def test_it_acts_by_chunks_and_a_memory_stays_what_it_was(folder, world):
    policy, rng = terrella.load_policy(folder, world.spec), make_rng(0)
    assert isinstance(policy, LerobotPolicy) and policy.sees == ("rgb", "state")
    state = world.start(1, rng)
    memory, raw, back = policy.begin(1, rng), None, None
    for step in range(7):
        seen = world.render(state, policy.sees)
        before = memory
        action, memory = act(policy, seen, memory, 1, world.spec, rng)
        if step % 3 == 0:
            raw, back = expected(seen["rgb"], seen["state"])
        assert torch.allclose(action, back(raw + 0.1 * (step % 3)), atol=1e-5)
        again, _ = act(policy, seen, before, 1, world.spec, rng)
        assert torch.equal(again, action)
        state = world.imagine(state, action, rng)


def test_a_batch_is_its_single_episodes_with_noise_too(folder, world):
    policy = terrella.load_policy(folder, world.spec)
    seen = {"rgb": torch.full((3, 64, 64, 3), 240, dtype=torch.uint8), "state": torch.ones(3, 2)}  # bright: with noise
    rng, again = make_rng(3), make_rng(3)
    action, memory = policy.act(seen, policy.begin(3, rng), rng)
    ones = [policy.act({k: v[i : i + 1] for k, v in seen.items()}, policy.begin(1, again), again)[0] for i in range(3)]
    assert torch.equal(action, torch.cat(ones)) and len({tuple(row) for row in action.tolist()}) == 3
    gone = [memory[0].number, memory[1].number]
    kept = memory[2:]
    del memory
    gc.collect()
    assert set(gone) <= set(policy.process.forgotten)
    policy.act({k: v[2:] for k, v in seen.items()}, kept, rng)
    assert not set(gone) & set(policy.process.forgotten)


def test_evaluate_prints_a_verdict_and_a_page_lets_it_drive(folder, world, capsys, tmp_path):
    words = ["evaluate", str(folder), "idle", "--in", NAME, "--episodes", "3", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "In the dream the best of 2 is policy" in said and "random (baseline)" in said
    agents = PageAgents(world, name=str(folder)).agents()
    assert isinstance(agents.make({}).policy, LerobotPolicy) and agents.words is None
    for words in (["practise", str(folder), "--goal", "state=0,0"], ["evaluate", str(folder), "--best-of", "2"]):
        assert main([*words, "--in", NAME, "--out", str(tmp_path / "other")]) == 2
        assert "is a policy of kind 'lerobot'" in capsys.readouterr().err
    assert play(world, terrella.load_policy(f"{folder}@0.5", world.spec), 2, PlaySettings(4)).episodes


def test_other_names_of_inputs(tmp_path, world):
    inputs = {"observation.image": PICTURE, "observation.joints": STATE}
    run = saved(
        tmp_path / "run/checkpoints/last/pretrained_model",
        rename={"observation.state": "observation.joints"},
        input_features=inputs,
    ).parents[2]
    config = LerobotConfig.read(lerobot_folder(run))
    assert config.channels(world.spec) == {"observation.image": "rgb", "observation.state": "state"}
    assert lerobot_folder(tmp_path) is None


def spec_with(**channels):
    return Spec("elsewhere", spaces.Box(-1, 1, (2,), np.float32), channels, (), 0.1)


RGB = spaces.Box(0, 255, (16, 16, 3), np.uint8)
TWO = spaces.Box(-1, 1, (2,), np.float32)


def test_what_a_world_lacks_is_named(folder, world):
    with pytest.raises(
        ChannelError, match=r"sees observation.state \(2,\).* shows observation.images.rgb \(16, 16, 3\)"
    ):
        terrella.load_policy(folder, spec_with(rgb=RGB))
    with pytest.raises(ChannelError, match=r"observation.images.rgb \(3, 32, 32\), observation.state.*more than once"):
        terrella.load_policy(folder, spec_with(**{"rgb.a": RGB, "rgb.b": RGB, "arm": TWO, "hand": TWO}))
    with pytest.raises(ActionError, match=r"actions of 2 numbers, and elsewhere takes 3"):
        terrella.load_policy(folder, Spec("elsewhere", spaces.Box(-1, 1, (3,), np.float32), {"state": TWO}, (), 0.1))
    policy = terrella.load_policy(folder, world.spec)
    with pytest.raises(ChannelError, match="sees state, which the observation lacks"):
        policy.act({"rgb": torch.zeros(1, 64, 64, 3, dtype=torch.uint8)}, policy.begin(1, make_rng(0)), make_rng(0))


def test_what_is_no_policy_that_runs_here_is_a_sentence(tmp_path, world, capsys):
    def refused(folder, kind=CheckpointError):
        with pytest.raises(kind) as error:
            terrella.load_policy(folder, world.spec)
        return str(error.value)

    assert "of kind 'smolvla'; act and diffusion run here" in refused(saved(tmp_path / "vla", type="smolvla"))
    bare = saved(tmp_path / "bare")
    (bare / "policy_preprocessor.json").unlink()
    assert "lacks policy_preprocessor.json; LeRobot before 0.4" in refused(bare)
    part = saved(tmp_path / "part")
    (part / "policy_postprocessor_1.safetensors").unlink()
    assert "lacks policy_postprocessor_1.safetensors. Copy the whole folder" in refused(part)
    broken = saved(tmp_path / "broken", input_features=3)
    assert "do not describe a policy of LeRobot" in refused(broken)
    assert main(["evaluate", str(bare), "--in", NAME, "--out", str(tmp_path / "out")]) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_a_normalisation_that_does_not_fit_is_refused(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(STAND_IN)

    def refused(name, **how):
        with pytest.raises(ValueError) as error:
            HostedPolicy(str(saved(tmp_path / name, **how)))
        return str(error.value)

    other = {**STATS, "action": (torch.tensor([0.1, 0.5]), torch.tensor([0.5, 0.25]))}
    assert "the statistics of actions differ" in refused("other", after=other)
    lacking = {name: pair for name, pair in STATS.items() if "state" not in name}
    assert "no statistics of observation.state, which is normalised by MEAN_STD" in refused("lacking", stats=lacking)
    flat = {**STATS, "observation.state": (torch.zeros(2), torch.zeros(2))}
    assert "observation.state give numbers that are not finite" in refused("flat", stats=flat)
    modes = {**KINDS, "STATE": "IDENTITY"}
    assert "STATE by IDENTITY, and policy_preprocessor.json by MEAN_STD" in refused("m", normalization_mapping=modes)
    for module in [name for name in sys.modules if name.partition(".")[0] == "lerobot"]:
        del sys.modules[module]


def test_a_python_without_lerobot_and_a_failing_one_are_sentences(folder, world, tmp_path, monkeypatch):
    policy = terrella.load_policy(folder, world.spec)
    seen = {"rgb": torch.zeros(1, 64, 64, 3, dtype=torch.uint8), "state": torch.full((1, 2), 1e9)}
    begun = policy.begin(1, make_rng(0))
    with pytest.raises(TerrellaError, match="LeRobot fails with RuntimeError: size mismatch"):
        policy.act(seen, begun, make_rng(0))
    policy.act({**seen, "state": torch.zeros(1, 2)}, begun, make_rng(0))  # it goes on
    policy.process._running.kill()
    with pytest.raises(TerrellaError, match="process has ended"):
        policy.act(seen, begun, make_rng(0))
    assert terrella.load_policy(folder, world.spec).process is not policy.process
    monkeypatch.setenv(PYTHON, "false")
    with pytest.raises(CheckpointError, match="does not load in LeRobot: LeRobot's process has ended"):
        terrella.load_policy(saved(tmp_path / "a"), world.spec)
    monkeypatch.setenv(PYTHON, str(tmp_path / "python"))
    with pytest.raises(CheckpointError, match=f"cannot be started .*{PYTHON}"):
        terrella.load_policy(saved(tmp_path / "b"), world.spec)
    monkeypatch.setenv(PYTHON, sys.executable)
    monkeypatch.delenv("PYTHONPATH")
    with pytest.raises(CheckpointError, match=f"does not run .*named 'lerobot'.: install lerobot 0.4.4 .* in {PYTHON}"):
        terrella.load_policy(saved(tmp_path / "d"), world.spec)
    monkeypatch.delenv(PYTHON)
    (tmp_path / "here/lerobot").mkdir(parents=True)  # an environment, as the guide makes it
    monkeypatch.syspath_prepend(str(tmp_path / "here"))
    with pytest.raises(CheckpointError, match=f"own code: install lerobot 0.4.4 .* in {PYTHON}"):
        terrella.load_policy(saved(tmp_path / "c"), world.spec)


def test_a_busy_process_ends_at_once():
    began, pipe = time.monotonic(), subprocess.PIPE
    busy = subprocess.Popen(["sleep", "60"], stdin=pipe, stdout=pipe)
    _end(busy, tempfile.TemporaryFile())
    assert busy.returncode is not None and time.monotonic() - began < 5
