"""BabyAI by imitation: one policy for several levels, from the bot's demonstrations, judged on missions and on words never seen.

    python lab/babyai.py demonstrate OUT.npz GoToObj:800 GoToLocal:3000 PickupLoc:2500
    python lab/babyai.py train OUT.npz RUN 50            # minutes
    python lab/babyai.py judge RUN GoToObj GoToLocal PickupLoc --missions 512

It needs `pip install minigrid`. Demonstrations go into arrays at once: recordings commit each short episode by itself, which takes
longer than the game.
"""

import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import torch

from terrella.act.imitation import ImitationActor
from terrella.act.imitation_network import ImitationNetwork
from terrella.core.instruction import text_to_bytes
from terrella.core.policy import Random
from terrella.core.world import make_rng
from terrella.learn.copycat import copycat
from terrella.learn.demonstrations import DemonstrationRows
from terrella.learn.feeds import RandomBatches
from terrella.learn.objectives.imitation import BehaviourCloning
from terrella.learn.recipes.imitation import Imitation, config_of
from terrella.learn.recipes.policy import ENDLESS, Practice
from terrella.learn.recording import Recording, controls_of
from terrella.learn.trainer import Run, Trainer
from terrella.measure.statistics import wilson
from terrella.sim.gymnasium import GymnasiumWorld

SLIPS = 0.1  # probability of a random action of the teacher
PARAPHRASES = {  # of "go to X" and "pick up X"; training has seen none of them
    "go to": ("walk over to", "please find", "move next to"),
    "pick up": ("grab", "please take", "get hold of"),
}


def demonstrate(out: str, levels: list[str]) -> None:
    """Arrays of all episodes of these levels (NAME:EPISODES)."""
    from minigrid.utils.baby_ai_bot import BabyAIBot

    rows = {name: [] for name in ("image", "direction", "action", "advice", "valid", "task", "reward")}
    tasks, ranges, rng = {}, [], np.random.default_rng(0)
    for level in levels:
        name, _, count = level.partition(":")
        env = gymnasium.make(f"BabyAI-{name}-v0").unwrapped
        for seed in range(int(count)):
            seen, _ = env.reset(seed=seed)
            bot, last, first, done = BabyAIBot(env), None, len(rows["valid"]), False
            while True:
                for key in ("image", "direction"):
                    rows[key].append(seen[key])
                rows["task"].append(tasks.setdefault(seen["mission"], len(tasks)))
                rows["valid"].append(not done)
                if done:
                    break
                try:
                    advice = int(bot.replan(last))
                except Exception:  # the bot lost its plan
                    advice = int(rng.integers(7))
                last = int(rng.integers(7)) if rng.random() < SLIPS else advice
                seen, reward, ended, cut, _ = env.step(last)
                done = ended or cut
                for key, value in zip(("action", "advice", "reward"), (last, advice, reward)):
                    rows[key].append(value)
            for key in ("action", "advice", "reward"):
                rows[key].append(0)
            ranges.append((first, len(rows["valid"])))
        print(name, len(ranges), "episodes", len(rows["valid"]), "rows", len(tasks), "tasks", flush=True)
    np.savez_compressed(out, ranges=ranges, tasks=list(tasks), **{key: np.array(value) for key, value in rows.items()})


def opened(file: str) -> Recording:
    """The demonstrations as a recording."""
    data = np.load(file)
    ranges = data["ranges"]
    world = {"action_low": [0], "action_high": [6], "discrete": True, "action_shape": [], "action_space": "Discrete(7)"}
    arrays = {
        "observation.image": data["image"].astype(np.uint8),
        "observation.direction": data["direction"].reshape(-1, 1),
        "task": data["task"],
    }
    cache = SimpleNamespace(
        arrays=arrays, keys={"image": "observation.image", "direction": "observation.direction"}, absent={}, ranges=ranges,
        episodes=[tuple(one) for one in ranges.tolist()], length=len(data["task"]), tasks=tuple(data["tasks"].tolist()),
        world=world, action=data["advice"].astype(np.float32)[:, None], action_valid=data["valid"], reward=data["reward"],
        rgb=None,
    )  # fmt: skip
    start, usable, held = np.zeros(cache.length, np.int64), np.zeros(cache.length, bool), []
    for number, (first, stop) in enumerate(cache.episodes):
        start[first:stop] = first
        usable[first:stop] = number % 20 > 0
        held += [number] if number % 20 == 0 else []
    return Recording(cache, start, usable, controls_of(cache), None, tuple(held))


def train(file: str, out: str, minutes: float, remember: int = 24, seed: int = 0) -> None:
    recording = opened(file)
    practice = Practice(batch=64 if remember else 128, learning_rate=2e-3, seed=seed)
    torch.manual_seed(seed)
    network = ImitationNetwork(config_of(recording, ("image", "direction"), 128, Imitation(remember=remember)))
    rows = DemonstrationRows.of(recording, network.config, torch.device("cpu"))
    network.fit_normalization(rows.sample(4096, np.random.default_rng(0)).seen)
    run = Run.of(out, practice, lambda done, total, text: print(text, flush=True), recording=file, remember=remember)
    feed = RandomBatches(lambda now: rows.sample(practice.batch, now.rng))
    trainer = Trainer(run, "imitation", feed, BehaviourCloning(network, practice.learning_rate), ENDLESS)
    trainer.limit_s = 60 * minutes
    trainer.train(lambda: ImitationActor.write(network, Path(out) / "policy", {}))
    ImitationActor.write(network, Path(out) / "policy", {})
    print(copycat(network.eval(), rows.held_out, 2048), round(trainer.facts["seconds"]), "s")


def judge(run: str, levels: list[str], missions: int) -> None:
    warnings.simplefilter("ignore")
    for level in levels:
        world = GymnasiumWorld(f"BabyAI-{level}-v0", rgb=False)
        policy = ImitationActor.load(run, world.spec)
        print(level, "random", *played(level, Random(world.spec), missions), flush=True)
        print(level, "as trained", *played(level, policy, missions), flush=True)
        for which in range(3):
            words = {old: new[which] for old, new in PARAPHRASES.items()}
            print(level, words, *played(level, policy, missions, words), flush=True)


@torch.no_grad()
def played(level: str, policy, missions: int, words: dict[str, str] | None = None) -> tuple:
    """(success with Wilson's interval, mean steps) over missions from seeds that no demonstration used."""
    envs = [gymnasium.make(f"BabyAI-{level}-v0") for _ in range(missions)]
    seen = [env.reset(seed=10**6 + number)[0] for number, env in enumerate(envs)]
    rng, won, steps, going = make_rng(0), 0, 0, list(range(missions))
    memory = policy.begin(missions, rng)
    while going:
        texts = [seen[number]["mission"] for number in going]
        for old, new in (words or {}).items():
            texts = [text.replace(old, new) for text in texts]
        shown = {
            "image": torch.from_numpy(np.stack([seen[number]["image"] for number in going])),
            "direction": torch.tensor([int(seen[number]["direction"]) for number in going]),
            "text": torch.from_numpy(np.stack([text_to_bytes(text) for text in texts])),
        }
        action, memory = policy.act(shown, memory, rng)
        kept = []
        for place, number in enumerate(going):
            seen[number], reward, ended, cut, _ = envs[number].step(int(action[place]))
            won, steps = won + (reward > 0), steps + 1
            kept += [] if ended or cut else [place]
        going = [going[place] for place in kept]
        if isinstance(memory, list):
            memory = [memory[place] for place in kept]
        elif kept:
            memory = memory.at(torch.tensor(kept))
    return wilson(int(won), missions), f"{steps / missions:.1f} steps"


if __name__ == "__main__":
    what, target, *rest = sys.argv[1:]
    import minigrid  # noqa: F401  it registers the levels

    torch.set_num_threads(1)
    if what == "demonstrate":
        demonstrate(target, rest)
    elif what == "train":
        train(target, rest[0], float(rest[1]), *map(int, rest[2:]))
    else:
        count = int(rest[rest.index("--missions") + 1]) if "--missions" in rest else 512
        judge(target, [one for one in rest if not one.startswith("-") and not one.isdigit()], count)
