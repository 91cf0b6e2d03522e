"""Laws over pictures: what moves is tracked to hundredths of a pixel, and injected violations are seen in pictures alone."""

import dataclasses

import pytest
import torch

from terrella.core import make_rng, rollout
from terrella.core.errors import TerrellaError
from terrella.core.policy import Idle
from terrella.data import record
from terrella.physics import PhysicalSystem, calibrate
from terrella.physics.constants import CONSTANTS
from terrella.physics.laws.permanence import Permanence
from terrella.physics.tracker import fit_tracker
from terrella.physics.tracks import fit_tracked
from terrella.sim.bodies import BodiesConfig, BodiesWorld
from terrella.workflows.check import CheckConfig, check

DT_S = 0.025


def film(family: str, seed: int, batch: int, steps: int = 24):
    """(the world, its system, pictures [T + 1, B, H, W, 3], places [T + 1, B, N, 2], velocities)."""
    world = BodiesWorld(family)
    waits = torch.zeros(steps, batch, dtype=torch.long)
    seen = rollout(
        world, world.start(batch, make_rng(seed)), waits, make_rng(0), ("position", "velocity", "rgb")
    ).observations
    parts = (seen[name].double().unflatten(2, (world.family.bodies, 2)) for name in ("position", "velocity"))
    return world, PhysicalSystem.from_json(world.spec.system), seen["rgb"], *parts


def discs(places, colours, side: int = 48) -> torch.Tensor:
    """Pictures uint8 [T, 1, side, side, 3] of discs of radius 3 at places [T][N] (x, y) in pixels; None: not there."""
    x = torch.arange(side) + 0.5
    picture = torch.full((len(places), side, side, 3), 20.0)
    for row, some in zip(picture, places):
        for place, colour in zip(some, colours):
            if place is not None:
                away = ((x[None, :] - place[0]) ** 2 + (x[:, None] - place[1]) ** 2).sqrt()
                cover = (3.5 - away).clamp(0, 1)[..., None]
                row.copy_(row * (1 - cover) + cover * torch.tensor(colour))
    return picture.round().to(torch.uint8)[:, None]


def test_things_are_tracked_and_measured_in_metres():
    _, system, pictures, places, speeds = film("bouncing", 1, 8, 30)
    tracked = fit_tracked(pictures, DT_S, system, places)
    assert tracked.scale.metres_per_pixel == pytest.approx(2.4 / 64, rel=1e-3)
    motion, whole = tracked.trajectory(pictures, DT_S, places[0])
    assert bool(whole.all())
    assert float((motion.position[:, :, :1, [0, 2]] - places).norm(dim=-1).max()) < 0.1 * 2.4 / 64
    wrong = (motion.velocity[3:-3, :, :1, [0, 2]] - speeds[3:-3]).norm(dim=-1)
    assert float(wrong.median()) < 0.005 and float(wrong.quantile(0.97)) < 0.05


def test_constants_are_measured_from_pictures():
    _, system, pictures, places, _ = film("bouncing", 2, 8, 30)
    motion, _ = fit_tracked(pictures, DT_S, system, places).trajectory(pictures, DT_S, places[0])
    motion = motion.between(3, 28)
    assert float(CONSTANTS["gravity"].estimate(motion).nanmean()) == pytest.approx(9.81, rel=0.01)
    assert float(CONSTANTS["restitution"].estimate(motion).nanmean()) == pytest.approx(0.8, rel=0.02)


def test_bodies_keep_their_names_through_a_collision():
    _, system, pictures, places, _ = film("collision", 3, 6, 30)
    motion, _ = fit_tracked(pictures, DT_S, system, places).trajectory(pictures, DT_S, places[0])
    assert float((motion.position[:, :, :2, [0, 2]] - places).norm(dim=-1).max()) < 0.2 * 4 / 64


def test_a_half_gravity_is_seen_in_pictures():
    world, system, pictures, places, _ = film("bouncing", 1, 16, 18)
    tracked = fit_tracked(pictures, DT_S, system, places)
    fall = next(
        one
        for one in calibrate(tracked.trajectory(pictures, DT_S, places[0])[0].between(3, 16))
        if one.law.name == "free fall"
    )
    assert not fall.wrong_here
    time_s = torch.arange(19)[:, None, None] * DT_S
    slow = places.clone()
    slow[..., 1] = places[0, ..., 1] - 0.25 * 9.81 * time_s**2
    radius = torch.full((16, 1), 0.1)
    shown = [
        world.observe({"position": row.flatten(1), "velocity": torch.zeros(16, 2), "radius": radius}, None, make_rng(0))
        for row in slow
    ]
    films = torch.stack([world.render(state, ("rgb",))["rgb"] for state in shown])
    motion = tracked.trajectory(films, DT_S, slow[0])[0].between(3, 16)
    assert float((fall.law.residual(motion).amax(0) > fall.value).double().mean()) > 0.9


def test_what_vanishes_or_appears_in_pictures_breaks_permanence():
    colours = ((250.0, 250.0, 250.0), (40.0, 200.0, 60.0))
    path = [[(8.0 + step, 12.0), (40.0 - step, 30.0)] for step in range(12)]
    tracker = fit_tracked(discs(path, colours), DT_S, metres_per_pixel=0.1)
    assert float(Permanence().residual(tracker.trajectory(discs(path, colours), DT_S)[0]).max()) == 0
    gone = [[one, None] if step > 6 else [one, two] for step, (one, two) in enumerate(path)]
    assert float(Permanence().residual(tracker.trajectory(discs(gone, colours), DT_S)[0])[-1]) == 1
    more = [[one, two, (24.0, 40.0) if step > 6 else None] for step, (one, two) in enumerate(path)]
    assert float(Permanence().residual(tracker.trajectory(discs(more, (*colours, colours[0])), DT_S)[0])[-1]) == 1


def test_things_of_one_colour_that_touch_stay_two():
    white = (250.0, 250.0, 250.0)
    path = [[(10.0 + step, 20.0), (38.0 - step, 25.0)] for step in range(28)]
    tracks = fit_tracker(discs(path, (white, white))[:, 0]).follow(discs(path, (white, white)))
    assert bool(tracks.present.all()) and int(tracks.others.max()) == 0
    assert float((tracks.place[:, 0] - torch.tensor(path)).norm(dim=-1).max()) < 1.0


def test_masks_show_a_thing_that_mostly_lies_still_on_a_background_of_many_colours():
    colour = (40.0, 200.0, 60.0)
    path = [[(30.0, 20.0)]] * 24 + [[(30.0 - step, 20.0 + step)] for step in range(12)]
    pictures = discs(path, (colour,))
    masks = (pictures[..., 1] > 110).long()
    tiles = 60 * (torch.arange(48)[:, None, None] // 6 % 2) * torch.tensor([1.0, 0.2, 1.0])
    pictures = torch.where(masks[..., None] > 0, pictures, tiles.to(torch.uint8).expand_as(pictures))
    places = torch.tensor(path, dtype=torch.double)
    tracks = fit_tracked(pictures, DT_S, metres_per_pixel=0.1, masks=masks).tracker.follow(pictures)
    assert bool(tracks.present.all()) and int(tracks.others.max()) == 0
    assert float((tracks.place[:, 0] - places).norm(dim=-1).max()) < 0.3
    blind = fit_tracked(
        pictures, DT_S, metres_per_pixel=0.1
    ).tracker.background  # without masks it is a part of the background
    assert (blind[20, 30] - torch.tensor(colour)).norm() < 32
    with pytest.raises(TerrellaError, match="nothing moves in the recorded masks"):
        fit_tracked(pictures, DT_S, metres_per_pixel=0.1, masks=torch.zeros_like(masks))


def test_the_scale_comes_from_things_that_fall():
    _, _, pictures, _, _ = film("parabola", 1, 16, 16)
    assert fit_tracked(pictures, DT_S).scale.metres_per_pixel == pytest.approx(6 / 64, rel=0.02)


def test_bad_pictures_get_a_sentence():
    _, system, pictures, places, _ = film("uniform", 1, 8, 12)
    with pytest.raises(TerrellaError, match="nothing says how large a pixel is"):
        fit_tracked(pictures, DT_S)
    with pytest.raises(TerrellaError, match="disagree by"):
        fit_tracked(pictures, DT_S, system, places.flip(0))
    given = fit_tracked(pictures, DT_S, system, places.flip(0), metres_per_pixel=0.01)  # what that error advises
    assert given.scale.metres_per_pixel == pytest.approx(0.01) and given.system.bodies[0].name == "thing 1"
    with pytest.raises(TerrellaError, match="nothing moves"):
        fit_tracked(pictures[:1, :1].expand(6, 2, -1, -1, -1), DT_S, system, places)
    with pytest.raises(TerrellaError, match="does the camera move"):
        fit_tracked(torch.randint(0, 256, (6, 2, 32, 32, 3), dtype=torch.uint8), DT_S, system, places)


def test_check_judges_pictures(tmp_path):
    world = BodiesWorld("bouncing", BodiesConfig(segmentation=True))
    record(world, Idle(world.spec), tmp_path / "rec", 520, make_rng(0))
    config = CheckConfig(tmp_path / "rec", pictures=True, out=tmp_path, steps=16, rollouts=8, fresh=True)
    result = check("physics:bouncing", config)
    assert result.report.coarse_horizon.value == 16
    assert (
        "Judged by pictures: ball 1 tracked, found by the recorded masks, 0.0375 m a pixel (fitted to recorded positions)"
        in result.summary()
    )
    assert "The truth above, the world below" in (tmp_path / "check.html").read_text()
    with pytest.raises(TerrellaError, match="--metres-per-pixel is above 0"):
        check("physics:bouncing", CheckConfig(tmp_path / "rec", metres_per_pixel=0.0))
    with pytest.raises(TerrellaError, match="judged by its numbers"):
        check("physics:bouncing", CheckConfig(tmp_path / "rec", metres_per_pixel=0.01))
    config = dataclasses.replace(config, metres_per_pixel=0.05)
    assert (
        "thing 1 tracked, found by the recorded masks, 0.05 m a pixel (as given)"
        in check("physics:bouncing", config).summary()
    )
