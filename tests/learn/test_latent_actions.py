"""Latent actions in a place whose four moves are known: found without labels, mapped to keys, written as actions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from lab.latent_actions import agreement, examine_latent, shown_shift
from tests.learn.stopping import goes_on_exactly, quiet

from terrella.core.errors import DatasetError, TrainingError
from terrella.data import ClipCache, Dataset, Layout, Recorder
from terrella.exchange import open_source, write_source
from terrella.exchange.formats.lerobot import LeRobotRows
from terrella.learn.latent_codes import labelled, map_keys
from terrella.learn.objectives.latent_actions import posterior
from terrella.learn.objectives.latent_model import Forward, warped
from terrella.learn.recipes.latent_actions import LatentActionsConfig, load_latent, train_latent_actions

from ..data.layouts import layout_of

CONFIG = LatentActionsConfig(codes=4, stride=1, size=(32, 32), steps=100, batch=8, strip_every_s=1e9)
MOVES = {"up": (-2, 0), "down": (2, 0), "left": (0, -2), "right": (0, 2)}


def scrolling(folder, acted=True, episodes=4, length=120):
    """A smooth random picture that one of four keys scrolls by two pixels."""
    rng = np.random.default_rng(0)
    coarse = torch.from_numpy(rng.random((1, 3, 16, 16), np.float32))
    wide = torch.nn.functional.interpolate(coarse.repeat(1, 1, 3, 3), (192, 192), mode="bicubic")[0, :, 64:128, 64:128]
    picture = (wide.clamp(0, 1) * 255).to(torch.uint8).permute(1, 2, 0).numpy()
    sensors = layout_of(10.0, tuple(MOVES), rgb=(32, 32)).sensors
    kept = {name: sensor for name, sensor in sensors.items() if acted or name != "action"}
    layout = Layout(10.0, kept, pictures="png", world={"name": "scroll"})
    with Recorder(folder, layout) as recorder:
        for _ in range(episodes):
            at = rng.integers(0, 64, 2)
            moves = rng.integers(4, size=length).repeat(4)
            for row, move in enumerate(moves[:length].tolist()):
                seen = np.roll(picture, (-at[0], -at[1]), (0, 1))[:32, :32]
                recorder.add({"rgb": seen}, np.eye(4)[move] if acted and row < length - 1 else None, 0.0, False)
                at = at + list(MOVES.values())[move]
            recorder.end_episode()
    return folder


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return scrolling(tmp_path_factory.mktemp("latent") / "set")


@pytest.fixture(scope="module")
def run(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    train_latent_actions(recording, out, CONFIG, quiet)
    return out


def test_four_moves_are_found_without_labels(recording, run):
    found = examine_latent(run, recording, quiet)
    assert found["actions"]["purity"] > 0.9 and found["actions"]["information"] > 0.8, found
    assert found["actions"]["commonest"] < 0.5, "else purity would say little"
    assert found["psnr_db"]["difference"] > 2 and found["psnr_db"]["interval"][0] > 2
    for name in ("drawn_px", "seen_px"):
        flows = sorted((np.round(np.array(code[name]) / 2).astype(int) + 0).tolist() for code in found["codes"])
        assert flows == [[-1, 0], [0, -1], [0, 1], [1, 0]], "the picture moves by two pixels in each direction"
    assert all(code["agreement"] > 0.9 for code in found["codes"])
    assert list(run.glob(f"strip-{CONFIG.steps:06d}.png"))


def test_keys_are_mapped_by_a_few_labelled_frames(recording, run):
    keys = map_keys(run, recording, quiet, frames=60)
    assert keys.accuracy > 0.9 and keys.commonest < 0.5 and keys.used == 60
    assert set(keys.pairs) == {tuple(np.eye(4)[i]) for i in range(4)}
    for action, code in keys.pairs.items():
        assert tuple(keys.actions[code]) == action
    assert keys.code_of(np.array([1, 1, 1, 1])) is None


@pytest.mark.slow
def test_a_labelled_copy_has_codes_for_actions(recording, run, tmp_path):
    told = write(run, recording, tmp_path / "copy").facts
    copy, original = Dataset(tmp_path / "copy"), Dataset(recording)
    assert told["frames"] == copy.length == original.length
    codes = [code for code in range(4) if code + 1 != told["still"]]
    assert copy.action_names == tuple(f"code_{code + 1}" for code in codes), (
        "while no key is held, the stillest happens"
    )
    assert copy.world["keys"] == {f"Digit{code + 1}": np.eye(3)[at].tolist() for at, code in enumerate(codes)}
    for number in range(len(original.episodes)):
        new, old = copy.episode(number), original.episode(number)
        assert np.array_equal(new["rgb"], old["rgb"])
        assert set(new["action"].sum(1)) <= {0, 1} and np.array_equal(new["action_valid"], old["action_valid"])
        assert agreement(old["action"][:-1], (new["action"][:-1] @ [1, 2, 3]).astype(int))["purity"] > 0.9
    assert set(open_source(tmp_path / "copy").sensors) == set(open_source(recording).sensors)


@pytest.mark.slow
def test_pictures_alone_are_enough(run, tmp_path):
    silent = scrolling(tmp_path / "set", False, episodes=2, length=40)
    assert ClipCache.open(silent, (32, 32)).action is None
    assert "actions" not in examine_latent(run, silent, quiet)
    assert write(run, silent, tmp_path / "copy").exact
    assert Dataset(tmp_path / "copy").episode(0)["action"].shape == (40, 3)
    with pytest.raises(DatasetError, match="no recorded actions"):
        map_keys(run, silent, quiet)


@pytest.mark.exact
def test_a_stopped_run_goes_on_exactly(recording, tmp_path):
    config = replace(CONFIG, steps=4, batch=4)
    train = lambda out: train_latent_actions(recording, out, config, quiet)  # noqa: E731
    goes_on_exactly(train, tmp_path / "a", tmp_path / "b", {"codes": 1})
    with pytest.raises(TrainingError, match="other settings"):
        train_latent_actions(recording, tmp_path / "b", replace(config, codes=5), quiet)


def write(run, recording, out):
    labels = labelled(run, recording, quiet)
    write_source(labels.source, out, "lerobot", LeRobotRows(pictures="png"))
    return labels


def test_bad_input_is_refused_in_one_sentence(recording, run, tmp_path):
    for wrong in ({"size": (30, 32)}, {"codes": 1}, {"stride": 0}):
        with pytest.raises(TrainingError):
            train_latent_actions(recording, tmp_path / "run", replace(CONFIG, **wrong), quiet)
    with pytest.raises(DatasetError, match="smaller --stride"):
        train_latent_actions(recording, tmp_path / "run", replace(CONFIG, stride=119), quiet)
    with pytest.raises(TrainingError, match="no run"):
        load_latent(tmp_path)
    with pytest.raises(DatasetError, match="ask for fewer"):
        map_keys(run, recording, quiet, frames=100_000)
    with Recorder(tmp_path / "blind", layout_of(10.0, ("a",), pose=True)) as recorder:
        for _ in range(3):
            recorder.add({"pose": np.eye(7, dtype=np.float32)[3]}, np.zeros(1))
    with pytest.raises(DatasetError, match="holds no rgb"):
        train_latent_actions(tmp_path / "blind", tmp_path / "run", CONFIG, quiet)


def test_warping_reads_where_the_flow_points():
    frame = torch.rand(1, 3, 8, 8)
    flow = torch.zeros(1, 2, 8, 8)
    assert torch.allclose(warped(frame, flow), frame, atol=1e-6)
    flow[:, 0], flow[:, 1] = 2, -1
    assert torch.allclose(warped(frame, flow)[..., 1:, :6], frame[..., :-1, 2:], atol=1e-5)


def test_a_shift_of_the_picture_is_seen():
    picture = torch.rand(1, 3, 48, 80)
    views = [picture[..., 4 + y : 36 + y, 8 + x : 72 + x] for x, y in ((0, 0), (3, -2), (-8, 0))]
    assert shown_shift(torch.cat(views[:1] * 3), torch.cat(views)).tolist() == [[0, 0], [-3, 2], [8, 0]]


def test_half_size_errors_agree_with_whole_outcomes():
    torch.manual_seed(0)
    model, before = Forward(4), torch.rand(2, 3, 32, 32)
    for code in range(4):
        after = model(before, torch.eye(4)[[code, code]])
        errors = model.errors(model.features(before), before, after)
        assert (errors.argmin(1) == code).all()


def test_the_posterior_is_even_at_first_and_sharp_at_last():
    errors = torch.rand(64, 4) * 0.01 + torch.tensor([0.1, 0.2, 0.2, 0.2])
    early, late = posterior(errors, 0.0), posterior(errors, 1.0)
    assert early.sum(0).max() / early.sum(0).min() < 5
    assert (late.argmax(1) == 0).all() and (late.max(1).values > 0.99).all()
    assert torch.allclose(early.sum(1), torch.ones(64), atol=1e-5)
