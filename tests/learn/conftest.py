"""Small worlds that many tests of this room share: trained once."""

from __future__ import annotations

import pytest
from tests.data.corridor import Corridor
from tests.learn.haunted import Haunted
from tests.learn.small import BARE, DREAMS, FLAT, POSED, STUDENT, TEACHER
from tests.learn.stopping import quiet

from terrella.act import Explorer
from terrella.core import make_rng
from terrella.data import RecordOptions, record
from terrella.learn.objectives import scroll
from terrella.learn.recipes.post_training import distil, train_dreams
from terrella.learn.recipes.video import train_video
from terrella.worlds.folder import load_world


def recorded(world, folder, rows: int = 300):
    record(world, Explorer(world.spec), folder, rows, make_rng(0), options=RecordOptions(max_episode_steps=80))
    return folder


@pytest.fixture(scope="session", autouse=True)
def few_scroll_steps():
    """How a made-up picture scrolls is learned in a tenth of the steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scroll, "STEPS", 60)
        yield


@pytest.fixture(scope="session")
def corridor(tmp_path_factory):
    """A recording with depth and poses, in which nothing moves."""
    return recorded(Corridor(), tmp_path_factory.mktemp("corridor") / "set")


@pytest.fixture(scope="session")
def haunted(tmp_path_factory):
    """A recording with depth and poses that marks what moves, and has a vital."""
    return recorded(Haunted(), tmp_path_factory.mktemp("haunted") / "set")


def trained(tmp_path_factory, data, config):
    out = tmp_path_factory.mktemp("run")
    return out, train_video(data, out, config, quiet)


@pytest.fixture(scope="session")
def posed_run(corridor, tmp_path_factory):
    """The folder and the facts of a run with all senses."""
    return trained(tmp_path_factory, corridor, POSED)


@pytest.fixture(scope="session")
def bare_run(corridor, tmp_path_factory):
    """The same without estimator and uncertainty."""
    return trained(tmp_path_factory, corridor, BARE)


@pytest.fixture(scope="session")
def flat_run(corridor, tmp_path_factory):
    """A world with an uncertainty, of the frames and actions of the same recording."""
    return trained(tmp_path_factory, corridor, FLAT)


@pytest.fixture(scope="session")
def haunted_run(haunted, tmp_path_factory):
    return trained(tmp_path_factory, haunted, BARE)


@pytest.fixture(scope="session")
def teacher(corridor, tmp_path_factory):
    """A world of four steps a frame."""
    return load_world(trained(tmp_path_factory, corridor, TEACHER)[0] / "world")


@pytest.fixture(scope="session")
def student_run(corridor, teacher, tmp_path_factory):
    """A distillation of the teacher."""
    out = tmp_path_factory.mktemp("student")
    return out, distil(teacher, corridor, out, STUDENT, quiet)


@pytest.fixture(scope="session")
def dreams_run(corridor, teacher, tmp_path_factory):
    """The teacher, trained on its own rollouts."""
    out = tmp_path_factory.mktemp("dreams")
    return out, train_dreams(teacher, corridor, out, DREAMS, quiet)
