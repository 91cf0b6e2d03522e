"""The distance is what mathematics says, the shipped eye sees what people see, and blur does not win."""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
from pathlib import Path

import numpy as np
import panorama
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from safetensors import safe_open
from safetensors.torch import save

import terrella
from terrella.core import make_rng
from terrella.core.errors import TerrellaError
from terrella.measure import PROBES, ExamConfig, encoder, page, to_json
from terrella.measure.encoder import FEATURES, FrameEncoder, encoder_of, frame_features, shipped_encoder
from terrella.measure.fidelity import blurred, psnr
from terrella.measure.frechet import frechet, frechet_interval, frechet_of_moments


def draw(n: int, d: int, seed: int) -> torch.Tensor:
    """Features [n, d], correlated and of falling spread."""
    rng = make_rng(seed)
    mix = torch.randn(d, d, generator=rng, dtype=torch.float64) * torch.logspace(0, -2, d)
    return torch.randn(n, d, generator=rng, dtype=torch.float64) @ mix


# --- the distance -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("d", [1, 3, 24])
def test_gaussians_of_one_basis_have_a_closed_form(d):
    rng = make_rng(d)
    basis = torch.linalg.qr(torch.randn(d, d, generator=rng, dtype=torch.float64)).Q
    a, b = torch.rand(2, d, generator=rng, dtype=torch.float64) * 3
    a[0] = 0  # no spread at all in one direction
    shift = torch.randn(d, generator=rng, dtype=torch.float64)
    covs = [basis @ torch.diag(spread.square()) @ basis.T for spread in (a, b)]
    found = frechet_of_moments(torch.zeros_like(shift), covs[0], shift, covs[1])
    expected = float(shift.square().sum() + (a - b).square().sum())
    assert float(found) == pytest.approx(expected, rel=1e-6)  # the root of a rounded zero is 1e-8 off


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 12), st.integers(2, 30), st.integers(2, 30), st.integers(0, 10**6))
def test_the_slow_twin_takes_eigenvalues_of_the_plain_product(d, n, m, seed):
    a, b = draw(n, d, seed), draw(m, d, seed + 1) + 0.3
    roots = torch.linalg.eigvals(torch.cov(a.T) @ torch.cov(b.T)).real.clamp_min(0).sqrt().sum()
    slow = (a.mean(0) - b.mean(0)).square().sum() + a.var(0).sum() + b.var(0).sum() - 2 * roots
    scale = float(a.var(0).sum() + b.var(0).sum())
    assert float(frechet(a, b)) == pytest.approx(float(slow), abs=1e-6 * scale)  # the twin loses half of its digits
    assert float(frechet(b, a)) == pytest.approx(float(frechet(a, b)), abs=1e-9 * scale)


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 20), st.integers(2, 40), st.floats(0.01, 100), st.integers(0, 10**6))
def test_nothing_from_itself_and_only_the_shift_from_its_shifted_self(d, n, scale, seed):
    a = draw(n, d, seed) * scale
    size = float(a.var(0).sum())
    assert float(frechet(a, a)) <= 1e-9 * size
    assert float(frechet(a, a + scale)) == pytest.approx(d * scale**2, rel=1e-6, abs=1e-9 * size)


def test_batches_are_the_figures_one_by_one():
    a, b = draw(3 * 20, 5, 0).reshape(3, 20, 5), draw(3 * 30, 5, 1).reshape(3, 30, 5)
    assert torch.allclose(frechet(a, b), torch.stack([frechet(x, y) for x, y in zip(a, b)]))


def test_the_bias_of_small_sets_is_taken_off_and_the_interval_holds_the_truth():
    plain, found = [], []
    for seed in range(12):
        rng = make_rng(seed)
        real = torch.randn(50, 24, generator=rng, dtype=torch.float64)
        dreamt = 1.3 * torch.randn(50, 24, generator=rng, dtype=torch.float64) + 0.1
        plain.append(float(frechet(real, dreamt)))
        found.append(frechet_interval(real, dreamt))
    truth = 24 * (0.1**2 + 0.3**2)
    assert np.mean(plain) > 2 * truth
    assert np.mean([figure.value for figure in found]) == pytest.approx(truth, rel=0.15)
    assert sum(figure.low <= truth <= figure.high for figure in found) >= 10


def test_more_than_fifty_rows_are_joined_the_same_way_each_time():
    real, dreamt = draw(200, 4, 0), draw(200, 4, 1)
    assert frechet_interval(real, dreamt) == frechet_interval(real, dreamt)


def test_few_clips_have_no_interval_and_two_have_no_distance():
    few = frechet_interval(draw(5, 3, 0), draw(5, 3, 1))
    assert math.isfinite(few.value) and math.isnan(few.low)
    assert math.isnan(frechet_interval(draw(2, 3, 0), draw(2, 3, 1)).value)


# --- the eye ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def game() -> torch.Tensor:
    """100 real frames of Doom, uint8 [100, 96, 128, 3]: keyframes that the bundled world carries."""
    path = Path(terrella.__file__).parent / "bundled" / "doom-maze" / "memory.safetensors"
    with safe_open(path, "np") as file:
        data, ends = file.get_tensor("memory.rgb_bytes").tobytes(), file.get_tensor("memory.rgb_ends")
    spans = list(zip([0, *ends[:-1]], ends))[::6][:100]
    pictures = [Image.open(io.BytesIO(data[a:b])).resize((128, 96), Image.Resampling.BOX) for a, b in spans]
    return torch.from_numpy(np.stack([np.asarray(picture.convert("RGB")) for picture in pictures]))


@pytest.fixture(scope="module")
def plain(game) -> torch.Tensor:
    return frame_features(game[::2])


@pytest.fixture(scope="module")
def halves(game, plain):
    return frechet_interval(plain, frame_features(game[1::2]))


def noisy(frames: torch.Tensor, size: float) -> torch.Tensor:
    grain = torch.randn(frames.shape, generator=make_rng(0))
    return (frames + size * grain).round().clamp(0, 255).byte()


def tinted(frames: torch.Tensor, size: float) -> torch.Tensor:
    return (frames + size * torch.tensor([1.0, 0.0, -1.0])).round().clamp(0, 255).byte()


def blocky(frames: torch.Tensor, quality: float) -> torch.Tensor:
    out = []
    for frame in frames.numpy():
        buffer = io.BytesIO()
        Image.fromarray(frame).save(buffer, "JPEG", quality=int(quality))
        out.append(np.array(Image.open(buffer)))
    return torch.from_numpy(np.stack(out))


def emptied(frames: torch.Tensor, count: float) -> torch.Tensor:
    """Boxes of 20x24 pixels where nothing is: each the mean of the row ends."""
    out, rng = frames.clone(), make_rng(1)
    for frame in out:
        for _ in range(int(count)):
            top, left = int(torch.randint(0, 76, (), generator=rng)), int(torch.randint(1, 103, (), generator=rng))
            ends = frame[top : top + 20, [left - 1, left + 24]].float().mean(1, keepdim=True)
            frame[top : top + 20, left : left + 24] = ends.round().byte()
    return out


def reclad(frames: torch.Tensor, count: float) -> torch.Tensor:
    """Boxes of 20x24 pixels that show a piece of another frame, upside down."""
    out, rng = frames.clone(), make_rng(2)
    for frame, other in zip(out, frames.roll(7, 0)):
        for _ in range(int(count)):
            top, left = int(torch.randint(0, 76, (), generator=rng)), int(torch.randint(0, 104, (), generator=rng))
            frame[top : top + 20, left : left + 24] = other[40:60, 50:74].flip(0)
    return out


@pytest.mark.exact
@pytest.mark.parametrize(
    ("spoil", "levels"),
    [
        (blurred, (0.6, 1.2, 2.4)),
        (noisy, (5, 10, 20)),
        (tinted, (8, 16, 32)),
        (blocky, (40, 15, 4)),
        (emptied, (4, 10, 24)),
        (reclad, (2, 6, 12)),
    ],
)
def test_it_rises_with_everything_that_spoils_a_picture(game, plain, spoil, levels):
    found = [frechet_interval(plain, frame_features(spoil(game[::2], level))) for level in levels]
    values = [0.0, *(figure.value for figure in found)]
    assert values == sorted(values) and found[-1].low > 0


@pytest.mark.exact
@pytest.mark.parametrize(("spoil", "level"), [(blurred, 1.2), (noisy, 10), (tinted, 24), (blocky, 8)])
def test_spoilt_pictures_of_other_moments_are_told_from_real_ones(game, plain, halves, spoil, level):
    assert frechet_interval(plain, frame_features(spoil(game[1::2], level))).low > halves.high


def test_two_halves_of_the_game_are_alike(plain, halves):
    assert halves.low < 0 < halves.high and abs(halves.value) < 0.1 * float(plain.var(0).sum())


def test_a_blurred_dream_with_the_better_psnr_loses_to_a_sharp_one_slightly_out_of_place(game, plain):
    real = game[::2]
    soft, moved = blurred(real, 1.2), real.roll((2, 2), (1, 2))
    average = ((real.float() + real.roll((4, 4), (1, 2)).float()) / 2).byte()
    sharp = frechet_interval(plain, frame_features(moved))
    for dream in (soft, average):
        assert psnr(dream, real).mean() > psnr(moved, real).mean() + 1
        assert frechet_interval(plain, frame_features(dream)).low > 2 * sharp.high


def test_a_frame_is_seen_alike_alone_and_in_company_at_any_size(game):
    some = game[:5]
    together = frame_features(some)
    assert together.dtype == torch.float64 and together.shape == (5, FEATURES)
    assert torch.equal(together, frame_features(some))
    alone = torch.cat([frame_features(frame[None]) for frame in some])
    assert torch.allclose(together, alone, atol=1e-4)
    assert frame_features(some[:, :48, :50].reshape(5, 1, 48, 50, 3)).shape == (5, 1, FEATURES)
    assert frame_features(some[:0]).shape == (0, FEATURES)


def test_only_the_published_weights_are_taken(tmp_path, monkeypatch):
    data = encoder.WEIGHTS.read_bytes()
    assert len(data) <= 2_000_000 and hashlib.sha256(data).hexdigest() == encoder.SHA256
    assert sum(tensor.numel() for tensor in shipped_encoder().parameters()) < 500_000
    with pytest.raises(TerrellaError, match="not the published ones"):
        encoder_of(data[:-1], encoder.SHA256)
    for broken in (b"", save({"last.bias": torch.zeros(3)}), save(FrameEncoder().state_dict())[:-9]):
        with pytest.raises(TerrellaError, match="do not fit"):
            encoder_of(broken, hashlib.sha256(broken).hexdigest())
    monkeypatch.setattr(encoder, "WEIGHTS", tmp_path / "none")
    shipped_encoder.cache_clear()
    with pytest.raises(TerrellaError, match="install terrella again"):
        shipped_encoder()


@pytest.fixture(scope="module")
def card():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(panorama, "HEIGHT", 48)
        patch.setattr(panorama, "WIDTH", 64)
        arms = {flaw or "perfect": panorama.Panorama(flaw) for flaw in ("", "static", "fading")}
        config = ExamConfig((1, 8, 24), (8,), **{**panorama.SHORT, "drop": (8, 24), "strips": 1})
        return panorama.card_of(arms, {"recorded": panorama.some_clips(12, 24)}, config)


def looks(card, arm: str):
    return card.find("pixels", "Frechet distance", arm=arm, motion="predicted")


@pytest.mark.slow
def test_the_scorecard_praises_the_perfect_world_and_finds_out_the_fading_one(card):
    perfect, fading, static = (
        [row.figure.value for row in looks(card, arm)] for arm in ("perfect", "fading", "static")
    )
    copied = [row.baselines["copy last"].value for row in looks(card, "perfect")]
    assert max(map(abs, perfect)) < 0.01 * fading[1]
    assert fading == sorted(fading) and fading[2] > copied[2]
    assert static[2] == pytest.approx(copied[2], rel=1e-3)  # real frames, of another moment
    assert all(row.baselines["blurred by 1 pixel"].value > 0 for row in looks(card, "perfect"))


@pytest.mark.slow
def test_the_page_and_the_json_tell_it(card):
    html = page(card, "t", PROBES)
    assert "Frechet distance" in html and "blurred by 1 pixel" in html
    assert "nan" not in re.sub(r"base64,[^\"]*", "", html).lower()
    told = [row for row in json.loads(to_json(card))["rows"] if row["what"] == "Frechet distance"]
    assert told[0]["baselines"]["blurred by 1 pixel"]["count"] == told[0]["figure"]["count"] == 12


def test_frames_too_small_to_look_at_are_scored_without_it():
    config = ExamConfig((1, 8), (8,), **{**panorama.SHORT, "drop": (1, 8), "strips": 1})
    card = panorama.card_of({"a": panorama.Panorama()}, {"recorded": panorama.some_clips(3)}, config)
    assert not card.find("pixels", "Frechet distance") and "Frechet distance," not in page(card, "t", PROBES)
