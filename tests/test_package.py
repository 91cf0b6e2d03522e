"""The package from outside: quick to import, and every promised name is there."""

from __future__ import annotations

import subprocess
import sys

import pytest

import terrella


def test_importing_is_quick_and_configures_nothing():
    script = "import sys, terrella; sys.exit(' '.join({'torch', 'numpy', 'gymnasium'} & set(sys.modules)) or 0)"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert run.returncode == 0, f"`import terrella` imported {run.stderr}"


@pytest.mark.parametrize("name", terrella.__all__)
def test_every_promised_name_is_there(name):
    assert getattr(terrella, name) is getattr(terrella, name)
    assert name in dir(terrella)


def test_learn_is_a_room_that_is_called_as_a_workflow():
    from terrella.core.errors import TerrellaError
    from terrella.learn.trainer import Trainer

    assert terrella.learn.trainer.Trainer is Trainer
    with pytest.raises(TerrellaError, match="--minutes"):
        terrella.learn("gym:CartPole-v1", terrella.LearnConfig(minutes=0))


def test_other_names_are_not():
    with pytest.raises(AttributeError, match="no_such_name"):
        terrella.no_such_name  # noqa: B018


def test_load_says_what_exists():
    from terrella.core.errors import TerrellaError

    with pytest.raises(TerrellaError, match="doom:my_way_home"):
        terrella.load("no such world")


def test_without_vizdoom_the_error_says_how_to_get_it(monkeypatch):
    from terrella import library
    from terrella.core.errors import TerrellaError

    monkeypatch.setattr(library, "find_spec", lambda name: None)
    with pytest.raises(TerrellaError, match=r"terrella\[sim\]"):
        library.load("doom:my_way_home")
    assert all(not entry.name.startswith("doom:") for entry in library.worlds())


def test_a_training_run_is_opened_at_its_world(tmp_path):
    from terrella import library
    from terrella.core.errors import CheckpointError

    (tmp_path / "run" / "world").mkdir(parents=True)
    (tmp_path / "run" / "world" / "world.json").write_text('{"kind": "of another sort"}')
    with pytest.raises(CheckpointError, match="of another sort"):
        library.load(tmp_path / "run")
    assert [entry.name for entry in library.worlds([tmp_path])][-1] == str(tmp_path / "run" / "world")
