"""Lifts five pictures that nobody here made: three photographs, and two scenes by renderers of other projects.

pip install --no-deps --target OTHERS scikit-image scikit-learn pybullet miniworld pyglet==1.5.31
PYTHONPATH=OTHERS:src python benchmarks/lift_others.py OUT

The photographs come in the packages: a motorcycle in a workshop (scikit-image, Middlebury 2014, with measured depth), a cup on a
table (scikit-image, CC0), a palace (scikit-learn, china.jpg, CC BY 2.0 by danielbuechele). MiniWorld draws a hallway, PyBullet an
arm at a table. Prints AbsRel of depth where it is known, beside a plane at 3 m; writes the pictures, a place of each, and
OUT/others.jpg: picture, depth, and views 0.3 m to the right, to the left, and up.
"""

from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import terrella
from terrella.core import make_rng
from terrella.space.lifting.layers import layers_of
from terrella.space.lifting.network import load_lifter

sys.path.insert(0, str(Path(__file__).parent))
from lift import MEAN_M, abs_rel  # beside this file

MOTORCYCLE = (
    994.978,
    193.001e-3,
    31.086,
)  # focal length in pixels, baseline in metres, offset of the principal points in pixels
TILE = 256
Shown = tuple[np.ndarray, np.ndarray | None]  # rgb uint8 [H, W, 3]; depth in metres [H, W], 0: unknown


def package_file(package: str, *parts: str) -> Path:
    """A file of an installed package, which is not imported."""
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        raise SystemExit(f"{package} is not installed; see the head of this file.")
    return Path(spec.origin).parent.joinpath(*parts)


def photograph(package: str, *parts: str) -> Shown:
    return np.asarray(Image.open(package_file(package, *parts)).convert("RGB")), None


def motorcycle() -> Shown:
    rgb, _ = photograph("skimage", "data", "motorcycle_left.png")
    with np.load(package_file("skimage", "data", "motorcycle_disp.npz")) as stored:
        apart = stored["arr_0"]
    focal, baseline, offset = MOTORCYCLE
    known = np.isfinite(apart)
    return rgb, np.where(known, focal * baseline / (np.where(known, apart, 0) + offset), 0)


def hallway() -> Shown:
    """MiniWorld's hallway from half-way, a little to the side."""
    import miniworld  # noqa: F401  (registers its environments)
    from gymnasium import make

    env = make("MiniWorld-Hallway-v0", obs_width=320, obs_height=240).unwrapped
    env.reset(seed=3)
    env.agent.pos, env.agent.dir = np.array([2.0, 0.0, 0.6]), 0.25
    return env.render_obs(), np.asarray(env.render_depth(env.obs_fb)).reshape(240, 320)


def table() -> Shown:
    """An arm at a table with things, by PyBullet's own renderer."""
    import pybullet

    data = str(package_file("pybullet_data"))
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setAdditionalSearchPath(data)
    for name, place in (
        ("plane.urdf", (0, 0, 0)),
        ("table/table.urdf", (0.6, 0, 0)),
        ("franka_panda/panda.urdf", (0.1, 0.1, 0.63)),
        ("duck_vhacd.urdf", (0.6, -0.25, 0.68)),
        ("soccerball.urdf", (0.9, 0.1, 0.7)),
        ("lego/lego.urdf", (0.5, 0.15, 0.66)),
    ):
        pybullet.loadURDF(name, place, globalScaling=0.15 if "soccer" in name else 1.0)
    eye, near, far = [-0.7, -1.0, 1.35], 0.1, 20.0
    view = pybullet.computeViewMatrix(eye, [0.6, 0.0, 0.65], [0, 0, 1])
    lens = pybullet.computeProjectionMatrixFOV(60, 4 / 3, near, far)
    _, _, rgb, z, _ = pybullet.getCameraImage(320, 240, view, lens, renderer=pybullet.ER_TINY_RENDERER)
    pybullet.disconnect(client)
    depth = far * near / (far - (far - near) * np.reshape(z, (240, 320)))
    return np.reshape(rgb, (240, 320, 4))[..., :3].astype(np.uint8), np.where(depth < 0.99 * far, depth, 0)


PICTURES = {
    "motorcycle": motorcycle,
    "cup": lambda: photograph("skimage", "data", "coffee.png"),
    "palace": lambda: photograph("sklearn", "datasets", "images", "china.jpg"),
    "hallway": hallway,
    "table": table,
}


def views(folder: Path, asides: list[tuple[float, float]]) -> list[np.ndarray]:
    """Pictures uint8 [H, W, 3] of a lifted place from where one begins, moved by (left, up) in metres."""
    world = terrella.load(folder)
    state = world.start(1, make_rng(0))
    shown = []
    for left, up in asides:
        pose = state["pose"].clone()
        turn = 2 * math.atan2(float(pose[0, 6]), float(pose[0, 3]))
        pose[0, :3] += pose.new_tensor([-left * math.sin(turn), left * math.cos(turn), up])
        shown.append(world.render(state.replace(pose=pose), ("rgb",))["rgb"][0].numpy())
    return shown


def tile(picture: np.ndarray) -> np.ndarray:
    image = Image.fromarray(picture)
    return np.asarray(image.resize((TILE * 4 // 3, TILE), Image.Resampling.LANCZOS))


def main() -> None:
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    lifter, rows = load_lifter(), []
    for name, make in PICTURES.items():
        rgb, truth = make()
        Image.fromarray(rgb).save(out / f"{name}.png")
        if truth is not None:
            size = (rgb.shape[1] // 2, rgb.shape[0] // 2)
            small = np.asarray(Image.fromarray(rgb).resize(size, Image.Resampling.BOX))
            near = truth[: 2 * size[1] : 2, : 2 * size[0] : 2]
            lifted = abs_rel(layers_of(small, lifter).depth.numpy(), near)
            plane = abs_rel(np.full(near.shape, MEAN_M), near)
            print(
                f"{name}: AbsRel {lifted[0]:.2f}, scaled {lifted[1]:.2f}; a plane at 3 m {plane[0]:.2f}, {plane[1]:.2f}"
            )
        job = terrella.generate_place(out / f"place-{name}", image=out / f"{name}.png")
        print(f"{name}: {job.lines[1]}; {' '.join(job.facts['notes'])}")
        depth = layers_of(rgb, lifter).depth.numpy()
        grey = np.clip(255 * np.quantile(depth, 0.02) / depth, 0, 255).astype(np.uint8)
        drawn = views(out / f"place-{name}", [(0, 0), (-0.3, 0), (0.3, 0), (0, 0.3)])
        rows.append(np.concatenate([tile(one) for one in (rgb, np.repeat(grey[..., None], 3, 2), *drawn)], 1))
    Image.fromarray(np.concatenate(rows)).save(out / "others.jpg", quality=88)


if __name__ == "__main__":
    main()
