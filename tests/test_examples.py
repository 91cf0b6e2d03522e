"""Every example runs, and shows what it promises."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest
from PIL import Image

import terrella

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
    }


def test_hello(tmp_path):
    if not BUNDLED.exists():
        pytest.skip("the learned world doom-maze is not bundled yet: src/terrella/bundled/doom-maze is absent")
    path = example("00_hello.py")["main"](steps=8, picture=tmp_path / "hello.png")
    with Image.open(path) as picture:
        assert picture.size == (5 * 128, 3 * 96)


def test_one_planner_balances_by_the_truth_and_by_a_learned_world():
    survived = example("01_random_shooting.py")["main"]()
    assert survived["at random"] < 40
    assert survived["planning in the truth"] >= 150
    assert survived["planning in the learned world"] >= 2.5 * survived["at random"]


def test_a_world_as_a_gymnasium_environment():
    result = example("02_gym_env.py")["main"]()
    assert result["episodes"] > 10 and 9 < result["mean_return"] < 60


def test_a_robot_with_two_cameras_is_recorded(tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'terrella[mujoco]'")
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:  # a machine without OpenGL
        pytest.skip(f"MuJoCo cannot draw here ({error}): install libegl1 and set MUJOCO_GL=egl")
    found = example("03_two_cameras.py")["main"](tmp_path / "robot", 40)
    assert found["rows"] == 40 and len(found["cameras"]) == 2
