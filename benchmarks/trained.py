"""What the outside judges train first: by the commands that a user types, and not again what stands there already."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import terrella
from terrella.act.goal_network import GoalActor
from terrella.core import World


def words(given: Sequence[str]) -> list[str]:
    """Words without -- as a command takes them: every other one is a setting's name."""
    return [f"--{word}" if number % 2 == 0 else word for number, word in enumerate(given)]


def command(*given: str) -> float:
    """A command of terrella's, as a user types it; the processor seconds that it took."""
    print("$ terrella", *given, flush=True)
    began = _used()
    subprocess.run([str(Path(sys.executable).with_name("terrella")), *given], check=True)
    return _used() - began


def _used() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def trained(
    folder: Path, seed: int, record: Callable[[Path], None], train: Sequence[str], reach: Sequence[str]
) -> tuple[World, GoalActor, dict[str, float]]:
    """The world and the policy of a seed, made where they are missing, and the processor seconds of training."""
    recording, run, goals, notes = (folder / f"{name}-{seed}" for name in ("recording", "world", "goals", "cost.json"))
    spent = json.loads(notes.read_text()) if notes.exists() else {}
    if not (recording / "meta" / "info.json").exists():
        record(recording)
    if not (run / "world" / "world.json").exists():
        spent["world"] = command("train", "latent", str(recording), "--out", str(run), "--seed", str(seed), *train)
    if not (goals / "policy" / "policy.json").exists():
        given = ("--in", str(run), "--from", str(recording), "--out", str(goals), "--seed", str(seed), *reach)
        spent["goals"] = command("train", "goals", *given)
    notes.write_text(json.dumps(spent))
    world = terrella.load(run)
    return world, GoalActor.load(goals, world.spec), spent
