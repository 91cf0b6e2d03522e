"""Fast play draws what eager torch draws, for any batch, and leaves eager torch to whatever needs a gradient."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import torch

import terrella
from terrella.cli import main
from terrella.core import check_world, make_rng
from terrella.core.errors import TerrellaError
from terrella.space.keyframes import Glimpse
from terrella.worlds import fast
from terrella.worlds.carried_frames import PLANES
from terrella.worlds.config import VideoConfig
from terrella.worlds.controls import Controls
from terrella.worlds.fast import EAGER, ONNX, example_inputs, onnx_forward, with_faster_generator, with_step_programs
from terrella.worlds.frame_history import FrameHistory, StartClips
from terrella.worlds.generator import Conditioning, UNet, generate
from terrella.worlds.learned import About, LearnedWorld

from .made import place

PARITY = 2e-6  # of colours in [-1, 1], so far below one level of 255


@pytest.fixture(scope="module")
def worlds():
    """The bundled world, eager and through ONNX Runtime."""
    pytest.importorskip("onnxruntime", reason="ONNX Runtime is not installed: pip install 'terrella[fast]'")
    eager, quick = terrella.load("doom-maze"), terrella.load("doom-maze")
    quick.generator.forward = onnx_forward(quick.generator, example_inputs(quick))
    return eager, quick


def small_world() -> LearnedWorld:
    """A frames-only world, its network untrained but not silent."""
    config = VideoConfig((1.0, 1.0, 0.5, 0.5), 2, (32, 48), (8, 12), geometry=False)
    torch.manual_seed(0)
    generator = UNet(config.generator)
    torch.nn.init.normal_(generator.output.weight, std=0.1)
    frames = torch.randint(0, 256, (4, 3, 3, 32, 48), dtype=torch.uint8, generator=make_rng(0))
    scene = FrameHistory(config.frames, StartClips.of(frames, 2))
    return LearnedWorld(About("small", Controls.buttons(2), 0.1, ("a", "b")), scene=scene, generator=generator)


def repeated(conditioning: Conditioning, batch: int) -> Conditioning:
    def more(part: torch.Tensor) -> torch.Tensor:
        return part.repeat(batch, *[1] * (part.ndim - 1))

    glimpse = Glimpse(*map(more, vars(conditioning.glimpse).values()))
    return Conditioning(glimpse, more(conditioning.last), more(conditioning.context))


def walk(world, batch: int, steps: int):
    rng = make_rng(5)
    state = world.start(batch, rng)
    for step in range(steps):
        state = world.imagine(state, world.spec.sample_action(batch, make_rng(step)), rng)
        yield state


@pytest.mark.parametrize("batch", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_one_frame_is_that_of_eager_torch(worlds, batch):
    eager, quick = worlds
    noisy, time, conditioning = example_inputs(eager)
    noise = torch.randn(batch, *noisy.shape[1:], generator=make_rng(1))
    given = (noise, time.repeat(batch), repeated(conditioning, batch))
    with torch.inference_mode():
        one, other = eager.generator(*given), quick.generator(*given)
    assert one.shape == other.shape == (batch, 4, 96, 128)
    assert 0 < (one - other).abs().max() < PARITY, "it drew by another way, the same"


@pytest.mark.parametrize("kind", [{}, {"moving": True}, {"geometry": False}])
def test_every_kind_of_generator_is_drawn_alike(kind):
    pytest.importorskip("onnxruntime", reason="ONNX Runtime is not installed: pip install 'terrella[fast]'")
    config = VideoConfig((1.0, 1.0, 0.5, 0.5), 2, (32, 48), (8, 12), **kind)
    torch.manual_seed(0)
    generator, rng = UNet(config.generator).eval(), make_rng(0)
    torch.nn.init.normal_(generator.output.weight, std=0.1)

    def given(batch: int) -> tuple:
        def some(*shape: int) -> torch.Tensor:
            return torch.rand(batch, *shape, generator=rng)

        glimpse = Glimpse(some(3, 3, 32, 48), some(3, 32, 48), 1 + 5 * some(32, 48), some(32, 48).round())
        conditioning = Conditioning(glimpse, some(4 + PLANES * config.moving, 32, 48), some(config.generator.context))
        return some(4, 32, 48), some(), conditioning

    quick = onnx_forward(generator, given(1))
    with torch.inference_mode():
        for batch in (1, 4):
            inputs = given(batch)
            torch.testing.assert_close(quick(*inputs), generator(*inputs), atol=2e-5, rtol=1e-5)


@pytest.mark.slow
def test_a_dream_of_32_steps_is_that_of_eager_torch(worlds):
    off = [
        (one["rgb"].int() - other["rgb"].int()).abs() for one, other in zip(*(walk(world, 2, 32) for world in worlds))
    ]
    share = [float((part > 0).float().mean()) for part in off]
    assert max(share) < 5e-3, "a pixel on the edge of a surface may fall to its other side"
    assert max(share[:8]) < 1e-4 and max(float(part.float().square().mean()) for part in off) < 0.065, "60 dB"


def test_the_faster_way_is_taken_and_said(monkeypatch):
    pytest.importorskip("onnxruntime", reason="ONNX Runtime is not installed: pip install 'terrella[fast]'")
    for times, way in (((9.0, 4.0), ONNX), ((4.0, 9.0), EAGER)):
        monkeypatch.setattr(fast, "alternating_ms", lambda ways, taken=times: list(taken))
        world = small_world()
        quick, choice = with_faster_generator(world)
        assert choice.way == way and quick.spec.card["fast"] == str(choice)
        assert ("forward" in vars(quick.generator)) == (way == ONNX)
        assert "eager torch" in str(choice)
        assert "forward" not in vars(world.generator) and "fast" not in world.spec.card, "the old world is as it was"


def test_a_quickened_world_keeps_the_contract_and_its_weights(monkeypatch):
    pytest.importorskip("onnxruntime", reason="ONNX Runtime is not installed: pip install 'terrella[fast]'")
    monkeypatch.setattr(fast, "alternating_ms", lambda ways: [2.0, 1.0])
    eager = small_world()
    world, _ = with_faster_generator(eager)
    assert {"states_are_values", "batches"} <= set(check_world(world))
    assert world.generator.state_dict().keys() == eager.generator.state_dict().keys(), "it can be saved as it was"
    for one, other in zip(walk(eager, 2, 8), walk(world, 2, 8)):
        assert (one["frames"].int() - other["frames"].int()).abs().max() <= 1
    noisy, time, conditioning = example_inputs(world)
    noisy.requires_grad_(True)
    world.generator(noisy, time, conditioning).mean().backward()
    assert noisy.grad is not None and noisy.grad.abs().max() > 0, "a gradient comes from eager torch"


def test_it_keeps_to_the_threads_that_torch_has(worlds):
    quick, threads = worlds[1], torch.get_num_threads()
    given = example_inputs(quick)
    try:
        frames = []
        for count in (1, 2, 1):
            torch.set_num_threads(count)
            with torch.inference_mode():
                frames.append(quick.generator(*given))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(frames[0], frames[2]) and (frames[0] - frames[1]).abs().max() < PARITY


def test_without_the_packages_a_sentence_says_what_to_install(monkeypatch):
    world = small_world()
    for absent, said in ((("onnx",), "needs onnx: "), (("onnx", "onnxruntime"), "needs onnxruntime and onnx: ")):
        monkeypatch.setattr(fast, "find_spec", lambda name, absent=absent: None if name in absent else True)
        with pytest.raises(TerrellaError, match=said + r"pip install 'terrella\[fast\]'"):
            with_faster_generator(world)


def test_fast_is_for_learned_worlds(capsys):
    assert main(["play", "gym:CartPole-v1", "--fast"]) == 2
    assert "only a learned world can be drawn faster" in capsys.readouterr().err


@pytest.mark.parametrize("quick", [True, pytest.param(False, marks=pytest.mark.exact)])
def test_steps_are_programs_where_that_is_faster(quick, monkeypatch):
    monkeypatch.setattr(fast, "alternating_ms", lambda ways: [2.0, 1.0 if quick else 3.0])
    world = place(Controls.buttons(3))
    chosen, choice = with_step_programs(world, None)
    assert choice.way == ("traced" if quick else EAGER) and chosen.spec.card["fast"] == str(choice)
    assert (chosen.stepper is not None) == quick and world.stepper is None, "the old world is as it was"
    for one, other in zip(walk(world, 2, 3), walk(chosen, 2, 3)):
        assert (one["rgb"].int() - other["rgb"].int()).abs().float().mean() < 1
        torch.testing.assert_close(one["pose"], other["pose"])
    assert chosen.replaced().stepper is None, "another world has its own"


@pytest.mark.gpu
def test_cuda_graphs_draw_the_same():
    if not torch.cuda.is_available():
        pytest.skip("NOT MEASURED: the CUDA-graph path of worlds/fast.py needs a GPU, and there is none here")
    eager, quick = terrella.load("doom-maze", device="cuda"), terrella.load("doom-maze", device="cuda", fast=True)
    for one, other in zip(walk(eager, 1, 8), walk(quick, 1, 8)):
        np.testing.assert_allclose(one["rgb"].int(), other["rgb"].int(), atol=2)


@pytest.mark.slow
def test_several_flow_steps_go_through_it_too(worlds):
    eager, quick = worlds
    noisy, _, conditioning = example_inputs(eager)
    with torch.inference_mode():
        one, other = (generate(world.generator, noisy, conditioning, 3) for world in worlds)
    assert (one - other).abs().max() < 3 * PARITY


def test_threads_that_draw_with_other_numbers_of_threads_do_not_disturb_one_another(monkeypatch):
    pytest.importorskip("onnxruntime", reason="ONNX Runtime is not installed: pip install 'terrella[fast]'")
    import onnxruntime

    world = place(Controls.buttons(3))
    given = example_inputs(world)
    quick = onnx_forward(world.generator, given)
    counts = threading.local()
    monkeypatch.setattr(torch, "get_num_threads", lambda: counts.now)
    real = onnxruntime.InferenceSession

    def draw(threads: int) -> torch.Tensor:
        counts.now = threads
        with torch.no_grad():
            return quick(*given)

    class Interrupted:
        """A session that another thread's call comes between."""

        def __init__(self, *args, **kwargs):
            self.inner = real(*args, **kwargs)
            self.run = self.inner.run

        def get_inputs(self):
            if not interrupted:
                interrupted.append(True)
                other = threading.Thread(target=draw, args=(1,))
                other.start()
                other.join()
            return self.inner.get_inputs()

    interrupted: list[bool] = []
    monkeypatch.setattr(onnxruntime, "InferenceSession", Interrupted)
    assert torch.isfinite(draw(2)).all() and interrupted
