"""Every example runs, and shows what it promises."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

import terrella
from terrella.data import Dataset

EXAMPLES = Path(__file__).parents[1] / "examples"
BUNDLED = Path(terrella.__file__).parent / "bundled" / "doom-maze"


def example(name: str) -> dict:
    return runpy.run_path(str(EXAMPLES / name))


def test_no_example_is_forgotten_here():
    assert {path.name for path in EXAMPLES.glob("*.py")} == {
        "00_hello.py",
        "01_random_shooting.py",
        "02_gym_env.py",
        "03_two_cameras.py",
        "04_controllers.py",
        "05_robot.py",
        "06_babyai.py",
    }


def test_hello(tmp_path):
    if not BUNDLED.exists():
        pytest.skip("the learned world doom-maze is not bundled yet: src/terrella/bundled/doom-maze is absent")
    path = example("00_hello.py")["main"](steps=8, picture=tmp_path / "hello.png")
    with Image.open(path) as picture:
        assert picture.size == (5 * 128, 3 * 96)


@pytest.mark.slow
def test_one_planner_balances_by_the_truth_and_by_a_learned_world():
    survived = example("01_random_shooting.py")["main"]()
    assert survived["at random"] < 40
    assert survived["planning in the truth"] >= 150
    assert survived["planning in the learned world"] >= 2.5 * survived["at random"]


def test_a_world_as_a_gymnasium_environment():
    result = example("02_gym_env.py")["main"]()
    assert result["episodes"] > 10 and 9 < result["mean_return"] < 60


def test_controllers_of_ones_own():
    steps = example("04_controllers.py")["main"](episodes=3)
    assert steps["balance"] > steps["lean"] and steps["balance"] > steps["random"]


@pytest.mark.slow
def test_a_robot_with_two_cameras_is_recorded(tmp_path):
    """In a process of its own: a renderer without a display fails in ways that outlive a test."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'terrella[mujoco]'")
    surroundings = {"MUJOCO_GL": "egl", **os.environ}
    probe = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).close()"
    drawn = subprocess.run([sys.executable, "-c", probe], env=surroundings, capture_output=True, text=True)
    if drawn.returncode:
        pytest.skip("MuJoCo cannot draw here: install libegl1 (and libgl1-mesa-dri), or set MUJOCO_GL")
    command = [sys.executable, str(EXAMPLES / "03_two_cameras.py"), str(tmp_path / "robot"), "40"]
    subprocess.run(command, env=surroundings, check=True, capture_output=True)
    dataset = Dataset(tmp_path / "robot")
    assert dataset.length == 40 and len(dataset.cameras) == 2
    assert set(dataset.camera_models) == {"rgb", "rgb.left"}
    assert dataset.world["action_units"] == ["m/s", "rad/s"]


@pytest.mark.parametrize("body", ["g1", "go1"])
def test_a_robot_sees_where_a_post_is(body):
    pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'terrella[mujoco]'")
    shown = example("05_robot.py")
    try:
        walker = shown["Walker"](body, EXAMPLES / f"{body}_gait")
        rng = terrella.make_rng(1)
        state = walker.start(8, rng)
        seen = walker.render(state, ("rgb", "depth", "posts"))
    except terrella.core.errors.TerrellaError as error:  # no files of the Go1, or no pictures here
        pytest.skip(str(error))
    found = [shown["seen_at"](rgb, depth, 1, walker.body) for rgb, depth in zip(seen["rgb"], seen["depth"])]
    green = seen["posts"][:, 1]
    ahead = green[:, 0] > 1.5 * green[:, 1].abs()
    assert ahead.any() and all((post is not None) == bool(one) for post, one in zip(found, ahead) if one)
    assert all((post - truth).norm() < 0.3 for post, truth in zip(found, green) if post is not None)
    after = walker.imagine(state, walker.spec.sample_action(8, rng), rng)
    assert not after["done"].any()


def test_an_instruction_names_posts_in_order():
    pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'terrella[mujoco]'")
    understood = example("05_robot.py")["understood"]
    assert understood("Walk to the BLUE one, then to red!")["posts"].tolist() == [[2, 0]]
    with pytest.raises(terrella.core.errors.ContractError, match="no post"):
        understood("make tea")


def test_the_bot_of_babyai_says_how_its_demonstrations_are_recorded():
    made = example("06_babyai.py")
    assert "--method imitation" in made["__doc__"] and callable(made["teacher"]) and "expert" in made
