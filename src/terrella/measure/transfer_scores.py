"""What came of carrying policies over to a real robot: successes of each arm, how much of the gap it recovers, and a verdict."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from .agreement import Agreement, agreement
from .policy_evaluation import percent, with_interval
from .statistics import Figure, clopper_pearson

NOMINAL, ORACLE, RANDOM, IDLE = "nominal", "oracle", "random", "idle"
FLOORS = (RANDOM, IDLE)
FAILS, SUCCEEDS, RECOVERS = 0.2, 0.8, 0.6  # shares that the experiment asks for

Successes = Mapping[str, Mapping[int, torch.Tensor]]  # arm -> seed -> successes [episodes]


@dataclass(frozen=True)
class TransferScores:
    """arms: of each its successes in the real one, over all seeds and episodes; least, most: over seeds; recovered: of the gap
    between nominal and oracle; dial: arm -> gap -> successes; agreed: by simulator or model, how it and the real one agree on
    all policies."""

    arms: dict[str, Figure]
    spread: dict[str, tuple[float, float]]
    recovered: dict[str, float]
    dial: dict[str, dict[float, Figure]]
    agreed: dict[str, Agreement]
    camera: dict[str, Figure]
    errors: dict[str, tuple[float, float]]


def compare_transfer_arms(
    real: Successes,
    dial: Mapping[str, Mapping[float, torch.Tensor]],
    inside: Mapping[str, Successes],
    camera: Successes,
    errors: Mapping[str, Sequence[float]],
) -> TransferScores:
    """Figures of all arms. inside: by simulator or model, the same policies' successes there, from starts of its own; camera: those
    of arms that are told their goal by an encoder of pictures; errors: arm -> seeds, how far off the goal is that its encoder
    reads."""
    arms = {arm: _share(torch.cat(list(seeds.values()))) for arm, seeds in real.items()}
    spread = {arm: _ends([float(one.float().mean()) for one in seeds.values()]) for arm, seeds in real.items()}
    recovered = {}
    if NOMINAL in arms and ORACLE in arms and arms[ORACLE].value > arms[NOMINAL].value:
        low, high = arms[NOMINAL].value, arms[ORACLE].value
        recovered = {arm: (figure.value - low) / (high - low) for arm, figure in arms.items() if arm not in FLOORS}
    rng = torch.Generator().manual_seed(0)
    agreed = {}
    for name, played in inside.items():
        pairs = [
            (one, real[arm][seed]) for arm, seeds in played.items() for seed, one in seeds.items() if arm != ORACLE
        ]
        if len(pairs) > 2:
            dreamt, seen = (torch.stack([pair[at].float() for pair in pairs]) for at in (0, 1))
            agreed[name] = agreement(dreamt, seen, rng, 1.0)
    curves = {arm: {gap: _share(one) for gap, one in gaps.items()} for arm, gaps in dial.items()}
    by_camera = {arm: _share(torch.cat(list(seeds.values()))) for arm, seeds in camera.items()}
    off = {name: _ends(values) for name, values in errors.items()}
    return TransferScores(arms, spread, recovered, curves, agreed, by_camera, off)


def best_arm(found: TransferScores) -> str:
    """The arm that succeeds most often of those that saw few real episodes or none."""
    own = [arm for arm in found.arms if arm not in (*FLOORS, NOMINAL, ORACLE)]
    return max(own, key=lambda arm: found.arms[arm].value, default=NOMINAL)


def verdict(found: TransferScores) -> list[str]:
    """Sentences, the answer first."""
    arms, winner = found.arms, best_arm(found)
    lines = [f"Trained in the simulator alone a policy succeeds in {percent(arms[NOMINAL])} of real episodes"]
    if winner != NOMINAL:
        lines[0] += f"; the best of the others, {winner}, in {percent(arms[winner])}"
    lines[0] += "."
    if ORACLE in arms:
        lines.append(f"trained in the real one itself: {percent(arms[ORACLE])}")
    lines += [f"{arm}: {percent(arms[arm])}" for arm in FLOORS if arm in arms]
    if arms[NOMINAL].value >= FAILS:
        lines.append(f"nominal succeeds in {FAILS:.0%} or more: an easier pair than where it mostly fails")
    for arm, part in found.recovered.items():
        if arm not in (NOMINAL, ORACLE):
            lines.append(f"{arm} recovers {part:.0%} of the gap between nominal and oracle")
    for name, agreed in found.agreed.items():
        pearson, mmrv = with_interval(agreed.pearson), with_interval(agreed.mmrv)
        lines.append(f"{name} and the real one on {agreed.pearson.count} policies: Pearson {pearson}, MMRV {mmrv}")
    if found.camera:
        winner = max((arm for arm in found.camera if ORACLE not in arm), key=lambda arm: found.camera[arm].value)
        told_so = f"told the goal by a camera, nominal succeeds in {percent(found.camera[NOMINAL])}"
        lines.append(f"{told_so}; the best that saw no real goal, {winner}, in {percent(found.camera[winner])}")
    return lines


def camera_table(found: TransferScores) -> tuple[list[str], list[list[str]]]:
    """The same of the arms with a camera, and how far off their encoder's goals are."""
    lines = []
    for arm, figure in found.camera.items():
        off = found.errors.get(arm)
        lines.append([arm, percent(figure), f"{off[0]:.3f} to {off[1]:.3f}" if off else ""])
    return ["with a camera", "real successes", "goal's error, seeds"], lines


def table(found: TransferScores) -> tuple[list[str], list[list[str]]]:
    """Heads and lines of the arms in their order."""
    lines = []
    for arm, figure in found.arms.items():
        low, high = found.spread[arm]
        part = f"{found.recovered[arm]:.0%}" if arm in found.recovered else ""
        lines.append([arm, percent(figure), f"{low:.0%} to {high:.0%}", part])
    return ["arm", "real successes", "seeds", "gap recovered"], lines


def as_dict(found: TransferScores) -> dict[str, Any]:
    """Plain data for JSON, the verdict first."""
    plain = dataclasses.asdict(found)
    plain["dial"] = {arm: {f"{gap:g}": one for gap, one in gaps.items()} for arm, gaps in plain["dial"].items()}
    return {"verdict": verdict(found), **plain}


def _share(successes: torch.Tensor) -> Figure:
    return clopper_pearson(int(successes.sum()), len(successes))


def _ends(values: Sequence[float]) -> tuple[float, float]:
    return min(values), max(values)
