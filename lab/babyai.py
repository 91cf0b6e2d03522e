"""BabyAI by imitation: one policy for several levels, from the bot's demonstrations, judged on missions and on words never seen.

    python lab/babyai.py demonstrate OUT.npz GoToObj:800 GoToLocal:3000 PickupLoc:2500
    python lab/babyai.py train OUT.npz RUN 50            # minutes; several files with commas between
    python lab/babyai.py judge RUN GoToObj GoToLocal PickupLoc --missions 512
    python lab/babyai.py play MINE.npz RUN PutNextLocal:500  # the policy's own episodes, for the ends of skills
    python lab/babyai.py skills OUT.npz RUN LIBRARY      # a library of skills
    python lab/babyai.py compose LIBRARY GoTo Synth --missions 300   # three steps by skills and by the flat policy

It needs `pip install minigrid`. Demonstrations go into arrays at once: recordings commit each short episode by itself, which takes
longer than the game.
"""

import signal
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import torch

from terrella.act.imitation import ImitationActor, load_imitation_network
from terrella.act.imitation_network import ImitationNetwork
from terrella.act.skills.actor import SkillActor
from terrella.act.skills.library import SkillLibrary
from terrella.core.instruction import text_to_bytes
from terrella.core.policy import Random
from terrella.core.world import make_rng
from terrella.learn.copycat import copycat
from terrella.learn.demonstrations import DemonstrationRows
from terrella.learn.feeds import RandomBatches
from terrella.learn.objectives.imitation import BehaviourCloning
from terrella.learn.recipes.imitation import Imitation, config_of
from terrella.learn.recipes.policy import ENDLESS, Practice
from terrella.learn.recipes.skills import SkillTraining, learn_skills
from terrella.learn.recording import Recording, controls_of
from terrella.learn.trainer import Run, Trainer
from terrella.measure.statistics import wilson
from terrella.sim.gymnasium import GymnasiumWorld

INSTRUCTIONS, MOST_STEPS = 4, 64  # of a long demonstration, and steps of each at most
PATIENCE_S = 1.0  # of a decision of the bot
SLIPS = 0.1  # probability of a random action of the teacher
PARAPHRASES = (  # three wordings of each mission; training has seen none of them
    {"go to": "walk over to", "pick up": "grab", "put": "place", "next to": "beside"},
    {"go to": "please find", "pick up": "please take", "put": "please bring", "next to": "close to"},
    {"go to": "move up to", "pick up": "get hold of", "put": "carry", "next to": "over to"},
)


def demonstrate(out: str, levels: list[str]) -> None:
    """Arrays of all episodes of these levels (NAME:EPISODES). Of Chain they are long: INSTRUCTIONS follow each other in a room."""
    rows = {name: [] for name in ("image", "direction", "action", "advice", "valid", "task", "reward")}
    tasks, ranges, rng = {}, [], np.random.default_rng(0)
    signal.signal(signal.SIGALRM, _out_of_time)
    for level in levels:
        name, _, count = level.partition(":")
        env = room_of(lambda room: room.sample(("go", "put", "pick"))) if name == "Chain" else None
        env = env or gymnasium.make(f"BabyAI-{name}-v0").unwrapped
        for seed in range(int(count)):
            seen, _ = env.reset(seed=seed + (2 * 10**6 if name == "Chain" else 0))
            first = len(rows["valid"])
            for left in reversed(range(INSTRUCTIONS if name == "Chain" else 1)):
                seen, won = _carried_out(env, seen, rows, tasks, rng)
                if not won or not left:
                    break
                env.instrs = env.sample(("go", "put", "pick"))
                env.instrs.reset_verifier(env)
                env.mission = seen["mission"] = env.instrs.surface(env)
            _add(rows, seen, tasks.setdefault(seen["mission"], len(tasks)), False)
            _add_action(rows, 0, 0, 0.0)
            ranges.append((first, len(rows["valid"])))
        print(name, len(ranges), "episodes", len(rows["valid"]), "rows", len(tasks), "tasks", flush=True)
    np.savez_compressed(out, ranges=ranges, tasks=list(tasks), **{key: np.array(value) for key, value in rows.items()})


@torch.no_grad()
def play(out: str, run: str, levels: list[str]) -> None:
    """Arrays of a policy's own episodes: what it does wrong is no end, by the game's reward."""
    rows = {name: [] for name in ("image", "direction", "action", "advice", "valid", "task", "reward")}
    tasks, ranges, rng = {}, [], make_rng(0)
    policy = ImitationActor.load(run, GymnasiumWorld("BabyAI-GoToLocal-v0", rgb=False).spec)
    for level in levels:
        name, _, count = level.partition(":")
        env = gymnasium.make(f"BabyAI-{name}-v0").unwrapped
        for seed in range(int(count)):
            seen, _ = env.reset(seed=3 * 10**6 + seed)
            first, memory, over = len(rows["valid"]), policy.begin(1, rng), False
            task = tasks.setdefault(seen["mission"], len(tasks))
            for _ in range(MOST_STEPS):
                action, memory = policy.act(_shown([seen], [seen["mission"]]), memory, rng)
                _add(rows, seen, task, True)
                seen, reward, ended, cut, _ = env.step(int(action[0]))
                _add_action(rows, int(action[0]), int(action[0]), reward)
                if over := ended or cut:
                    break
            _add(rows, seen, task, not over)
            _add_action(rows, 0, 0, 0.0)
            ranges.append((first, len(rows["valid"])))
    np.savez_compressed(out, ranges=ranges, tasks=list(tasks), **{key: np.array(value) for key, value in rows.items()})


def _shown(seen: list, texts: list[str]) -> dict[str, torch.Tensor]:
    return {
        "image": torch.from_numpy(np.stack([one["image"] for one in seen])),
        "direction": torch.tensor([int(one["direction"]) for one in seen]),
        "text": torch.from_numpy(np.stack([text_to_bytes(text) for text in texts])),
    }


def _out_of_time(*_) -> None:
    raise TimeoutError


def _carried_out(env, seen, rows, tasks, rng) -> tuple:
    """(the observation after the instruction of `env`, whether it was carried out)"""
    from minigrid.utils.baby_ai_bot import BabyAIBot

    bot, last, task = None, None, tasks.setdefault(seen["mission"], len(tasks))
    for _ in range(MOST_STEPS):
        _add(rows, seen, task, True)
        try:
            if bot is None and env.carrying and not seen["mission"].startswith("go"):  # the bot cannot begin so
                advice = 0 if env.grid.get(*env.front_pos) else 4  # turn left, or drop it
            else:
                bot, last = (BabyAIBot(env), None) if bot is None else (bot, last)
                signal.setitimer(signal.ITIMER_REAL, PATIENCE_S)  # with full hands and no way it plans for ever
                advice = int(bot.replan(last))
        except Exception:  # the bot lost its plan
            advice = int(rng.integers(7))
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        last = int(rng.integers(7)) if rng.random() < SLIPS else advice
        seen, reward, ended, cut, _ = env.step(last)
        _add_action(rows, last, advice, reward)
        if ended or cut:
            return seen, reward > 0
    return seen, False


def _add(rows, seen, task: int, valid: bool) -> None:
    for key, value in {"image": seen["image"], "direction": seen["direction"], "task": task, "valid": valid}.items():
        rows[key].append(value)


def _add_action(rows, action: int, advice: int, reward: float) -> None:
    for key, value in {"action": action, "advice": advice, "reward": reward}.items():
        rows[key].append(value)


def opened(files: str) -> Recording:
    """The demonstrations of one file, or of several with commas between, as a recording."""
    parts = [np.load(file) for file in files.split(",")]
    tasks = tuple(dict.fromkeys(task for part in parts for task in part["tasks"].tolist()))
    before = np.cumsum([0, *(len(part["task"]) for part in parts)])
    ranges = np.concatenate([part["ranges"] + offset for part, offset in zip(parts, before)])
    data = {
        key: np.concatenate([part[key] for part in parts]) for key in parts[0].files if key not in ("tasks", "ranges")
    }
    data["task"] = np.concatenate(
        [np.array([tasks.index(one) for one in part["tasks"]])[part["task"]] for part in parts]
    )
    world = {"action_low": [0], "action_high": [6], "discrete": True, "action_shape": [], "action_space": "Discrete(7)"}
    arrays = {
        "observation.image": data["image"].astype(np.uint8),
        "observation.direction": data["direction"].reshape(-1, 1),
        "task": data["task"],
    }
    cache = SimpleNamespace(
        arrays=arrays, keys={"image": "observation.image", "direction": "observation.direction"}, absent={}, ranges=ranges,
        episodes=[tuple(one) for one in ranges.tolist()], length=len(data["task"]), tasks=tasks,
        world=world, action=data["advice"].astype(np.float32)[:, None], action_valid=data["valid"], reward=data["reward"],
        rgb=None,
    )  # fmt: skip
    start, usable, held = np.zeros(cache.length, np.int64), np.zeros(cache.length, bool), []
    for number, (first, stop) in enumerate(cache.episodes):
        start[first:stop] = first
        usable[first:stop] = number % 20 > 0
        held += [number] if number % 20 == 0 else []
    return Recording(cache, start, usable, controls_of(cache), None, tuple(held))


def train(file: str, out: str, minutes: float, remember: int = 24, seed: int = 0, begin: str = "") -> None:
    """begin: a policy of the same vocabulary whose weights it goes on from."""
    recording = opened(file)
    practice = Practice(batch=64 if remember else 128, learning_rate=1e-3 if begin else 2e-3, seed=seed)
    torch.manual_seed(seed)
    network = ImitationNetwork(config_of(recording, ("image", "direction"), 128, Imitation(remember=remember)))
    rows = DemonstrationRows.of(recording, network.config, torch.device("cpu"))
    network.fit_normalization(rows.sample(4096, np.random.default_rng(0)).seen)
    if begin:
        network.load_state_dict(load_imitation_network(begin)[0].state_dict())
    run = Run.of(out, practice, lambda done, total, text: print(text, flush=True), recording=file, remember=remember)
    feed = RandomBatches(lambda now: rows.sample(practice.batch, now.rng))
    trainer = Trainer(run, "imitation", feed, BehaviourCloning(network, practice.learning_rate), ENDLESS)
    trainer.limit_s = 60 * minutes
    trainer.train(lambda: ImitationActor.write(network, Path(out) / "policy", {}))
    ImitationActor.write(network, Path(out) / "policy", {})
    print(copycat(network.eval(), rows.held_out, 2048), round(trainer.facts["seconds"]), "s")


def judge(run: str, levels: list[str], missions: int) -> None:
    warnings.simplefilter("ignore")
    spec = GymnasiumWorld("BabyAI-GoToLocal-v0", rgb=False).spec
    policy = ImitationActor.load(run, spec)
    for level in levels:
        make = partial(gymnasium.make, f"BabyAI-{level}-v0")
        print(level, "random", *played(make, Random(spec), missions), flush=True)
        print(level, "as trained", *played(make, policy, missions), flush=True)
        for words in PARAPHRASES:
            print(level, words, *played(make, policy, missions, words), flush=True)


def skills(file: str, run: str, out: str) -> None:
    report = lambda done, total, text: print(text, flush=True)  # noqa: E731
    library, facts = learn_skills(opened(file), Path(run) / "policy", out, SkillTraining(), report)
    print(
        *(f"{one.name}: {one.phrase}, {one.tries} segments, {one.steps:.0f} steps" for one in library.skills), sep="\n"
    )
    print(facts)


def compose(folder: str, kinds: list[str], missions: int) -> None:
    """Three steps in one room, in BabyAI's own grammar: by skills and planner, and by the policy given the whole sentence."""
    warnings.simplefilter("ignore")
    spec = GymnasiumWorld("BabyAI-GoToLocal-v0", rgb=False).spec
    library = SkillLibrary.load(folder)
    policies = {
        "skills": SkillActor(library, spec),
        "flat": ImitationActor(library.network, spec),
        "random": Random(spec),
    }
    for kind in kinds:
        for name, policy in policies.items():
            print(kind, name, *played(partial(three_steps, kind), policy, missions), flush=True)


def room_of(mission: Callable):
    """A room of 8 x 8 with 8 different objects, and the instruction `mission`(the room)."""
    from minigrid.envs.babyai.core import verifier
    from minigrid.envs.babyai.core.roomgrid_level import RoomGridLevel

    class Room(RoomGridLevel):
        def gen_mission(self):
            self.place_agent()
            self.things = self.add_distractors(num_distractors=8, all_unique=True)
            self.check_objs_reachable()
            self.instrs = mission(self)

        def sample(self, kinds, things=None):
            """An instruction of one of these kinds, about objects that lie in the room, not before the agent."""
            there = [one for one in self.things if one is not self.carrying and one is self.grid.get(*one.cur_pos)]
            away = [one for one in there if one is not self.grid.get(*self.front_pos)]
            thing, other = self._rand_subset(things or away, 2)
            what, one = self._rand_elem(kinds), verifier.ObjDesc(thing.type, thing.color)
            if what == "put":
                return verifier.PutNextInstr(one, verifier.ObjDesc(other.type, other.color))
            return verifier.GoToInstr(one) if what == "go" else verifier.PickupInstr(one)

    return Room(num_rows=1, num_cols=1, room_size=8, max_steps=MOST_STEPS * INSTRUCTIONS)


def three_steps(kind: str):
    """A mission of three steps in one room: go to (GoTo), or also put next to and pick up (Synth). At most one picks up, among
    those that come last, for no instruction of the four levels puts anything down alone."""
    from minigrid.envs.babyai.core import verifier

    kinds = ("go", "put") if kind == "Synth" else ("go",)

    def mission(room):
        pick = room._rand_subset(room.things, 6)
        one, two = (room.sample(kinds, pick[at : at + 2]) for at in (0, 2))
        last = room.sample((*kinds, "pick") if kind == "Synth" else kinds, pick[4:])
        if room._rand_bool():  # two in any order, then one
            first, last = verifier.AndInstr(one, two), last
        else:
            first, last = one, verifier.AndInstr(*room._rand_subset([two, last], 2))
        return verifier.BeforeInstr(first, last) if room._rand_bool() else verifier.AfterInstr(last, first)

    return room_of(mission)


@torch.no_grad()
def played(make: Callable, policy, missions: int, words: dict[str, str] | None = None) -> tuple:
    """(success with Wilson's interval, mean steps) over missions from seeds that no demonstration used."""
    envs = [make() for _ in range(missions)]
    seen = [env.reset(seed=10**6 + number)[0] for number, env in enumerate(envs)]
    rng, won, steps, going = make_rng(0), 0, 0, list(range(missions))
    memory = policy.begin(missions, rng)
    while going:
        texts = [seen[number]["mission"] for number in going]
        for old, new in (words or {}).items():
            texts = [text.replace(old, new) for text in texts]
        shown = _shown([seen[number] for number in going], texts)
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
        train(target, rest[0], float(rest[1]), *map(int, rest[2:4]), *rest[4:])
    elif what == "play":
        play(target, rest[0], rest[1:])
    elif what == "skills":
        skills(target, *rest)
    else:
        count = int(rest[rest.index("--missions") + 1]) if "--missions" in rest else 512
        (compose if what == "compose" else judge)(
            target, [one for one in rest if not one.startswith("-") and not one.isdigit()], count
        )
