"""The commands `check`, `bench physics` and `bench geometry`."""

from typing import Annotated

from tyro.conf import Positional, arg

from ..workflows.bench_physics import BenchPhysicsConfig
from ..workflows.bench_physics import bench_physics as run_bench
from ..workflows.check import CheckConfig
from ..workflows.check import check as run_check
from ..workflows.geometry import GeometryConfig, measure_geometry
from ..workflows.results import command
from .say import Json, WorldName, say, show


def check(world: WorldName, config: CheckConfig, json: Json = False) -> None:
    """Check which laws of physics a world's predictions keep: bodies that overlap or vanish, energy from nothing, wrong gravity.

    Tolerances are calibrated on the recording, so that the truth itself passes. A folder receives a page with plots and the worst
    rollout, and all figures.

    Args:
        world: The world to check: a name of `terrella list`, or a path.
    """
    show(run_check(world, config, progress=say), json, command("terrella", "score", world, data=config.data))


def bench_physics(
    config: BenchPhysicsConfig,
    world: Annotated[str | None, Positional, arg(metavar="[WORLD]")] = None,
    json: Json = False,
) -> None:
    """Compare predictions of moving bodies with the truth, within the ranges of training and beyond: a ball thrown, collisions,
    bounces, a pendulum, rolling, stacking.

    Beside the world, with and without its guard: copying, linear extrapolation, and the truth from a noisy start.

    Args:
        world: A latent world of such a family. Default: the baselines alone, or worlds that --train makes.
    """
    show(run_bench(world, config, progress=say), json, command("terrella", "play", "physics:bouncing"))


def bench_geometry(world: WorldName, config: GeometryConfig, json: Json = False) -> None:
    """Measure the geometry of a latent world: how many dimensions its data fill, how far predictions leave them, and how fast
    nearby rollouts part.

    The last gives a trust horizon before any rollout is compared with the truth; the measured one stands beside it.

    Args:
        world: A latent world: a run of `train latent`, or its folder.
    """
    show(measure_geometry(world, config, progress=say), json, command("terrella", "score", world, data=config.data))
