"""Many workers, one recording: each episode is there once and the same, whoever died on the way."""

from __future__ import annotations

from errno import ENOSPC
from functools import partial
from typing import Any

import numpy as np
import pytest
from crew import STEPS, dying, failing, opened

from terrella.care import doctor
from terrella.core import make_rng
from terrella.core.errors import TerrellaError
from terrella.data import Dataset, record
from terrella.data.collect import Job, LocalWorkers, Player, collect
from terrella.data.format import Layout

COUNT = 5


@pytest.fixture(scope="module")
def never(tmp_path_factory) -> Dataset:
    """What one process records."""
    world, policy = opened()
    root = tmp_path_factory.mktemp("never") / "set"
    record(world, policy(), root, (STEPS + 1) * COUNT, make_rng(3))
    return Dataset(root)


def gathered(root, workers, open=opened, **more) -> Dataset:
    collect(Job.of(open, opened()[0].spec, make_rng(3)), root, workers, episodes=COUNT, **more)
    return Dataset(root)


def assert_same(found: Dataset, never: Dataset) -> None:
    assert doctor(found.root) == [] and len(found.episodes) == len(never.episodes) == COUNT
    for one, other in zip(found.episodes, never.episodes):
        mine, theirs = found.episode(one.number), never.episode(other.number)
        assert all(np.array_equal(mine[name], theirs[name]) for name in theirs)
    rows = [0, found.length // 2, found.length - 1]
    assert np.array_equal(found.rgb_at(rows), never.rgb_at(rows))


@pytest.mark.slow
def test_workers_record_what_one_process_does_when_some_are_killed(tmp_path, never, monkeypatch):
    (tmp_path / "deaths").mkdir()
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    assert_same(gathered(tmp_path / "set", LocalWorkers(2), partial(dying, tmp_path / "deaths", 2)), never)
    assert len(list((tmp_path / "deaths").iterdir())) == 2
    assert not list((tmp_path / "temporary").glob("terrella-*"))  # nothing is left among temporary files


@pytest.mark.slow
def test_what_was_stopped_goes_on(tmp_path, never):
    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        gathered(tmp_path / "set", LocalWorkers(1), progress=stop)
    assert len(Dataset(tmp_path / "set").episodes) == 2
    assert_same(gathered(tmp_path / "set", LocalWorkers(1)), never)


@pytest.mark.slow
def test_what_fails_in_a_worker_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr("terrella.data.collect.MOST_DEATHS", 1)
    with pytest.raises(TerrellaError, match="this policy fails. 0 episodes are safe"):
        gathered(tmp_path / "set", LocalWorkers(1), failing)
    (tmp_path / "deaths").mkdir()
    with pytest.raises(TerrellaError, match=r"episode 0 ended its worker 1 times .* 0 episodes are safe"):
        gathered(tmp_path / "set", LocalWorkers(1), partial(dying, tmp_path / "deaths", 99))
    with pytest.raises(TerrellaError, match="0 workers"):
        LocalWorkers(0)


def test_a_full_disk_is_said_as_what_it_is(tmp_path, monkeypatch):
    def full(**_):
        raise OSError(ENOSPC, "No space left on device")

    monkeypatch.setattr("tempfile.TemporaryDirectory", full)
    with pytest.raises(OSError, match="No space left"):
        gathered(tmp_path / "set", LocalWorkers(1))


def test_ray_records_the_same_when_a_worker_is_killed(tmp_path, never):
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'terrella[ray]'")
    from terrella.data.ray import RayWorkers

    (tmp_path / "deaths").mkdir()
    assert_same(gathered(tmp_path / "set", RayWorkers(2), partial(dying, tmp_path / "deaths", 1)), never)
    assert len(list((tmp_path / "deaths").iterdir())) == 1


class BusyRay:
    """A Ray of which only so many actors ever start."""

    def __init__(self, free: int):
        self.free, self.killed = free, []

    def wait(self, asked, num_returns, timeout):
        return asked[: self.free], asked[self.free :]

    def kill(self, actor):
        self.killed.append(actor)


class Asked:
    def __init__(self, number: int):
        self.__ray_ready__, self.remote = self, lambda: number


@pytest.mark.parametrize("free", [0, 1])
def test_busy_processors_are_said_and_not_waited_for(free):
    from terrella.data.ray import RayWorkers

    workers: Any = object.__new__(RayWorkers)
    workers.size, workers._ray, workers._actors = 2, BusyRay(free), [Asked(0), Asked(1)]
    if free:
        with pytest.warns(UserWarning, match="1 of 2 workers found no free processor"):
            workers._started()
        assert workers.size == 1 and len(workers._ray.killed) == 1
    else:
        with pytest.raises(TerrellaError, match="no worker has started on Ray"):
            workers._started()


def test_a_player_clears_what_one_that_died_has_left(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    job = Job(opened, Layout.of(opened()[0].spec), "test", 0, STEPS)
    (Player(job, "one")._folder / "half an episode").touch()
    again = Player(job, "one")
    assert not list(again._folder.iterdir())
    again.clear()
    assert not list(tmp_path.iterdir())
