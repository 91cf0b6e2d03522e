"""`transfer`: transfers policies from a simulator to a "real" robot that differs, and measures which methods help."""

from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from .. import library
from ..core.errors import TerrellaError
from ..core.files import write_json
from ..measure.transfer_page import transfer_page
from ..measure.transfer_scores import (
    Successes,
    TransferScores,
    as_dict,
    camera_table,
    compare_transfer_arms,
    table,
    verdict,
)
from .progress import Progress, silent, stopping_with
from .results import changed_settings, jsonable, table_lines
from .transfer_arms import run_seed
from .transfer_experiment import DIAL, TransferExperiment, check_pair, check_robot, claim_folder, looks_hash, robot_hash
from .transfer_recorded import RecordedTransferResult, transfer_to_recording

BUNDLED = Path(__file__).parent.parent / "sim" / "models"
ARMS = ("nominal", "randomised", "identified", "model", "oracle")


@dataclass(frozen=True)
class TransferConfig:
    """Settings of `transfer`; the defaults are the bundled pair, an arm."""

    sim: str = "mujoco:arm"
    """The simulator to train in: mujoco:NAME, or a mujoco:FILE.xml that declares a task (docs/robots.md)."""
    # The real robot: another such simulator; or the folder of a recording with actions, qpos and qvel, against which open-loop
    # errors are measured. Default: the bundled one, or --sim itself with --gap.
    real: str | None = None
    gap: Path | None = None
    """A TOML or JSON file of how the real robot differs at a gap of 1: parameters, delay, backlash, noise.CHANNEL."""
    dial: float = 1.0  # Scale of the gap: 0 is the nominal robot, 1 the values of --gap.
    randomise: Path | None = None
    """A TOML or JSON file of parameter ranges, for domain randomisation and for system identification."""
    # Arms to compare, by where their policy is trained: nominal (the simulator as it is), randomised and identified (with other
    # parameters), model (with a learned correction), oracle (the real robot itself).
    arms: tuple[str, ...] = ARMS
    # Numbers of real episodes that models are fitted to. Identification uses 10, or the largest number if 10 is not listed.
    real_episodes: tuple[int, ...] = (1, 5, 10, 50)
    episodes: int = 300  # Real episodes in which each policy is tested.
    seeds: int = 3  # Number of repetitions, each with its own training and its own real episodes to learn from.
    practice: int = 120
    """PPO updates, of 6,144 steps each, to train the nominal policy, and again for each arm."""
    success: str = "success"  # An episode succeeds when this channel is above 0.
    # Also test policies that read their goal off a camera picture. Their encoders are trained on the simulator, on randomised
    # looks, adversarially with unlabelled real pictures, or on labelled real pictures.
    camera: bool = False
    look: Path | None = None
    """With --camera: a TOML or JSON file of how the real robot looks at a gap of 1. Default: that of the bundled pair."""
    looks: Path | None = None
    """With --camera: a TOML or JSON file of the looks that are randomised. Default: that of the bundled pair."""
    out: Path | None = None
    """Folder for the page, the figures and the policies; default: transfers/ and the robot's name."""
    workers: int = 1  # Number of seeds that run at once, each in its own process.
    seed: int = 0  # The same seed gives the same result.


@dataclass(frozen=True)
class TransferResult:
    """The successes of each arm on the real robot."""

    scores: TransferScores  # Figures of each arm, and how much of the gap it recovers.
    experiment: TransferExperiment
    seeds: tuple[int, ...]
    identified: tuple[Mapping[str, float], ...]  # Of each seed the parameters that were identified, and their error.
    page: Path

    def to_json(self) -> dict[str, Any]:
        facts = {**asdict(self.experiment), "seeds": self.seeds, "identified": self.identified}
        return jsonable({**facts, **as_dict(self.scores), "page": self.page})

    def summary(self) -> str:
        lines = [*verdict(self.scores), "", *table_lines(*table(self.scores)), ""]
        lines += [*table_lines(*camera_table(self.scores)), ""] if self.scores.camera else []
        return "\n".join([*lines, f"the real one: sha256 {self.experiment.hash}", f"the page: {self.page}"])


def transfer(
    config: TransferConfig | None = None, *, progress: Progress = silent
) -> TransferResult | RecordedTransferResult:
    """Trains policies in a simulator, tests them on a real robot that differs, and compares what helps: domain randomisation,
    system identification, a model of a few real episodes.

    A page and all figures are left in a folder; stopped at any time, the same call continues. If `real` is a recording, open-loop
    errors are measured instead. With several workers `progress` is pickled.
    """
    config = config or TransferConfig()
    check_robot(config.sim)
    counts = (config.episodes, config.seeds, config.practice, config.workers, *config.real_episodes)
    if not config.real_episodes or min(counts) < 1:
        raise TerrellaError("--episodes, --seeds, --practice, --workers and --real-episodes are 1 or more.")
    if config.real is not None and not library.is_truth(config.real):
        used = {"sim", "real", "randomise", "real_episodes", "out", "seed"}
        if unused := [f"--{name.replace('_', '-')}" for name in changed_settings(config) if name not in used]:
            raise TerrellaError(
                f"{config.real} is a recording, which has no use for {', '.join(unused)}; leave that out."
            )
        real, count = Path(config.real), max(config.real_episodes)
        return transfer_to_recording(config.sim, real, config.randomise, count, out=config.out, seed=config.seed)
    experiment = _experiment(config)
    check_pair(experiment)
    folder = Path(config.out or "transfers/" + config.sim.partition(":")[2].replace("/", "-"))
    claim_folder(folder, experiment)
    progress(f"the real one is frozen: sha256 {experiment.hash}")
    seeds = range(config.seed, config.seed + config.seeds)
    run = partial(run_seed, experiment, folder, progress)
    with stopping_with(f"stopped: the arms that are done are kept in {folder}; the same command continues."):
        if config.workers == 1 or len(seeds) == 1:
            return _result(experiment, folder, {seed: run(seed) for seed in seeds})
        with ProcessPoolExecutor(config.workers, get_context("spawn")) as pool:
            return _result(experiment, folder, dict(zip(seeds, pool.map(run, seeds))))


def _experiment(config: TransferConfig) -> TransferExperiment:
    """The experiment with its files, the bundled ones where none are given. TerrellaError where something is missing."""
    wrong = [arm for arm in config.arms if arm not in ARMS]
    if wrong or "nominal" not in config.arms:
        raise TerrellaError(f"--arms are some of {', '.join(ARMS)}, nominal among them; got {', '.join(config.arms)}.")
    bundled = config.sim == "mujoco:arm"
    if config.gap is None and config.real is None and not bundled:
        raise TerrellaError(
            "say what stands for reality: --real mujoco:NAME, a recording, or --gap FILE; or leave --sim out."
        )
    real = config.real or ("mujoco:arm-real" if bundled and config.gap is None else config.sim)
    gap = str(config.gap or (BUNDLED / "arm_gap.toml" if bundled and config.real is None else ""))
    ranges = str(config.randomise or (BUNDLED / "arm_randomised.toml" if bundled else ""))
    if not ranges and {"randomised", "identified"} & set(config.arms):
        raise TerrellaError(
            "say what is randomised with --randomise FILE, or leave randomised and identified out of --arms."
        )
    usual = bundled and config.camera
    look = str(config.look or (BUNDLED / "arm_look.toml" if usual else ""))
    looks = str(config.looks or (BUNDLED / "arm_looks.toml" if usual else ""))
    if config.camera and not (look and looks):
        raise TerrellaError(
            "say how the real one looks with --look FILE, and what looks are randomised with --looks FILE."
        )
    if not config.camera and (look or looks):
        raise TerrellaError("--look and --looks are of --camera; give that too.")
    return TransferExperiment(
        sim=config.sim,
        real=real,
        gap=gap,
        dial=config.dial,
        randomise=ranges,
        episodes=config.episodes,
        practice=config.practice,
        real_episodes=config.real_episodes,
        success=config.success,
        arms=config.arms,
        hash=robot_hash(real, gap, config.dial),
        look=look,
        looks=looks,
        look_hash=looks_hash(config.sim, looks, robot_hash(real, gap, config.dial, look)) if config.camera else "",
    )


def _result(experiment: TransferExperiment, folder: Path, seeds: Mapping[int, Mapping[str, Any]]) -> TransferResult:
    """Writes the page and the figures. seeds: of each seed place -> arm -> successes."""

    def successes(place: str) -> Successes:
        return _by_arm({seed: one[place] for seed, one in seeds.items()})

    dial: dict[str, dict[float, torch.Tensor]] = {}
    for gap in DIAL:
        for arm, by_seed in successes(f"dial {gap}").items():
            dial.setdefault(arm, {})[gap] = torch.cat(list(by_seed.values()))
    places = [one for one in ("the simulator", "the model") if any(kept.get(one) for kept in seeds.values())]
    inside = {place: successes(place) for place in places}
    cameras = {seed: one["camera"][experiment.look_hash] for seed, one in seeds.items() if experiment.look}
    camera = _by_arm({seed: one["arms"] for seed, one in cameras.items()})
    named = next(iter(cameras.values()))["errors"] if cameras else ()
    errors = {arm: [one["errors"][arm] for one in cameras.values()] for arm in named}
    scores = compare_transfer_arms(successes("real"), dial if experiment.gap else {}, inside, camera, errors)
    identified = tuple(one["identified"] for one in seeds.values() if one.get("identified"))
    result = TransferResult(scores, experiment, tuple(seeds), identified, folder / "transfer.html")
    facts = {**asdict(experiment), "seeds": list(seeds), "identified": list(identified)}
    title = f"{experiment.sim}, transferred to {experiment.real}"
    result.page.write_text(transfer_page(title, scores, facts), encoding="utf-8")
    write_json(folder / "transfer.json", {name: one for name, one in result.to_json().items() if name != "page"})
    return result


def _by_arm(seeds: Mapping[int, Mapping[str, Any]]) -> Successes:
    """arm -> seed -> successes [episodes]."""
    arms = dict.fromkeys(arm for one in seeds.values() for arm in one)
    return {arm: {seed: torch.tensor(one[arm]) for seed, one in seeds.items() if arm in one} for arm in arms}
