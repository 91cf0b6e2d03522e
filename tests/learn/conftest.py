"""Small worlds that many tests of this room share: trained once, by whichever process of pytest-xdist is the first."""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.data.corridor import Corridor
from tests.learn.haunted import Haunted
from tests.learn.small import BARE, DREAMS, FLAT, POSED, STUDENT, TEACHER
from tests.learn.stopping import quiet

from terrella.act import Explorer
from terrella.core import make_rng
from terrella.core.files import write_json
from terrella.data import RecordOptions, record
from terrella.learn.objectives import scroll
from terrella.learn.recipes.post_training import distil, train_dreams
from terrella.learn.recipes.video import train_video
from terrella.worlds.folder import load_world


@pytest.fixture(scope="session")
def shared(tmp_path_factory, request):
    """shared(name, make) -> the folder that make(folder) filled, and the facts that it returned."""
    root = tmp_path_factory.getbasetemp()
    root = (root.parent if hasattr(request.config, "workerinput") else root) / "shared"
    root.mkdir(exist_ok=True)

    def made(name: str, make: Callable[[Path], dict | None]) -> tuple[Path, dict]:
        folder, facts = root / name, root / f"{name}.json"
        with open(root / f"{name}.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not facts.exists():
                shutil.rmtree(folder, ignore_errors=True)  # a process that ended may have left a part of it
                write_json(facts, make(folder))
        return folder, json.loads(facts.read_text())

    return made


def recorded(shared, name: str, world) -> Path:
    def make(folder: Path) -> None:
        record(world, Explorer(world.spec), folder, 300, make_rng(0), options=RecordOptions(max_episode_steps=80))

    return shared(name, make)[0]


@pytest.fixture(scope="session", autouse=True)
def few_scroll_steps():
    """How a made-up picture scrolls is learned in a tenth of the steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scroll, "STEPS", 60)
        yield


@pytest.fixture(scope="session")
def corridor(shared):
    """A recording with depth and poses, in which nothing moves."""
    return recorded(shared, "corridor", Corridor())


@pytest.fixture(scope="session")
def haunted(shared):
    """A recording with depth and poses that marks what moves, and has a vital."""
    return recorded(shared, "haunted", Haunted())


@pytest.fixture(scope="session")
def posed_run(shared, corridor):
    """The folder and the facts of a run with all senses."""
    return shared("posed", lambda out: train_video(corridor, out, POSED, quiet))


@pytest.fixture(scope="session")
def bare_run(shared, corridor):
    """The same without estimator and uncertainty."""
    return shared("bare", lambda out: train_video(corridor, out, BARE, quiet))


@pytest.fixture(scope="session")
def flat_run(shared, corridor):
    """A world with an uncertainty, of the frames and actions of the same recording."""
    return shared("flat", lambda out: train_video(corridor, out, FLAT, quiet))


@pytest.fixture(scope="session")
def haunted_run(shared, haunted):
    return shared("haunted-run", lambda out: train_video(haunted, out, BARE, quiet))


@pytest.fixture(scope="session")
def teacher(shared, corridor):
    """A world of four steps a frame."""
    return load_world(shared("teacher", lambda out: train_video(corridor, out, TEACHER, quiet))[0] / "world")


@pytest.fixture(scope="session")
def student_run(shared, corridor, teacher):
    """A distillation of the teacher."""
    return shared("student", lambda out: distil(teacher, corridor, out, STUDENT, quiet))


@pytest.fixture(scope="session")
def dreams_run(shared, corridor, teacher):
    """The teacher, trained on its own rollouts."""
    return shared("dreams", lambda out: train_dreams(teacher, corridor, out, DREAMS, quiet))
