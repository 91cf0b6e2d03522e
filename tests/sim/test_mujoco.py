"""MuJoCo's worlds: values that batch, fork, differ and repeat; files that lack something or are broken; what ends in infinity."""

# pyright: reportAttributeAccessIssue=false, reportArgumentType=false

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch

from terrella.core import State, check_world, make_rng
from terrella.core.errors import TerrellaError
from terrella.core.policy import Idle
from terrella.core.spec import neutral_action
from terrella.data import Dataset, record
from terrella.library import load

if find_spec("mujoco") is None:
    pytest.skip("mujoco is not installed: pip install 'terrella[mujoco]'", allow_module_level=True)

from terrella.sim.mujoco_model import mujoco
from terrella.sim.mujoco_robots import robot_of
from terrella.sim.mujoco_tasks import Hold, Reach, RobotLayout, Stepping, VelocityTracking
from terrella.sim.mujoco_world import MujocoConfig, MujocoWorld

ARM = """<mujoco><option timestep="0.004"/><worldbody>
 <light pos="0 0 3"/><geom name="ground" type="plane" size="2 2 .1"/>
 <camera name="eye" pos="0 -2 1" xyaxes="1 0 0 0 0.4 0.9"/><camera name="top" pos="0 0 3"/>
 <body name="arm" pos="0 0 .5"><joint name="swing" axis="0 1 0" range="-2 2" limited="true" damping=".1"/>
  <geom type="capsule" fromto="0 0 0 0 0 .4" size=".08" rgba="1 0 0 1"/><site name="tip" pos="0 0 .4"/></body>
 <body name="ball" pos=".6 0 .2"><freejoint/><geom name="ball" size=".1" rgba="0 1 0 1"/></body>
</worldbody><sensor><framepos name="tip" objtype="site" objname="tip"/></sensor></mujoco>"""

URDF = """<robot name="x"><link name="a"><inertial><mass value="1"/>
<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link><link name="b"><inertial>
<origin xyz="0 0 .2"/><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="swing" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="2" effort="20" velocity="3"/></joint></robot>"""

BLIND = {"size": (24, 32)}


@pytest.fixture
def arm(tmp_path) -> Path:
    (tmp_path / "arm.xml").write_text(ARM)
    return tmp_path / "arm.xml"


def drawn_or_skipped(world):
    """The world, where it can be drawn here."""
    try:
        world.render(world.start(1, make_rng(0)), ("rgb",))
    except TerrellaError as error:
        pytest.skip(str(error))
    return world


def test_the_contract_holds_with_pictures_from_several_cameras(arm):
    options = {
        "cameras": ("eye", "top"),
        "depth": True,
        "segmentation": True,
        "parameters": ("mass.ball", "camera.x", "red"),
    }
    world = drawn_or_skipped(load(f"mujoco:{arm}", **BLIND, **options))
    assert "a_batch_equals_its_singles" in check_world(world, steps=8)
    assert {"rgb", "rgb.top", "depth.top", "segmentation.top", "pose.top"} <= set(world.spec.channels)
    seen = world.render(world.start(1, make_rng(0)), ("depth.top", "segmentation", "pose.top"))
    arm_and_ball = set(seen["segmentation"].unique().tolist())
    assert {0, 1, 2} <= arm_and_ball  # bodies: the world, the arm, the ball
    assert seen["depth.top"].min() > 1.5 and seen["pose.top"][0, :3].tolist() == [0, 0, 3]
    world.close()


@pytest.mark.parametrize("name", ["ant", "hopper", "drone", "car"])
def test_robots_that_come_with_gymnasium(name):
    world = load(f"mujoco:{name}", **BLIND)
    drawn_or_skipped(world)
    assert "states_can_be_saved" in check_world(world, steps=5)


@pytest.mark.parametrize("name", ["go1", "g1", "yam"])
def test_robots_of_a_zoo_that_may_be_installed(name):
    if find_spec("mjlab") is None:
        with pytest.raises(TerrellaError, match="pip install --no-deps mjlab"):
            load(f"mujoco:{name}")
        return
    world, rng = load(f"mujoco:{name}"), make_rng(0)
    state = world.start(4, rng)
    for _ in range(20):
        state = world.imagine(state, torch.tensor(world.spec.idle).expand(4, -1), rng)
    assert not state["done"].any() and world.spec.action_units[0] == "rad"


def test_a_large_batch_is_its_entries_and_threads_do_not_matter(arm):
    one, many = load(f"mujoco:{arm}", threads=1), load(f"mujoco:{arm}", threads=3)
    states = one.start(64, make_rng(1))
    for step in range(5):
        actions = one.spec.sample_action(64, make_rng(step))
        together, apart = one.imagine(states, actions, make_rng(0)), many.imagine(states, actions, make_rng(0))
        assert together == apart  # bit for bit
        alone = one.imagine(states.at([7]), actions[7:8], make_rng(0))
        assert torch.allclose(alone["physics"], together["physics"][7:8], atol=1e-9)
        states = together


def test_one_thread_at_a_time_steps(arm, monkeypatch):
    world, rng, alone = load(f"mujoco:{arm}", cameras=()), make_rng(0), []
    step = world._stepper.step
    monkeypatch.setattr(world._stepper, "step", lambda *rest: alone.append(world._lock.locked()) or step(*rest))
    world.imagine(world.start(1, rng), torch.zeros(1, 1), rng)
    assert alone == [True, True]


def test_worlds_of_one_batch_differ_by_their_parameters(arm):
    world = load(f"mujoco:{arm}").varying(("gravity", "mass.ball", "gain"))
    state = world.start(3, make_rng(0))
    assert state["parameters"][0].tolist() == pytest.approx([9.81, 1, 1])
    values = torch.tensor([[9.81, 1, 1], [0, 1, 1], [9.81, 3, 0.5]])
    state, still = world.adjusted(state, values), torch.zeros(3, 1)
    for _ in range(5):
        state = world.imagine(state, still, make_rng(0))
    fallen = state["physics"][:, 1:].gather(1, torch.full((3, 1), 3))[:, 0]  # the ball's height
    assert fallen[1] == pytest.approx(0.2) and fallen[0] < 0.2 - 0.01
    assert world.imagine(state.at([2]), still[:1], make_rng(0))["parameters"].tolist() == [values[2].tolist()]
    with pytest.raises(TerrellaError, match="'gravity'.*0 to 30"):
        world.adjusted(state, torch.tensor([[-5.0, 1, 1]]))
    with pytest.raises(TerrellaError, match="no parameter 'gravty'; did you mean 'gravity'"):
        world.varying(("gravty",))


def test_a_urdf_gets_servos_a_camera_and_a_floor(tmp_path):
    (tmp_path / "x.urdf").write_text(URDF)
    world, rng = load(f"mujoco:{tmp_path / 'x.urdf'}"), make_rng(0)
    spec = world.spec
    assert (spec.action_names, spec.action_units, spec.action_mode) == (("swing",), ("rad",), "position")
    assert spec.action.low.tolist() == [-1] and spec.action.high.tolist() == [2] and "rgb" in spec.channels
    state = world.start(1, rng)
    for _ in range(100):
        state = world.imagine(state, torch.tensor([[0.5]]), rng)
    assert float(world.render(state, ("qpos",))["qpos"]) == pytest.approx(0.5, abs=0.1)  # the servo holds it there


BROKEN = {
    "<mujoco><worldbody>\n<geom size='.1' foo='3'/></worldbody></mujoco>": "'foo' Element 'geom', line 2",
    "<mujoco><worldbody><body>\n<freejoint/></body></worldbody></mujoco>": "mass and inertia .* line 1",
    "<mujoco><asset><mesh name='m' file='gone.stl'/></asset></mujoco>": "gone.stl",
    "<mujoco><worldbody></mujoco>": "(?i)mismatched",
    "": "empty",
}  # fmt: skip


@pytest.mark.parametrize("text", BROKEN)
def test_broken_files_are_told_in_a_sentence(text, tmp_path):
    (tmp_path / "x.xml").write_text(text)
    with pytest.raises(TerrellaError, match=BROKEN[text]) as found:
        load(f"mujoco:{tmp_path / 'x.xml'}")
    assert "\n" not in str(found.value)


def test_a_file_tells_its_task(arm):
    told = '<custom><text name="terrella.task" data="{}"/><numeric name="terrella.{}" data="{}"/></custom></mujoco>'
    for kind, key, numbers, why in (
        ("hald", "ring", "1 2", "did you mean 'hold'"),
        ("hold", "rng", "1 2", "did you mean 'ring'"),
        ("hold", "ring", "1", "takes 2 numbers; got 1"),
        ("hold", "dwell", "5", "'hand'; the file has tip"),
    ):
        arm.write_text(ARM.replace("</mujoco>", told.format(kind, key, numbers)))
        with pytest.raises(TerrellaError, match=why):
            load(f"mujoco:{arm}", cameras=())
    file = ARM.replace('framepos name="tip"', 'framepos name="hand"').replace(
        "</mujoco>", told.format("hold", "dwell", "5")
    )
    arm.write_text(file)
    with pytest.raises(TerrellaError, match="free joint"):
        load(f"mujoco:{arm}", cameras=())
    arm.write_text(file.replace("<freejoint/>", ""))
    world = load(f"mujoco:{arm}", cameras=())
    assert world.task == Hold(dwell=5) and {"reward", "success"} < set(world.spec.channels)
    check_world(world)


def test_success_needs_steps_in_a_row_at_the_goal():
    joints, axes = torch.zeros(2), (torch.arange(2), torch.arange(2))
    layout = RobotLayout(
        slice(1, 3), slice(3, 5), axes, joints, joints, joints - 1, joints + 1, {"hand": slice(0, 3)}, 0.02
    )
    task, held = Hold(dwell=2), torch.zeros(1, dtype=torch.int64)
    for away_m, count in ((0.0, 1), (0.5, 0), (0.0, 1), (0.02, 2)):
        after = {"physics": torch.zeros(1, 5), "sensors": torch.tensor([[away_m, 0, 0]]), "goal": torch.zeros(1, 2)}
        held = task.evaluate(layout, {"held": held}, after)[2]["held"]
        assert held.tolist() == [count] and task.render(layout, {"held": held}, "success").tolist() == [count >= 2]


def test_names_that_there_are_not(arm):
    for name, words in (("gone.xml", "no file"), ("ants", "did you mean 'ant'")):
        with pytest.raises(TerrellaError, match=words):
            load(f"mujoco:{name}")
    with pytest.raises(TerrellaError, match="no camera side; there are eye, top"):
        load(f"mujoco:{arm}", cameras=("side",))


def test_an_unstable_world_ends_and_can_be_repeated(tmp_path):
    (tmp_path / "wild.xml").write_text(
        '<mujoco><worldbody><body><joint name="j" type="slide"/><geom size=".01"/></body></worldbody>'
        '<actuator><motor joint="j" gear="1e12" ctrlrange="-1 1"/></actuator></mujoco>'
    )
    world, rng = load(f"mujoco:{tmp_path / 'wild.xml'}", dumps=tmp_path / "dumps"), make_rng(0)
    state = world.start(3, rng)
    with pytest.warns(RuntimeWarning, match="1 worlds of .* became unstable at 0.00 s"):
        state = world.imagine(state, torch.tensor([[0.0], [1.0], [0.0]]), rng)
    assert state["done"].tolist() == [False, True, False] and state["physics"].isfinite().all()
    assert world.imagine(state, torch.zeros(3, 1), rng)["done"].tolist() == [False, True, False]
    (dump,) = (tmp_path / "dumps").iterdir()
    before = State.load(dump)
    with pytest.warns(RuntimeWarning, match="unstable"):
        assert world.imagine(before, before["action"], rng)["done"].tolist() == [True]


def test_bodies_without_an_actuator_have_one_action_to_wait_and_are_recorded(tmp_path):
    world = load("physics:stacking", pictures=False)
    check_world(world)
    assert world.spec.action_names == ("wait",) and neutral_action(world.spec) == 0
    record(world, Idle(world.spec), tmp_path / "recording", 130, make_rng(0))
    assert Dataset(tmp_path / "recording").length == 130


def test_joints_without_names_get_servos_too(tmp_path):
    body = '<body><joint/><geom size="0.1"/><body pos="1 0 0"><joint name="joint 1"/><geom size="0.1"/></body></body>'
    (tmp_path / "x.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    assert load(f"mujoco:{tmp_path / 'x.xml'}", cameras=()).spec.action_names == ("joint 2", "joint 1")


def test_what_cannot_be_dumped_does_not_stop_the_others(tmp_path):
    (tmp_path / "file").write_text("")
    world, rng = load("mujoco:ant", cameras=(), dumps=tmp_path / "file"), make_rng(0)
    state = world.start(2, rng)
    physics = state["physics"].clone()
    physics[0, world.layout.qvel] = 1e9
    with pytest.warns(RuntimeWarning, match="could not be saved"):
        after = world.imagine(state.replace(physics=physics), torch.zeros(2, 8), rng)
    assert after["done"].tolist() == [True, False]


def test_a_robot_that_falls_is_done_and_velocity_is_paid():
    world, rng = load("mujoco:ant"), make_rng(0)
    state = world.start(2, rng)
    command = torch.tensor([[0.0, 0, 0], [3.0, 0, 0]])
    state = world.imagine(state.replace(command=command), torch.zeros(2, 8), rng)
    assert state["reward"][0] > state["reward"][1]  # who stands still obeys the first command
    over = state["physics"].clone()
    over[:, 4:8] = torch.tensor([0.0, 1, 0, 0], dtype=torch.float64)  # on its back
    assert world.imagine(state.replace(physics=over), torch.zeros(2, 8), rng)["done"].all()
    assert np.isfinite(world.spec.action_limits).all()


def test_lidar_tells_how_far_walls_are(tmp_path):
    (tmp_path / "room.xml").write_text("""<mujoco><worldbody>
     <geom type="box" size=".1 5 1" pos="2.1 0 0"/><geom type="box" size="5 .1 1" pos="0 3.1 0"/>
     <body euler="0 0 90"><freejoint/><geom size=".1"/><site name="lidar"/></body></worldbody></mujoco>""")
    world = load(f"mujoco:{tmp_path / 'room.xml'}", cameras=(), lidar=8, lidar_m=10.0)
    assert world.spec.units["lidar"] == "m"
    seen = world.render(world.start(1, make_rng(0)), ("lidar",))["lidar"][0]
    # counter-clockwise from the body's x, which looks along y
    far = [3, 3 * 2**0.5, 10, 10, 10, 2 * 2**0.5, 2, 2 * 2**0.5]
    assert seen.numpy() == pytest.approx(np.array(far), abs=1e-3)
    rows = load(f"mujoco:{tmp_path / 'room.xml'}", cameras=(), lidar=(3, 8)).spec.channels["lidar"]
    assert rows.shape == (3, 8)


def flown(action: list[float], steps: int):
    world = load("mujoco:drone", cameras=())
    rng = make_rng(0)
    state = world.start(4, rng)
    for _ in range(steps):
        state = world.imagine(state, torch.tensor([action] * 4), rng)
    return world, state


def test_the_drone_flies_as_it_is_told_from_any_heading():
    for asked in ([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, -1.0, 0.5, 0.0]):
        world, state = flown(asked, 150)
        seen = world.render(state, ("velocity", "done", "qvel"))
        assert not seen["done"].any()
        found = torch.cat([seen["velocity"][:, :2], seen["qvel"][:, 2:3], seen["velocity"][:, 2:]], 1)
        assert (found - torch.tensor(asked)).abs().max() < 0.15
    assert load("mujoco:drone", cameras=(), pilot=False).spec.action_names[0] == "front_left"


def test_the_car_drives_and_steers_to_the_left():
    world, rng = load("mujoco:car", cameras=()), make_rng(0)
    state = world.start(1, rng)
    for _ in range(60):
        state = world.imagine(state, torch.tensor([[0.3, 1.0]]), rng)
    seen = world.render(state, ("sensor.velocity", "sensor.gyro", "lidar"))
    assert 0.7 < float(seen["sensor.velocity"][0, 0]) < 1.1 and float(seen["sensor.gyro"][0, 2]) > 0.5
    assert 0 < seen["lidar"].min() < seen["lidar"].max() < 20
    assert world.spec.action_units == ("rad", "m/s")


def test_many_pictures_drawn_at_once_are_those_drawn_one_by_one():
    world = drawn_or_skipped(load("mujoco:ant", size=(24, 32)))
    assert isinstance(world, MujocoWorld)
    state = world.start(70, make_rng(0))  # more than are drawn before they are read
    seen = world.render(state, ("rgb",))["rgb"]
    alone = torch.cat([world.render(state.at(at), ("rgb",))["rgb"] for at in (0, 1, 63, 64, 69)])
    assert (seen[[0, 1, 63, 64, 69]].float() - alone.float()).abs().mean() < 0.5
    assert seen.float().std(0).mean() > 1  # they differ
    world.close()


DRAWN_ASIDE = """
import threading
from terrella.core import make_rng
from terrella.library import load
world, drawn = load("mujoco:ant", size=(24, 32)), threading.Event()
def draw():
    try:
        world.render(world.start(1, make_rng(0)), ("rgb",))
    finally:
        drawn.set()
    threading.Event().wait()
threading.Thread(target=draw, daemon=True).start()
drawn.wait()
"""


@pytest.mark.slow
def test_a_process_that_drew_in_another_thread_ends_in_silence():
    drawn_or_skipped(load("mujoco:ant", size=(24, 32))).close()
    ended = subprocess.run([sys.executable, "-c", DRAWN_ASIDE], capture_output=True, text=True, timeout=120)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_a_small_picture_of_a_fine_mesh_looks_as_before(tmp_path):
    turns = [(a, b) for a in range(40) for b in range(80)]
    points = "".join(
        f"v {np.sin(np.pi * a / 39) * np.cos(np.pi * b / 40):.5f} {np.sin(np.pi * a / 39) * np.sin(np.pi * b / 40):.5f} "
        f"{np.cos(np.pi * a / 39):.5f}\n"
        for a, b in turns
    )
    at = lambda a, b: 80 * a + b % 80 + 1  # noqa: E731
    faces = "".join(
        f"f {at(a, b)} {at(a + 1, b)} {at(a + 1, b + 1)}\nf {at(a, b)} {at(a + 1, b + 1)} {at(a, b + 1)}\n"
        for a, b in turns
        if a < 39
    )
    (tmp_path / "ball.obj").write_text(points + faces)
    (tmp_path / "ball.xml").write_text(
        '<mujoco><asset><mesh name="ball" file="ball.obj" scale=".3 .3 .3"/></asset><worldbody><light pos="0 0 3"/>'
        '<camera name="eye" pos="0 -1.5 .3" xyaxes="1 0 0 0 0 1"/><geom type="plane" size="0 0 .05"/>'
        '<body pos="0 0 .3"><freejoint/><geom type="mesh" mesh="ball"/></body></worldbody></mujoco>'
    )
    small = drawn_or_skipped(load(f"mujoco:{tmp_path / 'ball.xml'}", size=(32, 32)))
    large = load(f"mujoco:{tmp_path / 'ball.xml'}", size=(256, 256))
    assert isinstance(small, MujocoWorld) and isinstance(large, MujocoWorld)
    seen, fine = (world.render(world.start(1, make_rng(0)), ("rgb",))["rgb"][0].float() for world in (small, large))
    coarse = torch.nn.functional.avg_pool2d(fine.permute(2, 0, 1), 8).permute(1, 2, 0)
    assert small._renderer._model.mesh_facenum[0] < large._renderer._model.mesh_facenum[0] / 2
    assert (seen - coarse).square().mean().sqrt() < 12  # of 255
    small.close()
    large.close()


BIPED = """<mujoco><option timestep="0.005"/><worldbody><geom type="plane" size="5 5 .1"/>
 <body pos="0 0 .5"><freejoint/><geom type="box" size=".1 .1 .1" mass="5" contype="0" conaffinity="0"/>
  <body pos="0 .1 -.1"><joint name="l" type="slide" axis="0 0 1" range="-.3 .3"/><site name="left_foot" pos="0 0 -.4" size=".2"/>
   <geom type="box" size=".15 .2 .05" pos="0 0 -.35" mass=".5" contype="0"/></body>
  <body pos="0 -.1 -.1"><joint name="r" type="slide" axis="0 0 1" range="-.3 .3"/><site name="right_foot" pos="0 0 -.4" size=".2"/>
   <geom type="box" size=".15 .2 .05" pos="0 0 -.35" mass=".5" contype="0"/></body>
</body></worldbody><actuator><position joint="l" kp="3000" kv="80"/><position joint="r" kp="3000" kv="80"/></actuator>
<sensor>%s</sensor></mujoco>"""
SOLES = "".join(
    f'<touch name="foot_{foot}" site="{foot}"/><framepos name="place_{foot}" objtype="site" objname="{foot}"/>'
    f'<framelinvel name="speed_{foot}" objtype="site" objname="{foot}"/>'
    for foot in ("left_foot", "right_foot")
)


def test_legs_are_paid_for_taking_turns_by_a_clock_that_is_seen(tmp_path):
    (tmp_path / "blind.xml").write_text(BIPED % "")
    with pytest.raises(TerrellaError, match="lacks: foot_left_foot, place_left_foot"):
        MujocoWorld(str(tmp_path / "blind.xml"), MujocoConfig(task=Stepping(), cameras=()))
    (tmp_path / "biped.xml").write_text(BIPED % SOLES)
    task = Stepping(forward=(0.0, 0.0), turning=(0.0, 0.0), noise=0.0, straight=())
    world = MujocoWorld(str(tmp_path / "biped.xml"), MujocoConfig(task=task, cameras=()))
    plain = MujocoWorld(str(tmp_path / "biped.xml"), MujocoConfig(task=VelocityTracking(), cameras=()))
    clock = world.spec.channels["observation"].shape[0] - plain.spec.channels["observation"].shape[0]
    state, rng, paid = world.start(3, make_rng(0)), make_rng(0), torch.zeros(3)
    moves = torch.tensor(
        [[0.0, 0.0], [0.0, 0.1], [0.1, 0.0]]
    )  # stands, lifts the right foot first, the left foot first
    for step in range(38):
        if step > 2:
            paid += state["reward"]
        state = world.imagine(state, moves if step < 19 else moves.flip(1), rng)
    seen = world.render(state, ("observation",))["observation"][:, -2:]
    angle = 2 * np.pi * float(state["physics"][0, 0]) / task.period_s
    assert clock == 2 and torch.allclose(seen[0], torch.tensor([np.sin(angle), np.cos(angle)]).float(), atol=1e-5)
    assert not state["done"].any()
    assert paid[1] > paid[0] + 1 and paid[1] > paid[2] + 3  # the left foot stands during the first half


def test_hinges_that_are_held_stay_as_they_are_at_rest():
    robot = replace(robot_of("hopper"), pose={"leg_joint": 0.4})
    free, held = robot.spec("hopper").compile(), replace(robot, still="leg_joint").spec("hopper").compile()
    assert held.nq == free.nq - 1
    poses = []
    for model, extra in ((free, [0.4]), (held, [])):
        data = mujoco.MjData(model)
        if extra:
            data.qpos[model.joint("leg_joint").qposadr] = extra
        mujoco.mj_kinematics(model, data)
        poses.append(data.xpos.copy())
    assert np.allclose(*poses, atol=1e-6)


def test_a_reaching_arm_sees_its_own_joints_and_nothing_that_lies_about(arm):
    world = MujocoWorld(str(arm), MujocoConfig(task=Reach(hand="tip"), cameras=()))
    assert world.spec.channels["observation"].shape == (8,)  # a joint, its speed, the goal, what is left to it
    state = world.start(2, make_rng(0))
    moved = state["physics"].clone()
    moved[1] = moved[0]
    moved[1, world.layout.qpos][1:4] += 0.3  # the ball
    state = state.replace(
        physics=moved, goal=state["goal"][:1].expand(2, 3), sensors=state["sensors"][:1].expand(2, -1)
    )
    seen = world.render(state, ("observation", "qpos"))
    assert torch.equal(*seen["observation"]) and not torch.equal(*seen["qpos"])
