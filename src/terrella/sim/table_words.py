"""The instructions of `mujoco:table`: three wordings of each task for training, and three that training never sees."""

from collections.abc import Mapping

from .table_scene import COLOURS

SIDES = ("left", "right")  # as the front camera sees them
# task -> (wordings of training, wordings that are held out): {a} and {b} are colours, {side} is a side
WORDINGS: Mapping[str, tuple[tuple[str, str, str], tuple[str, str, str]]] = {
    "reach": (
        ("reach for the {a} block", "move the hand to the {a} block", "go to the {a} block"),
        ("reach the {a} block with the hand", "move to the {a} block", "go over to the {a} block"),
    ),
    "push": (
        ("push the {a} block to the {side}", "slide the {a} block to the {side}", "move the {a} block to the {side}"),
        ("push the {a} block {side}", "slide the {a} block over to the {side}", "push the {a} block over to the {side}"),
    ),
    "pick": (
        ("pick up the {a} block", "lift the {a} block", "grasp the {a} block and lift it"),
        ("pick the {a} block up", "lift up the {a} block", "grasp and lift the {a} block"),
    ),
    "place": (
        ("put the {a} block in the cup", "place the {a} block in the cup", "drop the {a} block into the cup"),
        ("put the {a} block into the cup", "drop the {a} block in the cup", "pick up the {a} block and place it in the cup"),
    ),
    "open": (
        ("open the drawer", "pull the drawer open", "pull out the drawer"),
        ("pull open the drawer", "pull the drawer out", "open up the drawer"),
    ),
    "close": (
        ("close the drawer", "push the drawer shut", "shut the drawer"),
        ("push the drawer closed", "shut the drawer again", "push shut the drawer"),
    ),
    "stack": (
        ("stack the {a} block on the {b} block", "put the {a} block on the {b} block",
         "place the {a} block on top of the {b} block"),
        ("put the {a} block on top of the {b} block", "place the {a} block on the {b} block",
         "stack the {a} block on top of the {b} block"),
    ),
    "store": (
        ("put the {a} block in the drawer", "place the {a} block in the drawer", "drop the {a} block into the drawer"),
        ("put the {a} block into the drawer", "drop the {a} block in the drawer",
         "pick up the {a} block and place it in the drawer"),
    ),
}  # fmt: skip
TASKS = tuple(WORDINGS)
ALONE = TASKS[:-1]  # of which an episode of one task draws; `store` needs an open drawer, and comes in chains


def text_of(job: tuple[int, int, int, int], wording: int, unseen: bool) -> str:
    """The instruction of a job: numbers of the task, the block, the other block and the side."""
    task, block, other, side = job
    colours = tuple(COLOURS)
    return WORDINGS[TASKS[task]][unseen][wording].format(a=colours[block], b=colours[other], side=SIDES[side])
