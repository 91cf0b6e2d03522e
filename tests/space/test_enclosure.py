"""Colliders of places of which only Gaussians are known: holes, edges, haze, and what counts as indoors."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from terrella import load
from terrella.cli import main
from terrella.space.enclosure import enclosed, kind_of_place
from terrella.space.files import write_scene
from terrella.space.kernels_numba.flood import floors
from terrella.space.occupancy import Occupancy, Walker
from terrella.space.raster import Gaussians, join
from terrella.space.raster.gaussians import plain_sh
from terrella.workflows.splat_places import open_splat
from terrella.worlds import collider_file
from terrella.worlds.collider_file import COLLIDER_FILE
from terrella.worlds.splat import SplatWorld
from terrella.worlds.splat_folder import write_edits

BODY, EYE = Walker(), torch.tensor([[2.0, 2.0, 1.6]])


def slab(low, high, step=0.08) -> Gaussians:
    """Round Gaussians all over a box."""
    axes = [torch.arange(a, b + 1e-6, step) for a, b in zip(low, high)]
    means = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    count = len(means)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4)
    return Gaussians(
        means, quats, torch.full((count, 3), 0.05), torch.full((count,), 0.95), plain_sh(torch.rand(count, 3))
    )


def without(place: Gaussians, low, high) -> Gaussians:
    inside = ((place.means > torch.tensor(low)) & (place.means < torch.tensor(high))).all(1)
    return place.at(~inside)


@pytest.fixture(scope="module")
def room() -> Gaussians:
    """A room of 4 x 4 x 2.6 m with a hole in its floor, and without its wall at x = 4."""
    floor, roof = without(slab((0, 0, 0), (4, 4, 0)), (2.6, 2.6, -1), (3.3, 3.3, 1)), slab((0, 0, 2.6), (4, 4, 2.6))
    walls = [slab((0, 0, 0), (0, 4, 2.6)), slab((0, 0, 0), (4, 0, 2.6)), slab((0, 4, 0), (4, 4, 2.6))]
    return join([floor, roof, *walls])


def walked(place: Occupancy, way, steps=120, start=EYE) -> torch.Tensor:
    here = start
    for _ in range(steps):
        here = place.walk(here, torch.tensor([[*way, 0.0]]), BODY)
    return here[0]


def test_a_floor_goes_on_over_holes_and_ends_a_metre_beyond_what_is_known(room):
    plain, closed = (enclosed(room, EYE, kind, BODY) for kind in ("open", "indoor"))
    over = torch.tensor([[2.95, 2.95, 1.6]])
    assert plain.surface(over, BODY).isnan() and closed.surface(over, BODY).abs() < 0.11
    assert walked(plain, (0.1, 0))[0] > 10  # out of the open side, into nothing
    assert 4.1 < walked(closed, (0.1, 0))[0] < 5.2
    assert closed.surface(torch.tensor([[4.3, 2.0, 1.6]]), BODY).abs() < 0.11
    for way in ((-0.1, 0), (0, 0.1), (0, -0.1)):
        assert torch.allclose(walked(plain, way), walked(closed, way), atol=0.11)


def test_a_soft_table_top_through_which_the_floor_shines_stops_walkers(room):
    top = slab((0.8, 1.2, 0.75), (1.4, 2.8, 0.75))
    soft = replace(top, opacities=torch.full((len(top),), 0.5))
    closed = enclosed(join([room, soft]), EYE, "indoor", BODY)
    assert bool(closed.blocked(torch.tensor([[1.1, 2.0, 1.6]]), BODY)) and walked(closed, (-0.1, 0))[0] > 1.4


def test_haze_of_fits_stops_nobody_where_one_begins_nor_on_the_way(room):
    haze = join([room, slab((2.2, 2.0, 0.7), (2.25, 2.05, 0.8)), slab((1.0, 1.9, 1.0), (1.05, 1.95, 1.1))])
    plain, closed = (enclosed(haze, EYE, kind, BODY) for kind in ("open", "indoor"))
    assert bool(plain.blocked(EYE, BODY)) and not bool(closed.blocked(EYE, BODY))
    assert walked(plain, (-0.1, 0), start=torch.tensor([[1.6, 1.95, 1.6]]))[0] > 1.2
    assert walked(closed, (-0.1, 0))[0] < 0.4
    pillar = enclosed(join([room, slab((1.0, 1.0, 0.0), (1.0, 3.0, 1.5))]), EYE, "indoor", BODY)
    assert walked(pillar, (-0.1, 0))[0] > 1.2  # what is larger stays


@pytest.mark.parametrize("high_m", [0.5, 1.0, 2.4])
def test_a_floor_lies_where_it_is_wherever_above_it_one_looks_from(room, high_m):
    deep = join([room, slab((5, 5, -3), (6, 6, -3))])  # the grid goes on below the floor
    closed = enclosed(deep, torch.tensor([[2.0, 2.0, high_m]]), "indoor", BODY)
    assert closed.surface(torch.tensor([[2.95, 2.95, 1.6]]), BODY).abs() < 0.11
    assert 4.1 < walked(closed, (0.1, 0))[0] < 5.2


def test_one_comes_down_from_a_table_and_into_the_room():
    table, floor = slab((1.5, 1.5, 0.75), (2.5, 2.5, 0.75)), slab((0, 0, 0), (6, 6, 0))
    sides = [slab((0, 0, 0), (0, 6, 2.9)), slab((6, 0, 0), (6, 6, 2.9)), slab((0, 0, 2.9), (6, 6, 2.9))]
    closed = enclosed(join([table, floor, *sides]), torch.tensor([[2.0, 2.0, 2.35]]), "indoor", BODY)
    assert closed.surface(torch.tensor([[3.2, 2.0, 2.35]]), BODY).abs() < 0.11
    assert walked(closed, (0.1, 0), start=torch.tensor([[2.0, 2.0, 2.35]]))[0] > 5.3


def test_floors_of_a_large_place_take_little_memory():
    field = np.zeros((1500, 1500, 6), bool)
    field[:, :, 1] = True
    level, away = floors(field, np.array([700, 700, 1]), 2, 2, 3, 1500)  # was 27 GB
    assert (level == 1).all() and not away.any()


def test_soft_gaussians_do_not_fill_the_room(room):
    haze = slab((0.5, 0.5, 0.3), (3.5, 3.5, 2.2), 0.3)
    thin = {"opacities": torch.full_like(haze.opacities, 0.32), "scales": haze.scales * 0.6}
    soft = join([room, replace(haze, **thin)])
    spots = 0.6 + 2.8 * torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    spots[:, 2] = 1.6
    said = {kind: enclosed(soft, EYE, kind, BODY).blocked(spots, BODY).float().mean() for kind in ("open", "indoor")}
    assert said["open"] > 0.3 and said["indoor"] < 0.02


def test_what_no_flood_reaches_is_solid():
    ends = [((1, 1, 0), (2, 2, 0)), ((1, 1, 1), (2, 2, 1)), ((1, 1, 0), (1, 2, 1))]
    ends += [((2, 1, 0), (2, 2, 1)), ((1, 1, 0), (2, 1, 1)), ((1, 2, 0), (2, 2, 1))]
    crate = join([slab(low, high) for low, high in ends])
    middle = torch.tensor([[1.5, 1.5, 0.5]])
    assert not Occupancy.of(crate).holds(middle)
    whole = enclosed(crate, EYE, "object", BODY)
    assert whole.holds(middle) and not whole.holds(torch.tensor([[0.75, 1.5, 0.5]]))
    assert kind_of_place(Occupancy.of(crate), torch.tensor([1.5, 1.5, 1.6])) == "object"


def test_auto_tells_indoors_from_outdoors(room):
    assert kind_of_place(Occupancy.of(room), EYE[0]) == "indoor"
    field = slab((0, 0, 0), (8, 8, 0), 0.1)
    assert kind_of_place(Occupancy.of(field), torch.tensor([4.0, 4, 1.6])) == "outdoor"


@pytest.mark.exact
def test_an_imported_place_is_closed_and_a_wrong_point_is_refused(tmp_path, room, capsys):
    write_scene(room, tmp_path / "room.ply")
    given = ["space", "import", str(tmp_path / "room.ply"), "--out", str(tmp_path / "w")]
    assert main([*given, "--inside", "2", "2", "1.6"]) == 0
    assert "collider: indoor" in capsys.readouterr().out
    world = load(tmp_path / "w")
    assert isinstance(world, SplatWorld) and world.config.collider == "indoor"
    assert (world.starts[0, :2] - 2).norm() < 0.5
    assert 4.1 < walked(world.occupancy, (0.1, 0))[0] < 5.2
    assert main([*given, "--collider", "open"]) == 0
    again = load(tmp_path / "w")
    assert isinstance(again, SplatWorld) and again.config.collider == "open"
    assert main([*given, "--inside", "90", "2", "1.6"]) == 2
    assert "--inside 90 2 1.6 is not in free space" in capsys.readouterr().err


@pytest.mark.exact
def test_a_collider_is_computed_once_and_anew_after_an_edit(tmp_path, room, monkeypatch):
    write_scene(room, tmp_path / "room.ply")
    assert main(["space", "import", str(tmp_path / "room.ply"), "--out", str(tmp_path / "w")]) == 0
    opened = lambda: open_splat(str(tmp_path / "w")).occupancy  # noqa: E731
    first, calls = opened(), []
    monkeypatch.setattr(collider_file, "enclosed", lambda *given: calls.append(1) or enclosed(*given))
    again = opened()
    assert not calls and torch.equal(again.solid, first.solid) and torch.equal(again.origin, first.origin)
    assert torch.equal(again.top[first.solid], first.top[first.solid]) and again.cell_m == first.cell_m
    write_edits(tmp_path / "w", [{"select": {"sphere": [2, 2, 0, 1]}, "do": "move", "by": [0, 0, 1.0]}])
    edited = opened()
    assert len(calls) == 1 and not torch.equal(edited.solid, first.solid) and torch.equal(opened().solid, edited.solid)
    write_edits(tmp_path / "w", [])
    assert torch.equal(opened().solid, first.solid) and len(calls) == 1  # that without edits is kept beside it
    (tmp_path / "w" / COLLIDER_FILE).write_bytes(b"damaged")
    assert torch.equal(opened().solid, first.solid) and torch.equal(opened().solid, first.solid) and len(calls) == 2
