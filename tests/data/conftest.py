"""Lets the tests of this room import their small world by name, and gives them a small recording."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session")
def _recorded(tmp_path_factory) -> Path:
    from corridor import Corridor, keys

    from terrella.core import make_rng
    from terrella.data import RecordOptions, record

    root = tmp_path_factory.mktemp("recorded") / "corridor"
    record(Corridor(), keys, root, frames=100, rng=make_rng(0), options=RecordOptions(max_episode_steps=29))
    return root


@pytest.fixture
def recording(_recorded, tmp_path) -> Path:
    """A folder of 100 rows: episodes of 30, 30, 30 and 10, free to be damaged."""
    shutil.copytree(_recorded, tmp_path / "recording")
    return tmp_path / "recording"
