"""MJCF and URDF files of others: lenses, controls without limits, joints that other joints drive."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
import torch

from terrella.core import check_world, make_rng
from terrella.core.errors import TerrellaError
from terrella.library import load
from terrella.workflows.recording_facts import describe

if find_spec("mujoco") is None:
    pytest.skip("mujoco is not installed: pip install 'terrella[mujoco]'", allow_module_level=True)

from terrella.sim.mujoco_model import mujoco

BODY = '<mujoco><worldbody><body><joint name="j" axis="0 0 1"/><geom size=".1"/></body>{}</worldbody></mujoco>'


def world_of(tmp_path, text, ending="xml", **options):
    (tmp_path / f"x.{ending}").write_text(text)
    return load(f"mujoco:{tmp_path / f'x.{ending}'}", **{"cameras": (), **options})


def moved_by(world, action, steps=100) -> np.ndarray:
    """qpos after steps of one action."""
    rng = make_rng(0)
    state = world.start(1, rng)
    for _ in range(steps):
        state = world.imagine(state, torch.tensor([action], dtype=torch.float32), rng)
    return world.render(state, ("qpos",))["qpos"][0].numpy()


LENSES = {  # what fx/W, fy/H, cx/W, cy/H of a picture of 96 x 128 pixels are
    'fovy="60"': (0.75 / 3**0.5 * 1.5, 3**0.5 / 2, 0.5, 0.5),
    'focal="4e-3 3e-3" sensorsize="6e-3 4e-3" resolution="640 480"': (2 / 3, 3 / 4, 0.5, 0.5),
    'focalpixel="400 300" sensorsize="6.4e-3 4.8e-3" resolution="640 480"': (400 / 640, 300 / 480, 0.5, 0.5),
    'focal="4e-3 4e-3" sensorsize="8e-3 4e-3" principal="1e-3 -5e-4" resolution="9 9"': (0.5, 1, 0.5 - 1 / 8, 0.5 + 1 / 8),
    'projection="orthographic" fovy="2"': None,
}  # fmt: skip


@pytest.mark.parametrize("camera", LENSES)
def test_a_lens_is_that_with_which_it_is_drawn(tmp_path, camera):
    world = world_of(tmp_path, BODY.format(f'<camera name="eye" pos="0 0 1" {camera}/>'), cameras=None)
    lens = LENSES[camera]
    if lens is None:
        assert not world.spec.cameras and "eye is no pinhole" in world.spec.card["notes"][0]
        assert any("Note: camera eye" in line for line in describe(world.spec))
    else:
        assert world.spec.cameras["rgb"].intrinsics == pytest.approx(lens, abs=1e-4)
    check_world(world, steps=1)


def test_a_point_is_drawn_where_the_lens_says(tmp_path):
    """A lens off the middle with pixels that are not square: two small balls in the picture."""
    at = np.array([[0.3, 0.2, -2.0], [-0.25, -0.3, -1.5]])  # right, up, back of the camera
    balls = "".join(f'<geom size=".02" pos="{x} {y} {z}" rgba="1 0 0 1"/>' for x, y, z in at)
    camera = '<camera name="eye" focal="4e-3 5e-3" sensorsize="6e-3 6e-3" principal="6e-4 -9e-4" resolution="64 64"/>'
    text = f"<mujoco><worldbody>{camera}{balls}</worldbody></mujoco>"
    world = world_of(tmp_path, text, cameras=None, size=(240, 320))
    try:
        seen = world.render(world.start(1, make_rng(0)), ("rgb",))["rgb"][0].numpy().astype(float)
    except TerrellaError as error:
        pytest.skip(str(error))
    rows, columns = np.nonzero(seen[..., 0] - seen[..., 1:].max(-1) > 20)
    fx, fy, cx, cy = world.spec.cameras["rgb"].intrinsics
    for x, y, z in at:
        u, v = 320 * (cx + fx * x / -z), 240 * (cy - fy * y / -z)
        near = (np.abs(columns - u) < 20) & (np.abs(rows - v) < 20)
        assert columns[near].mean() + 0.5 == pytest.approx(u, abs=1.5) and rows[near].mean() + 0.5 == pytest.approx(
            v, abs=1.5
        )
    wider = world.varying(("camera.fov",))
    state = wider.start(1, make_rng(0))
    state = wider.adjusted(state, torch.tensor([[1.5]]))
    red = wider.render(state, ("rgb",))["rgb"][0].numpy().astype(float)
    assert (red[..., 0] - red[..., 1:].max(-1) > 20).sum() < 0.7 * len(rows)  # things are smaller in a wider view
    world.close(), wider.close()


ARM = """<mujoco><worldbody><site name="base"/><body pos="0 0 1"><joint name="swing" axis="0 1 0" {} damping="1"/>
<geom size=".05" mass="1"/><site name="tip"/><body pos="0 0 .3"><joint name="slide" type="slide" axis="1 0 0" {}/>
<geom size=".05" mass=".2"/></body></body></worldbody>
<tendon><fixed name="both"><joint joint="swing" coef="2"/><joint joint="slide" coef="-1"/></fixed></tendon>
<actuator>{}</actuator>{}</mujoco>"""
SERVOS = {  # actuator: joints' limits, low, high, and why
    '<position joint="swing" kp="9"/>': ("", "", -np.pi, np.pi, "nothing limits it"),
    '<position joint="swing" kp="9" gear="-2"/>': ('range="-90 45"', "", -np.pi / 2, np.pi, "its range"),
    '<position joint="slide" kp="9" timeconst=".1"/>': ("", 'range="-.2 .5"', -0.2, 0.5, "its range"),
    '<position tendon="both" kp="9"/>': ('range="-90 90"', 'range="-.2 .5"', -np.pi - 0.5, np.pi + 0.2, "its range"),
    '<position site="tip" refsite="base" gear="1 0 0 0 0 0" kp="9"/>': ("", "", -1, 1, "nothing limits it"),
    '<general joint="swing" gainprm="4" biastype="affine" biasprm="2 -8 -1"/>': ('range="-1 1" limited="true"', "", None, None, ""),
    '<position joint="swing" kp="9" ctrllimited="false" ctrlrange="-.3 .2"/>': ("", "", -0.3, 0.2, "its range, which"),
    '<motor joint="swing" gear="5" forcerange="-30 20"/>': ("", "", -30, 20, "its force range"),
    '<motor joint="swing" gear="5"/>': ('actuatorfrcrange="-30 20"', "", -6, 4, "its force range"),
    '<motor joint="swing" gear="50"/>': ("", "", -1, 1, "its gear"),
    '<velocity joint="swing" kv="2"/>': ("", "", -10 * np.pi, 10 * np.pi, "nothing limits it"),
    '<velocity joint="swing" kv="2" forcerange="-90 90"/>': ("", "", -45, 45, "its force range over its gain"),
    '<velocity joint="slide" kv="2"/>': ("", 'range="-.2 .5"', -0.7, 0.7, "its range in a second"),
    '<intvelocity joint="swing" kp="9" actrange="-1 1"/>': ("", "", -10 * np.pi, 10 * np.pi, "nothing limits it"),
    '<general joint="swing" gaintype="affine" gainprm="0 0 -2"/>': ("", "", -1, 1, "its gear"),
    '<muscle joint="swing" lengthrange="-1 1"/>': ("", "", 0, 1, "a muscle's excitation"),
}  # fmt: skip


@pytest.mark.parametrize("servo", SERVOS)
def test_controls_without_limits_get_those_of_what_they_move(tmp_path, servo):
    one, other, low, high, why = SERVOS[servo]
    world = world_of(tmp_path, ARM.format(one, other, servo, ""))
    box = world.spec.action
    if low is None:  # 4 u + 2 - 8 q = 0 at q = -1 and 1 degree
        low, high = sorted((8 * q - 2) / 4 for q in np.radians([-1, 1]))
        why = "its range"
    assert (box.low.tolist(), box.high.tolist()) == (pytest.approx([low], rel=1e-5), pytest.approx([high], rel=1e-5))
    assert f"({why}" in world.spec.card["notes"][0]
    assert "0 N m" not in world.spec.action_units


HOME = '<keyframe><key name="home" qpos="{}"{}/></keyframe>'


@pytest.mark.parametrize(
    ("servo", "key", "rest"),
    [
        ('<position joint="swing" kp="100" kv="1"/>', HOME.format("-1.57 0", ' ctrl="-1.57"'), -1.57),
        ('<position joint="swing" kp="100" kv="1"/>', HOME.format("-1.57 0", ""), -1.57),  # a pose without controls
        ('<position joint="swing" kp="100" kv="1"/>', HOME.format("4 0", ' ctrl="4"'), 4),  # farther than half a turn
        ('<position joint="swing" kp="100" kv="1" gear="2" timeconst=".2"/>', HOME.format("-1.57 0", ""), -3.14),
        ('<intvelocity joint="swing" kp="100" actrange="-3 3"/>', HOME.format("-1.57 0", ""), 0),
    ],
)
def test_a_pose_at_rest_is_held(tmp_path, servo, key, rest):
    world = world_of(tmp_path, ARM.format("", 'range="-.01 .01"', servo, key))
    assert world.spec.idle == pytest.approx((rest,)) and world.spec.action.contains(
        np.array(world.spec.idle, np.float32)
    )
    home = float(world.layout.home[0])
    assert moved_by(world, world.spec.idle)[0] == pytest.approx(home, abs=0.05)


def test_a_rest_beyond_the_files_limits_is_named_and_the_keyframe_home_is_the_rest(tmp_path):
    servo = '<position joint="swing" kp="100" kv="1" ctrlrange="-1 1"/>'
    world = world_of(tmp_path, ARM.format("", "", servo, HOME.format("-1.57 0", ' ctrl="-1.57"')))
    assert world.spec.idle == (-1.0,)
    assert "beyond the file's limits, which hold: swing -1.57 of -1 to 1" in world.spec.card["notes"][0]
    keys = '<keyframe><key name="down" qpos="1 0"/><key name="Home" qpos="2 0"/></keyframe>'
    world = world_of(tmp_path, ARM.format("", "", '<position joint="swing" kp="9"/>', keys))
    assert world.spec.idle == (2.0,) and float(world.layout.home[0]) == 2


def test_added_servos_do_not_take_the_defaults_of_motors(tmp_path):
    defaults = '<default><motor gear="5e-4" ctrlrange="-1 1" forcerange="-1e-3 1e-3"/><general gear="5e-4"/></default>'
    text = BODY.format("").replace("<worldbody>", f"{defaults}<worldbody>")
    world = world_of(tmp_path, text)
    assert world.spec.action.high[0] == pytest.approx(np.pi) and moved_by(world, [2.0]) == pytest.approx(2, abs=0.02)


def test_limits_of_the_file_stay_and_nothing_is_noted(tmp_path):
    world = world_of(tmp_path, ARM.format("", "", '<position joint="swing" kp="9" ctrlrange="-.5 .25"/>', ""))
    assert (world.spec.action.low[0], world.spec.action.high[0]) == (-0.5, 0.25) and "notes" not in world.spec.card


INERTIA = """<inertial><mass value=".05"/><origin xyz="0 0 .03"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>"""


def hand(*mimics: tuple[str, str]) -> str:
    """A URDF of fingers about z, each with the text that makes it follow another."""
    links = "".join(f'<link name="{name}">{INERTIA}</link>' for name in ("base", *(f"l_{one}" for one, _ in mimics)))
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="base"/><child link="l_{name}"/><axis xyz="0 0 1"/>'
        f'<limit lower="-1.5" upper="1.5" effort="20" velocity="3"/>{text}</joint>'
        for name, text in mimics
    )
    return f'<robot name="hand">{links}{joints}</robot>'


def test_joints_that_follow_in_a_chain_have_no_servo(tmp_path):
    tip, middle = '<mimic joint="b" multiplier="2" offset="-0.1"/>', '<mimic joint="a" multiplier="-0.5" offset="0.2"/>'
    world = world_of(tmp_path, hand(("c", tip), ("b", middle), ("a", "")), "urdf")
    assert world.spec.action_names == ("a",)
    c, b, a = range(3)
    start = moved_by(world, [0.0], 0)
    assert start[[a, b, c]] == pytest.approx([0, 0.2, 0.3], abs=1e-6)  # where the constraints have them
    end = moved_by(world, [0.6])
    assert end[[a, b, c]] == pytest.approx([0.6, -0.1, -0.3], abs=0.01)


def test_of_joints_that_follow_one_another_one_is_driven(tmp_path):
    tree = "".join(
        f'<body><joint name="{name}" axis="0 0 1"/><geom size=".1" contype="0" conaffinity="0"/></body>'
        for name in "abcd"
    )
    links = '<joint joint1="a" joint2="b"/><joint joint1="b" joint2="a"/><joint joint1="c" polycoef=".3 0 0 0 0"/>'
    world = world_of(tmp_path, f"<mujoco><worldbody>{tree}</worldbody><equality>{links}</equality></mujoco>")
    assert world.spec.action_names == ("a", "d")  # c is held
    end = moved_by(world, [0.5, -0.5])
    assert end == pytest.approx([0.5, 0.5, 0.3, -0.5], abs=0.02)
    curve = '<joint joint1="b" joint2="a" polycoef="0 0 .5 0 0"/><joint joint1="d" joint2="c"/>'
    world = world_of(tmp_path, f"<mujoco><worldbody>{tree}</worldbody><equality>{curve}</equality></mujoco>")
    assert world.spec.action_names == ("a", "c")
    assert moved_by(world, [1.2, 0.4]) == pytest.approx([1.2, 0.72, 0.4, 0.4], abs=0.02)
    loose = links.replace('/><joint joint1="b"', ' active="false"/><joint active="false" joint1="b"')
    world = world_of(tmp_path, f"<mujoco><worldbody>{tree}</worldbody><equality>{loose}</equality></mujoco>")
    assert world.spec.action_names == ("a", "b", "d")


def link(name: str, mass: float, com: str, inertia: float) -> str:
    about = " ".join(
        f'{one}="{inertia if one[1] == one[2] else 0}"' for one in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    return (
        f'<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="{com}"/><inertia {about}/></inertial></link>'
    )


def test_servos_of_a_long_arm_reach_what_is_asked_against_gravity(tmp_path):
    """Six joints, light ones last: with Euler's method and the inertia alone they swing for ever."""
    parts, axes = [link("l0", 3, "0 0 .1", 0.01)], ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
    for k, axis in enumerate(axes):
        parts.append(link(f"l{k + 1}", 2.5 - 0.4 * k, "0 0 .12", 0.01 - 0.0015 * k))
        parts.append(
            f'<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/><origin xyz="0 0 .25"/>'
            f'<axis xyz="{axis}"/><limit lower="-2.8" upper="2.8" effort="1000" velocity="2"/></joint>'
        )
    world = world_of(tmp_path, f"<robot name='arm'>{''.join(parts)}</robot>", "urdf")
    wanted = [0.5, 0.8, -0.6, 0.3, 0.9, 0.0]
    assert moved_by(world, wanted, 300) == pytest.approx(wanted, abs=0.05)


def test_fingers_in_mirrored_chains_reach_what_is_asked_against_gravity(tmp_path):
    text = "".join(link(name, 0.02, ".02 0 .03", 3e-5) for name in ("base", "l", "r", "lt", "rt"))
    for name, parent, child, axis, mimic in (
        ("a", "base", "l", "0 -1 0", ""),
        ("b", "base", "r", "0 1 0", '<mimic joint="a"/>'),
        ("c", "l", "lt", "0 -1 0", '<mimic joint="a" multiplier="-1"/>'),
        ("d", "r", "rt", "0 1 0", '<mimic joint="b" multiplier="-1"/>'),
    ):
        text += (
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz=".03 0 .05"/>'
            f'<axis xyz="{axis}"/><limit lower="-.9" upper=".9" effort="20" velocity="2"/>{mimic}</joint>'
        )
    world = world_of(tmp_path, f"<robot name='hand'>{text}</robot>", "urdf")
    end = moved_by(world, [0.5])  # in the order of the tree: a, c, b, d
    assert world.spec.action_names == ("a",) and end == pytest.approx([0.5, -0.5, 0.5, -0.5], abs=0.02)


@pytest.mark.skipif(not hasattr(mujoco.mjtGain, "mjGAIN_PID"), reason="this version of MuJoCo has no such actuators")
def test_actuators_of_several_controls_are_refused(tmp_path):
    with pytest.raises(TerrellaError, match="several controls"):
        world_of(tmp_path, ARM.format("", "", '<pid joint="swing" kp="9"/>', ""))
