"""Files are replaced whole: laws of core/files.py."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from terrella.core import files
from terrella.core.errors import DatasetError


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing(tmp_path):
    target = tmp_path / "deep" / "a.json"
    files.write_json(target, {"value": 1})
    with pytest.raises(RuntimeError), files.replacing(target) as staged:
        staged.write_text("half")
        raise RuntimeError("stopped")
    with pytest.raises(ValueError):
        files.write_json(target, float("nan"))
    assert target.read_text() == '{\n  "value": 1\n}\n' and os.listdir(target.parent) == ["a.json"]


@pytest.mark.parametrize("durable", [True, False])
def test_a_write_is_synced_before_it_is_renamed(tmp_path, monkeypatch, durable):
    events, fsync, rename = [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: events.append("sync") or fsync(handle))
    monkeypatch.setattr(os, "replace", lambda old, new: events.append("rename") or rename(old, new))
    with files.replacing(tmp_path / "a", durable) as staged:
        staged.write_bytes(b"new")
    assert events == (["sync", "rename", "sync"] if durable else ["rename"])
    assert (tmp_path / "a").read_bytes() == b"new"


def test_threads_that_replace_one_file_do_not_mix(tmp_path):
    target, texts = tmp_path / "a", [letter * 200_000 for letter in "abcd"]
    threads = [threading.Thread(target=files.write_text, args=(target, text)) for text in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert target.read_text() in texts and os.listdir(tmp_path) == ["a"]


KILLED = """
import sys
from terrella.core.files import replacing
with replacing(sys.argv[1]) as staged:
    staged.write_text("half")
    print("written", flush=True)
    sys.stdin.read()
"""


def test_what_a_killed_process_left_is_swept_by_a_later_write(tmp_path):
    target = tmp_path / "a"
    files.write_text(target, "old")
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", KILLED, str(target)], **pipes) as process:
        assert process.stdout and process.stdout.readline()
        process.send_signal(signal.SIGKILL)
    (left,) = [tmp_path / name for name in os.listdir(tmp_path) if name != "a"]
    assert target.read_text() == "old"
    files.write_text(target, "new")
    assert left.exists()  # it may belong to a process that is still writing
    os.utime(left, (time.time() - 7200,) * 2)
    files.write_text(target, "newer")
    assert target.read_text() == "newer" and os.listdir(tmp_path) == ["a"]


def test_creating_refuses_to_overwrite_and_is_all_or_nothing(tmp_path):
    with files.creating(tmp_path / "new") as staged:
        staged.mkdir()
        (staged / "a").write_text("a")
    with pytest.raises(DatasetError, match="exists already"), files.creating(tmp_path / "new"):
        pass
    with (
        pytest.raises(DatasetError, match="was not written: the disk is full"),
        files.creating(tmp_path / "b") as staged,
    ):
        staged.write_text("half")
        raise OSError(files.FULL[0], "No space left on device")
    assert os.listdir(tmp_path) == ["new"]
