"""A policy of pictures and instructions predicts where its numbers go, from the places to which the instruction attends."""

from dataclasses import replace

import numpy as np
import torch
from gymnasium import spaces
from tests.learn.test_imitation_of_a_teacher import rows_of

from terrella.act.actor_network import ActorConfig
from terrella.act.imitation import ImitationActor
from terrella.act.imitation_network import ImitationConfig, ImitationNetwork
from terrella.act.sentences import WordEncoder
from terrella.core.instruction import text_to_bytes
from terrella.core.policy import Random
from terrella.core.spec import TEXT as TEXT_SPACE
from terrella.core.world import make_rng
from terrella.learn.objectives.imitation import BehaviourCloning, Demonstrations, moments, waypoint_errors
from terrella.learn.train_step import TrainStep
from terrella.sim.gymnasium import GymnasiumWorld

COLOURS = {"blue": (30, 60, 220), "green": (30, 150, 50), "red": (220, 30, 30)}


def scenes(count, rng):
    """Pictures of three squares, the numbers [count, 2] of two that are named, and their places [count, 2, 2] from -1 to 1."""
    corners = np.stack([rng.permutation(16)[:3] for _ in range(count)])
    corners = np.stack([corners // 4, corners % 4], 2) * 6 + rng.integers(0, 3, (count, 3, 2))
    pictures = np.full((count, 24, 24, 3), 120, np.uint8)
    for picture, three in zip(pictures, corners):
        for colour, (y, x) in zip(COLOURS.values(), three):
            picture[y : y + 3, x : x + 3] = colour
    named = np.stack([rng.permutation(3)[:2] for _ in range(count)])
    return torch.from_numpy(pictures), named, torch.from_numpy(corners[np.arange(count)[:, None], named] / 11.5 - 0.9)


def test_waypoints_are_at_the_two_things_that_are_named_in_scenes_never_seen():
    torch.manual_seed(0)
    actor = ActorConfig((("rgb", (24, 24, 3)), ("hand", (2,))), "axes", (1,), (-1.0,), (1.0,), hidden=32)
    network = ImitationNetwork(ImitationConfig(actor, (24, 24), (*COLOURS, "on"), history=1, waypoint=8))
    objective, rng, count = BehaviourCloning(network, 1e-2), np.random.default_rng(0), 48
    optimiser = objective.learners["imitation"].optimiser
    optimiser.param_groups[0]["lr"] = 1e-2

    def batch():
        pictures, named, places = scenes(count, rng)
        colours = np.array(list(COLOURS))[named]
        words = network.words.read([f"{first} on {second}" for first, second in colours])
        seen = {"rgb": pictures, "hand": torch.zeros(count, 2)}
        still, weight = torch.zeros(count, 1, 1), torch.ones(count, 1)
        waypoints = tuple({"hand": places[:, at].float()} for at in (0, 1))
        return Demonstrations(seen, still, still, weight, words, waypoints=waypoints, begins=torch.ones(count))

    for step in range(80):
        loss = next(iter(objective.losses(batch(), TrainStep(step, 0.0, torch.device("cpu"), rng, make_rng(step)))))
        optimiser.zero_grad()
        loss.value.backward()
        optimiser.step()
    test = batch()
    with torch.no_grad():
        foreseen = network.eval().foreseen(*moments(network, test))
        assert foreseen is not None
        errors = foreseen - torch.stack([network.numbers(numbers) for numbers in test.waypoints], 1)
    assert set(loss.parts) == {"imitation", "waypoint", "end"}
    near = errors.abs().amax(2).lt(0.25).float().mean(0)
    assert near.min() > 0.9, near  # by chance one in ten


def test_waypoints_are_learned_where_an_instruction_begins(tmp_path):
    rows, opened = rows_of(Random, tmp_path / "random")
    rows = replace(rows, config=replace(rows.config, waypoint=3))
    place = torch.from_numpy(np.array(opened.cache.arrays["observation.place"], np.float32)).reshape(-1, 1)
    first, stop = opened.cache.episodes[1]
    batch = rows.at(np.array([first, first + 1, stop - 2]))
    assert batch.begins.tolist() == [1, 0, 0]
    later, end = (numbers["place"].reshape(-1, 1) for numbers in batch.waypoints)
    assert torch.equal(later, place[[first + 3] * 3])
    assert torch.equal(end, place[[stop - 1] * 3])
    drawn = rows.sample(400, np.random.default_rng(0))
    assert 0.375 <= drawn.begins.mean() < 0.575  # three in eight, and what is drawn by chance


def test_actions_are_given_the_waypoints_of_the_beginning_until_the_instruction_changes():
    torch.manual_seed(0)
    hand, picture = spaces.Box(-1, 1, (2,), np.float32), spaces.Box(0, 255, (24, 24, 3), np.uint8)
    spec = replace(
        GymnasiumWorld("Pendulum-v1", rgb=False).spec, channels={"rgb": picture, "hand": hand, "text": TEXT_SPACE}
    )
    actor = ActorConfig((("rgb", (24, 24, 3)), ("hand", (2,))), "axes", (1,), (-2.0,), (2.0,), hidden=16)
    config = ImitationConfig(actor, (24, 24), tuple(COLOURS), history=1, chunk=4, execute=4, waypoint=8)
    policy = ImitationActor(ImitationNetwork(config).eval(), spec)
    pictures = scenes(2, np.random.default_rng(0))[0]

    def act(picture, words, memory):
        text = torch.from_numpy(np.stack([text_to_bytes(word) for word in words]))
        seen = {"rgb": pictures[[picture, picture]], "hand": torch.zeros(2, 2), "text": text}
        return policy.act(seen, memory, make_rng(0))[1]

    began = act(0, ("red", "red"), policy.begin(2, make_rng(0)))
    later = act(1, ("red", "blue"), began)
    anew = act(1, ("red", "blue"), policy.begin(2, make_rng(0)))
    assert began["waypoints"].shape == (2, 2, 2)
    assert later["waypoints"][0].equal(began["waypoints"][0])
    assert not later["waypoints"][0].equal(anew["waypoints"][0])
    assert later["waypoints"][1].equal(anew["waypoints"][1])  # the instruction changed
    assert later["taken"].tolist() == [2, 1]  # and with it the chunk


def test_the_errors_of_given_waypoints_are_those_of_beginnings():
    truth = torch.zeros(6, 2, 3)
    difference = torch.arange(6.0)[:, None, None].expand(6, 2, 3)
    begins = torch.tensor([0.0, 1, 0, 0, 1, 0])
    batch = Demonstrations({}, truth, truth, truth, begins=begins)
    now = TrainStep(0, 0.0, torch.device("cpu"), np.random.default_rng(0), make_rng(0))
    squares, given = waypoint_errors(difference, truth, batch, now)
    assert squares.tolist() == [8.5, 8.5]  # of 1 and 4
    assert set(given.flatten().tolist()) == {1.0, 4.0}
    nothing = replace(batch, begins=torch.zeros(6))
    squares, given = waypoint_errors(difference, truth, nothing, now)
    assert squares.tolist() == [0, 0] and given.equal(truth)


def test_picks_are_the_same_beside_longer_sentences():
    encoder = WordEncoder(("blue", "on", "red"), picks=4).eval()
    alone, beside = (encoder(encoder.read(texts))[0] for texts in (["red on blue"], ["red on blue", 9 * "blue on "]))
    assert alone.shape == (encoder.width,) and torch.allclose(alone, beside, atol=1e-6)


def test_a_policy_without_pictures_or_instructions_has_no_waypoints():
    numbers = ActorConfig((("hand", (2,)),), "axes", (1,), (-1.0,), (1.0,), hidden=8)
    pictures = replace(numbers, sees=(("rgb", (24, 24, 3)), ("hand", (2,))))
    for actor, words in ((numbers, ("red",)), (pictures, ())):
        assert not ImitationNetwork(ImitationConfig(actor, (24, 24), words, history=1, waypoint=8)).waypoints
