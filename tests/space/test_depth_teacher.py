"""Depth networks of others as the first layer of a lifted picture: small ONNX files of the form of Depth Anything V2."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from terrella.cli import main
from terrella.core.errors import DatasetError, TerrellaError
from terrella.space.lifting.depth_teacher import inverse_depth, with_teacher
from terrella.space.lifting.layers import PictureLayers

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


def network(path, sides=("h", "w"), sign=1.0, words=False) -> str:
    """A network that calls the red channel inverse depth: pixel_values [1, 3, h, w] to predicted_depth [1, h, w]."""
    from onnx import TensorProto, helper, numpy_helper

    gives = helper.make_tensor_value_info("predicted_depth", TensorProto.FLOAT, [1, *sides])
    shape = [1, 3] if words else [1, 3, *sides]
    takes = helper.make_tensor_value_info("pixel_values", TensorProto.FLOAT, shape)
    constants = [
        numpy_helper.from_array(np.array(0), "red"),
        numpy_helper.from_array(np.array(sign, np.float32), "sign"),
    ]
    nodes = [
        helper.make_node("Gather", ["pixel_values", "red"], ["channel"], axis=1),
        helper.make_node("Mul", ["channel", "sign"], ["predicted_depth"]),
    ]
    graph = helper.make_graph(nodes, "teacher", [takes], [gives], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, str(path))
    return str(path)


def ramp(height=60, width=90) -> tuple[torch.Tensor, PictureLayers]:
    """Depth [H, W] that grows to the right and has a step, shown by the red channel; and layers that are a poor guess of it."""
    x = torch.linspace(0, 1, width).expand(height, width)
    truth = 1 / (0.8 - 0.5 * x + 0.3 * (x > 0.5))
    red = (1 / truth - 0.2) / 1.2
    rgb = torch.stack([red, 0.5 * torch.ones_like(red), red])
    guess = truth * (1 + 0.3 * torch.sin(9 * x))
    half = guess[::2, ::2]
    return truth, PictureLayers(
        rgb, guess, 1.5 * half, torch.zeros_like(half), rgb[:, ::2, ::2], 0.1 + 0 * guess, 0.5, 0.0, 0.0, 1.5
    )


@pytest.mark.parametrize("sides", [("h", "w"), (56, 84)])
def test_the_first_layer_is_the_teachers_in_the_lifters_scale(tmp_path, sides):
    truth, layers = ramp()
    taught, agreement = with_teacher(layers, network(tmp_path / "net.onnx", sides))
    ours, theirs = (float((depth / truth - 1).abs().median()) for depth in (layers.depth, taught.depth))
    assert agreement > 0.5 and theirs < 0.5 * ours
    form = torch.stack([1 / taught.depth, 1 / truth])[:, :, 3:-3].flatten(1)
    assert torch.corrcoef(form)[0, 1] > 0.995  # the teacher's
    assert torch.allclose(taught.behind / taught.depth[::2, ::2], layers.behind / layers.depth[::2, ::2], rtol=1e-4)
    assert torch.equal(taught.rgb, layers.rgb) and torch.equal(taught.hides, layers.hides)


def test_a_picture_of_any_size_is_seen_in_multiples_of_the_networks_patch(tmp_path):
    file = network(tmp_path / "net.onnx")
    for height, width in ((33, 61), (90, 40)):
        assert inverse_depth(torch.rand(3, height, width), file).shape == (height, width)


def test_what_is_no_teacher_is_refused_in_one_sentence(tmp_path, capsys):
    _, layers = ramp()
    with pytest.raises(DatasetError, match="correlation -0"):
        with_teacher(layers, network(tmp_path / "net.onnx", sign=-1.0))
    with pytest.raises(DatasetError, match="correlation -?0.00"):
        with_teacher(replace(layers, rgb=0 * layers.rgb), str(tmp_path / "net.onnx"))
    (tmp_path / "broken.onnx").write_bytes(b"not a network")
    for name, fault in (("broken.onnx", "cannot be read as ONNX"), ("absent.onnx", "there is no such file")):
        with pytest.raises(TerrellaError, match=fault):
            with_teacher(layers, str(tmp_path / name))
    with pytest.raises(TerrellaError, match="takes no picture"):
        inverse_depth(torch.rand(3, 30, 40), network(tmp_path / "words.onnx", words=True))
    picture = np.random.default_rng(0).integers(0, 255, (64, 128, 3), np.uint8)
    Image.fromarray(picture).save(tmp_path / "all.png")
    given = [
        "space",
        "lift",
        str(tmp_path / "all.png"),
        "--out",
        str(tmp_path / "w"),
        "--panorama",
        "--depth",
        "x.onnx",
    ]
    assert main(given) == 2 and "--depth is for pictures of one direction" in capsys.readouterr().err
    assert not (tmp_path / "w").exists()


def test_the_command_says_by_which_network_depth_is(tmp_path, capsys):
    x, y = np.meshgrid(np.linspace(0, 255, 96), np.linspace(0, 255, 64))
    Image.fromarray(np.stack([y, x, 255 - x], -1).astype(np.uint8)).save(tmp_path / "a.png")
    file = network(tmp_path / "net.onnx")
    given = ["space", "lift", str(tmp_path / "a.png"), "--out", str(tmp_path / "w"), "--longest", "64", "--depth", file]
    assert main(given) == 0 and "depth by" in capsys.readouterr().out


def test_a_folder_is_taken_if_it_holds_one_network(tmp_path):
    rgb = ramp()[1].rgb
    with pytest.raises(TerrellaError, match="is a folder; give one .onnx file .none in it"):
        inverse_depth(rgb, str(tmp_path))
    (tmp_path / "onnx").mkdir()
    one = network(tmp_path / "onnx" / "model.onnx")
    assert torch.equal(inverse_depth(rgb, str(tmp_path)), inverse_depth(rgb, one))
