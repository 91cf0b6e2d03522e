"""Whatever form an environment gives its pictures, observations, rewards and ends in, all of it is used or named."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from PIL import Image

from terrella.care.doctor import examine
from terrella.cli.record import described as describe
from terrella.core import check_world, make_rng
from terrella.core.errors import TerrellaError
from terrella.core.instruction import bytes_to_text, embed, text_to_bytes
from terrella.core.policy import Random
from terrella.data import Dataset, RecordOptions, record
from terrella.sim.gymnasium import Adapter, Channel, GymnasiumWorld

GREY = np.full((24, 32), 200, np.uint8)
RGB = np.dstack([GREY, GREY // 2, GREY // 4])  # 200, 100, 50
DEPTH = np.full((24, 32), 3.7, np.float32)


class Plain(gymnasium.Env):
    """Counts its steps. Subclasses change what it gives."""

    action_space: spaces.Space = spaces.Discrete(2)
    observation_space: spaces.Space = spaces.Box(-9, 99, (1,), np.float32)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    render_mode = "rgb_array"

    def __init__(self):
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.seen(), self.info()

    def step(self, action):
        self.steps += 1
        return self.seen(), self.reward(), self.ended(), False, self.info()

    def seen(self):
        return np.array([self.steps], np.float32)

    def info(self):
        return {}

    def reward(self):
        return 1.0

    def ended(self):
        return False

    def render(self):
        return RGB


def gives(**methods):
    """An environment class in which these methods return these values."""
    return type("Plain", (Plain,), {name: lambda self, value=value: value for name, value in methods.items()})


def drawn(picture) -> np.ndarray:
    world = GymnasiumWorld(gives(render=picture))
    assert "rgb" in world.spec.channels, world.spec.card["left_out"]
    return world.render(world.start(1, make_rng(0)), ("rgb",))["rgb"][0].numpy()


@pytest.mark.parametrize(
    "picture",
    [
        RGB,
        np.dstack([RGB, GREY]),  # with alpha
        np.dstack([RGB, GREY]) / np.float32(255),
        np.dstack([RGB / np.float32(255), DEPTH]),
        RGB.transpose(2, 0, 1),
        np.dstack([RGB, GREY]).transpose(2, 0, 1) / 255,
        RGB.astype(np.uint16) * 257,
        RGB.astype(np.int32) * 256,
        RGB.astype(np.int64),
        RGB.astype(np.float64),
        RGB / 127.5 - 1,
        RGB[None],
        RGB.tolist(),
        [np.zeros_like(RGB), RGB],
        [Image.fromarray(RGB)],
        (RGB, DEPTH),
        (DEPTH, RGB),
        {"depth": DEPTH, "rgb": RGB},
        Image.fromarray(RGB),
        Image.fromarray(np.dstack([RGB, GREY])),
        Image.fromarray(RGB).quantize(8),
        torch.from_numpy(RGB.copy()),
        (torch.from_numpy(RGB.transpose(2, 0, 1).copy()) / 255).requires_grad_(),
    ],
)
def test_a_picture_in_any_form_is_the_picture(picture):
    assert np.abs(drawn(picture).astype(int) - RGB).max() <= 1


@pytest.mark.parametrize(
    "picture",
    [GREY, GREY[..., None], GREY[None], np.dstack([GREY, GREY]), GREY / 255, GREY.tolist(), Image.fromarray(GREY)],
)
def test_a_grey_picture_in_any_form_is_grey(picture):
    assert (drawn(picture) == 200).all()


def test_a_bilevel_picture_is_black_and_white_and_a_dark_one_stays_dark():
    bilevel = GREY[:, :] > np.arange(32) * 10
    assert set(np.unique(drawn(bilevel))) == set(np.unique(drawn(bilevel.astype(np.int64)))) == {0, 255}

    class Dawn(Plain):
        def render(self):
            return np.full((24, 32, 3), 100.0 * (self.steps == 0) + 1.0)

    world, rng = GymnasiumWorld(Dawn, forkable=False), make_rng(0)
    state = world.imagine(world.start(1, rng), torch.tensor([0]), rng)
    assert world.render(state, ("rgb",))["rgb"].unique().tolist() == [1], "1 of 255, as the picture before says"


def test_a_highlight_beyond_white_darkens_nothing():
    bright = RGB / 255
    bright[0, 0] = 1.7
    assert (drawn(bright)[0, 0] == 255).all() and (drawn(bright)[1:] == RGB[1:]).all()


@pytest.mark.parametrize("picture", [None, "ascii", np.zeros(7), np.zeros((24, 32, 9)), [], (None,), {}])
def test_what_is_no_picture_is_named(picture):
    world = GymnasiumWorld(gives(render=picture))
    lines = " ".join(describe(world.spec))
    assert "rgb" not in world.spec.channels and "pictures (its render() gives" in lines


def test_a_render_mode_without_a_picture_is_named_and_one_with_depth_is_drawn():
    made = type("Plain", (Plain,), {"render_mode": None})
    assert "pictures (it was made with render_mode=None, not 'rgb_array')" in " ".join(
        describe(GymnasiumWorld(made).spec)
    )
    bare = type("Plain", (Plain,), {"render_mode": None, "metadata": None})
    assert "rgb" not in GymnasiumWorld(bare).spec.channels
    deep = type("Plain", (Plain,), {"render_mode": "rgbd_tuple", "render": lambda self: (RGB, DEPTH)})
    assert "rgb" in GymnasiumWorld(deep).spec.channels


def test_what_info_holds_after_a_step_only_is_named_too():
    class Late(Plain):
        def info(self):
            return {"speed": 1.0} if self.steps else {}

    assert "Left out: info.speed (no channel reads it; an adapter can)." in describe(GymnasiumWorld(Late).spec)


def test_the_form_in_which_pictures_are_drawn_is_named():
    assert (
        "pictures of 24x32 (drawn as float64 [24, 32] up to 1)"
        in describe(GymnasiumWorld(gives(render=GREY / 255)).spec)[0]
    )
    assert "pictures of 24x32 (--size)" in describe(GymnasiumWorld(Plain).spec)[0]
    several = GymnasiumWorld(gives(render={"mask": GREY, "front": RGB, "wrist": RGB})).spec
    assert "drawn as 'front' of a dictionary of mask, front, wrist up to 255" in describe(several)[0]


@pytest.mark.parametrize(
    "one", [lambda it: np.array([it]), np.array, lambda it: [it], torch.tensor, lambda it: np.array([[it]])]
)
def test_rewards_and_ends_of_any_form_are_one_number(one):
    class Shaped(Plain):
        def reward(self):
            return one(2.0)

        def ended(self):
            return one(self.steps == 3)

        def info(self):
            return {"laps": one(self.steps)}

    world, rng = GymnasiumWorld(Shaped, info_channels=("laps",)), make_rng(0)
    state, seen = world.start(2, rng), []
    for _ in range(3):
        state = world.imagine(state, torch.tensor([0, 1]), rng)
        seen.append(world.render(state, ("reward", "done", "laps")))
    assert [one["reward"].tolist() for one in seen] == [[2, 2]] * 3
    assert [one["done"].tolist() for one in seen] == [[False] * 2, [False] * 2, [True] * 2]
    assert [one["laps"].tolist() for one in seen] == [[1, 1], [2, 2], [3, 3]]
    with pytest.raises(
        TerrellaError, match=r"reward of gym:Plain is an array of shape \(2,\), and one number is needed"
    ):
        world = GymnasiumWorld(gives(reward=np.ones(2)))
        world.imagine(world.start(1, rng), torch.tensor([0]), rng)


class Nested(Plain):
    """Every kind of entry. The mission is another one in each episode; the message changes within it."""

    observation_space = spaces.Dict(
        {
            "arm": spaces.Dict(
                {"pos": spaces.Box(-9, 99, (2,)), "grip": spaces.Tuple((spaces.Discrete(3), spaces.Box(0, 1, (1, 2))))}
            ),
            "walker/height": spaces.Box(-9, 99, (), np.float64),
            "walker_height": spaces.Box(-9, 99, (1,)),
            "Arm.Pos": spaces.MultiBinary(2),
            "numbers": spaces.MultiDiscrete([4, 5]),
            "pose": spaces.Dict({"position": spaces.Box(-9, 9, (3,))}),
            "camera": spaces.Dict({"front": spaces.Box(0, 255, (24, 32, 3), np.float32)}),
            "goal": spaces.Dict({"mission": spaces.Text(60), "hint": spaces.Text(60)}),
            "crowd": spaces.Sequence(spaces.Box(0, 1, (2,))),
            "none": spaces.Box(0, 1, (0,)),
        }
    )
    render_mode = None
    metadata = {}

    def seen(self):
        n = self.steps
        if n == 0:
            self.word = ("red", "blau")[int(self.np_random.integers(2))]
        return {
            "arm": {"pos": np.array([n, -1], np.float32), "grip": (2, np.array([[0.25, 0.5]], np.float32))},
            "walker/height": np.float64(n / 2),
            "walker_height": np.array([n + 7], np.float32),
            "Arm.Pos": np.array([1, 0], np.int8),
            "numbers": np.array([3, n % 5]),
            "pose": {"position": np.zeros(3, np.float32)},
            "camera": {"front": RGB.astype(np.float32)},
            "goal": {"mission": f"go to the {self.word} bäll", "hint": f"step {n}"},
            "crowd": (np.zeros(2, np.float32),) * n,
            "none": np.zeros(0, np.float32),
            "secret": 3,
        }

    def info(self):
        return {"success": False, "laps": 2}


def test_ten_entries_go_in_and_each_comes_out_or_is_named(tmp_path):
    world, rng = GymnasiumWorld(Nested, info_channels=("laps",)), make_rng(0)
    check_world(world)
    channels = {
        "arm.pos", "arm.grip.0", "arm.grip.1", "walker_height", "walker_height_2", "Arm_Pos", "seen_numbers",
        "seen_pose.position", "rgb", "text", "instruction", "reward", "done", "laps",
    }  # fmt: skip
    assert set(world.spec.channels) == channels
    state = world.imagine(world.start(2, rng), torch.tensor([0, 1]), rng)
    seen = world.render(state, tuple(channels))
    assert seen["arm.pos"].tolist() == [[1, -1]] * 2 and seen["arm.grip.0"].tolist() == [2, 2]
    assert seen["arm.grip.1"].tolist() == [[[0.25, 0.5]]] * 2 and seen["seen_numbers"].tolist() == [[3, 1]] * 2
    assert sorted((float(seen["walker_height"][0].sum()), float(seen["walker_height_2"][0].sum()))) == [0.5, 8]
    assert (seen["rgb"] == torch.from_numpy(RGB)).all()
    said = " ".join(describe(world.spec))
    assert "Left out: crowd (a Sequence), none (it is empty), secret (its space does not declare it), " in said
    assert "goal/hint (a text beside that of the task), info.success (no channel reads it; an adapter can)." in said
    assert "The task of each episode: the text 'goal/mission'." in said
    assert (
        "walker/height is walker_height" in said and "numbers is seen_numbers" in said and "camera/front is rgb" in said
    )

    options = RecordOptions(max_episode_steps=4, pictures="png")
    record(world, Random(world.spec), tmp_path / "r", 40, make_rng(0), options=options)
    dataset = Dataset(tmp_path / "r")
    tasks = {take.task for take in dataset.source().takes()}
    assert tasks == {"go to the red bäll", "go to the blau bäll"}
    assert "left out when it was recorded: crowd (a Sequence)" in examine(tmp_path / "r").notes
    kept = set(dataset.about["channels"])
    assert kept == channels - {"text", "instruction"} and set(dataset.world["left_out"]) >= {
        "crowd",
        "none",
        "goal/hint",
    }


def test_a_text_that_changes_within_an_episode_is_the_instruction_of_the_rows_that_follow(tmp_path):
    class Talking(Plain):
        observation_space = spaces.Dict({"at": spaces.Discrete(99), "says": spaces.Text(20)})
        render_mode = None

        def seen(self):
            return {"at": self.steps, "says": "left" if self.steps < 2 else "right"}

    world = GymnasiumWorld(Talking)
    record(world, Random(world.spec), tmp_path / "r", 4, make_rng(0))
    (take,) = Dataset(tmp_path / "r").source().takes()
    assert [text for _, text in take.facts["language"]] == ["left", "right"]


@pytest.mark.parametrize("dtype", [np.int32, np.uint16, np.float64])
def test_an_observation_of_numbers_up_to_255_is_a_picture(dtype):
    space = spaces.Box(0, 255, RGB.shape, dtype)
    world = GymnasiumWorld(
        type("Plain", (Plain,), {"observation_space": space, "seen": lambda self: RGB.astype(dtype)})
    )
    assert np.array_equal(world.render(world.start(1, make_rng(0)), ("rgb",))["rgb"][0].numpy(), RGB)


def test_further_pictures_of_an_observation_are_cameras(tmp_path):
    class Arm(Plain):
        observation_space = spaces.Dict(
            {
                "pixels": spaces.Dict(
                    {"top": spaces.Box(0, 255, (24, 32, 3), np.uint8), "wrist": spaces.Box(0, 1, (3, 24, 32))}
                ),
                "spare": spaces.Dict({"wrist": spaces.Box(0, 255, (16, 18), np.uint8)}),
                "uneven": spaces.Box(0, 255, (17, 18, 3), np.uint8),
            }
        )

        def seen(self):
            pixels = {"top": RGB, "wrist": RGB.transpose(2, 0, 1).astype(np.float32) / 255}
            return {"pixels": pixels, "spare": {"wrist": GREY[:16, :18]}, "uneven": np.zeros((17, 18, 3), np.uint8)}

    drawn = GymnasiumWorld(Arm)  # it renders a picture, too
    check_world(drawn)
    assert set(drawn.spec.channels) == {"rgb", "rgb.top", "rgb.wrist", "rgb.wrist_2", "uneven", "reward", "done"}
    seen = drawn.render(drawn.start(1, make_rng(0)), ("rgb.wrist", "rgb.wrist_2"))
    assert np.abs(seen["rgb.wrist"][0].numpy().astype(int) - RGB).max() <= 1 and (seen["rgb.wrist_2"] == 200).all()
    small = GymnasiumWorld(type("Arm", (Arm,), {"render_mode": None}), size=(12, 16))
    assert {name: space.shape for name, space in small.spec.channels.items() if "rgb" in name} == {
        "rgb": (12, 16, 3), "rgb.wrist": (12, 16, 3), "rgb.wrist_2": (12, 16, 3)
    }  # fmt: skip
    record(small, Random(small.spec), tmp_path / "r", 4, make_rng(0))
    assert {"observation.images.rgb", "observation.images.wrist"} <= set(Dataset(tmp_path / "r").cameras)


@pytest.mark.parametrize("name", ["Blackjack-v1"])
def test_an_observation_that_is_a_tuple_is_several_channels(name):
    world = GymnasiumWorld(name, rgb=False)
    assert [one for one in world.spec.channels if one.startswith("observation")] == [
        f"observation.{n}" for n in range(3)
    ]
    state = world.start(1, make_rng(3))
    env = gymnasium.make(name)
    hand = env.reset(seed=int(torch.randint(2**31 - 1, (1,), generator=make_rng(3))))[0]
    assert tuple(int(state[f"observation.{n}"]) for n in range(3)) == hand


def test_channels_that_no_file_can_be_named_after_are_recorded_under_another_name(tmp_path):
    adapter = Adapter(
        channels={"arm/height": Channel(lambda env: float(env.steps)), "depth.left/eye": Channel(lambda env: DEPTH)}
    )
    world = GymnasiumWorld(gives(render=None), adapter=adapter)
    said = " ".join(describe(world.spec))
    assert "arm/height is observation.arm_height, depth.left/eye is observation.depth.left_eye" in said
    record(world, Random(world.spec), tmp_path / "r", 4, make_rng(0))
    dataset = Dataset(tmp_path / "r")
    assert dataset.about["channels"]["arm/height"] == "observation.arm_height"
    assert dataset.episode(0)["observation.arm_height"].ravel().tolist() == [0, 1, 2, 3]


def test_an_observation_without_an_entry_that_its_space_declares_is_named():
    class Forgetful(Plain):
        observation_space = spaces.Dict({"at": spaces.Discrete(99), "far": spaces.Discrete(2)})

        def seen(self):
            return {"at": self.steps}

    world = GymnasiumWorld(Forgetful)
    with pytest.raises(TerrellaError, match="observation without 'far', which its space declares"):
        world.start(1, make_rng(0))


@pytest.mark.parametrize("text", ["", "go", "ä" * 600])
def test_a_text_is_kept_as_bytes(text):
    padded = text_to_bytes(text)
    assert padded.shape == (1024,) and bytes_to_text(padded) == text[:512]
    assert not text or np.array_equal(embed(text), embed(text))


def test_a_channel_of_numbers_that_is_called_text_is_recorded_as_numbers(tmp_path):
    adapter = Adapter(channels={"text": Channel(lambda env: np.full(3, env.steps, np.float32))})
    world = GymnasiumWorld(gives(render=None), adapter=adapter)
    record(world, Random(world.spec), tmp_path / "r", 4, make_rng(0))
    dataset = Dataset(tmp_path / "r")
    assert dataset.tasks == ("explore gym:Plain",) and dataset.episode(0)["observation.text"][:, 0].tolist() == [
        0,
        1,
        2,
        3,
    ]
