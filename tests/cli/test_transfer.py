"""transfer: pairs that fit are carried over and reported, others are refused in a sentence; recordings stand for reality; pace."""

from __future__ import annotations

import json
from importlib.util import find_spec

import pytest

from terrella.cli import main

pytestmark = pytest.mark.skipif(find_spec("mujoco") is None, reason="mujoco is not installed")


def ran(capsys, *words) -> tuple[int, str, str]:
    code = main([str(word) for word in words])
    told = capsys.readouterr()
    return code, told.out, told.err


@pytest.fixture
def few(monkeypatch):
    from terrella.workflows import transfer_arms

    monkeypatch.setattr(transfer_arms, "FITTED", 10)
    monkeypatch.setattr(transfer_arms, "GATHER", 2)


@pytest.mark.slow
def test_a_pair_is_carried_over_and_goes_on_where_it_was(tmp_path, capsys, few):
    asked = [
        "transfer",
        "--practice",
        1,
        "--episodes",
        6,
        "--seeds",
        1,
        "--real-episodes",
        1,
        2,
        "--out",
        tmp_path / "t",
        "--json",
    ]
    code, out, _ = ran(capsys, *asked, "--arms", "nominal", "model")
    told = json.loads(out)
    assert code == 0 and {"nominal", "model 1", "model 2", "random", "idle"} == set(told["arms"])
    assert told["arms"]["idle"]["count"] == 6 and "the model" in told["agreed"]
    assert told["hash"] in (tmp_path / "t" / "transfer.html").read_text()
    again = json.loads(ran(capsys, *asked, "--arms", "nominal")[1])
    assert again["arms"]["nominal"] == told["arms"]["nominal"]
    # What is asked for bit by bit comes to the same.
    bits = [tmp_path / "bits" if word == tmp_path / "t" else word for word in asked]
    ran(capsys, *bits, "--arms", "nominal")
    assert json.loads(ran(capsys, *bits, "--arms", "nominal", "model")[1]) | {"page": ""} == told | {"page": ""}
    code, _, err = ran(capsys, *asked, "--dial", "0.5")
    assert code == 2 and "another experiment" in err and "dial" in err


def test_what_one_installation_began_another_continues(tmp_path, capsys, few, monkeypatch):
    import shutil

    from terrella.workflows import transfer

    words = ["transfer", "--practice", 1, "--episodes", 2, "--seeds", 1, "--out", tmp_path / "t", "--json"]
    arms = ["--arms", "nominal"]
    first = json.loads(ran(capsys, *words, *arms)[1])
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(transfer.BUNDLED, elsewhere)
    monkeypatch.setattr(transfer, "BUNDLED", elsewhere)
    again = json.loads(ran(capsys, *words, *arms)[1])
    assert again["gap"].startswith(str(elsewhere)) and again["arms"] == first["arms"]
    ranges = elsewhere / "arm_randomised.toml"
    ranges.write_text(ranges.read_text().replace("0.7, 1.1", "0.8, 1.1"))  # of the same name, and yet another
    code, _, err = ran(capsys, *words, *arms)
    assert code == 2 and "another experiment (randomise" in err and "hash" not in err


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--sim", "mujoco:arm", "--real", "mujoco:ant"), "takes actions in"),
        (("--sim", "mujoco:reacher", "--real", "mujoco:reacher", "--arms", "nominal"), "has no channel 'success'"),
        (("--sim", "mujoco:ant"), "say what stands for reality"),
        (("--real", "gym:Reacher-v5"), "between robots in MuJoCo"),
        (("--sim", "gym:CartPole-v1"), "between robots in MuJoCo"),
        (("--dial", "3"), "from 0 to 1"),
        (("--real-episodes",), "are 1 or more"),
        (("--arms", "nominal", "wishful"), "--arms are some of"),
    ],
)
def test_what_is_no_pair_is_refused_in_a_sentence(tmp_path, capsys, words, why):
    code, _, err = ran(capsys, "transfer", *words, "--out", tmp_path / "t")
    assert code == 2 and why in err and err.count("\n") == 1


@pytest.mark.parametrize("words", [("--episodes", "5"), ("--seeds", "2"), ("--workers", "2"), ("--practice", "3")])
def test_what_a_recording_has_no_use_for_is_named(tmp_path, capsys, words):
    code, _, err = ran(capsys, "transfer", "--real", tmp_path, *words, "--out", tmp_path / "t")
    assert code == 2 and f"has no use for {words[0]}" in err and err.count("\n") == 1


HOLD = '<custom><text name="terrella.task" data="hold"/><numeric name="terrella.within" data="0.1"/></custom>'


def own_arm(folder, name, *changes: tuple[str, str]):
    """A file of somebody's own arm that tells its task."""
    from terrella.workflows.transfer import BUNDLED

    text = (BUNDLED / "arm.xml").read_text().replace("<worldbody>", f"{HOLD}<worldbody>")
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    (folder / f"{name}.xml").write_text(text)
    return f"mujoco:{folder / name}.xml"


@pytest.mark.slow
def test_files_of_ones_own_that_tell_their_task_are_carried_over(tmp_path, capsys, few):
    mine, other = own_arm(tmp_path, "mine"), own_arm(tmp_path, "other", ('gear="8"', 'gear="7"'))
    (tmp_path / "gap.toml").write_text("delay = 1")
    words = ["transfer", "--sim", mine, "--real", other, "--gap", tmp_path / "gap.toml", "--arms", "nominal", "model"]
    words += ["--real-episodes", 1, "--practice", 1, "--episodes", 2, "--seeds", 1, "--out", tmp_path / "t", "--json"]
    code, out, _ = ran(capsys, *words)
    assert code == 0 and {"nominal", "model 1"} < set(json.loads(out)["arms"])


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ((('motor name="shoulder" joint="shoulder" gear="8"', 'position name="shoulder" joint="shoulder"'),), "in rad"),
        ((("motor name", "velocity name"), ('gear="8" ', ""), ('gear="4" ', "")), "rad/s"),
        ((('name="shoulder" joint="shoulder" gear="8"', 'name="elbow" joint="elbow" gear="4" '),
          ('name="elbow" joint="elbow" gear="4" ctrl', 'name="shoulder" joint="shoulder" gear="8" ctrl')), "their axes are"),
        ((("<option", '<option gravity="0 9.81 0"'),), "their axes differ"),
    ],
)  # fmt: skip
def test_pairs_that_disagree_about_units_or_axes_are_refused(tmp_path, capsys, changes, why):
    mine, other = own_arm(tmp_path, "mine"), own_arm(tmp_path, "other", *changes)
    code, _, err = ran(capsys, "transfer", "--sim", mine, "--real", other, "--arms", "nominal", "--out", tmp_path / "t")
    assert code == 2 and why in err and err.count("\n") == 1


def test_an_unknown_parameter_of_the_gap_is_named(tmp_path, capsys):
    (tmp_path / "gap.toml").write_text("fricton = 2.0")
    code, _, err = ran(capsys, "transfer", "--gap", tmp_path / "gap.toml", "--out", tmp_path / "t")
    assert code == 2 and "no parameter 'fricton'" in err and "friction" in err


@pytest.mark.slow
def test_policies_are_told_their_goal_by_a_camera(tmp_path, capsys, few, monkeypatch):
    from terrella.core.errors import TerrellaError
    from terrella.core.world import make_rng
    from terrella.library import load
    from terrella.workflows import transfer_camera

    try:
        seen = load("mujoco:arm", size=(8, 8))
        seen.render(seen.start(1, make_rng(0)), ("rgb",))
    except TerrellaError as error:
        pytest.skip(str(error))
    for name, value in {"LABELLED": 16, "UNLABELLED": 16, "TESTED": 16, "BATCH": 16, "STEPS": 3}.items():
        monkeypatch.setattr(transfer_camera, name, value)
    words = ("transfer", "--practice", 1, "--episodes", 4, "--seeds", 1, "--out", tmp_path / "t", "--json")
    plain = json.loads(ran(capsys, *words, "--arms", "nominal")[1])
    code, out, _ = ran(capsys, *words, "--arms", "nominal", "--camera")
    told = json.loads(out)
    assert code == 0 and told["arms"] == plain["arms"] and told["look_hash"] != told["hash"]
    assert {"nominal", "visual", "nominal, adversarial encoder"} < set(told["camera"]) == set(told["errors"])
    code, _, err = ran(capsys, *words, "--look", "x.toml")
    assert code == 2 and "--camera" in err


def test_a_recording_stands_for_reality(tmp_path, capsys, few):
    from terrella.core import make_rng
    from terrella.core.policy import Random
    from terrella.data import RecordOptions, record
    from terrella.library import load

    real = load("mujoco:arm-real", cameras=())
    record(
        real, Random(real.spec, (1, 9)), tmp_path / "set", 120, make_rng(0), options=RecordOptions(max_episode_steps=30)
    )
    words = ("transfer", "--real", tmp_path / "set", "--real-episodes", 2, "--out", tmp_path / "t", "--json")
    code, out, _ = ran(capsys, *words)
    told = json.loads(out)
    assert code == 0 and set(told["open_loop"]) == {"simulator", "model 2", "stands still"} and told["held_out"] == 2
    assert told["open_loop"]["simulator"]["10"]["value"] < 0.1 * told["open_loop"]["stands still"]["10"]["value"]
    assert told["action_error"]["simulator"]["value"] < 0.5 * told["action_error"]["random"]["value"]
    for ignored in (("--dial", "0.5"), ("--arms", "nominal"), ("--camera",)):
        code, _, err = ran(capsys, *words, *ignored)
        assert code == 2 and "leave that out" in err
    record(
        load("mujoco:arm", cameras=()),
        Random(real.spec, (1, 9)),
        tmp_path / "other",
        120,
        make_rng(0),
        options=RecordOptions(max_episode_steps=30),
    )
    code, _, err = ran(capsys, "transfer", "--real", tmp_path / "other", *words[3:])
    assert code == 2 and "other settings" in err  # the folder's residual is of the first recording
    code, _, err = ran(capsys, *words, "--sim", "mujoco:ant")
    assert code == 2 and "actions" in err and err.count("\n") == 1
    about = tmp_path / "set" / "meta" / "terrella.json"
    plain, facts = about.read_text(), json.loads(about.read_text())
    facts["world"]["action_names"].reverse()
    about.write_text(json.dumps(facts))
    code, _, err = ran(capsys, *words)
    assert code == 2 and "their axes are elbow, shoulder" in err
    about.write_text(plain)
    about.write_text(about.read_text().replace('"action_mode": "torque"', '"action_mode": "position"'))
    code, _, err = ran(capsys, *words)
    assert code == 2 and "other semantics" in err


def test_acceleration_is_told_beside_a_simulator(capsys):
    words = (
        "bench",
        "acceleration",
        "mujoco:arm",
        "--beside",
        "mujoco:arm-real",
        "--batches",
        1,
        8,
        "--seconds",
        0.01,
        "--turns",
        1,
    )
    code, out, _ = ran(capsys, *words, "--json")
    told = json.loads(out)
    assert code == 0 and told["ratio"] > 0 and [one["batch"] for one in told["world_paces"]] == [1, 8]
    assert "imagines" in ran(capsys, *words)[1]
    code, _, err = ran(capsys, "bench", "acceleration", "mujoco:arm", "--beside", "mujoco:ant")
    assert code == 2 and "differ" in err
    code, _, err = ran(capsys, "bench", "acceleration", "mujoco:arm", "--agent", "x")
    assert code == 2 and "all three" in err
