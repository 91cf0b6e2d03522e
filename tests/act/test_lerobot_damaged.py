"""A folder of LeRobot's whose config.json is cut off is still known as one of LeRobot's."""

from __future__ import annotations

import pytest
from tests.act.reach import NAME
from tests.act.test_lerobot_policy import saved, stand_in  # noqa: F401

import terrella
from terrella.core.errors import CheckpointError


def test_a_cut_off_config_is_named_as_damaged(tmp_path):
    place = saved(tmp_path / "policy")
    whole = (place / "config.json").read_text()
    (place / "config.json").write_text(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match="is damaged: its JSON files do not describe a policy of LeRobot"):
        terrella.load_policy(place, terrella.load(NAME).spec)
