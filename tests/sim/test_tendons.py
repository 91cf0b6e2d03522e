"""Fixed tendons whose equality couples joints, or holds one: as with equalities of joints, only the one that drives has a servo."""

from __future__ import annotations

import pytest
from tests.sim.test_mujoco_files import moved_by, world_of


def test_joints_that_tendons_couple_have_one_servo(tmp_path):
    tree = "".join(
        f'<body><joint name="{name}" axis="0 0 1"/><geom size=".1" contype="0" conaffinity="0"/></body>'
        for name in "abcde"
    )
    fixed = "".join(
        f'<fixed name="t{name}">{"".join(f"""<joint joint="{one}" coef="{coef}"/>""" for one, coef in joints)}</fixed>'
        for name, joints in {"a": [("a", 2)], "b": [("b", 0.5)], "cd": [("c", 1), ("d", -1)], "e": [("e", 4)]}.items()
    )
    pairs = '<tendon tendon1="tb" tendon2="ta" polycoef=".1 .5 0 0 0"/><tendon tendon1="tcd"/>'
    held = '<tendon tendon1="te" polycoef=".8 0 0 0 0"/>'
    text = f"<worldbody>{tree}</worldbody><tendon>{fixed}</tendon><equality>{pairs}{held}</equality>"
    world = world_of(tmp_path, f"<mujoco>{text}</mujoco>")
    assert world.spec.action_names == ("a", "c")
    # 0.5 b = 0.1 + 0.5 * 2 a; c = d; 4 e = 0.8
    assert moved_by(world, [0.3, -0.4]) == pytest.approx([0.3, 0.8, -0.4, -0.4, 0.2], abs=0.02)
