"""Doom in which things move: monsters, doors, several maps; what is recorded as still does stand still."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from terrella.core import make_rng
from terrella.core.errors import TerrellaError
from terrella.space.camera import project, unproject
from terrella.space.reproject import warp

pytest.importorskip("vizdoom", reason="ViZDoom is not installed: pip install vizdoom")

from terrella.sim.doom import BUTTONS, CAMERA, Doom, DoomConfig, map_origin
from terrella.sim.doom_map import Sectors
from terrella.space.camera import yaw


@pytest.fixture(scope="module")
def maps():
    game = Doom(DoomConfig(scenario="freedoom2/MAP01,MAP02"))
    yield game
    game.close()


def press(game: Doom, *names: str) -> torch.Tensor:
    return torch.tensor([[float(button in names) for button in game.buttons]])


def test_a_scenario_has_what_makes_sense_in_it():
    for scenario, buttons, alive in [
        ("my_way_home", BUTTONS, False),
        ("health_gathering", BUTTONS, True),
        ("defend_the_line", (*BUTTONS, "ATTACK"), True),
    ]:
        game = Doom(DoomConfig(scenario=scenario))
        assert game.spec.action_names == buttons
        assert ("health" in game.spec.channels, "things" in game.spec.channels) == (alive, alive)
        assert ("Space" in game.spec.keys) == ("ATTACK" in buttons)
        game.close()


def test_monsters_hurt_and_can_be_shot():
    """Who stands still in a line of monsters is hurt; who turns to what moves and shoots is paid for a kill."""
    game, rng = Doom(DoomConfig(scenario="defend_the_line")), make_rng(0)
    state, health, paid = game.start(1, rng), [], 0.0
    for _ in range(250):
        seen = game.render(state, ("things", "health"))
        health.append(float(seen["health"]))
        columns = seen["things"][0].any(0).nonzero()[:, 0].float()
        off = float(columns[(columns - 63.5).abs().argmin()] - 63.5) if len(columns) else 0.0
        turn = () if abs(off) < 3 else ("TURN_RIGHT",) if off > 0 else ("TURN_LEFT",)
        state = game.imagine(state, press(game, *turn, "ATTACK"), rng)
        paid += float(game.render(state, ("reward",))["reward"])
    game.close()
    assert health[0] == 100 and min(health) < 100
    assert paid >= 1


def test_what_moves_is_told_apart_by_number_and_place():
    """Each card's pixels lie about the column of its place, within `things`; who goes on being seen keeps the number, and
    comes no further than a monster walks."""
    game, rng = Doom(DoomConfig(scenario="defend_the_line")), make_rng(0)
    state, before, met, kept = game.start(1, rng), {}, 0, 0
    for _ in range(60):
        seen = game.render(state, ("objects", "instances", "things", "pose"))
        rows = (seen["objects"][0, :, 0] > 0).nonzero()[:, 0].tolist()
        assert rows == list(range(len(rows))) and not (seen["instances"].bool() & ~seen["things"]).any()
        where, _ = project(seen["objects"][:, :, 1:], seen["pose"], CAMERA)
        for row in rows:
            columns = (seen["instances"][0] == row + 1).any(0).nonzero()[:, 0].float()
            if len(columns) > 2 and 5 < columns.min() and columns.max() < 122:
                assert abs(float(where[0, row, 0]) * 128 - float(columns.mean()) - 0.5) < max(3, len(columns) / 2)
                met += 1
        now = {float(card[0]): card[1:] for card in seen["objects"][0][: len(rows)]}
        for number in now.keys() & before.keys():
            assert (now[number] - before[number]).norm() < 1.0
            kept += 1
        before = now
        state = game.imagine(state, press(game, "ATTACK"), rng)
    game.close()
    assert met > 50 and kept > 100


def test_who_dies_has_no_health_left():
    game, rng = Doom(DoomConfig(scenario="deadly_corridor")), make_rng(0)
    state = game.start(1, rng)
    for _ in range(400):
        state = game.imagine(state, press(game, "MOVE_FORWARD"), rng)
        seen = game.render(state, ("health", "done", "reward"))
        if seen["done"]:
            break
        assert seen["health"] > 0
    game.close()
    assert seen["done"] and seen["health"] == 0 and seen["reward"] < -50


def test_shots_that_hit_and_who_falls_are_events():
    game, rng = Doom(DoomConfig(scenario="deadly_corridor")), make_rng(0)
    state, hits, fallen = game.start(1, rng), 0, 0
    for _ in range(80):
        seen = game.render(state, ("objects", "pose", "hit", "fallen", "done"))
        hits, fallen = hits + int(seen["hit"]), fallen + int(seen["fallen"])
        if seen["done"]:
            break
        listed = seen["objects"][0][seen["objects"][0, :, 0] > 0]
        apart = (listed[:, 1:3] if len(listed) else torch.ones(1, 2)) - seen["pose"][0, :2]
        nearest = apart[apart.norm(dim=1).argmin()]
        turn = float(torch.atan2(nearest[1], nearest[0]) - yaw(seen["pose"])[0] + torch.pi) % (2 * torch.pi) - torch.pi
        state = game.imagine(
            state, press(game, "TURN_LEFT" if turn > 0.06 else "TURN_RIGHT" if turn < -0.06 else "ATTACK"), rng
        )
    game.close()
    assert hits >= 1 and hits >= fallen


def test_a_frame_is_found_again_in_the_next_where_nothing_moves(maps):
    """Colours carried by depth and pose into the frame three steps later are those that are seen there; far less so by a
    depth that is a third off."""
    rng = make_rng(2)
    state, errors, wrong = maps.start(1, rng), [], []
    for turn in ("TURN_LEFT", "TURN_RIGHT") * 4:
        before = maps.render(state, ("rgb", "depth", "pose", "things"))
        for _ in range(3):
            state = maps.imagine(state, press(maps, "MOVE_FORWARD", turn), rng)
        after = maps.render(state, ("rgb", "depth", "pose", "things"))
        for share, into in ((1.0, errors), (1.5, wrong)):
            colour, agreement, _ = warp(
                before["rgb"].permute(0, 3, 1, 2)[:, None].float(), before["depth"][:, None], before["pose"][:, None],
                after["depth"] * share, after["pose"], CAMERA,
            )  # fmt: skip
            sure = (agreement[0, 0] > (0.9 if share == 1 else -1)) & ~after["things"][0]
            if share == 1:
                assert sure.float().mean() > 0.3
            off = (colour[0, 0].permute(1, 2, 0) - after["rgb"][0].float()).abs().mean(-1)
            into.append(float(off[sure].mean()))
    assert np.median(errors) < 6 and np.median(errors) < 0.6 * np.median(wrong)


def test_the_cast_agrees_with_trying_every_sector_on_every_ray(maps):
    rng = make_rng(5)
    state = maps.start(1, rng)
    for _ in range(4):
        state = maps.imagine(state, press(maps, "TURN_LEFT"), rng)
    walls, (x, y, eye, yaw, _) = maps._walls, (float(v) for v in np.asarray(maps._present.game_variables))
    depth, sector = walls.depth(x, y, eye, np.deg2rad(yaw), CAMERA, (12, 16), 2000.0)
    for row, column in [(2, 3), (5, 8), (8, 12), (11, 1), (6, 15), (0, 9)]:
        side, down = ((column + 0.5) / 16 - 0.5) / 0.5, ((row + 0.5) / 12 - 0.5) / 0.8
        expected = slowly(walls, np.array([x, y]), eye, np.deg2rad(yaw), side, down, 2000.0)
        assert depth[row, column] == pytest.approx(expected, rel=1e-9), (row, column, sector[row, column])


def slowly(
    walls: Sectors, here: np.ndarray, eye: float, yaw: float, side: float, down: float, farthest: float
) -> float:
    """The depth of one ray: for every sector, where it is above or below the ray, or the ray enters it."""
    forward, right = np.array([np.cos(yaw), np.sin(yaw)]), np.array([np.sin(yaw), -np.cos(yaw)])
    along = forward + side * right

    def meets(line) -> float | None:
        a, b = line[:2] - here, line[2:] - here
        edge = b - a
        bottom = along[0] * edge[1] - along[1] * edge[0]
        if bottom == 0:
            return None
        far, at = (a[0] * edge[1] - a[1] * edge[0]) / bottom, (a[0] * along[1] - a[1] * along[0]) / bottom
        return far if far > 0 and 0 <= at < 1 else None

    best, open_air = farthest, False
    for line in walls.lines[walls.solid]:
        best = min(best, meets(line) or farthest)
    for s, (floor, ceiling) in enumerate(walls.heights):
        found = [meets(line) for line in walls.lines[walls.first[s] : walls.first[s + 1]]]
        cuts = sorted(cut for cut in found if cut is not None)
        cuts = [0.0, *cuts] if len(cuts) % 2 else cuts
        for enter, leave in zip(cuts[::2], cuts[1::2]):
            high = eye - down * enter
            hit = enter if not floor < high < ceiling else (eye - (floor if down > 0 else ceiling)) / down
            if hit <= leave and hit < best:
                best, open_air = hit, walls.sky[s] and eye - down * hit > ceiling - 1e-3
    return farthest if open_air else best


def test_what_opens_is_marked_and_its_depth_changes():
    """A made-up room with a gate across it: closed, it hides what lies behind and is a thing; opening, it lets depth through
    and still is one."""
    room = lambda x0, x1, floor, ceiling: FakeSector(x0, x1, floor, ceiling)  # noqa: E731
    began = [room(0, 256, 0, 128), room(256, 288, 0, 0), room(288, 512, 0, 128)]
    walls = Sectors(began, np.zeros(0, bool))
    look = (128.0, 0.0, 41.0, 0.0, CAMERA, (24, 32), 2000.0)
    depth, sector = walls.depth(*look)
    assert (
        depth[11, 16] == pytest.approx(128) and sector[11, 16] == 1 and walls.dynamic().tolist() == [False, True, False]
    )
    walls.update([began[0], room(256, 288, 0, 128), began[2]])
    depth, _ = walls.depth(*look)
    assert depth[11, 16] > 350 and walls.dynamic().tolist() == [False, True, False]


class FakeLine:
    def __init__(self, x1, y1, x2, y2, is_blocking):
        self.x1, self.y1, self.x2, self.y2, self.is_blocking = x1, y1, x2, y2, is_blocking


class FakeSector:
    """A part of a corridor along x, 256 wide; its ends are open to its neighbours, those of the corridor are walls."""

    def __init__(self, x0, x1, floor, ceiling):
        self.floor_height, self.ceiling_height = floor, ceiling
        sides = [(x0, -128, x0, 128), (x1, -128, x1, 128), (x0, -128, x1, -128), (x0, 128, x1, 128)]
        self.lines = [FakeLine(*side, is_blocking=side[0] != side[2] or side[0] in (0, 512)) for side in sides]


def test_each_story_takes_one_of_the_maps_and_each_map_has_its_own_place(maps):
    rng, rooms = make_rng(0), set()
    for _ in range(8):
        x, y, _ = maps.render(maps.start(1, rng), ("pose",))["pose"][0, :3].tolist()
        near = [number for number in (1, 2) if abs(x - map_origin("freedoom2", f"MAP{number:02d}")[0]) < 500]
        assert len(near) == 1 and abs(y) < 500
        rooms.add(near[0])
    assert rooms == {1, 2}
    places = {map_origin("freedoom2", f"MAP{number:02d}") for number in range(1, 33)}
    places |= {map_origin("freedoom1", f"E{episode}M{number}") for episode in range(1, 5) for number in range(1, 10)}
    assert len(places) == 32 + 36


def test_points_of_a_map_lie_on_its_floor(maps):
    """What is seen straight below the horizon is not above the eye; at the start it stands on level ground."""
    rng = make_rng(0)
    seen = maps.render(maps.start(1, rng), ("depth", "pose", "things"))
    points = unproject(seen["depth"], seen["pose"], CAMERA)[0]
    below = ~seen["things"][0] & (torch.arange(96) > 48)[:, None]
    assert (points[below][:, 2] < seen["pose"][0, 2]).all()


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("freedoom2", "none is named.*give freedoom2/MAP01"),
        ("freedoom2/MAP77", "MAP77"),
        ("my_way_home/MAP01", "no maps to choose from; games with maps are freedoom1"),
        ("doom2", "does not include"),
        ("../secrets", "no scenario"),
        ("", "no scenario"),
        ("freedoom2/", "none is named"),
    ],
)
def test_a_map_that_is_not_there_is_refused_in_one_sentence(name, says):
    with pytest.raises(TerrellaError, match=says):
        Doom(DoomConfig(scenario=name))
