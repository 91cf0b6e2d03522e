"""Sim-to-real transfer of policies: success rates of each arm, the share of the gap that it recovers, and a verdict."""

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
FAILS, SUCCEEDS, RECOVERS = 0.2, 0.8, 0.6  # success rates of nominal and of the best; share of the gap recovered

Successes = Mapping[str, Mapping[int, torch.Tensor]]  # arm -> seed -> successes [episodes]


@dataclass(frozen=True)
class TransferScores:
    """Success rates in the real environment, over all seeds and episodes."""

    arms: dict[str, Figure]
    spread: dict[str, tuple[float, float]]  # arm -> least and greatest over seeds
    recovered: dict[str, float]  # arm -> share of the gap between nominal and oracle
    dial: dict[str, dict[float, Figure]]  # arm -> share of the whole gap -> success rate
    agreed: dict[str, Agreement]  # simulator or model -> agreement with the real environment on all policies
    camera: dict[str, Figure]  # arms whose goal is read from a picture by an encoder
    errors: dict[str, tuple[float, float]]  # the same arms -> least and greatest error of the goal over seeds


def compare_transfer_arms(
    real: Successes,
    dial: Mapping[str, Mapping[float, torch.Tensor]],
    inside: Mapping[str, Successes],
    camera: Successes,
    errors: Mapping[str, Sequence[float]],
) -> TransferScores:
    """Figures of all arms. inside: simulator or model -> successes of the same policies there, from other starts. camera: successes
    of arms whose goal is read from a picture by an encoder; errors: their errors of the goal, by seed."""
    arms = {arm: _share(torch.cat(list(seeds.values()))) for arm, seeds in real.items()}
    spread = {arm: _ends([float(one.float().mean()) for one in seeds.values()]) for arm, seeds in real.items()}
    recovered = {}
    if NOMINAL in arms and ORACLE in arms and arms[ORACLE].value > arms[NOMINAL].value:
        low, high = arms[NOMINAL].value, arms[ORACLE].value
        recovered = {arm: (figure.value - low) / (high - low) for arm, figure in arms.items() if arm not in FLOORS}
    rng = torch.Generator().manual_seed(0)
    agreed = {}
    for name, played in inside.items():
        arms_of = {arm: seeds for arm, seeds in played.items() if arm != ORACLE}
        pairs = [(one, real[arm][seed]) for arm, seeds in arms_of.items() for seed, one in seeds.items()]
        if len(pairs) > 2:
            dreamt, seen = (torch.stack([pair[at].float() for pair in pairs]) for at in (0, 1))
            agreed[name] = agreement(dreamt, seen, rng, 1.0)
    curves = {arm: {gap: _share(one) for gap, one in gaps.items()} for arm, gaps in dial.items()}
    by_camera = {arm: _share(torch.cat(list(seeds.values()))) for arm, seeds in camera.items()}
    off = {name: _ends(values) for name, values in errors.items()}
    return TransferScores(arms, spread, recovered, curves, agreed, by_camera, off)


def best_arm(scores: TransferScores) -> str:
    """The arm with the highest success rate of those that saw few real episodes or none."""
    own = [arm for arm in scores.arms if arm not in (*FLOORS, NOMINAL, ORACLE)]
    return max(own, key=lambda arm: scores.arms[arm].value, default=NOMINAL)


def verdict(scores: TransferScores) -> list[str]:
    """Sentences, the verdict first."""
    arms, winner = scores.arms, best_arm(scores)
    lines = [f"Trained in the simulator alone, a policy succeeds in {percent(arms[NOMINAL])} of real episodes"]
    if winner != NOMINAL:
        lines[0] += f"; the best of the others, {winner}, in {percent(arms[winner])}"
    lines[0] += "."
    if ORACLE in arms:
        lines.append(f"trained in the real environment (oracle): {percent(arms[ORACLE])}")
    lines += [f"{arm}: {percent(arms[arm])}" for arm in FLOORS if arm in arms]
    if arms[NOMINAL].value >= FAILS:
        lines.append(f"nominal succeeds in {FAILS:.0%} or more: this pair is easier than the experiment asks for")
    for arm, part in scores.recovered.items():
        if arm not in (NOMINAL, ORACLE):
            lines.append(f"{arm} recovers {part:.0%} of the gap between nominal and oracle")
    for name, agreed in scores.agreed.items():
        pearson, mmrv = with_interval(agreed.pearson), with_interval(agreed.mmrv)
        both = f"{name} and the real environment on {agreed.pearson.count} policies"
        lines.append(f"{both}: Pearson {pearson}, MMRV {mmrv}")
    if scores.camera:
        winner = max((arm for arm in scores.camera if ORACLE not in arm), key=lambda arm: scores.camera[arm].value)
        nominal = f"with the goal read from a camera, nominal succeeds in {percent(scores.camera[NOMINAL])}"
        lines.append(f"{nominal}; the best without real goals, {winner}, in {percent(scores.camera[winner])}")
    return lines


def camera_table(scores: TransferScores) -> tuple[list[str], list[list[str]]]:
    """The table of the arms with a camera, and the errors of their goals."""
    lines = []
    for arm, figure in scores.camera.items():
        off = scores.errors.get(arm)
        lines.append([arm, percent(figure), f"{off[0]:.3f} to {off[1]:.3f}" if off else ""])
    return ["with a camera", "real successes", "goal's error, seeds"], lines


def table(scores: TransferScores) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of the arms in their order."""
    lines = []
    for arm, figure in scores.arms.items():
        low, high = scores.spread[arm]
        part = f"{scores.recovered[arm]:.0%}" if arm in scores.recovered else ""
        lines.append([arm, percent(figure), f"{low:.0%} to {high:.0%}", part])
    return ["arm", "real successes", "seeds", "gap recovered"], lines


def as_dict(scores: TransferScores) -> dict[str, Any]:
    """Plain data for JSON, the verdict first."""
    plain = dataclasses.asdict(scores)
    plain["dial"] = {arm: {f"{gap:g}": one for gap, one in gaps.items()} for arm, gaps in plain["dial"].items()}
    return {"verdict": verdict(scores), **plain}


def _share(successes: torch.Tensor) -> Figure:
    return clopper_pearson(int(successes.sum()), len(successes))


def _ends(values: Sequence[float]) -> tuple[float, float]:
    return min(values), max(values)
