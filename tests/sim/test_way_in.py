"""Any environment: what it tells of itself is taken, whatever form it shows itself in, and what is amiss is one sentence."""

from __future__ import annotations

from enum import IntEnum

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.core import make_rng
from terrella.core.errors import TerrellaError
from terrella.core.spec import neutral_action
from terrella.library import load, load_adapter
from terrella.sim.gymnasium import Adapter, Channel, GymnasiumConfig, GymnasiumWorld


class Toy(gymnasium.Env):
    """Counts its steps; shows a picture that is as bright as that."""

    action_space: spaces.Space = spaces.Discrete(3)
    observation_space: spaces.Space = spaces.Box(0, 255, (16, 20), np.uint8)
    metadata = {"render_fps": 25}

    def __init__(self):
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.seen(), self.info()

    def step(self, action):
        self.steps += 1
        return self.seen(), 0.0, False, False, self.info()

    def info(self) -> dict:
        return {"depth": np.full((4, 5), 2.0 + self.steps), "body": {"pose": [self.steps, 0, 0, 1, 0, 0, 0]}}

    def seen(self):
        return np.full((16, 20), self.steps, np.uint8)


class Moves(IntEnum):
    turn_left = 0
    turn_right = 1
    stay = 2
    unused = 3


class WithEnum(Toy):
    actions = Moves


class WithTables(Toy):
    def get_action_meanings(self):
        return ["NOOP", "UP", "DOWN"]

    def get_keys_to_action(self):
        return {"i": 1, ("k",): 2, "n": 0}


def test_names_keys_rest_and_clock_are_the_environments_own():
    enum, tables, nothing = (GymnasiumWorld(each).spec for each in (WithEnum, WithTables, Toy))
    assert enum.action_names == ("turn_left", "turn_right", "stay") and enum.dt_s == 0.04
    assert enum.keys["ArrowLeft"] == [0] and enum.keys["ArrowRight"] == [1] and neutral_action(enum) == 2
    assert tables.keys == {"KeyI": [1], "KeyK": [2]} and tables.card["how"]["keys"] == "get_keys_to_action"
    assert nothing.action_names == () and nothing.card["how"]["action names"] == "without names"


def test_pictures_of_any_form_and_the_parts_of_a_dictionary_are_seen():
    class Many(Toy):
        observation_space = spaces.Dict(
            image=spaces.Box(0, 1, (3, 16, 20), np.float32), speed=spaces.Box(0, 9, (2,)), text=spaces.Text(5)
        )

        def seen(self):
            return {"image": np.full((3, 16, 20), 0.2, np.float32), "speed": [self.steps, 1], "text": "go"}

    for make, brightness in ((Toy, 1), (Many, 51)):
        world, rng = GymnasiumWorld(make), make_rng(0)
        state = world.imagine(world.start(1, rng), torch.tensor([0]), rng)
        rgb = world.render(state, ("rgb",))["rgb"]
        assert rgb.shape == (1, 16, 20, 3) and (rgb == brightness).all()
    assert set(world.spec.channels) == {"rgb", "speed", "reward", "done", "text", "instruction"}
    assert world.render(state, ("speed",))["speed"].tolist() == [[1, 1]]


def test_channels_are_read_off_info_and_attributes(tmp_path):
    (tmp_path / "mine.py").write_text(
        "from terrella.sim.gymnasium import Adapter, Channel\n"
        "adapter = Adapter(channels={'depth': Channel('info.depth', unit='m'), 'pose': Channel('info.body.pose'),\n"
        "                            'age': Channel('unwrapped.steps')}, action_names=('a', 'b', 'c'), idle=(1,))\n"
    )
    world, rng = GymnasiumWorld(Toy, GymnasiumConfig(adapter=load_adapter(f"{tmp_path}/mine.py"))), make_rng(0)
    state = world.start(2, rng)
    state = world.imagine(world.imagine(state, torch.tensor([0, 0]), rng), torch.tensor([0, 0]), rng)
    seen = world.render(state, ("depth", "pose", "age"))
    assert (seen["depth"] == 4).all() and seen["depth"].shape == (2, 4, 5) and seen["age"].tolist() == [2, 2]
    assert seen["pose"][:, 0].tolist() == [2, 2] and neutral_action(world.spec) == 1
    with pytest.raises(
        TerrellaError, match="'depth' of .* cannot be read: there is no 'info.range': the keys are depth, body"
    ):
        GymnasiumWorld(Toy, GymnasiumConfig(adapter=Adapter({"depth": Channel("info.range")})))
    with pytest.raises(TerrellaError, match="has no 'other'"):
        load_adapter(f"{tmp_path}/mine.py:other")


def test_a_module_in_the_working_directory_is_found(tmp_path, monkeypatch):
    (tmp_path / "way_in_toy.py").write_text(
        "import gymnasium, numpy as np\nfrom gymnasium import spaces\n"
        "class Game(gymnasium.Env):\n    action_space = observation_space = spaces.Discrete(2)\n"
        "    def reset(self, *, seed=None, options=None):\n        return 0, {}\n"
        "    def step(self, action):\n        return 0, 0.0, False, False, {}\n"
        "gymnasium.register('WayInToy-v0', Game, max_episode_steps=7)\n"
    )
    monkeypatch.chdir(tmp_path)
    spec = load("gym:way_in_toy:WayInToy-v0").spec
    assert spec.max_episode_steps == 7 and spec.dt_s == 0.1
    with pytest.raises(TerrellaError, match="Python module 'no_such_module' .* pip install"):
        load("gym:no_such_module:Game-v0")
    with pytest.raises(TerrellaError, match="name it: gym:PACKAGE:ID"):
        load("gym:someone/Game-v0")


class Headless(Toy):
    metadata = {"render_modes": ["rgb_array"]}
    render_mode = "rgb_array"
    observation_space = spaces.Discrete(256)

    def seen(self):
        return self.steps

    def render(self):
        raise RuntimeError("GLX: cannot connect to display None")


class Growing(Headless):
    def render(self):
        return np.zeros((16 + self.steps, 16, 3), np.uint8)


class Broken(Toy):
    def reset(self, *, seed=None, options=None):
        raise KeyError("level")


@pytest.mark.parametrize(
    "make, answer",
    [(Headless, "without a display .*MUJOCO_GL=egl"), (Broken, "fails when it is reset.*KeyError: 'level'")],
)
def test_what_does_not_open_says_why(make, answer):
    with pytest.raises(TerrellaError, match=answer):
        GymnasiumWorld(make)


class Falling(Headless):
    """Fails in its 20th step, and when it is drawn after its 10th."""

    def step(self, action):
        if self.steps == 19:
            raise ZeroDivisionError("float division by zero")
        return super().step(action)

    def render(self):
        if self.steps > 10:
            raise IndexError("list index out of range")
        return np.zeros((16, 16, 3), np.uint8)


def test_an_error_of_the_environments_own_is_a_sentence_with_its_name():
    world, rng = GymnasiumWorld(Falling), make_rng(0)
    state = world.start(1, rng)
    for _ in range(19):
        state = world.imagine(state, torch.tensor([0]), rng)
    with pytest.raises(TerrellaError, match="^gym:Falling fails when it is drawn, .*IndexError: list index"):
        world.render(state, ("rgb",))
    with pytest.raises(TerrellaError, match="^gym:Falling fails when it is stepped, .*ZeroDivisionError: float"):
        world.imagine(state, torch.tensor([0]), rng)
    assert world.imagine(world.start(1, rng), torch.tensor([0]), rng)["observation"].shape


def test_pictures_that_change_their_size_are_refused_unless_one_size_is_given():
    world, rng = GymnasiumWorld(Growing), make_rng(0)
    state = world.imagine(world.start(1, rng), torch.tensor([0]), rng)
    with pytest.raises(TerrellaError, match="change their size, from 16x16 to 17x16; .*--size 64 64"):
        world.render(state, ("rgb",))
    world = GymnasiumWorld(Growing, GymnasiumConfig(size=(8, 8)))
    state = world.imagine(world.start(1, rng), torch.tensor([0]), rng)
    assert world.render(state, ("rgb",))["rgb"].shape == (1, 8, 8, 3)
