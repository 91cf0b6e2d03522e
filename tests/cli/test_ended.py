"""SIGTERM ends a command and its workers."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time

import pytest

from terrella.cli import main


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_sigterm_ends_a_command_and_its_workers(monkeypatch):
    workers = []

    def command(given):
        workers.append(multiprocessing.get_context("spawn").Process(target=time.sleep, args=(600,), daemon=True))
        workers[0].start()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(600)

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr("terrella.cli._run", command)
    assert main([]) == 130
    workers[0].join(60)
    assert workers[0].exitcode == -signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is before
