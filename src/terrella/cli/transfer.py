"""The command `terrella transfer`: policies of a simulator are carried over to a "real" robot that differs."""

from __future__ import annotations

import hashlib
import json as json_text
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
from ..measure.transfer_scores import Successes, as_dict, camera_table, compare_transfer_arms, table, verdict
from .beside import check_alike, sound
from .evaluate import table_lines
from .say import Json, Seed, result, say

BUNDLED = Path(__file__).parent.parent / "sim" / "models"
ARMS = ("nominal", "randomised", "identified", "model", "oracle")
FREE = ("arms", "real_episodes", "look", "looks", "look_hash")  # more of them may be asked for later
ROUNDS = 2  # in which a model's episodes are gathered, each by the policy that practised in the last one's model
PICTURE = (64, 64)  # pixels of the real one's pictures, where its goal is read off them
DIAL = (0.0, 0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True)
class Experiment:
    """What is asked. real: mujoco:NAME; gap: the file of how it differs at 1; randomise: the file of what the engineer varies;
    look, looks: files of how it looks, and of what looks the engineer varies; "" where no camera is asked for."""

    sim: str
    real: str
    gap: str
    dial: float
    randomise: str
    episodes: int
    practice: int
    real_episodes: tuple[int, ...]
    success: str
    arms: tuple[str, ...]
    hash: str
    look: str = ""
    looks: str = ""
    look_hash: str = ""
    rounds: int = ROUNDS


def transfer(
    sim: str = "mujoco:arm",
    real: str | None = None,
    gap: Path | None = None,
    dial: float = 1.0,
    randomise: Path | None = None,
    arms: tuple[str, ...] = ARMS,
    real_episodes: tuple[int, ...] = (1, 5, 10, 50),
    episodes: int = 300,
    seeds: int = 3,
    practice: int = 120,
    success: str = "success",
    look: Path | None = None,
    looks: Path | None = None,
    camera: bool = False,
    out: Path | None = None,
    workers: int = 1,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Carry policies from a simulator over to a "real" robot that differs, and measure what helps: randomisation, system
    identification, a world model of a few real episodes. Without options, the bundled pair: an arm.

    Leaves a page of plots and all figures in a folder. Stop it with Ctrl-C at any time; the same command continues.

    Args:
        sim: The simulator to learn in (mujoco:NAME, or a mujoco:FILE.xml that tells a task: docs/robots.md).
        real: What stands for reality: another such world, or the folder of a recording with actions, qpos and qvel, of which
            open-loop errors and the agreement of actions are told. Default: the bundled one, or --sim itself with --gap.
        gap: A TOML or JSON file of what else differs in reality at a gap of 1: parameters, delay, backlash, noise.CHANNEL.
        dial: The gap, from 0 (nothing of the file) to 1.
        randomise: A TOML or JSON file of the ranges that are randomised, and searched by identification.
        arms: Of nominal, randomised, identified, model, oracle.
        real_episodes: Numbers of real episodes that a model is fitted to; identification takes 10 or the most below.
        episodes: Real episodes in which each policy is judged.
        seeds: Whole repetitions, each with its own training and its own real episodes to learn from.
        practice: Updates of practice (of 6,144 steps) of the nominal policy, and again of each arm after it.
        success: The channel that is above 0 where an episode has succeeded.
        camera: Judge besides policies that are told their goal by an encoder of pictures: nominal, of randomised looks, adapted
            to unlabelled real pictures by an adversary, or of the real one.
        look: A TOML or JSON file of how the real one looks otherwise at a gap of 1. Default: the bundled pair's.
        looks: A TOML or JSON file of the looks that are randomised. Default: the bundled pair's.
        out: Folder for the page, the figures and the policies; default: transfers/NAME.
        workers: Seeds that run at once, each a process of its own.
    """
    _check_robot(sim)
    if not real_episodes or min(episodes, seeds, practice, workers, *real_episodes) < 1:
        raise TerrellaError("--episodes, --seeds, --practice, --workers and --real-episodes are 1 or more.")
    if real is not None and not library.is_truth(real):
        from .transfer_recorded import transfer_recorded

        if gap or look or looks or camera or dial != 1 or set(arms) != set(ARMS):
            raise TerrellaError(
                f"{real} is a recording, which has no --gap, --dial, --look, --looks, --camera and --arms; leave them out."
            )
        return transfer_recorded(sim, Path(real), randomise, max(real_episodes, default=1), out, seed, json)
    wrong = [arm for arm in arms if arm not in ARMS]
    if wrong or "nominal" not in arms:
        raise TerrellaError(f"--arms are some of {', '.join(ARMS)}, nominal among them; got {', '.join(arms)}.")
    bundled = sim == "mujoco:arm"
    if gap is None and real is None and not bundled:
        raise TerrellaError(
            "say what stands for reality: --real mujoco:NAME, a recording, or --gap FILE; or leave --sim out."
        )
    real_name = real or ("mujoco:arm-real" if bundled and gap is None else sim)
    gap_file = str(gap or (BUNDLED / "arm_gap.toml" if bundled and real is None else ""))
    ranges = str(randomise or (BUNDLED / "arm_randomised.toml" if bundled else ""))
    if not ranges and {"randomised", "identified"} & set(arms):
        raise TerrellaError(
            "say what is randomised with --randomise FILE, or leave randomised and identified out of --arms."
        )
    look_file, looks_file = (
        str(said or (BUNDLED / own if bundled and camera else ""))
        for said, own in ((look, "arm_look.toml"), (looks, "arm_looks.toml"))
    )
    if camera and not (look_file and looks_file):
        raise TerrellaError(
            "say how the real one looks with --look FILE, and what looks are randomised with --looks FILE."
        )
    if not camera and (look or looks):
        raise TerrellaError("--look and --looks are of --camera; give that too.")
    mark = real_hash(real_name, gap_file, dial)
    asked = Experiment(
        sim, real_name, gap_file, dial, ranges, episodes, practice, real_episodes, success, arms, mark,
        look_file, looks_file, _looks_hash(sim, looks_file, real_hash(real_name, gap_file, dial, look_file)) if camera else "",
    )  # fmt: skip
    check_pair(asked)
    folder = out or Path("transfers") / sim.partition(":")[2].replace("/", "-")
    same_as_before(folder, asked)
    say(f"the real one is frozen: sha256 {mark}")
    _report(folder, asked, _all_seeds(asked, folder, range(seed, seed + seeds), workers), json)


def _all_seeds(asked: Experiment, folder: Path, seeds: range, workers: int) -> dict[int, dict[str, Any]]:
    """What each seed found, as many at once as there are workers."""
    from .transfer_arms import one_seed

    run = partial(one_seed, asked, folder)
    if workers == 1 or len(seeds) == 1:
        return {number: run(number) for number in seeds}
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        return dict(zip(seeds, pool.map(run, seeds)))


def opened_real(name: str, gap: str, dial: float, look: str = "") -> Any:
    """The real one at a gap, with a camera where a look is asked for; TerrellaError for what cannot be."""
    from ..sim import randomised

    if not 0 <= dial <= 1:
        raise TerrellaError(f"--dial is the share of the gap, from 0 to 1; got {dial:g}.")
    _check_robot(name)
    world = library.load(name, cameras=None if look else (), size=PICTURE, threads=1)
    told = {key: one for file in (gap, look) if file for key, one in randomised.read(file).items()}
    return randomised.Randomised(world, told, dial) if told else world


def _check_robot(name: str) -> None:
    if not name.startswith("mujoco:"):
        raise TerrellaError(
            f"policies are carried over between robots in MuJoCo; '{name}' is no mujoco:NAME or mujoco:FILE.xml."
        )


def real_hash(name: str, gap: str, dial: float, look: str = "") -> str:
    """sha256 of all that the real one is: engine, model, task, its gap, and its look."""
    world = opened_real(name, gap, dial, look)
    told = world.spec.card.get("randomised", {})
    inside = getattr(world, "world", world).fingerprint()
    return hashlib.sha256(json_text.dumps([inside, told, dial if told else 0], sort_keys=True).encode()).hexdigest()


def _looks_hash(sim: str, looks: str, real: str) -> str:
    """sha256 of how the real one looks, whose own is `real`, and of the looks that are randomised."""
    return hashlib.sha256(f"{real} {real_hash(sim, '', 0.0, looks)}".encode()).hexdigest()


def check_pair(asked: Experiment) -> None:
    """TerrellaError where the two cannot be a pair, or where nobody could say what success is."""
    sim, real = library.load(asked.sim, cameras=(), threads=1), opened_real(asked.real, asked.gap, asked.dial)
    check_alike(sim.spec, real.spec)
    inside: list[Any] = [getattr(world, "world", world) for world in (sim, real)]
    pulls = [world.file.opt.gravity for world in inside]
    if pulls[0] @ pulls[1] < 0.5 * (pulls[0] @ pulls[0] * (pulls[1] @ pulls[1])) ** 0.5:
        along = " and ".join(str(pull.tolist()) for pull in pulls)
        raise TerrellaError(
            f"{asked.sim} and {asked.real} have gravity along {along}: their axes differ; turn one of them."
        )
    for spec in (sim.spec, real.spec):
        if "reward" not in spec.channels or asked.success not in spec.channels:
            raise TerrellaError(
                f"{spec.name} has no channel '{asked.success}' beside 'reward', so nobody can say what success is; it has "
                f"{', '.join(spec.channels)}. A file tells its task itself, hold for example: docs/robots.md says how."
            )
    for channel in ("observation", "qpos", "qvel"):
        if sim.spec.channels[channel].shape != real.spec.channels[channel].shape:
            raise TerrellaError(f"{asked.sim} and {asked.real} are no pair: their '{channel}' have different lengths.")
    fitted = [arm for arm in ("model", "identified") if arm in asked.arms]
    if fitted:
        from ..sim.trials import inner

        try:
            inner(sim)
        except TerrellaError as error:
            raise TerrellaError(f"{error} Leave {' and '.join(fitted)} out of --arms.") from error


def same_as_before(folder: Path, asked: Experiment) -> None:
    """Notes what is asked in the folder; TerrellaError where it holds something else, or another real one. Files are what they
    hold, not where they lie: what one installation began, another continues."""
    file, mine = folder / "asked.json", {name: value for name, value in asdict(asked).items() if name not in FREE}
    mine["contents"] = _contents(asked)
    if file.is_file():
        before = json_text.loads(file.read_text(encoding="utf-8"))
        other = [f"{name} {before.get(name)}, not {mine[name]}" for name in _different(before, mine)]
        if other:
            raise TerrellaError(
                f"{folder} holds another experiment ({'; '.join(other)}); repeat it, or give another --out."
            )
        return
    folder.mkdir(parents=True, exist_ok=True)
    write_json(file, mine)


def _contents(asked: Experiment) -> dict[str, str]:
    """sha256 of what the simulator is and of what is randomised; the real one and its gap have theirs, `hash`."""
    ranges = real_hash(asked.sim, asked.randomise, 1.0) if asked.randomise else ""
    return {"sim": real_hash(asked.sim, "", 0.0), "randomise": ranges}


def _different(before: Mapping[str, Any], mine: Mapping[str, Any]) -> list[str]:
    """The names under which another experiment was asked for. Folders of before there were `contents` are told by file names."""
    held, found = before.get("contents", {}), []
    for name, value in mine.items():
        was = before.get(name)
        if name in ("real", "gap"):
            same = was == value or before.get("hash") == mine["hash"]
        elif name in held:
            same = held[name] == mine["contents"][name]
        else:
            same = (
                name == "contents" or was == value or (name == "randomise" and Path(str(was)).name == Path(value).name)
            )
        found += [] if same else [name]
    return found


def _report(folder: Path, asked: Experiment, found: Mapping[int, Mapping[str, Any]], json: bool) -> None:
    def played(place: str) -> Successes:
        arms = list(dict.fromkeys(arm for one in found.values() for arm in one[place]))
        return {
            arm: {seed: torch.tensor(one[place][arm]) for seed, one in found.items() if arm in one[place]}
            for arm in arms
        }

    dialled = {name: played(f"dial {name}") for name in map(str, DIAL)}
    arms = list(dict.fromkeys(arm for one in dialled.values() for arm in one))
    dial = {arm: {float(name): torch.cat(list(one[arm].values())) for name, one in dialled.items()} for arm in arms}
    inside = {
        name: played(name) for name in ("the simulator", "the model") if any(one.get(name) for one in found.values())
    }
    looked = [(seed, one["camera"][asked.look_hash]) for seed, one in found.items() if asked.look]
    named = list(dict.fromkeys(arm for _, one in looked for arm in one["arms"]))
    camera = {
        arm: {seed: torch.tensor(one["arms"][arm]) for seed, one in looked if arm in one["arms"]} for arm in named
    }
    errors = {name: [one["errors"][name] for _, one in looked] for name in (looked[0][1]["errors"] if looked else ())}
    whole = compare_transfer_arms(played("real"), dial if asked.gap else {}, inside, camera, errors)
    identified = [one["identified"] for one in found.values() if one.get("identified")]
    facts: dict[str, Any] = {**asdict(asked), "seeds": list(found), "identified": identified}
    page = folder / "transfer.html"
    page.write_text(transfer_page(f"{asked.sim}, carried over to {asked.real}", whole, facts), encoding="utf-8")
    write_json(folder / "transfer.json", sound({**facts, **as_dict(whole)}))
    lines = [
        *verdict(whole),
        "",
        *table_lines(*table(whole)),
        "",
        *((*table_lines(*camera_table(whole)), "") if camera else ()),
        f"the real one: sha256 {asked.hash}",
        f"the page: {page}",
    ]
    result(sound({**facts, **as_dict(whole), "page": str(page)}), json, "\n".join(lines))
