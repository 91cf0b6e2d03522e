"""The commands `terrella export ...`."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from .. import library
from ..core.errors import TerrellaError
from .say import Json, WorldName, result


def policy(name: Annotated[Path, Positional, arg(metavar="POLICY")], world: str, out: Path, json: Json = False) -> None:
    """Write a learned policy as one ONNX file, with normalisation and action limits inside: it runs without PyTorch.

    Args:
        name: The folder of the policy, or of its training run. Policies of `terrella train goals` cannot be exported yet.
        world: A world with the same actions, such as the one in which it practised (mujoco:go1).
        out: The file, NAME.onnx.
    """
    from ..act.actor import Actor, policy_folder, read_policy
    from ..act.goal_network import KIND as GOALS
    from ..act.onnx_file import write_onnx

    if read_policy(policy_folder(name)).get("kind") == GOALS:
        raise TerrellaError(
            f"{name} is a policy for goals, which needs its world to act, so it cannot be exported; `terrella plan WORLD --agent` "
            "plays it."
        )
    spec = library.load(world).spec
    inputs = write_onnx(Actor.load(name, spec), out)
    facts = {"file": str(out), "inputs": inputs, "outputs": {"action": [-1, *(spec.action.shape or ())]}}
    facts |= {"action_names": list(spec.action_names), "action_units": list(spec.action_units), "control_s": spec.dt_s}
    result(facts, json)


def world(name: WorldName, out: Path, json: Json = False) -> None:
    """Write a learned world of frames as one HTML file that anybody plays in a browser: no server, no installation, no network.

    Args:
        name: A world without depth and poses, such as islet or the run of `terrella learn`.
        out: The file, NAME.html.
    """
    from ..workflows.export_world import export_world

    result(export_world(name, out), json)
