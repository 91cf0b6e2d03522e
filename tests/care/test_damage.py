"""Whatever is cut, flipped or forged, reading ends in a clear error or in the truth, and a repair keeps what is whole.

The whole sweep, every offset of every kind of file and thousands of flipped bits, runs for an hour where
TERRELLA_DAMAGE is set ("all"); a sample of it runs always.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import threading
from collections import Counter
from pathlib import Path

import pytest
from damage import IN_FLIGHT, KINDS, LENGTHS, OF_EPISODE, make

pytestmark = pytest.mark.slow  # a sweep: `make test-all` runs it

SECONDS = 60.0  # that one case may take before it counts as a hang
LAST = 64 << 10  # bytes of each file that are cut one by one
WHOLE = os.environ.get("TERRELLA_DAMAGE") == "all"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    shared = Path("/dev/shm")  # no disk to wait for
    root = tmp_path_factory.mktemp("damage")
    if WHOLE and shared.is_dir():
        root = shared / f"terrella-damage-{os.getpid()}"
        root.mkdir()
    make(root)
    return root


def _run(folder: Path, cases: list[dict]) -> list[dict]:
    """Each case's outcome, from processes of their own: {"crash": why} of one that crashed, hung, or ended in a foreign error."""
    found: list[dict] = []
    while len(found) < len(cases):
        some, crash = _outcomes(folder, cases[len(found) :])
        found += some
        if crash:
            found.append({"crash": crash, "seconds": 0.0, "mib": 0})
    return found


def _outcomes(folder: Path, cases: list[dict]) -> tuple[list[dict], str]:
    script, file = Path(__file__).with_name("damage.py"), folder / "cases.json"
    file.write_text(json.dumps(cases))
    command = [sys.executable, "-W", "error", str(script), str(folder), str(file)]
    found: list[dict] = []
    with open(folder / "stderr", "w+") as errors:
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True) as process:
            assert process.stdout
            while True:
                watch = threading.Timer(SECONDS, process.kill)
                watch.start()
                line = process.stdout.readline()
                watch.cancel()
                if not line:
                    break
                said = json.loads(line)
                if "end" in said:
                    found.append(said)
        errors.seek(0)
        why = errors.read()[-2000:]
    crashed = process.returncode != 0 or len(found) < len(cases)
    return found, f"exit code {process.returncode} (-9: a hang) in {cases[len(found)]}\n{why}" if crashed else ""


def _judge(case: dict, result: dict) -> None:
    assert "crash" not in result, result["crash"]
    kind, cut = case["kind"], "cut" in case
    others = [0, 2]
    if cut and kind in OF_EPISODE and result["read"] != ["error"]:
        assert [result["read"][n] for n in others] == ["same", "same"], (case, result)
    if cut and kind not in ("journal", "growing", "growing film", "tasks", "stats"):
        assert "other" not in result["read"], (case, result)  # a cut file is never read as something else
        assert result["faults"] != [] or result["read"] == ["same"] * 3, (case, result)
    if "mended" in result and (cut or kind not in ("info", "world")):  # a flipped bit there may mean another dataset
        mended = result["mended"]
        assert set(mended.get("kept", ())) >= set(others), (case, result)
        if kind not in OF_EPISODE:
            assert 1 in mended["kept"], (case, result)
        if cut:
            assert mended["faults"] == [], (case, result)
            assert len(mended["lengths"]) >= 2 and max(mended["lengths"]) <= max(LENGTHS), (case, result)
    if kind in ("journal", "growing") and "mended" in result:
        rest = result["mended"]["lengths"][len(LENGTHS) :]
        assert len(rest) <= 1 and all(2 <= length <= IN_FLIGHT for length in rest), (case, result)


def _cuts(folder: Path, step: int, doctor: int, repair: int) -> list[dict]:
    cases = []
    for kind, name in KINDS.items():
        size = (folder / "sound" / name).stat().st_size
        for cut in range(max(0, size - LAST) + (size % step if step > 1 else 0), size, step):
            cases.append({"kind": kind, "cut": cut, "doctor": cut % doctor == 0, "repair": cut % repair == 0})
    return cases


def _flips(folder: Path, count: int, seed: int, repair: int) -> list[dict]:
    rng, cases = random.Random(seed), []
    for number in range(count):
        kind = rng.choice(list(KINDS))
        bits = 8 * (folder / "sound" / KINDS[kind]).stat().st_size
        flip = [rng.randrange(bits) for _ in range(rng.choice((1, 1, 1, 2, 8, 64)))]
        cases.append({"kind": kind, "flip": flip, "doctor": True, "repair": number % repair == 0})
    return cases


def _report(cases: list[dict], results: list[dict]) -> str:
    lines = [
        f"{len(cases)} cases, {sum(r['seconds'] for r in results):.0f} s, {max(r['mib'] for r in results)} MiB at most"
    ]
    for kind in KINDS:
        reads = Counter()
        for case, result in zip(cases, results):
            if case["kind"] == kind:
                reads[_outcome(result)] += 1
        lines.append(f"  {kind}: {dict(reads)}")
    mended = [result["mended"] for result in results if "mended" in result]
    kept = sum("kept" in one for one in mended)
    whole = sum(one.get("kept") == list(range(len(LENGTHS))) for one in mended)
    lines.append(f"  repairs: {len(mended)}, refused {len(mended) - kept}, all episodes whole in {whole}")
    return "\n".join(lines)


def _outcome(result: dict) -> str:
    reads = result.get("read", ["crash"])
    if reads in (["crash"], ["error"]):
        return "CRASH" if reads == ["crash"] else "does not open"
    return next((name for name in ("error", "other") if name in reads), "same")


def test_a_file_cut_anywhere_is_an_error_or_the_truth_and_its_repair_keeps_the_rest(folder):
    cases = _cuts(folder, 2503, 1, 2)
    for case, result in zip(cases, _run(folder, cases)):
        _judge(case, result)


def test_flipped_bits_never_crash_and_a_repair_keeps_the_other_episodes(folder):
    cases = _flips(folder, 30, 5, 3)
    for case, result in zip(cases, _run(folder, cases)):
        _judge(case, result)


@pytest.mark.slow
@pytest.mark.skipif(
    not WHOLE, reason="an hour: set TERRELLA_DAMAGE=all to cut every file at every offset and flip thousands of bits"
)
@pytest.mark.parametrize("kind", ["flips", "cuts"])
def test_the_whole_sweep(folder, kind):
    cases = _flips(folder, 3000, 1, 3) if kind == "flips" else _cuts(folder, 1, 16, 32)
    results = _run(folder, cases)
    print(f"\n{kind}: {_report(cases, results)}", flush=True)
    for case, result in zip(cases, results):
        _judge(case, result)
