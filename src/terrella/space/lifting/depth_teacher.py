"""A depth network of others as the first layer of a lifted picture: an ONNX file of the form of Depth Anything V2, which gives
inverse depth up to a factor and an offset. These are fitted to the lifter's depth, which is metric."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from ...core.errors import DatasetError, TerrellaError
from .layers import PictureLayers, levelled

HUB = {"depth-anything-v2-small": ("onnx-community/depth-anything-v2-small", "onnx/model.onnx")}  # Apache-2.0
SIDE, MULTIPLE = (
    518,
    14,
)  # of the picture that it sees: pixels of the shorter side, and what both sides are multiples of
MEAN, SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's colours
LEAST = 0.25  # inverse depth, as a share of the lifter's at its farthest
AGREES = 0.3  # the correlation of inverse depths from which a teacher is used


def with_teacher(layers: PictureLayers, source: str) -> tuple[PictureLayers, float]:
    """The layers with the first one's depth by the teacher `source` (a name in HUB, or an .onnx file), and the correlation of
    its inverse depth with the lifter's. The hidden layer keeps its distance behind the first. TerrellaError if it cannot be had
    or read, DatasetError if both do not agree."""
    teacher = inverse_depth(layers.rgb, source)
    ours = 1 / layers.depth
    pair = torch.stack([teacher.flatten(), ours.flatten()])
    agreement = float(torch.corrcoef(pair)[0, 1]) if float(teacher.std()) > 1e-9 else 0.0
    if not agreement >= AGREES:
        raise DatasetError(
            f"the depth of {source} does not agree with the lifter's (correlation {agreement:.2f}): its scale stays unknown. Leave "
            "--depth out, or give a network whose output is inverse depth (larger is nearer)."
        )
    basis = torch.stack([pair[0], torch.ones_like(pair[0])], 1)
    weight = torch.ones(len(basis))
    solution = torch.zeros(2)
    for _ in range(5):  # outliers weigh less
        root = weight.sqrt()[:, None]
        solution = torch.linalg.lstsq(basis * root, pair[1][:, None] * root).solution[:, 0]
        off = (basis @ solution - pair[1]).abs()
        weight = 1 / (off + 0.1 * off.median() + 1e-6)
    farthest = LEAST * float(ours.quantile(0.01))
    depth = 1 / (teacher * solution[0] + solution[1]).clamp_min(farthest)
    behind = layers.behind * (depth / layers.depth)[::2, ::2]
    return levelled(replace(layers, depth=depth, behind=behind)), agreement


def inverse_depth(rgb: torch.Tensor, source: str) -> torch.Tensor:
    """What a teacher gives for a picture [3, H, W] in 0..1: [H, W], up to a factor and an offset; larger is nearer."""
    session = _session(source)
    height, width = rgb.shape[1:]
    share = SIDE / min(height, width)
    wanted = next(iter(session.get_inputs()), None)
    if wanted is None or len(wanted.shape) != 4:
        raise TerrellaError(f"{source} takes no picture: its first input must be pixels [1, 3, H, W].")
    given = [side if isinstance(side, int) else None for side in list(wanted.shape)[-2:]]
    size = [fixed or max(round(side * share / MULTIPLE), 1) * MULTIPLE for fixed, side in zip(given, (height, width))]
    picture = F.interpolate(rgb[None], size, mode="bicubic", antialias=True)
    mean, spread = (torch.tensor(part).view(1, 3, 1, 1) for part in (MEAN, SPREAD))
    try:
        (answer, *_) = session.run(None, {wanted.name: ((picture - mean) / spread).numpy()})
    except Exception as error:
        raise TerrellaError(
            f"{source} cannot be run on a picture ({_short(error)}); its input is pixels [1, 3, H, W]."
        ) from error
    answered = torch.from_numpy(np.asarray(answer, np.float32)).squeeze()
    if answered.ndim != 2 or not bool(answered.isfinite().all()):
        raise TerrellaError(
            f"{source} gives numbers of shape {list(np.shape(answer))}; inverse depth is finite, [1, H, W]."
        )
    return F.interpolate(answered[None, None], (height, width), mode="bilinear")[0, 0]


def _session(source: str) -> Any:
    if not find_spec("onnxruntime"):
        raise TerrellaError("--depth runs an ONNX file: pip install 'terrella[fast]', then try again.")
    import onnxruntime

    file = _downloaded(source) if source in HUB else Path(source)
    if file.is_dir():
        inside = sorted(file.rglob("*.onnx"))
        if len(inside) != 1:
            names = ", ".join(str(one.relative_to(file)) for one in inside[:5]) or "none"
            raise TerrellaError(f"--depth {source} is a folder; give one .onnx file ({names} in it).")
        file = inside[0]
    if not file.is_file():
        raise TerrellaError(f"--depth {source}: there is no such file; give an .onnx file, or one of {', '.join(HUB)}.")
    try:
        return onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    except Exception as error:
        raise TerrellaError(f"{file} cannot be read as ONNX ({_short(error)}); export the network again.") from error


def _downloaded(name: str) -> Path:
    """The file of a teacher of the hub, from its cache where it lies there."""
    repository, file = HUB[name]
    if not find_spec("huggingface_hub"):
        raise TerrellaError(
            f"--depth {name} is on the Hugging Face hub: pip install 'terrella[remote]', or give an .onnx file."
        )
    from huggingface_hub import hf_hub_download  # pyright: ignore[reportMissingImports]

    try:
        return Path(hf_hub_download(repository, file))
    except Exception as error:
        raise TerrellaError(
            f"{repository} cannot be fetched ({_short(error)}); give the path of its {file} instead."
        ) from error


def _short(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:120] if str(error).strip() else type(error).__name__
