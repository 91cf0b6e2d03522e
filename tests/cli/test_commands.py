"""The command line from outside: its options are promises, and bad input gets one sentence and exit code 2."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.cli.tiny import FAILS
from tests.worlds.made import place

import terrella
from terrella.care import doctor
from terrella.cli import COMMANDS, main, record
from terrella.core import make_rng
from terrella.core.errors import TerrellaError
from terrella.data import Dataset
from terrella.workflows.acceleration import AccelerationConfig, measure_acceleration
from terrella.workflows.collect import CollectResult
from terrella.workflows.export_space import _eased
from terrella.worlds.controls import CHOICE, Controls
from terrella.worlds.folder import load_world, save_world

# Whoever changes an option changes what people have in their scripts: change it here on purpose.
OPTIONS = {
    "learn": "--action-names --adapter --batch --device --fps --frames --idle --json --keys --minutes --no-compile --no-half --out "
    "--policy --practise --preset --randomise --seed --size --student --task --workers",
    "record doom": "--frames --height --human --json --live-mcap --out --port --scenario --seed --skill",
    "record world": "--action-names --adapter --episodes --fps --frames --human --idle --in --json --keys --live-mcap --on --out "
    "--pictures --policy --port --randomise --seed --size --task --workers",
    "play": "--action-names --agent --agent-ms --compare --device --estimator --fast --fps --host --idle --image --json --keys "
    "--memory-mb --no-memory --policy --port --randomise --record --remember --seed --token --truth --watts",
    "practise": "--adapter --episodes --fps --goal --group-size --groups --in --json --learning-rate --minutes "
    "--no-blind --noise --out --randomise --real --reference --reward --save-every-s --seed --size --steps --success --task "
    "--updates --within",
    "plan": "--adapter --agent --apart --block --budget-ms --colour "
    "--cost --decay --device --elites --episodes --fps --goal --horizon --iterations --json --keep "
    "--memory-mb --momentum --no-curve --out --proposal --randomise --real --replan --rollouts --samples --search "
    "--seed --size --skills --spread --steps --success --task --temperature --trust --watts --within",
    "skills learn": "--batch --json --learning-rate --out --policy --save-every-s --seed --steps",
    "skills list": "--json",
    "skills add": "--json",
    "skills rename": "--json",
    "skills try": "--adapter --episodes --fps --in --json --randomise --seed --size --task",
    "score": "--clips --data --device --drift --fast --fresh --horizons --json --long-steps --new --out --quick --seed",
    "bench costs": "--batch --device --fast --json --minutes --seed",
    "bench geometry": "--data --device --fresh --json --rollouts --seed --steps",
    "bench physics": "--device --families --frames --json --out --rollouts --seed --steps --train",
    "adapt": "--batch --device --from --json --keep --learning-rate --minutes --no-laws --out --seed --steps",
    "check": "--coarse --data --device --fresh --json --metres-per-pixel --out --pictures --rollouts --seed --steps --system",
    "space lift": "--collider --depth --eye --fov --json --longest --out --panorama",
    "space grow": "--json --seed --steps --to",
    "list": "--json",
    "data doctor": "--json --out --repair --yes",
    "data convert": "--episodes --fps --json --pictures --policy --seed --to",
    "data merge": "--dry --fps --json --mapping --out",
    "data label": "--frames --json --labelled --out --seed",
    "data view": "--host --json --out --port --rerun --token",
}


def help_of(command: str, capsys) -> str:
    try:
        assert main([*command.split(), "--help"]) == 0
    except SystemExit as stop:
        assert stop.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", OPTIONS)
def test_the_options_are_as_promised(command, capsys):
    shown = help_of(command, capsys)
    found = set(re.findall(r"^\W+(?:-h, )?(--[a-z][\w-]*)", shown, re.MULTILINE)) - {"--help"}
    assert " ".join(sorted(found)) == OPTIONS[command]
    for option in re.split(r"\n  (?=--[a-z])", shown)[1:]:
        text = re.sub(r"^--\S+( [A-Z{\[]\S*( \.\.\.\]\])?)?|\(default:.*|\(required\).*", "", " ".join(option.split()))
        assert len(text.strip()) > 10, f"{option.split()[0]} says nothing"


@pytest.mark.parametrize(
    "command", ["plan", "play", "practise", "evaluate", "train latent", "train policy", "data merge", "space build"]
)
def test_help_names_values_and_gives_only_defaults_that_are_values(command, capsys):
    shown = help_of(command, capsys)
    assert not re.search(r"default: (None|False|True|''|)\)|\bSTR\b|\{None|config\.", shown), shown
    assert not re.search(r"^ +--no-[\w-]+ *$\n\s*(--|$)", shown, re.MULTILINE), "every flag is described"
    assert shown.startswith(f"usage: terrella {command} ") and all(len(line) <= 110 for line in shown.splitlines())


def test_a_flag_is_described_as_what_it_does(capsys):
    shown = " ".join(help_of("plan", capsys).split())
    assert "--no-curve Do not plan again" in shown
    assert "--no-memory Play a learned world without its keyframes." in " ".join(help_of("play", capsys).split())
    for name in ("pictures", "vectors"):
        assert f"--no-{name} Observe the recording's" in " ".join(help_of("train latent", capsys).split())


def test_help_and_version_are_commands_too(capsys):
    assert help_of("data doctor", capsys) == (main(["help", "data", "doctor"]), capsys.readouterr().out)[1]
    assert main(["help"]) == 0 and "terrella data doctor" in capsys.readouterr().out
    assert main(["version"]) == 0 and capsys.readouterr().out == f"terrella {terrella.__version__}\n"


def test_train_promises_its_main_options(capsys):
    shown = help_of("train video", capsys)
    for option in ("--out", "--steps", "--hours", "--device", "--seed", "--json"):
        assert f"{option} " in shown


def test_every_command_is_in_the_help(capsys):
    shown = help_of("", capsys)
    assert set(re.findall(r"^  terrella (.+?)  ", shown, re.MULTILINE)) == set(COMMANDS)
    assert help_of("data", capsys).count("terrella data ") == 6


def test_the_package_runs_as_a_module():
    run = subprocess.run([sys.executable, "-m", "terrella", "version"], capture_output=True, text=True)
    assert run.stdout == f"terrella {terrella.__version__}\n", run.stderr


def test_the_version_is_said(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"terrella {terrella.__version__}\n"


@pytest.mark.parametrize(
    "given, meant",
    [
        (["paly", "doom-maze"], "'play'"),
        (["hlep"], "'help'"),
        (["data", "docter", "x"], "'doctor'"),
        (["train", "vido", "x"], "'video'"),
        (["--versoin"], "'--version'"),
        (["play", "doom-mzae"], "'doom-maze'"),
        (["play", "doom:my_way_hom"], "my_way_home"),
        (["play", "doom-maze", "--prot", "8"], "--port"),
    ],
)
def test_misspelt_words_are_recognised(given, meant, capsys):
    try:
        assert main(given) == 2
    except SystemExit as stop:
        assert stop.code == 2
    said = capsys.readouterr()
    assert meant in said.err and said.out == "" and "Traceback" not in said.err


@pytest.mark.parametrize(
    "given, sentence",
    [
        (
            ["play", "doom-maze", "--compare", "doom:my_way_home"],
            "--compare takes no value; --truth GAME names the game.",
        ),
        (["play", "doom-maze", "--compare=doom:my_way_home"], "--compare takes no value; --truth GAME names the game."),
        (["play", "doom-maze", "--remember", "eye.onnx"], "--remember takes no value; --estimator FILE names"),
        (["space", "fit", "x", "--out", "y", "--watch", "80"], "--watch takes no value; --port PORT chooses the port."),
        (["space", "edit", "x", "--delete", "3"], "--delete takes no value; --box, --sphere, --plane or --object"),
        (["space", "edit", "x", "--undo", "2"], "--undo takes no value; leave the value out."),
    ],
)
def test_a_flag_that_was_given_a_value_is_explained(given, sentence, capsys):
    with pytest.raises(SystemExit) as stop:
        main(given)
    shown = capsys.readouterr()
    assert stop.value.code == 2 and f"terrella: {sentence}" in shown.err and shown.out == ""


def test_a_positional_behind_a_flag_is_not_its_value(capsys):
    with pytest.raises(SystemExit):
        main(["play", "--compare", "doom-maze", "--prot", "8"])
    shown = capsys.readouterr()
    assert "takes no value" not in shown.err and "--port" in shown.err


def test_a_missing_command_shows_what_there_is(capsys):
    assert main([]) == 2 and main(["data"]) == 2
    assert "terrella data doctor" in capsys.readouterr().err


def test_the_names_of_older_releases_still_work(capsys):
    assert help_of("train eye", capsys) == help_of("train estimator", capsys)
    assert main(["play", "no-such-world", "--eye", "x"]) == 2
    assert "no-such-world" in capsys.readouterr().err


@pytest.mark.parametrize("device", ["tpu", "cuda:banana", "", "cuda:99"])
def test_a_device_that_is_not_here_is_said(device, capsys):
    assert "--device" in refusal(["play", "doom-maze", "--device", device], capsys)


def test_a_simulator_without_a_display_is_said(capsys, monkeypatch):
    class FatalError(Exception):
        pass

    FatalError.__module__ = "mujoco"

    def broken(*_, **__):
        raise FatalError("an OpenGL platform library has not been loaded into this process")

    monkeypatch.setattr("terrella.library.load", broken)
    assert "MUJOCO_GL=egl" in refusal(["play", "gym:Ant-v5"], capsys)


def test_only_a_renderer_has_no_display(capsys, monkeypatch):
    def load(error, name="terrella"):
        """A `library.load` that raises `error` in the module `name`."""
        space = {"__name__": name, "error": error}
        exec("def load(*_, **__): raise error", space)
        monkeypatch.setattr("terrella.library.load", space["load"])

    load(ModuleNotFoundError("No module named 'mujoco'", name="mujoco"))
    assert "terrella[mujoco]" in refusal(["play", "gym:Ant-v5"], capsys)
    load(ImportError("Cannot initialize a EGL device display."), "mujoco.egl")
    assert "MUJOCO_GL=egl" in refusal(["play", "gym:Ant-v5"], capsys)
    for error in (ValueError("the weights of mujoco-ant lack REGEL"), KeyError("glfw")):
        load(error)
        with pytest.raises(type(error)):
            main(["play", "gym:Ant-v5"])


@pytest.mark.parametrize("rows", [0, 1])
def test_a_recording_of_nothing_is_refused(rows, tmp_path, capsys, monkeypatch):
    def serve(worlds, _, *, sink_factory, **__):
        world, rng, sink = worlds[0], make_rng(0), sink_factory()
        shown = world.render(world.start(1, rng), list(world.spec.channels))
        for _ in range(rows):
            sink.add({name: value[0].numpy() for name, value in shown.items()}, None, 0.0, False)
        sink.close()

    monkeypatch.setattr("terrella.serve.serve", serve)
    said = refusal(["record", "world", "gym:CartPole-v1", "--human", "--out", tmp_path / "set"], capsys)
    assert "nothing was recorded" in said


@pytest.mark.parametrize(
    "more, kept",
    [([], True), (["--host", "0.0.0.0", "--token", "x"], False), (["--compare", "--truth", "gym:CartPole-v1"], False)],
    ids=["own", "strangers", "beside its game"],
)
def test_keys_set_on_the_page_are_kept_in_the_worlds_folder_and_told_in_recordings(tmp_path, monkeypatch, more, kept):
    def serve(worlds, _, *, sink_factory, keep, kept_in, **__):
        keep(replace(worlds[0].spec, keys={"KeyX": [1.0]}))
        assert (str(tmp_path / "one") in kept_in) == bool(kept_in) == kept
        sink_factory().close()

    monkeypatch.setattr("terrella.workflows.play.serve", serve)
    save_world(place(Controls(CHOICE, (0.0,), (1.0,))), tmp_path / "one")
    assert main(["play", str(tmp_path / "one"), "--record", str(tmp_path / "set"), "--device", "cpu", *more]) == 0
    assert (load_world(tmp_path / "one").spec.keys == {"KeyX": [1.0]}) == kept
    assert json.loads((tmp_path / "set" / "meta" / "terrella.json").read_text())["world"]["keys"] == {"KeyX": [1.0]}


def test_help_imports_nothing_heavy():
    script = (
        "import sys; from terrella.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "sys.exit(' '.join({'torch', 'numpy', 'av', 'pyarrow', 'starlette'} & set(sys.modules)) or 0)"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert run.returncode == 0, f"`terrella --help` imported {run.stderr}"


def refusal(arguments: list, capsys) -> str:
    """The one sentence of a refused command."""
    assert main([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = [line for line in captured.err.splitlines() if line.startswith("terrella: ")]
    assert len(lines) == 1 and "Traceback" not in captured.err, captured.err
    return lines[0]


def test_an_unknown_world_is_named_and_the_known_are_listed(capsys):
    said = refusal(["play", "no-such-world"], capsys)
    assert "no-such-world" in said and "doom:my_way_home" in said


def test_an_environment_without_its_gym_is_recognised(capsys):
    assert "did you mean 'gym:CartPole-v1'?" in refusal(["learn", "CartPole-v1"], capsys)


def test_a_path_that_begins_with_a_dash_is_recognised(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "-film.mp4").touch()
    with pytest.raises(SystemExit):
        main(["data", "convert", "-film.mp4", "out"])
    assert "write ./-film.mp4" in capsys.readouterr().err


def test_a_command_of_a_group_is_recognised_without_it(capsys):
    assert "did you mean 'data convert'?" in refusal(["convert", "here"], capsys)
    assert "did you mean 'data doctor'?" in refusal(["doctor"], capsys)


def test_a_file_is_no_folder_to_record_to(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    assert "give a folder" in refusal(["play", "gym:CartPole-v1", "--record", tmp_path / "file"], capsys)


def test_what_an_environment_played_before_it_failed_is_kept(capsys, tmp_path):
    said = refusal(["record", "world", FAILS, "--out", tmp_path / "set", "--frames", 500], capsys)
    assert said.startswith(f"terrella: {FAILS} fails when it is stepped, with its own error: OSError: the engine is")
    kept = Dataset(tmp_path / "set")
    assert f"{kept.length} frames are safe" in said and kept.length > 100 and not doctor(tmp_path / "set")


def test_an_unknown_scenario_is_named(capsys, tmp_path):
    pytest.importorskip("vizdoom", reason="ViZDoom is not installed: pip install -e '.[sim]'")
    assert "no_such_scenario" in refusal(
        ["record", "doom", "--scenario", "no_such_scenario", "--out", tmp_path], capsys
    )


def test_an_unknown_environment_is_named(capsys, tmp_path):
    assert "NoSuch-v0" in refusal(["record", "world", "gym:NoSuch-v0", "--out", tmp_path], capsys)


def test_a_folder_that_is_no_checkpoint_is_refused(capsys, tmp_path):
    assert "world.json" in refusal(["play", tmp_path], capsys)


@pytest.mark.parametrize("content", ['{"kind": "of another sort"}', "{not json", "[]", '{"kind": 3}', "{}"])
def test_a_foreign_checkpoint_is_refused(content, capsys, tmp_path):
    (tmp_path / "world.json").write_text(content)
    assert str(tmp_path) in refusal(["play", tmp_path], capsys)


def test_a_missing_gpu_is_said(capsys, monkeypatch, tmp_path):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    (tmp_path / "world.json").write_text("{}")
    assert "GPU" in refusal(["play", tmp_path, "--device", "cuda"], capsys)


def test_a_port_in_use_is_said(capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"port {port}" in refusal(["play", "gym:CartPole-v1", "--port", port], capsys)


@pytest.mark.parametrize("command", [["data", "doctor"], ["train", "video"]])
def test_a_missing_dataset_is_said(command, capsys, tmp_path):
    extra = ["--out", tmp_path / "run"] if command[0] == "train" else []
    assert "nowhere" in refusal([*command, tmp_path / "nowhere", *extra], capsys)


def test_a_foreign_dataset_is_left_alone(capsys, tmp_path):
    (tmp_path / "holiday.txt").write_text("mine")
    refusal(["train", "video", tmp_path, "--out", tmp_path / "run"], capsys)
    assert (tmp_path / "holiday.txt").read_text() == "mine"


def test_a_folder_that_cannot_be_written_is_said(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    assert "file" in refusal(["record", "world", "gym:CartPole-v1", "--out", tmp_path / "file", "--frames", 10], capsys)


@pytest.mark.parametrize("height", [0, -96, 100])
def test_a_height_that_the_game_has_not_is_said(height, capsys, tmp_path):
    pytest.importorskip("vizdoom", reason="ViZDoom is not installed: pip install -e '.[sim]'")
    assert "384x512" in refusal(["record", "doom", "--height", height, "--out", tmp_path / "set"], capsys)


def test_a_recording_of_one_frame_is_refused(capsys, tmp_path):
    said = refusal(["record", "world", "gym:CartPole-v1", "--out", tmp_path / "set", "--frames", 1], capsys)
    assert "2 rows" in said and not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    "wrong", [["--horizons", 0], ["--clips", 0], ["--long-steps", 3], ["--long-steps", -5], ["--horizons", 8, -1]]
)
def test_a_score_over_no_steps_is_refused(wrong, capsys, tmp_path):
    assert "from 1 up" in refusal(["score", "doom-maze", "--data", tmp_path, *wrong], capsys)


def test_missing_checkpoints_to_list_are_said(capsys, tmp_path):
    assert "nowhere" in refusal(["list", tmp_path / "nowhere"], capsys)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB."),
            "the GPU has too little memory for that; give",
        ),
        (
            RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: 8 bytes"),
            "this machine has too little",
        ),
        (RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED"), "the GPU has too little memory"),
        (RuntimeError("cuDNN error: CUDNN_STATUS_ALLOC_FAILED"), "the GPU has too little memory"),
        (MemoryError(), "this machine has too little memory"),
    ],
)
def test_a_lack_of_memory_is_a_sentence(error, said, capsys, monkeypatch):
    def lacking(*_, **__):
        raise error

    monkeypatch.setattr("terrella.library.worlds", lacking)
    assert said in refusal(["list"], capsys)


def test_ctrl_c_exits_with_130(capsys, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("terrella.library.worlds", interrupted)
    assert main(["list"]) == 130
    assert capsys.readouterr().err == "terrella: stopped.\n"


def test_our_own_faults_keep_their_trace(monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("a fault of ours")

    monkeypatch.setattr("terrella.library.worlds", broken)
    with pytest.raises(RuntimeError, match="a fault of ours"):
        main(["list"])


def test_list_shows_checkpoints_with_their_cards(capsys, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "world.json").write_text('{"kind": "video", "card": {"steps": 12}}')
    assert main(["list", str(tmp_path), "--json"]) == 0
    entries = json.loads(capsys.readouterr().out)
    assert {"name": str(tmp_path / "mine"), "source": "checkpoint", "card": {"steps": 12}} in entries
    assert main(["list", str(tmp_path)]) == 0
    assert "steps: 12" in capsys.readouterr().out


def test_list_offers_what_is_installed_and_says_how_to_install_the_rest(capsys, monkeypatch):
    there = terrella.library.find_spec
    monkeypatch.setattr("terrella.library.find_spec", lambda name: None if name in ("ale_py", "mjlab") else there(name))
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert not any(line.startswith(("mujoco:go1", "gym:ALE/Pong-v5")) for line in lines)
    assert "not installed: gym:ALE/Pong-v5: pip install 'terrella[atari]'" in lines
    assert any(line.startswith("not installed: mujoco:go1: ") and "mjlab" in line for line in lines)
    assert lines[-1].startswith("next: terrella play ")


def test_record_then_look(capsys, tmp_path):
    arguments = ["record", "world", "gym:CartPole-v1", "--out", str(tmp_path / "set"), "--frames", "40", "--json"]
    assert main(arguments) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["frames"] == 40 and facts["world"] == "gym:CartPole-v1"
    assert facts["next"] == f"terrella train video {tmp_path / 'set'} --out runs/set"
    assert (tmp_path / "set" / "look.jpg").stat().st_size > 0
    assert main(arguments) == 0, "a finished recording is left as it is"
    assert json.loads(capsys.readouterr().out)["frames"] == 40
    assert main(["data", "doctor", str(tmp_path / "set"), "--json"]) == 0
    json.loads(capsys.readouterr().out)


@pytest.mark.slow
def test_whole_episodes_of_a_policy_are_recorded_by_workers_and_again(capsys, tmp_path):
    folder, common = (
        tmp_path / "set",
        ["record", "world", "gym:CartPole-v1", "--policy", "constant:1", "--pictures", "none"],
    )
    for count in (2, 3):
        assert main([*common, "--episodes", str(count), "--workers", "1", "--out", str(folder), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["episodes"] == count
    assert set(np.concatenate([Dataset(folder).episode(at)["action"][:-1].ravel() for at in range(3)])) == {1}


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--workers", "0"], "0 workers"),
        (["--workers", "2", "--human"], "one player"),
        (["--episodes", "3", "--frames", "9"], "how much"),
        (["--episodes", "0"], "how much to record"),
        (["--policy", "explroer"], "did you mean 'explorer'"),
        (["--in", "gym:CartPole-v1"], "--in is for a --policy"),
        (["--in", "gym:CartPole-v1", "--policy", "random"], "--in is for a --policy"),
        (["--in", "gym:CartPole-v1", "--policy", "explorer@0.3"], "--in is for a --policy"),
        (["--in", "gym:CartPole-v1", "--policy", "plan", "--randomise", "no.toml"], "without --in"),
    ],
)
def test_who_plays_and_how_much_is_checked(more, said, capsys, tmp_path):
    assert said in refusal(["record", "world", "gym:CartPole-v1", "--out", tmp_path / "set", *more], capsys)


def test_what_comes_next_depends_on_who_was_recorded(tmp_path):
    recorded = CollectResult(tmp_path / "set", {"look": "look.jpg"})
    assert record._training(recorded, "teacher:0.1").startswith("terrella train policy --method imitation --from")
    assert record._training(recorded, "explorer").startswith("terrella train video")
    assert record._training(CollectResult(tmp_path, {}), "random").startswith("terrella train latent")


def test_the_doctor_exits_with_1_where_a_recording_is_broken(capsys, tmp_path):
    folder = tmp_path / "set"
    assert main(["record", "world", "gym:CartPole-v1", "--out", str(folder), "--frames", "40"]) == 0
    broken = next(folder.glob("videos/**/*.mp4"))
    broken.write_bytes(broken.read_bytes()[:100])
    capsys.readouterr()
    assert main(["data", "doctor", str(folder)]) == 1
    assert "mend" in capsys.readouterr().out


def test_warnings_are_sentences_without_our_source(monkeypatch, capsys):
    import warnings

    from terrella import cli

    monkeypatch.setattr(
        cli, "_run", lambda given: print(warnings.formatwarning("so it is.", UserWarning, "x.py", 3)) or 0
    )
    before = warnings.formatwarning
    assert main([]) == 0 and capsys.readouterr().out.strip() == "terrella: so it is."
    assert warnings.formatwarning is before


@pytest.mark.parametrize("name", ["doom-maze", "doom:my_way_home", "gym:ALE/Pong-v5"])
def test_a_world_that_always_draws_is_not_recorded_without_pictures(name, tmp_path, capsys):
    assert main(["record", "world", name, "--pictures", "none", "--frames", "10", "--out", str(tmp_path / "set")]) != 0
    assert "always draws its pictures" in capsys.readouterr().err


def test_a_throughput_needs_a_batch():
    with pytest.raises(TerrellaError, match="--batches"):
        measure_acceleration("doom-maze", AccelerationConfig(batches=()))


def test_a_film_passes_thousands_of_stations():
    stations = torch.rand(3000, 4)
    poses = _eased(stations, 6001)
    assert torch.allclose(poses[[0, -1], :3], stations[[0, -1], :3])


def test_an_option_of_many_values_that_is_given_twice_is_refused(capsys):
    """Only the last would count; of one value the last does."""
    assert main(["practise", "p", "--in", "x", "--out", "y", "--goal", "a=1", "--goal=b=2"]) == 2
    assert "--goal is given twice; give it once, with all of its values behind it." in capsys.readouterr().err
    assert main(["plan", "none-such", "--seed", "1", "--seed", "2"]) == 2
    assert "twice" not in capsys.readouterr().err
