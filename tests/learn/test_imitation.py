"""Imitation: instructions are followed, chunks of either of two ways, copies of the last action are named, runs go on exactly."""

from __future__ import annotations

import json
import warnings
from copy import copy
from dataclasses import replace
from shutil import copytree

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from tests.learn.stopping import goes_on_exactly, quiet

import terrella
from terrella.act.actor_network import ActorConfig
from terrella.act.imitation import ImitationActor
from terrella.act.imitation_network import ImitationConfig, ImitationNetwork
from terrella.act.planning import PlaySettings, play
from terrella.act.sentences import WORDS, WordEncoder, vocabulary_of
from terrella.cli import main
from terrella.core.errors import ActionError, ChannelError, CheckpointError, DatasetError, PlanningError, TrainingError
from terrella.core.instruction import bytes_to_text, text_to_bytes
from terrella.core.policy import Random
from terrella.core.world import make_rng
from terrella.data import record
from terrella.learn.demonstrations import DemonstrationRows
from terrella.learn.objectives.imitation import BehaviourCloning, Demonstrations, condition
from terrella.learn.recipes.imitation import Imitation, open_demonstrations, train_imitation
from terrella.learn.recipes.policy import Practice
from terrella.learn.train_step import TrainStep
from terrella.sim.gymnasium import GymnasiumWorld
from terrella.workflows.page_agents import PageAgents
from terrella.worlds.controls import Controls

NAME = "gym:tests.learn.test_imitation:TerrellaFetch-v0"
QUICK = Practice(steps=150, batch=64, hidden=32, learning_rate=5e-3, save_every_s=1e9)
COLOURS = ("red", "blue")


class Fetch(gymnasium.Env):
    """Two cells of a row hold a code each; the mission names the one to step on. An episode ends there, or after 12 steps."""

    action_space = spaces.Discrete(3)  # left, stay, right
    observation_space = spaces.Dict(
        {"grid": spaces.Box(0, 9, (1, 7, 1), np.uint8), "mission": spaces.Text(40), "wind": spaces.Box(-1, 1, (1,))}
    )
    metadata = {"render_modes": ["ansi"], "render_fps": 10}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cells = self.np_random.permutation([0, 6])  # of red and blue
        self.wanted, self.at, self.steps = int(self.np_random.integers(2)), int(self.np_random.integers(2, 5)), 0
        return self.seen(), {}

    def step(self, action):
        self.at, self.steps = int(np.clip(self.at + int(action) - 1, 0, 6)), self.steps + 1
        there = self.at in self.cells
        won = self.at == self.cells[self.wanted]
        return self.seen(), float(won), bool(there), self.steps >= 12, {}

    def seen(self):
        grid = np.zeros((1, 7, 1), np.uint8)
        grid[0, self.cells, 0] = (3, 5)
        grid[0, self.at, 0] += 1
        return {"grid": grid, "mission": f"go to the {COLOURS[self.wanted]} ball", "wind": np.zeros(1, np.float32)}


if "TerrellaFetch-v0" not in gymnasium.registry:
    gymnasium.register("TerrellaFetch-v0", Fetch)


def teacher(seen, rng):
    """Walks to the ball that the mission names."""
    actions = []
    for text, grid in zip(seen["text"], seen["grid"][:, 0, :, 0].tolist()):
        code = 3 if "red" in bytes_to_text(text.numpy()) else 5
        goal = next(at for at, value in enumerate(grid) if value in (code, code + 1))
        me = next(at for at, value in enumerate(grid) if value in (1, 4, 6))
        actions.append(1 + int(np.sign(goal - me)))
    return torch.tensor(actions)


def share_of_wins(world, policy, episodes=40):
    return np.mean([one.reward for one in play(world, policy, episodes, PlaySettings(12), 7).episodes])


@pytest.fixture(scope="module")
def fetch(tmp_path_factory):
    """(the environment, a recording of its teacher, facts of a policy that imitates it)"""
    folder = tmp_path_factory.mktemp("imitation")
    world = GymnasiumWorld("TerrellaFetch-v0")
    record(world, terrella.load_policy(f"{__file__}:teacher", world.spec), folder / "recording", 600, make_rng(0))
    facts = train_imitation(folder / "recording", folder / "run", QUICK, Imitation(history=1), quiet)
    return world, folder / "recording", facts


def test_an_instruction_is_followed_and_unknown_words_are_named(fetch):
    world, _, facts = fetch
    assert facts["sees"] == ["grid", "wind"] and "The policy predicts 100%" in facts["held_out_verdict"]
    policy = terrella.load_policy(facts["policy"], world.spec)
    assert isinstance(policy, ImitationActor) and policy.sees == ("grid", "wind", "text")
    assert share_of_wins(world, policy) > 0.9 > share_of_wins(world, Random(world.spec))
    assert policy.unknown("go to the crimson Ball!") == ("crimson",)
    state = world.start(1, make_rng(0))
    seen = world.render(state, policy.sees)
    text = torch.from_numpy(text_to_bytes("Walk over to the blue balls").copy())[None]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            policy.act({**seen, "text": text}, policy.begin(1, make_rng(0)), make_rng(0))
    assert [str(one.message) for one in caught] == [
        "the policy does not know 'walk', 'over' and leaves that out of the instruction."
    ]


def test_words_mean_the_same_in_other_sentences_and_their_order_counts():
    encoder = WordEncoder(vocabulary_of(["put the red ball on the blue box"])).eval()
    asked = "please kindly put the red ball on the box"
    alone, beside = (encoder(encoder.read(texts))[0] for texts in ([asked], [asked, 3 * f"{asked} "]))
    assert torch.allclose(alone, beside, atol=1e-6)  # unknown words cut nothing off
    words = encoder.read(["The RED balls", "the red ball", "red on blue", "blue on red", "crimson", ""])
    assert words.shape == (6, WORDS) and words[0].equal(words[1]) and not words[4:].any()
    features = encoder(words)
    assert features.shape == (6, encoder.width) and torch.isfinite(features).all()
    assert not torch.allclose(features[2], features[3])


def test_chunks_of_axes_go_either_of_two_ways_and_not_between():
    torch.manual_seed(0)
    actor = ActorConfig((("observation", (1,)),), "axes", (1,), (-2.0,), (2.0,), hidden=32)
    network = ImitationNetwork(ImitationConfig(actor, history=1, chunk=4))
    objective, rng = BehaviourCloning(network, 3e-3), np.random.default_rng(0)
    optimiser = objective.learners["imitation"].optimiser
    for step in range(250):
        way = torch.from_numpy(rng.choice([-0.8, 0.8], (128, 1, 1))).float().expand(128, 4, 1)
        batch = Demonstrations({"observation": torch.zeros(128, 1)}, torch.zeros(128, 1, 1), way, torch.ones(128, 4))
        now = TrainStep(step, step / 250, torch.device("cpu"), rng, make_rng(step))
        optimiser.param_groups[0]["lr"] = 3e-3
        loss = next(iter(objective.losses(batch, now))).value
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    out = network.eval()(
        network.features({"observation": torch.zeros(200, 1)}, None)[:, None], torch.zeros(200, 1, 1), None, None
    )
    chunks = network.chunk(out, torch.randn(200, 4, generator=make_rng(1)))[..., 0].detach()
    assert ((chunks.abs() - 0.8).abs() < 0.3).float().mean() > 0.85 and 0.2 < (chunks[:, 0] > 0).float().mean() < 0.8
    assert (chunks.sign() == chunks[:, :1].sign()).float().mean() > 0.95  # a chunk keeps to its way


def test_actions_are_decoded_as_they_were_encoded():
    axes = ImitationConfig(ActorConfig((), "axes", (2,), (-2.0, 0.0), (2.0, 1.0)))
    action = torch.tensor([[1.0, 0.25], [-2.0, 1.0]])
    spec = replace(
        GymnasiumWorld("Pendulum-v1", rgb=False).spec,
        action=spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 1.0], np.float32)),
    )
    assert torch.allclose(axes.decode(Controls.of(spec).encode(action), spec), action, atol=1e-4)
    choice = ImitationConfig(ActorConfig((), "choice", (), (1.0,), (3.0,)))
    spec = replace(spec, action=spaces.Discrete(3, start=1), action_mode="choice")
    assert choice.decode(Controls.of(spec).encode(torch.tensor([1, 3, 2])), spec).tolist() == [1, 3, 2]


def test_a_batch_of_episodes_is_as_each_alone_and_keeps_its_history(fetch):
    world, _, facts = fetch
    policy = ImitationActor.load(facts["policy"], world.spec)
    config = replace(policy.network.config, history=3, chunk=3, execute=2, own_actions=True)
    torch.manual_seed(1)
    policy = ImitationActor(ImitationNetwork(config).eval(), world.spec)
    seen = [world.render(world.start(1, make_rng(n)), policy.sees) for n in (1, 2)]
    memory = policy.begin(2, make_rng(0))
    for _ in range(5):
        _, memory = policy.act(
            {name: torch.cat([one[name] for one in seen]) for name in policy.sees}, memory, make_rng(0)
        )
    assert memory["taken"].tolist() == [1, 1] and (memory["acted"][:, :, :].sum(2) == 1).all()
    alone = policy.begin(1, make_rng(0))
    for _ in range(5):
        _, alone = policy.act(seen[1], alone, make_rng(0))
    assert torch.allclose(alone["features"], memory["features"][1:], atol=1e-5)
    assert alone["acted"].equal(memory["acted"][1:])


def test_a_person_types_the_instruction_on_the_page(fetch):
    world, _, facts = fetch
    agents = PageAgents(world, name=facts["policy"]).agents()
    state = world.start(1, make_rng(3))
    assert agents.words is not None and bytes_to_text(agents.make({}).see(state)["text"][0].numpy()).startswith("go to")
    for colour in COLOURS:
        agent = agents.make(agents.words(f"please go to the {colour} ball"))
        assert agent.name.endswith("(does not know 'please')")
        seen = agent.see(state)
        assert bytes_to_text(seen["text"][0].numpy()) == f"please go to the {colour} ball"
        with pytest.warns(UserWarning, match="does not know 'please'"):
            action, _ = agent.policy.act(seen, agent.policy.begin(1, make_rng(0)), make_rng(0))
        assert action.tolist() == teacher(seen, None).tolist()
    with pytest.raises(PlanningError, match="knows none of the words of 'jump high'; it knows ball, blue"):
        agents.words("jump high")
    silent = copy(world)
    silent.spec = replace(world.spec, channels={k: v for k, v in world.spec.channels.items() if k != "text"})
    assert not PageAgents(silent, name=facts["policy"]).make({}).see(state)["text"].any()


class Sweep(gymnasium.Env):
    """A number goes up or down as told, blindly: what is seen never changes."""

    action_space, observation_space = spaces.Discrete(2), spaces.Box(0, 1, (1,), np.float32)
    metadata = {"render_modes": ["ansi"], "render_fps": 10}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(1, np.float32), 0.0, False, self.steps >= 24, {}


class Stubborn:
    """Repeats its action and changes it now and then, by chance."""

    sees = ()

    def begin(self, batch, rng):
        return torch.zeros(batch, dtype=torch.int64)

    def act(self, observation, memory, rng):
        memory = torch.where(torch.rand(len(memory), generator=rng) < 0.15, 1 - memory, memory)
        return memory, memory


def test_a_copy_of_the_last_action_is_named(tmp_path):
    world = GymnasiumWorld(Sweep)
    record(world, Stubborn(), tmp_path / "recording", 1500, make_rng(0))
    facts = train_imitation(tmp_path / "recording", tmp_path / "run", QUICK, Imitation(own_actions=True), quiet)
    assert "copies its last action" in facts["held_out_verdict"] and facts["copies_at_changes"] > 0.9
    assert facts["held_out"] == facts["held_out_copy_last"] > 0.7 and facts["at_changes_copy_last"] == 0
    with pytest.raises(DatasetError, match="no outcomes to condition on; leave --outcome out"):
        train_imitation(tmp_path / "recording", tmp_path / "other", QUICK, Imitation(outcome=True), quiet)


class Slide(Sweep):
    action_space = spaces.Box(-1, 1, (1,), np.float32)


class Sawtooth:
    """Falls from 1 to 0.2 in three steps, and jumps back."""

    sees = ()

    def begin(self, batch, rng):
        return torch.zeros(batch)

    def act(self, observation, memory, rng):
        return 1 - 0.4 * memory[:, None] - 0.1 * torch.rand(len(memory), 1, generator=rng), (memory + 1) % 3


def test_an_untrained_policy_of_axes_copies_nothing(tmp_path):
    record(GymnasiumWorld(Slide), Sawtooth(), tmp_path / "recording", 300, make_rng(0))
    few = replace(QUICK, steps=1)
    facts = train_imitation(tmp_path / "recording", tmp_path / "run", few, Imitation(), quiet)
    assert facts["held_out"] < facts["held_out_usual"] and "predicts no better than" in facts["held_out_verdict"]


class Recall(gymnasium.Env):
    """Only the first observation shows which action, 0 or 2, the last step will reward."""

    action_space, observation_space = spaces.Discrete(3), spaces.Box(-1, 1, (1,), np.float32)
    metadata = {"render_modes": ["ansi"], "render_fps": 10}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.wanted, self.steps = int(self.np_random.integers(2)), 0
        return np.full(1, 2 * self.wanted - 1, np.float32), {}

    def step(self, action):
        self.steps += 1
        over = self.steps == 6
        return np.zeros(1, np.float32), float(over and action == 2 * self.wanted), over, False, {}


class Minder:
    """Does what the first observation showed, all the time."""

    def begin(self, batch, rng):
        return torch.zeros(batch)

    def act(self, observation, memory, rng):
        shown = observation["observation"][:, 0]
        memory = torch.where(shown == 0, memory, shown)
        return (memory + 1).long(), memory


def test_what_the_first_observation_showed_is_remembered(tmp_path):
    world = GymnasiumWorld(Recall)
    record(world, Minder(), tmp_path / "recording", 500, make_rng(0))
    won = {}
    for name, imitation in {"memory": Imitation(remember=8), "last two": Imitation(history=2)}.items():
        facts = train_imitation(tmp_path / "recording", tmp_path / name, QUICK, imitation, quiet)
        won[name] = share_of_wins(world, ImitationActor.load(facts["policy"], world.spec))
    assert won["memory"] == 1.0 and won["last two"] < 0.8


def test_a_memory_in_play_is_that_of_training(fetch):
    world, recording, facts = fetch
    policy = ImitationActor.load(facts["policy"], world.spec)
    torch.manual_seed(1)
    config = replace(policy.network.config, remember=30)
    policy = ImitationActor(ImitationNetwork(config).eval(), world.spec)
    rows = DemonstrationRows.of(
        open_demonstrations(recording, config.sees[:2], (64, 64), quiet)[0], config, torch.device("cpu")
    )
    first, stop = rows.recording.cache.episodes[3]
    batch = rows.at(np.array([first, stop - 2]))
    out = condition(policy.network, batch, batch.acted)[batch.requested]
    memory, arrays = policy.begin(1, make_rng(0)), rows.recording.cache.arrays
    for row in range(first, stop - 1):
        text = text_to_bytes(rows.recording.cache.tasks[arrays["task"][row]])
        seen = {"text": text, **{name: arrays[f"observation.{name}"][row] for name in ("grid", "wind")}}
        action, memory = policy.act({k: torch.tensor(v)[None] for k, v in seen.items()}, memory, make_rng(0))
        if row in (first, stop - 2):
            assert int(action) == int(out[int(row > first)].argmax())
    assert memory["features"].shape == (1, 1, config.actor.hidden)


@pytest.mark.exact
@pytest.mark.parametrize("imitation", [Imitation(), Imitation(remember=6)], ids=["history", "memory"])
def test_a_stopped_run_goes_on_exactly(fetch, tmp_path, imitation):
    _, recording, _ = fetch
    config = replace(QUICK, steps=8, batch=8, hidden=8)
    goes_on_exactly(
        lambda out: train_imitation(recording, out, config, imitation, quiet),
        tmp_path / "whole",
        tmp_path / "cut",
        {"imitation": 3},
    )


@pytest.mark.exact
def test_the_command_trains_plays_and_evaluates(fetch, tmp_path, capsys):
    _, recording, _ = fetch
    words = [
        "train",
        "policy",
        "--method",
        "imitation",
        "--from",
        str(recording),
        "--out",
        str(tmp_path / "run"),
        "--sees",
        "grid",
    ]
    words += ["--steps", "100", "--batch", "64", "--hidden", "32", "--learning-rate", "0.005", "--history", "1"]
    assert main([*words, "--real", NAME, "--episodes", "30", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["better by"]["low"] > 0 and "acts better than chance" in facts["verdict"]
    assert "The policy predicts " in facts["held_out_verdict"]
    policy = str(tmp_path / "run")
    evaluated = ["evaluate", policy, "--in", NAME, "--success", "reward", "--episodes", "20", "--json"]
    assert main([*evaluated, "--out", str(tmp_path / "evaluation")]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert rows["run"]["dream"]["value"] > rows["random"]["dream"]["value"]


@pytest.mark.parametrize(
    "words, said",
    [
        ([], "--from RECORDING"),
        (["--from", "r", "--in", "gym:CartPole-v1"], "--in: imitation learns from a recording"),
        (["--from", "r", "--horizon", "9"], "--horizon: imitation"),
        (["--from", "r", "--history", "0"], "1 or more"),
    ],
)
def test_what_cannot_be_imitated_is_said_in_a_sentence(words, said, tmp_path, capsys):
    assert main(["train", "policy", "--method", "imitation", *words, "--out", str(tmp_path / "x")]) == 2
    assert said in capsys.readouterr().err


def test_settings_of_imitation_alone_are_refused_elsewhere(tmp_path, capsys):
    out = ["--out", str(tmp_path / "x")]
    assert main(["train", "policy", "--in", "gym:CartPole-v1", "--history", "3", *out]) == 2
    assert "only --method imitation" in capsys.readouterr().err
    assert main(["train", "policy", *out]) == 2
    assert "--in WORLD" in capsys.readouterr().err


def test_a_policy_of_other_actions_or_channels_is_refused(fetch):
    world, recording, facts = fetch
    with pytest.raises(ActionError, match="for other actions"):
        ImitationActor.load(facts["policy"], replace(world.spec, action=spaces.Discrete(4)))
    silent = {name: space for name, space in world.spec.channels.items() if name not in ("text", "instruction")}
    with pytest.raises(ChannelError, match="follows instructions"):
        ImitationActor.load(facts["policy"], replace(world.spec, channels=silent))
    with pytest.raises(DatasetError, match="cannot see 'depth'"):
        train_imitation(recording, "unused", replace(QUICK, sees=("depth",)), Imitation(), quiet)
    with pytest.raises(DatasetError, match="did you mean 'grid'. It has grid, wind"):
        train_imitation(recording, "unused", replace(QUICK, sees=("gird",)), Imitation(), quiet)
    with pytest.raises(TrainingError, match="--device moon"):  # before a recording is read
        train_imitation("nowhere", "unused", QUICK, Imitation(), quiet, "moon")
    with pytest.raises(TrainingError, match="at most the 1 actions"):
        train_imitation(recording, "unused", QUICK, Imitation(execute=2), quiet)


def test_an_environment_of_other_actions_is_refused_before_training(fetch, tmp_path, capsys):
    words = ["--from", str(fetch[1]), "--real", "gym:MountainCarContinuous-v0", "--out", str(tmp_path / "run")]
    assert main(["train", "policy", "--method", "imitation", *words]) == 2
    assert "it is for other actions" in capsys.readouterr().err and not (tmp_path / "run").exists()


def test_a_policy_of_another_release_is_named(fetch, tmp_path):
    world, _, facts = fetch
    copytree(facts["policy"], tmp_path / "old")
    saved = json.loads((tmp_path / "old/policy.json").read_text())
    (tmp_path / "old/policy.json").write_text(json.dumps({**saved, "version": 1}))
    with pytest.raises(CheckpointError, match="another release .*train it again"):
        terrella.load_policy(str(tmp_path / "old"), world.spec)
