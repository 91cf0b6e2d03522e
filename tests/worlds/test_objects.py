"""Billboards: they are known again, that wait out of sight, that stand in the way, and that end."""

from __future__ import annotations

from typing import Any

import torch

from terrella.core import chance, make_rng
from terrella.core.state import State
from terrella.space.billboards import PICTURE, cut_out
from terrella.space.camera import planar_pose
from terrella.space.floorplan import NOWHERE, slide
from terrella.worlds.objects import (
    AGE,
    BEFORE,
    GOING,
    LIGHT,
    LOOK,
    NONE,
    NUMBER,
    PLACE,
    RESTED,
    Billboards,
    BillboardsConfig,
    nearest_look,
    new_billboards,
    update_billboards,
)

CAMERA, SIZE = (0.5, 0.8, 0.5, 0.5), (48, 64)
RED, BLUE = 0, 1


def viewer(heading: float = 0.0) -> torch.Tensor:
    one = torch.ones(1)
    return planar_pose(0 * one, 0 * one, one, heading * one)


def two_looks() -> Billboards:
    """A tall red look and a flat blue one; its network is as it was born."""
    torch.manual_seed(0)
    objects = Billboards(BillboardsConfig(actions=3, history=2, looks=4, moves=3, rows=4, starts=1)).eval()
    objects.boxes[:] = 1e3
    for look, (colour, box) in enumerate([((200, 0, 0), (0.4, 0.4, 0, 1.6)), ((0, 0, 200), (0.8, 0.8, 0, 0.4))]):
        objects.pictures[look] = torch.tensor([*colour, 255], dtype=torch.uint8)[:, None, None].expand(4, *PICTURE)
        objects.boxes[look] = torch.tensor(box)
    objects.moves[1] = torch.tensor([0.25, 0.0, 0.0])
    return objects


def sure(objects: Billboards, look: int, move: int, gone: bool = False) -> Billboards:
    """The same, which always tells one thing."""
    for head, wanted in ((objects.next_look, look), (objects.next_move, move), (objects.goes, None)):
        head.weight.data.zero_()
        head.bias.data.fill_(-50.0)
        if wanted is not None:
            head.bias.data[wanted] = 50.0
    objects.goes.bias.data.fill_(50.0 if gone else -50.0)
    return objects


def billboards(objects: Billboards, *places: tuple[float, float, float]) -> torch.Tensor:
    whole = objects.empty(1)
    for row, place in enumerate(places):
        whole[0, row] = new_billboards(row + 1, torch.tensor(place), RED)
    return whole


def step(objects: Billboards, before: torch.Tensor, seen=(True, True, True, True)) -> torch.Tensor:
    return objects.act(
        before,
        torch.tensor([seen]),
        viewer(),
        torch.zeros(1, 2, 3),
        chance.uniforms(chance.seeds(1, make_rng(0)), objects.draws),
    )


def test_a_billboard_does_what_is_told_of_it_and_its_ages_go_on():
    objects = sure(two_looks(), BLUE, 1)
    one = step(objects, billboards(objects, (4.0, 0.0, 0.0)))
    assert one[0, 0, LOOK] == BLUE and one[0, 0, BEFORE] == RED and one[0, 0, AGE] == 0 and one[0, 0, RESTED] == 0
    assert one[0, 0, PLACE].tolist() == [4.25, 0.0, 0.0] and one[0, 0, GOING].tolist() == [0.25, 0.0]
    two = step(objects, one)
    assert two[0, 0, AGE] == 1 and two[0, 0, BEFORE] == RED and two[0, 0, PLACE][0] == 4.5
    assert (two[0, 1:, NUMBER] == 0).all()


def test_what_is_out_of_sight_waits_and_what_is_gone_is_gone():
    objects = sure(two_looks(), BLUE, 1, gone=True)
    there = billboards(objects, (4.0, 0.0, 0.0), (-4.0, 0.0, 0.0))
    after = step(objects, there, (True, False, True, True))
    assert after[0, :, NUMBER].tolist() == [0, 2, 0, 0] and torch.equal(after[0, 1], there[0, 1])


def test_by_chance_as_often_as_told():
    objects = sure(two_looks(), BLUE, 0)
    objects.next_look.bias.data[:2] = torch.tensor([0.0, 1.0986])  # one to three
    many, rng = billboards(objects, (4.0, 0.0, 0.0)).expand(800, -1, -1), make_rng(1)
    seen = torch.ones(800, 4, dtype=torch.bool)
    looks = objects.act(
        many,
        seen,
        viewer().expand(800, 7),
        torch.zeros(800, 2, 3),
        chance.uniforms(chance.seeds(800, rng), objects.draws),
    )[:, 0, LOOK]
    assert abs(float((looks == BLUE).float().mean()) - 0.75) < 0.05
    again = objects.act(
        many,
        seen,
        viewer().expand(800, 7),
        torch.zeros(800, 2, 3),
        chance.uniforms(chance.seeds(800, make_rng(1)), objects.draws),
    )[:, 0, LOOK]
    assert torch.equal(looks, again)


def shown(objects: Billboards, there: torch.Tensor):
    """What evidence tells of a frame with these billboards: its cut, and number and place of each."""
    behind = torch.full((1, 3, *SIZE), 0.3), torch.full((1, *SIZE), 9.0)
    rgb, depth, instances = objects.painted(there, *behind, viewer(), CAMERA)
    listed = there[..., :4]
    return cut_out((rgb * 255).to(torch.uint8), instances, depth, listed[..., PLACE], viewer(), CAMERA), listed


def test_what_was_painted_is_recognised_by_its_look_and_its_light():
    objects = two_looks()
    there = billboards(objects, (4.0, 1.0, 0.0), (5.0, -1.5, 0.0))
    there[0, 1, LOOK], there[0, 0, LIGHT] = BLUE, 0.5
    found = objects.match_evidence(*shown(objects, there), objects.empty(1))
    assert torch.equal(found[..., :5], there[..., :5]) and (found[0, 2:] == 0).all()
    assert 0.35 < found[0, 0, LIGHT] < 0.6 and 0.7 < found[0, 1, LIGHT] < 1.1


def test_a_billboard_keeps_its_own_past_and_what_is_not_told_of_waits():
    objects = two_looks()
    before = billboards(objects, (4.0, 1.0, 0.0), (5.0, -1.5, 0.0))
    before[0, :2, NUMBER] = torch.tensor([7.0, 9.0])
    now = billboards(objects, (5.0, -1.25, 0.0))
    now[0, 0, NUMBER] = 9.0
    found = objects.match_evidence(*shown(objects, now), before)
    assert found[0, :, NUMBER].tolist() == [9, 7, 0, 0]
    assert found[0, 0, GOING].tolist() == [0.0, 0.25] and torch.equal(found[0, 1], before[0, 0])


def test_who_stands_upright_stops_a_body_and_who_is_walked_through_does_not():
    objects = two_looks()
    objects.solid[RED] = 1.0
    there = billboards(objects, (2.0, 0.0, 0.0))
    place, wish = torch.zeros(1, 2), torch.tensor([[3.0, 0.0]])
    moved, _ = slide(bodies(objects, there, 1.3)[0], place, wish, 0.5)
    assert abs(float(moved[0, 0]) - 1.0) < 1e-3
    assert (bodies(objects, there, 4.3) == NOWHERE).all()  # a floor below
    there[0, 0, LOOK] = BLUE
    assert (bodies(objects, there, 1.3) == NOWHERE).all()


def bodies(objects: Billboards, there: torch.Tensor, height: float) -> torch.Tensor:
    pose = planar_pose(*torch.tensor([[0.0], [0.0], [height], [0.0]]))
    return objects.bodies(State({"billboards": there, "pose": pose}), 0.5)


def test_evidence_of_a_batch_is_taken_as_each_alone():
    """Known again, new, seen in part or not at all, in rows of their own: as many episodes at once as one by one."""
    objects, rng = two_looks(), make_rng(3)
    before = torch.stack(
        [billboards(objects, *(3 + 3 * torch.rand(4, 3, generator=rng)).tolist())[0] for _ in range(6)]
    )
    before[..., NUMBER] = torch.stack([torch.randperm(9, generator=rng)[:4] for _ in range(6)])
    now = torch.stack(
        [billboards(objects, *((-2 + 4 * torch.rand(3, 3, generator=rng)).tolist()))[0] for _ in range(6)]
    )
    now[..., :3, NUMBER] = torch.stack([torch.randperm(9, generator=rng)[:3] for _ in range(6)]).float()
    now[..., :3, 1] = torch.tensor([3.0, 4.0, 5.0])
    behind = torch.full((6, 3, *SIZE), 0.3), torch.full((6, *SIZE), 9.0)
    pose = viewer().expand(6, 7)
    rgb, depth, instances = objects.painted(now, *behind, pose, CAMERA)
    listed = now[..., :4]
    cut = cut_out((rgb * 255).to(torch.uint8), instances, depth, listed[..., PLACE], pose, CAMERA)
    whole = objects.match_evidence(cut, listed, before)
    for n in range(6):
        picked = slice(n, n + 1)
        parts = (rgb[picked] * 255).to(torch.uint8), instances[picked], depth[picked], listed[picked][..., PLACE]
        alone = objects.match_evidence(cut_out(*parts, viewer(), CAMERA), listed[picked], before[picked])
        assert torch.allclose(alone[0], whole[n], atol=1e-4)
        kept = set(before[n, :, NUMBER].tolist()) | set(listed[n, :, 0].tolist())
        assert set(whole[n, :, NUMBER].tolist()) <= kept


def test_what_is_lit_more_than_its_picture_does_not_turn_dark():
    objects = two_looks()
    there = billboards(objects, (4.0, 0.0, 0.0))
    there[0, 0, LIGHT] = 4.0
    rgb, _, seen = objects.painted(there, torch.zeros(1, 3, *SIZE), torch.full((1, *SIZE), 9.0), viewer(), CAMERA)
    assert seen.any() and rgb.max() == 1.0


def test_a_look_lasts_unless_another_is_clearly_nearer():
    off = torch.tensor([0.30, 0.20, 2.0])
    assert (
        nearest_look(off, NONE) == 1
        and nearest_look(off, 0) == 0
        and nearest_look(torch.tensor([0.5, 0.2, 2.0]), 0) == 1
    )
    assert nearest_look(torch.tensor([0.9, 0.8, 2.0]), 0) == NONE


def test_a_look_that_is_not_known_is_not_painted():
    objects = two_looks()
    there = billboards(objects, (4.0, 0.0, 0.0))
    there[0, 0, LOOK] = NONE
    behind = torch.full((1, 3, *SIZE), 0.3), torch.full((1, *SIZE), 9.0)
    assert not objects.painted(there, *behind, viewer(), CAMERA)[2].any()
    assert torch.isfinite(step(objects, there)).all()


def test_ages_are_counted_to_a_limit():
    one = new_billboards(1, torch.zeros(3), RED)[None]
    for _ in range(40):
        one = update_billboards(one, torch.zeros(1, 3), torch.tensor([float(RED)]))
    assert one[0, AGE] == one[0, RESTED] == 24


def test_what_was_solid_and_never_is_again_has_fallen():
    """Looks 0 and 1 stand and follow each other, 2 falls to 3; a corpse that may rise (0 after 3) is not down."""
    objects = two_looks()
    objects.solid[:] = torch.tensor([1.0, 1.0, 0.0, 0.0])
    objects.follows[:] = False
    for one, other in ((0, 1), (1, 0), (1, 2), (2, 3), (3, 3)):
        objects.follows[one + 1, other] = True
    assert objects.down.tolist() == [False, False, True, True]
    objects.follows[4, 0] = True
    assert not objects.down.any()


def test_a_change_that_the_actions_caused_is_a_hit_and_another_is_not():
    objects: Any = two_looks()
    objects.solid[:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    objects.follows[:] = True
    objects.think[0].weight.data.zero_()
    objects.think[0].bias.data.zero_()
    objects.think[0].weight.data[0, -1] = 50.0  # the newest aimed action alone is heard
    for layer in (objects.think[3], objects.next_look):
        layer.weight.data.zero_()
        layer.bias.data.zero_()
    objects.think[3].weight.data[0, 0], objects.next_look.weight.data[BLUE, 0] = 1.0, 1.0
    objects.next_look.bias.data[RED] = 10.0
    blue = torch.full((1, 4), float(BLUE))
    before = billboards(objects, (4.0, 0.0, 0.0))
    for act, hit in ((1.0, True), (0.0, False)):
        acts = torch.zeros(1, 2, 3)
        acts[0, -1, -1] = act
        after = update_billboards(before, before[..., PLACE], blue)
        state = State({"billboards_before": before, "billboards": after, "pose": viewer(), "actions": acts})
        shown = objects.render(state, ("hit", "fallen"))
        assert (bool(shown["hit"]), bool(shown["fallen"])) == (hit, False)
