"""Files of a remote come whole or not at all, within their budget; clips of one obey the laws of clips nearby."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shutil
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path

import fsspec
import numpy as np
import pytest

from terrella.core.errors import DatasetError
from terrella.data import Dataset
from terrella.data.storage.remote import Files, LocalFiles, _let_go, open_files
from terrella.data.training.clips import Clips, ClipsConfig
from terrella.data.training.windows import _Belt

MEMORY = fsspec.filesystem("memory")


@pytest.fixture
def remote():
    """20 files of 10,000 bytes at memory://here, each full of its number."""
    MEMORY.rm("/", recursive=True)
    for i in range(20):
        MEMORY.pipe(f"/here/data/chunk-000/file-{i:03d}.bin", bytes([i]) * 10_000)
    MEMORY.pipe("/here/meta/info.json", b"{}")
    yield "memory://here"
    MEMORY.rm("/", recursive=True)


def name(i: int) -> str:
    return f"data/chunk-000/file-{i:03d}.bin"


def held(folder: Path) -> dict[str, int]:
    """Bytes of each file in a folder that others change meanwhile."""
    sizes = {}
    for top, _, names in os.walk(folder):  # which, unlike rglob, passes over a folder that has gone
        for path in (os.path.join(top, name) for name in names if not name.startswith(".")):
            with contextlib.suppress(FileNotFoundError):
                sizes[path] = os.stat(path).st_size
    return sizes


def kept(folder: Path) -> int:
    """Bytes of all that lies in the cache at one moment: listed until nothing moved, came or went meanwhile."""
    while (found := held(folder)) != held(folder):
        pass
    return sum(found.values())


def test_a_folder_and_its_remote_twin_tell_the_same(remote, tmp_path):
    MEMORY.get("/here", str(tmp_path / "near"), recursive=True)
    (tmp_path / "near" / "data" / ".hidden").mkdir()
    (tmp_path / "near" / "data" / ".hidden" / "x.bin").touch()
    addresses = [remote, f"file://{tmp_path / 'near'}"]
    twins = [LocalFiles(tmp_path / "near"), *(Files(root, tmp_path / "cache") for root in addresses)]
    for files in twins:
        assert files.list("data", ".bin") == [name(i) for i in range(20)]
        assert files.list("", ".json") == ["meta/info.json"] and files.list("nowhere", "") == []
        assert files.exists("meta/info.json") and not files.exists("meta/other.json") and not files.exists("meta")
        assert not files.exists("nowhere/at/all")
        with files.holding(name(7)):
            assert files.local(name(7)).read_bytes() == bytes([7]) * 10_000
        assert open_files(files) is files
    assert isinstance(open_files(tmp_path), LocalFiles) and str(open_files(str(tmp_path))) == str(tmp_path)


@pytest.mark.parametrize("wrong", ["../secret", "/etc/passwd", "data/../../x", "a\\..\\..\\b", "", "~/x", "x\0y"])
def test_a_name_never_leads_out(remote, tmp_path, wrong):
    for files in (LocalFiles(tmp_path), Files(remote, tmp_path / "cache")):
        for ask in (files.local, files.exists):
            with pytest.raises(DatasetError, match="leads out"):
                ask(wrong)


def test_what_was_used_longest_ago_makes_room(remote, tmp_path):
    files = Files(remote, tmp_path, budget_bytes=55_000)
    for i in range(20):
        assert files.local(name(i)).read_bytes() == bytes([i]) * 10_000
        assert kept(tmp_path) <= 55_000
        files.local(name(0))  # is used again and again, and never fetched again
    MEMORY.rm("/here/data", recursive=True)
    assert files.local(name(0)).stat().st_size == 10_000 and files.local(name(19)).exists()
    with pytest.raises(DatasetError, match="is gone"):
        files.local(name(5))
    with pytest.raises(DatasetError, match="there is no"):
        Files(remote, tmp_path).local(name(5))


def test_a_file_in_use_stays_and_a_cache_full_of_them_says_so(remote, tmp_path):
    files = Files(remote, tmp_path, budget_bytes=35_000, timeout_s=0.2)
    with files.holding(name(0), name(1)):
        held = [files.local(name(i)) for i in (0, 1)]
        for i in range(2, 12):
            files.local(name(i))
            assert all(path.exists() for path in held) and kept(tmp_path) <= 35_000
        with Files(remote, tmp_path, budget_bytes=35_000).holding(name(2)):  # somebody else
            with pytest.raises(DatasetError, match="full of files in use"):
                files.local(name(3))
    files.local(name(3))
    with pytest.raises(DatasetError, match="10,000 bytes, and only 9,999 fit"):
        Files(remote, tmp_path, budget_bytes=9_999).local(name(4))


def test_half_a_file_is_never_kept(remote, tmp_path, monkeypatch):
    files, real, calls = Files(remote, tmp_path, attempts=3), type(MEMORY).get_file, []

    def cut(self, path, made, **options):
        calls.append(path)
        Path(made).write_bytes(b"half")
        if len(calls) == 1:
            raise OSError("connection reset")

    monkeypatch.setattr(type(MEMORY), "get_file", cut)
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    with pytest.raises(DatasetError, match="tried 3 times to fetch .*4 of 10000 bytes arrived"):
        files.local(name(1))
    assert len(calls) == 3 and kept(tmp_path) == 0 and not list((tmp_path / ".coming").iterdir())
    monkeypatch.setattr(type(MEMORY), "get_file", lambda *a, **o: cut(*a, **o) if len(calls) < 5 else real(*a, **o))
    assert files.local(name(1)).read_bytes() == bytes([1]) * 10_000  # the third time it comes


def test_silence_and_refusal_are_told(remote, tmp_path, monkeypatch):
    files = Files(remote, tmp_path, timeout_s=0.05, attempts=2)
    waiting = threading.Event()
    monkeypatch.setattr(type(MEMORY), "ls", lambda *a, **o: waiting.wait(5))
    begun = time.monotonic()
    with pytest.raises(DatasetError, match="cannot be reached .*silent for 0.05 s"):
        files.exists("meta/info.json")
    assert time.monotonic() - begun < 3
    waiting.set()

    def refuse(*arguments, **options):
        raise PermissionError("401")

    monkeypatch.setattr(type(MEMORY), "ls", refuse)
    with pytest.raises(DatasetError, match="refuses to .*credentials"):
        files.exists("meta/info.json")


def test_a_missing_package_and_an_unknown_scheme_are_told(tmp_path, monkeypatch):
    with pytest.raises(DatasetError, match="not a valid address"):
        Files("nonsense://x", tmp_path)

    def missing(*arguments, **options):
        raise ImportError("Install s3fs to access S3")

    monkeypatch.setattr(fsspec.core, "url_to_fs", missing)
    with pytest.raises(DatasetError, match=r"pip install 'terrella\[remote\]'"):
        Files("s3://bucket/set", tmp_path)


def test_what_changes_at_the_remote_is_fetched_anew(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "a.txt").write_text("old")
    root = f"file://{tmp_path / 'far'}"
    assert Files(root, tmp_path / "cache").local("a.txt").read_text() == "old"
    (tmp_path / "far" / "a.txt").write_text("new")  # as many bytes
    os.utime(tmp_path / "far" / "a.txt", (1, 1))
    assert Files(root, tmp_path / "cache").local("a.txt").read_text() == "new"


def test_what_a_killed_process_was_fetching_is_cleared_away(remote, tmp_path):
    files = Files(remote, tmp_path, budget_bytes=35_000)
    left = tmp_path / ".coming" / "30000-killed"
    left.mkdir()
    (left / "part-x").write_bytes(b"x" * 20_000)
    assert files.local(name(1)).exists() and not left.exists() and kept(tmp_path) == 10_000


def test_what_arrives_or_is_cleared_away_while_room_is_made(remote, tmp_path, monkeypatch):
    files, list_folder = Files(remote, tmp_path, budget_bytes=35_000), os.scandir

    def arrives_between(folder):
        entries = list(list_folder(folder))
        if part.exists():
            os.replace(part, tmp_path / "arrived")
            room.rmdir()
        return entries

    with files._room("a", 20_000) as room:
        part = room / "part-x"
        part.write_bytes(b"x" * 20_000)
        with monkeypatch.context() as patch:
            patch.setattr("terrella.data.storage.remote.os.scandir", arrives_between)
            assert files._evicted(0) >= 20_000
    room.mkdir()  # as if its owner, done, removed it once it was found and before it was locked
    assert _let_go(room, lambda path: [shutil.rmtree(path), shutil.rmtree(path)]) and not room.exists()


WORKER = """
import random, sys
from terrella.data.storage.remote import Files
root, cache, seed = sys.argv[1:]
files, rng = Files(root, cache, budget_bytes=45_000), random.Random(int(seed))
for _ in range(40):
    i = rng.randrange(20)
    with files.holding(f"data/chunk-000/file-{i:03d}.bin"):
        content = files.local(f"data/chunk-000/file-{i:03d}.bin").read_bytes()
        assert content == bytes([i]) * 10_000, (i, len(content))
"""


def test_several_processes_share_one_cache(remote, tmp_path):
    MEMORY.get("/here", str(tmp_path / "far"), recursive=True)
    command = [sys.executable, "-c", WORKER, f"file://{tmp_path / 'far'}", str(tmp_path / "cache")]
    running = [subprocess.Popen([*command, str(seed)]) for seed in range(3)]
    most = 0
    while any(process.poll() is None for process in running):
        most = max(most, kept(tmp_path / "cache"))
        time.sleep(0.002)
    assert [process.returncode for process in running] == [0, 0, 0]
    assert 0 < most <= 45_000


# -- recordings ------------------------------------------------------------------------------------------------------


@pytest.fixture
def far(recording, tmp_path) -> str:
    shutil.rmtree(recording / ".cache", ignore_errors=True)
    return f"file://{recording}"


def same(a, b) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[key], b[key]) for key in a)


def test_a_recording_far_away_reads_as_one_nearby(far, recording, tmp_path):
    near, remote = Dataset(recording), Dataset(Files(far, tmp_path / "cache"))
    assert remote.length == near.length and remote.features == near.features
    assert same(remote.episode(2), near.episode(2))


CHANNELS = ("rgb", "depth", "pose", "action", "episode", "row")


def streaming(far, tmp_path, budget_bytes=400_000, **options) -> Clips:
    options = {"batch": 4, "size": (12, 16), "drop_last": False, "cache_dir": tmp_path / "cache", **options}
    return Clips(far, ClipsConfig(5, CHANNELS, budget_bytes=budget_bytes, **options))


@pytest.mark.parametrize("budget_bytes", [1 << 30, 200_000, 100_000])  # one window; some; episodes cut
def test_its_clips_are_those_of_the_clip_cache(far, recording, tmp_path, budget_bytes):
    near = Clips(recording, ClipsConfig(5, CHANNELS, 4, (12, 16), drop_last=False, shuffle=False))
    want = {
        int(row[0]): {name: batch[name][i] for name in CHANNELS} for batch in near for i, row in enumerate(batch["row"])
    }
    clips = streaming(far, tmp_path, budget_bytes, workers=2)
    orders = []
    for _ in range(2):
        found = [{name: batch[name][i] for name in CHANNELS} for batch in clips for i in range(len(batch["row"]))]
        orders.append([int(clip["row"][0]) for clip in found])
        assert sorted(orders[-1]) == sorted(want)
        assert all(same(clip, want[int(clip["row"][0])]) for clip in found)
    assert orders[0] != orders[1] != sorted(want)


def test_it_goes_on_after_any_batch_and_shares_an_epoch_among_ranks(far, tmp_path):
    budget, states, seen = 100_000, [], []
    clips = streaming(far, tmp_path, budget, workers=2, seed=4)
    states.append(clips.state())
    assert states[0]["of"]["window_rows"] < 30
    for batch in clips.forever():
        seen.append(batch)
        states.append(json.loads(json.dumps(clips.state())))
        if len(seen) == len(clips) + 3:
            break
    for at in range(0, len(seen), 3):
        rest = streaming(far, tmp_path, budget, workers=at % 3, seed=4).resume(states[at]).forever()
        assert all(same(next(rest), batch) for batch in seen[at:])
        rest.close()
    ranks = [[*streaming(far, tmp_path, budget, rank=rank, world_size=2)] for rank in range(2)]
    rows = [row for batches in ranks for batch in batches for row in batch["row"][:, 0].tolist()]
    assert sorted(rows) == sorted(
        row for batch in streaming(far, tmp_path, budget) for row in batch["row"][:, 0].tolist()
    )
    with pytest.raises(DatasetError, match="window_rows"):
        streaming(far, tmp_path, budget + 100_000, seed=4).resume(states[0])


def test_files_and_windows_stay_within_the_budget(far, recording, tmp_path, monkeypatch):
    whole = sum(path.stat().st_size for path in recording.rglob("*") if path.is_file())
    budget, most, windows, real = int(1.6 * whole), 0, [], _Belt._made

    def made(belt, pieces):
        window = real(belt, pieces)
        windows.append((weakref.ref(window), sum(array.nbytes for array in window.arrays.values())))
        alive.append(sum(size for window, size in windows if window() is not None))
        return window

    alive: list[int] = []
    monkeypatch.setattr(_Belt, "_made", made)
    clips = streaming(far, tmp_path, budget, size=(24, 32), workers=1)
    for batch in itertools.chain(clips, clips):
        most = max(most, kept(tmp_path / "cache"))
        del batch
        time.sleep(0.01)  # so that the next window is made meanwhile
    assert 0.4 * budget < most <= budget / 2 < whole  # some files were fetched twice, and evicted
    assert len(windows) >= 6 and 0.25 * budget < max(alive) <= budget / 2


def test_errors_of_a_window_reach_the_reader(far, recording, tmp_path):
    clips = streaming(far, tmp_path)
    for path in (recording / "videos").rglob("*.mp4"):
        path.write_bytes(b"")
    with pytest.raises(DatasetError):
        list(clips)
    with pytest.raises(DatasetError, match="holds no clip"):
        streaming(far, tmp_path, 1 << 30, size=(40_000, 4_000))


@pytest.mark.parametrize("scheme", ["file", "memory"])
def test_a_clip_cache_of_a_recording_far_away(recording, tmp_path, monkeypatch, scheme):
    import fsspec

    from terrella.data import ClipCache

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    near = ClipCache.open(recording, (12, 16))
    root = f"file://{recording}"
    if scheme == "memory":
        root = "memory://far/recording"
        memory = fsspec.filesystem("memory")
        for path in recording.rglob("*"):
            if path.is_file() and ".cache" not in path.parts:
                memory.pipe(f"/far/recording/{path.relative_to(recording)}", path.read_bytes())
    dataset = Dataset(Files(root, tmp_path / "files", budget_bytes=1 << 20))
    far = ClipCache.open(dataset, (12, 16))
    assert (
        far.path.is_relative_to(tmp_path / "home")
        and list(far.episodes) == list(near.episodes)
        and far.tasks == near.tasks
    )
    assert all(np.array_equal(near.arrays[name], far.arrays[name]) for name in near.arrays)
    assert ClipCache.open(dataset, (12, 16)).path == far.path  # built once
    with pytest.raises(DatasetError, match="may be kept here.*smaller pictures"):
        ClipCache.open(dataset, (24, 32), budget_bytes=100_000)
