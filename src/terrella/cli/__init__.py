"""The command line: finds the command, runs it, and turns errors into one sentence."""

import errno
import multiprocessing
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from ..core.errors import TerrellaError, is_out_of_memory
from ..core.files import remedy_of
from ..core.similar import did_you_mean

DESCRIPTION = "Learn a world from recordings, step inside it, and measure how far it can be trusted."

# Each command: the function of this package that runs it, and a line of help. Its module is imported when it runs.
COMMANDS = {
    "learn": ("learn:learn", "record an environment, train a world on it and score it, in one go"),
    "play": ("play:play", "play a world in the browser"),
    "plan": ("studies:plan", "plan in a world, act in the real environment"),
    "evaluate": ("studies:evaluate", "evaluate policies in a world and in the real environment"),
    "transfer": ("studies:transfer", "transfer policies to a real robot that differs, and measure which methods help"),
    "bench acceleration": (
        "studies:acceleration",
        "how much faster than real time a world imagines, beside MuJoCo",
    ),
    "bench costs": ("studies:costs", "what a world costs: milliseconds, joules and memory, of a frame and of play"),
    "bench geometry": ("physics:bench_geometry", "dimensions, Lyapunov exponents and trust horizon of a latent world"),
    "bench physics": ("physics:bench_physics", "how well worlds predict moving bodies, with and without a guard"),
    "record doom": ("record:record_doom", "record the game Doom, by a script or by a person"),
    "record world": ("record:record_world", "record any other world or Gymnasium environment"),
    "train video": ("train:video", "learn a world from a recording with pictures"),
    "train latent": ("train:latent", "learn a fast world for agents from pictures, state vectors or both"),
    "train policy": ("train_policy:policy", "train a policy on imagined rollouts of a world, or by imitation"),
    "practise": (
        "train_policy:practise",
        "fine-tune a policy in a world by verified rewards, and prove the gain outside",
    ),
    "train inverse": ("train_policy:inverse", "learn which actions clips show, from a few labelled episodes"),
    "skills learn": ("skills:learn", "learn a library of skills from a recording and a policy that imitates it"),
    "skills list": ("skills:list_", "list the skills of a library"),
    "skills add": ("skills:add", "add a skill that is made of others"),
    "skills rename": ("skills:rename", "give a skill another name"),
    "skills try": ("skills:try_", "try a skill in an environment, and count how often it works"),
    "adapt": ("train:adapt", "adapt a world to another body or camera, on a recording of minutes"),
    "train goals": ("train:goals", "train a policy that reaches goals in a latent world, without a search"),
    "train estimator": (
        "train:estimator",
        "train an estimator of depth and camera motion on a recording with depth and poses",
    ),
    "train uncertainty": ("train:uncertainty", "add an estimator and an uncertainty to a trained world"),
    "train objects": ("train:objects", "train the moving objects of a world, on another recording"),
    "train latent-actions": ("train:latent_actions", "learn actions from pictures alone"),
    "train distil": ("train:few_steps", "distil a world that draws a frame in many steps into one of one or two"),
    "train dreams": ("train:dreams", "continue training a world on its own rollouts"),
    "export policy": ("export:policy", "write a learned policy as an ONNX file that runs without PyTorch"),
    "export world": ("export:world", "write a learned world of frames as one HTML file that runs in any browser"),
    "score": ("score:score", "compare a world's predictions with a recording"),
    "check": ("physics:check", "check which laws of physics a world's predictions keep"),
    "space fit": ("space:fit", "fit a place of Gaussians to a recording, photographs or a video"),
    "space grow": ("space:grow", "invent what a place does not know"),
    "space lift": ("space:lift", "make a place to walk in from one picture or a panorama"),
    "space build": ("space:build", "build a place to walk in from a sentence or a layout of rooms and furniture"),
    "space import": ("space:import_", "import a file of another tool as a world (.ply, .spz, .sog, .glb)"),
    "space export": ("space:export", "write a world's Gaussians for other tools, or as a page to walk in"),
    "space view": ("space:view", "walk in a place and edit it by hand, drawn by your browser"),
    "space edit": ("space:edit", "move, turn, scale, recolour, duplicate or delete a part of a place; undo"),
    "list": ("worlds:list_worlds", "list the available worlds"),
    "convert-world": ("worlds:convert_world", "convert a world of an earlier release"),
    "data doctor": ("data:doctor", "find faults in a recording, and repair them"),
    "data convert": ("data:convert", "convert a recording to another format"),
    "data merge": ("data:merge", "merge recordings of several robots"),
    "data label": ("data:label", "write learned actions into a recording"),
    "data view": ("data:view", "look through a recording in the browser"),
}
# names of commands and options in older releases
RENAMED = {
    "train eye": "train estimator",
    "train things": "train objects",
    "record gym": "record world",
    "train senses": "train uncertainty",
    "--eye": "--estimator",
}

_OF_THE_MACHINE = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS, errno.EEXIST, errno.ENOTDIR, errno.EISDIR)
_RENDERERS = (
    "mujoco.egl", "mujoco.glfw", "mujoco.osmesa", "mujoco.cgl", "mujoco.gl_context", "glfw", "OpenGL",
    "gymnasium.envs.mujoco.mujoco_rendering",
)  # fmt: skip


@contextmanager
def _ending_workers() -> Iterator[None]:
    """Lets SIGTERM end the workers of this process, and then the process as Ctrl-C does."""

    def end(number: int, frame: object) -> None:
        for worker in multiprocessing.active_children():
            worker.terminate()
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Prints a warning as its sentence, without a line of source."""
    before, plain = warnings.formatwarning, lambda message, *_, **__: f"terrella: {message}\n"
    warnings.formatwarning = plain
    try:
        yield
    finally:
        warnings.formatwarning = before


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command. The exit code is 0, the command's own, 2 with one sentence on stderr, or 130 after Ctrl-C or SIGTERM."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with _ending_workers(), _plain_warnings():
            return _run(given)
    except KeyboardInterrupt as stop:
        print(f"terrella: {str(stop) or 'stopped.'}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has exited
        sys.stdout = None
        return 0
    except Exception as error:
        sentence = _sentence(error)
        if sentence is None:
            raise
        print(f"terrella: {sentence}", file=sys.stderr)
        return 2


def _run(given: list[str]) -> int:
    if given[:1] == ["help"]:  # terrella help play: terrella play --help
        given = [*given[1:], "--help"]
    if given[:1] in (["version"], ["--version"], ["-V"]):
        from ..version import __version__

        print(f"terrella {__version__}")
        return 0
    name, rest = _command(given)
    if name not in COMMANDS:
        return _help(name, requested=bool(rest))

    import tyro

    from .flags import dashed_path, given_twice, value_of_flag
    from .help_page import help_page

    module, _, function = COMMANDS[name][0].partition(":")
    command: Callable[..., int | None] = getattr(import_module(f"{__name__}.{module}"), function)
    markers, words = (
        (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes),
        rest if name == "space lift" else [RENAMED.get(word, word) for word in rest],  # its --eye is a height
    )
    if {"-h", "--help"} & set(words):
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", DeprecationWarning
            )  # of get_parser; constraints.txt keeps a tyro that has it
            parser: Any = tyro.extras.get_parser(command, prog=f"terrella {name}", config=markers)
        print(help_page(parser))
        return 0
    if sentence := given_twice(command, words):
        raise TerrellaError(sentence)
    try:
        return tyro.cli(command, prog=f"terrella {name}", args=words, config=markers) or 0
    except SystemExit as stop:
        if stop.code == 2 and (sentence := value_of_flag(command, words) or dashed_path(words)):
            print(f"terrella: {sentence}", file=sys.stderr)
        raise


def _command(given: list[str]) -> tuple[str, list[str]]:
    """The command's name and the words after it; of a missing command "" or the group. TerrellaError for unknown names."""
    group = ""
    for at, word in enumerate(given[:2]):
        name = f"{group} {word}".strip()
        name = RENAMED.get(name, name)
        if name in COMMANDS:
            return name, given[at + 1 :]
        if word.startswith("-"):
            break
        known = _members(group)
        if name not in known:
            inside = [one for one in COMMANDS if not group and one.split()[-1] == word]  # of a group: data convert
            hint = (
                f"; did you mean '{inside[0]}'?"
                if inside
                else did_you_mean(word, known if group else (*known, "help", "version"))
            )
            raise TerrellaError(f"there is no command '{name}'{hint or '.'} The commands are {', '.join(known)}.")
        group = name
    rest = given[len(group.split()) :]
    if rest and rest[0] not in ("-h", "--help"):
        hint = did_you_mean(rest[0], ("--help", "--version"))
        raise TerrellaError(f"there is no option '{rest[0]}'{hint or '.'} `terrella --help` lists the commands.")
    return group, rest


def _members(group: str) -> list[str]:
    """The first words of all commands, or the second words of those in a group."""
    at = len(group.split())
    names = [name.split() for name in COMMANDS if not group or name.startswith(f"{group} ")]
    return list(dict.fromkeys(words[at] for words in names))


def _help(group: str, requested: bool) -> int:
    """Lists the commands; on stderr with exit code 2 where a command is missing."""
    shown = {name: words for name, (_, words) in COMMANDS.items() if not group or name.startswith(f"{group} ")}
    lines = [f"usage: terrella {group + ' ' if group else ''}COMMAND ...", ""]
    lines += [] if group else [DESCRIPTION, ""]
    lines += [f"  terrella {name:<22} {words}" for name, words in shown.items()]
    lines += ["", "`terrella help COMMAND` explains a command and its options."]
    lines += [] if group else ["`terrella version` prints the version."]
    print("\n".join(lines), file=sys.stdout if requested else sys.stderr)
    return 0 if requested else 2


def _sentence(error: Exception) -> str | None:
    """The sentence for an error of the input or the machine; None for a fault of this program, which needs its trace."""
    if isinstance(error, TerrellaError):
        return str(error)
    if isinstance(error, OSError) and error.errno in _OF_THE_MACHINE:
        where = f" ({error.filename})" if error.filename else ""
        return f"{error.strerror}{where}; {remedy_of(error)}, or choose another folder."
    if is_out_of_memory(error):
        where = (
            "the GPU" if any(word in str(error) for word in ("CUDA", "CUBLAS", "CUDNN", "CUSOLVER")) else "this machine"
        )
        smaller = "give a smaller --batch or --size, where the command has one"
        return f"{where} has too little memory for that; {smaller}{', or --device cpu' * (where == 'the GPU')}."
    if isinstance(error, ModuleNotFoundError) and error.name in ("mujoco", "glfw", "OpenGL"):
        return f"{error.name} is not installed; `pip install 'terrella[mujoco]'` installs what MuJoCo's worlds need."
    if _of_a_renderer(error):
        sys.unraisablehook = lambda _: None  # a renderer that failed to start complains again when it is deleted
        what = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
        return f"the simulator cannot draw without a display ({what}); set MUJOCO_GL=egl or MUJOCO_GL=osmesa and try again."
    return None


def _of_a_renderer(error: Exception) -> bool:
    """Whether MuJoCo's renderer, or a library that it draws with, is in the error's trace."""
    if type(error).__module__ == "mujoco" and any(word in str(error) for word in ("OpenGL", "gladLoadGL", "EGL")):
        return True
    frames = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
    starts = tuple(f"{renderer}." for renderer in _RENDERERS)
    return any(f"{name}.".startswith(starts) for name in (type(error).__module__, *frames))
