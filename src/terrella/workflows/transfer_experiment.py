"""What an experiment of `transfer` is: the simulator, the "real" robot and how it differs, opened, checked and fingerprinted."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from .. import library
from ..core.errors import TerrellaError
from ..core.files import write_json
from ..core.world import World
from ..sim.randomised import Randomised, read
from ..sim.trials import fitted_simulator, simulator_of
from .real_environment import check_alike

PICTURE = (64, 64)  # pixels of the pictures from which encoders read the goal
DIAL = (0.0, 0.25, 0.5, 0.75, 1.0)  # gaps at which the nominal and the randomised policy are tested
_EXTENDABLE = ("arms", "real_episodes", "look", "looks", "look_hash")  # a later run may ask for more of these


@dataclass(frozen=True)
class TransferExperiment:
    """An experiment with its files and fingerprints; asked.json holds it. Files are paths, "" for none."""

    sim: str  # The simulator to train in, mujoco:NAME.
    real: str  # The simulator that stands for reality, mujoco:NAME.
    gap: str  # File of how it differs at a gap of 1.
    dial: float  # The gap, from 0 to 1.
    randomise: str  # File of the parameters that domain randomisation varies.
    episodes: int  # Episodes in which each policy is tested.
    practice: int  # Updates of training of the nominal policy, and again of each other arm.
    real_episodes: tuple[int, ...]  # Numbers of real episodes that models are fitted to.
    success: str  # The channel that is above 0 where an episode has succeeded.
    arms: tuple[str, ...]  # Arms of the experiment.
    hash: str  # sha256 of the real robot and its gap.
    look: str = ""  # File of how the real robot looks different.
    looks: str = ""  # File of the looks that visual randomisation varies.
    look_hash: str = ""  # sha256 of both looks.
    rounds: int = 2
    """Rounds in which a model's episodes are gathered, each by the policy that was trained in the model before."""

    def open_real(self, dial: float | None = None, look: str = "") -> World:
        """The real robot, at another gap or with a look where that is given."""
        return open_robot(self.real, self.gap, self.dial if dial is None else dial, look)


def open_robot(name: str, gap: str, dial: float, look: str = "") -> World:
    """A robot at a gap, with a camera where a look is given."""
    if not 0 <= dial <= 1:
        raise TerrellaError(f"--dial is the share of the gap, from 0 to 1; got {dial:g}.")
    check_robot(name)
    world = library.load(name, cameras=None if look else (), size=PICTURE, threads=1)
    distributions = {key: one for file in (gap, look) if file for key, one in read(file).items()}
    return Randomised(world, distributions, dial) if distributions else world


def check_robot(name: str) -> None:
    if not name.startswith("mujoco:"):
        raise TerrellaError(
            f"policies are transferred between robots in MuJoCo; '{name}' is no mujoco:NAME or mujoco:FILE.xml."
        )


def robot_hash(name: str, gap: str = "", dial: float = 0.0, look: str = "") -> str:
    """sha256 of the engine, the model, the task, the gap and the look."""
    world = open_robot(name, gap, dial, look)
    gaps = world.spec.card.get("randomised", {})
    parts = [simulator_of(world).fingerprint(), gaps, dial if gaps else 0]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def looks_hash(sim: str, looks: str, real: str) -> str:
    """sha256 of the look of the real robot, whose own hash is `real`, and of the looks that are randomised."""
    return hashlib.sha256(f"{real} {robot_hash(sim, look=looks)}".encode()).hexdigest()


def check_pair(experiment: TransferExperiment) -> None:
    """TerrellaError where the two robots are no pair, or where success cannot be seen."""
    sim, real = library.load(experiment.sim, cameras=(), threads=1), experiment.open_real()
    check_alike(sim.spec, real.spec)
    pulls = [simulator_of(world).file.opt.gravity for world in (sim, real)]
    if pulls[0] @ pulls[1] < 0.5 * (pulls[0] @ pulls[0] * (pulls[1] @ pulls[1])) ** 0.5:
        along = " and ".join(str(pull.tolist()) for pull in pulls)
        raise TerrellaError(
            f"{experiment.sim} and {experiment.real} have gravity along {along}: their axes differ; turn one of them."
        )
    for spec in (sim.spec, real.spec):
        if "reward" not in spec.channels or experiment.success not in spec.channels:
            raise TerrellaError(
                f"{spec.name} has no channel '{experiment.success}' beside 'reward', so nobody can say what success is; it has "
                f"{', '.join(spec.channels)}. A file declares its own task, hold for example: docs/robots.md says how."
            )
    for channel in ("observation", "qpos", "qvel"):
        if sim.spec.channels[channel].shape != real.spec.channels[channel].shape:
            raise TerrellaError(
                f"{experiment.sim} and {experiment.real} are no pair: their '{channel}' have different lengths."
            )
    if fitted := [arm for arm in ("model", "identified") if arm in experiment.arms]:
        try:
            fitted_simulator(sim)
        except TerrellaError as error:
            raise TerrellaError(f"{error} Leave {' and '.join(fitted)} out of --arms.") from error


def claim_folder(folder: Path, experiment: TransferExperiment) -> None:
    """Writes the experiment into the folder. TerrellaError where the folder holds another one. Files count by their contents, not
    their paths, so that another installation can continue."""
    file, mine = (
        folder / "asked.json",
        {name: one for name, one in asdict(experiment).items() if name not in _EXTENDABLE},
    )
    ranges = robot_hash(experiment.sim, experiment.randomise, 1.0) if experiment.randomise else ""
    mine["contents"] = {"sim": robot_hash(experiment.sim), "randomise": ranges}
    if not file.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        write_json(file, mine)
        return
    before = json.loads(file.read_text(encoding="utf-8"))
    other = [f"{name} {before.get(name)}, not {mine[name]}" for name in _different(before, mine)]
    if other:
        raise TerrellaError(
            f"{folder} holds another experiment ({'; '.join(other)}); repeat it, or give another --out."
        )


def _different(before: Mapping[str, Any], mine: Mapping[str, Any]) -> list[str]:
    """The settings that differ. Folders of older releases have no `contents`: their files are compared by name."""
    held, different = before.get("contents", {}), []
    for name, value in mine.items():
        old = before.get(name)
        if name in ("real", "gap"):
            same = old == value or before.get("hash") == mine["hash"]
        elif name in held:
            same = held[name] == mine["contents"][name]
        else:
            same_file = name == "randomise" and Path(str(old)).name == Path(value).name
            same = name == "contents" or old == value or same_file
        different += [] if same else [name]
    return different
