"""COLMAP through pycolmap: reads its models, and computes poses and points of pictures (x right, y down, z forward)."""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from ...core.errors import DatasetError
from .locating import locate
from .posed import FAR, FEWEST, Lens, Shots, absent, levelled, pose_of
from .turning import Pair, rotation_error

MODELS = ("sparse/0", "sparse", "colmap/sparse/0", "0", ".")
_MANY = 120  # pictures; of more, each is compared with its successors alone
_TURNED = 1 / 640  # of the longest side: a smaller error of rotations alone means that the camera only turned
_FEWEST_MATCHES = 30  # of a pair whose rotation is fitted


def _pycolmap() -> Any:
    try:
        import pycolmap  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise DatasetError(
            "COLMAP's models and plain pictures need pycolmap: pip install 'terrella[colmap]'."
        ) from error
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value  # failures are raised
    return pycolmap


def model_of(folder: Path) -> Path | None:
    """The folder of COLMAP's model in a folder of pictures."""
    names = ("cameras.bin", "cameras.txt")
    return next((folder / name for name in MODELS if any((folder / name / one).is_file() for one in names)), None)


def read_colmap(folder: Path) -> Shots:
    """The posed pictures of a model, levelled by their average up direction; DatasetError for a broken model."""
    colmap, model = _pycolmap(), model_of(folder)
    if model is None:
        raise DatasetError(f"{folder} has no model of COLMAP (sparse/0/cameras.bin); give the folder that holds one.")
    left_out: list[str] = []
    try:
        with TemporaryDirectory() as work:
            model_data = colmap.Reconstruction(str(_with_points(model, Path(work), left_out)))
    except (RuntimeError, ValueError, MemoryError) as error:
        raise DatasetError(f"{model} cannot be read as a model of COLMAP; make it again.") from error
    lenses = {number: _lens(camera) for number, camera in model_data.cameras.items()}
    homes = [home for home in (folder / "images", model.parent.parent / "images", folder) if home.is_dir()]
    placed = sorted((one for one in model_data.images.values() if one.has_pose), key=lambda one: one.name)
    if not placed:
        raise DatasetError(f"{model} places no picture; make it again.")
    located = list(zip(placed, locate(homes, [one.name for one in placed])))
    kept = [(image, file) for image, file in located if file is not None]
    if not kept:
        raise DatasetError(
            f"none of the {len(placed)} pictures of {model} is in {folder}, such as {placed[0].name}; add them."
        )
    poses = []
    for image, _ in kept:
        pose = image.cam_from_world().inverse().matrix()
        rot = np.stack([pose[:, 2], -pose[:, 0], -pose[:, 1]], 1)
        poses.append(pose_of(rot, pose[:, 3], f"{model}: {image.name}"))
    points = np.array([point.xyz for point in model_data.points3D.values()], np.float32).reshape(-1, 3)
    points = torch.from_numpy(points[np.isfinite(points).all(1)])
    files, own = [file for _, file in kept], [lenses[image.camera_id] for image, _ in kept]
    left_out += [absent(image.name) for image, file in located if file is None]
    return levelled(Shots(files, own, torch.stack(poses), points, False, tuple(left_out)))


def _with_points(model: Path, work: Path, left_out: list[str]) -> Path:
    """The model, or its copy in `work` with no points if their file is absent, which pycolmap refuses."""
    name = "points3D.bin" if (model / "cameras.bin").is_file() else "points3D.txt"
    if (model / name).is_file():
        return model
    left_out.append(absent(name))
    for file in model.glob(f"*{name[-4:]}"):
        shutil.copy(file, work)
    (work / name).write_bytes(bytes(8) if name.endswith("bin") else b"")
    return work


def _lens(camera: Any) -> Lens:
    focal = (camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y)

    def pixels(at: np.ndarray) -> np.ndarray:
        return camera.img_from_cam(np.concatenate([at, np.ones((len(at), 1))], 1))

    return Lens(camera.width, camera.height, focal, pixels)


def place_pictures(folder: Path, film: bool, alike: bool, seed: int = 0) -> int:
    """Computes poses and points of FOLDER/images into FOLDER/sparse/0; returns the number of posed pictures. film: they are
    consecutive; alike: they have one camera. DatasetError where they do not fit together."""
    colmap = _pycolmap()
    colmap.set_random_seed(seed)
    images, database, work = folder / "images", folder / "database.db", folder / "work"
    database.unlink(missing_ok=True)
    shutil.rmtree(work, ignore_errors=True)
    count = len(list(images.iterdir()))
    cameras = colmap.CameraMode.SINGLE if alike else colmap.CameraMode.AUTO
    features = colmap.FeatureExtractionOptions()
    features.max_image_size = 1600
    plan = colmap.IncrementalPipelineOptions()
    plan.random_seed, plan.multiple_models = seed, True
    work.mkdir(parents=True)
    try:
        colmap.extract_features(database, images, camera_mode=cameras, extraction_options=features)
        (colmap.match_sequential if film and count > _MANY else colmap.match_exhaustive)(database)
        if (error := rotation_error(_pairs(colmap, database))) is not None and error < _TURNED:
            raise DatasetError(
                f"the camera only turned, or moved little beside something flat or far away: rotations alone explain the pictures, "
                f"to {100 * error:.2f}% of their longer side, so they show no depth. Walk while you take them, or stitch them to a "
                "panorama for `terrella space lift`."
            )
        models = colmap.incremental_mapping(database, images, work, options=plan)
        best = max(models.values(), key=lambda one: one.num_reg_images()) if models else None
        placed = best.num_reg_images() if best else 0
        if best is None or placed < FEWEST:
            raise DatasetError(
                f"{placed} of {count} pictures could be placed, and a fit needs {FEWEST}: they overlap too little, are blurred, "
                "show a pattern that repeats (bricks), or were all taken from one spot. Walk while you take them, so that each "
                "shows most of what its neighbours show."
            )
        places = np.array([one.projection_center() for one in best.images.values() if one.has_pose])
        if not (np.abs(places) < FAR).all():
            raise DatasetError(
                "the pictures contradict one another: their poses run off. Patterns that repeat (bricks) and cameras that "
                "only turn do that; take pictures while you walk, of things that differ."
            )
        model = folder / "sparse" / "0"
        model.mkdir(parents=True, exist_ok=True)
        best.write(str(model))
    except RuntimeError as error:
        raise DatasetError(f"COLMAP failed on these pictures ({error}); take others.".replace("\n", " ")) from error
    finally:
        shutil.rmtree(work, ignore_errors=True)
        database.unlink(missing_ok=True)
    return placed


def _pairs(colmap: Any, database: Path) -> list[Pair]:
    """The matches of all pairs of pictures in a database that fit one geometry."""
    with colmap.Database.open(database) as stored:
        cameras = {one.camera_id: one for one in stored.read_all_cameras()}
        points, sizes = {}, {}
        for image in stored.read_all_images():
            camera = cameras[image.camera_id]
            sizes[image.image_id] = max(camera.width, camera.height)
            keypoints = np.asarray(stored.read_keypoints(image.image_id), float)[:, :2]
            points[image.image_id] = keypoints - [camera.width / 2, camera.height / 2]
        pairs = []
        for number, geometry in zip(*stored.read_two_view_geometries()):
            one, two = colmap.pair_id_to_image_pair(number)
            rows = np.asarray(geometry.inlier_matches)
            if len(rows) >= _FEWEST_MATCHES and sizes[one] == sizes[two]:
                pairs.append((points[one][rows[:, 0]], points[two][rows[:, 1]], sizes[one]))
    return pairs
