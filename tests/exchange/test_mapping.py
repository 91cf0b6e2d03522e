"""A mapping is guessed from names and units alone, survives its file, and every slip in that file is named."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from robots import arm, robot, rover

from terrella.core.errors import DatasetError
from terrella.data.source import Sensor
from terrella.exchange.merging.mapping import (
    Dimension,
    MergedCamera,
    MergeMapping,
    MergeRows,
    Number,
    SourceMapping,
    Vector,
    affine,
    check_mapping,
)
from terrella.exchange.merging.mapping_file import mapping_of, read_mapping, to_toml, write_mapping
from terrella.exchange.merging.propose import propose
from terrella.exchange.merging.units import basic, convert, quantity


def vector(name, names, units=None, frame="", size=None, rate=None):
    return Sensor(name, "vector", (size or len(names),), "float32", tuple(names), units or {}, frame, rate_hz=rate)


def goes(mapping, source, sensor="observation.state"):
    found = next(it for it in mapping.sources if it.path == source)
    return [number.to for number in found.vectors[sensor].numbers]


def test_same_names_go_together_and_units_are_converted():
    sources = {
        "A": robot("a", [vector("observation.state", ["x_m", "Yaw", "grip"], {"Yaw": "rad", "grip": "0..1"})], []),
        "B": robot("b", [vector("observation.state", ["grip", "x_mm", "yaw"], {"yaw": "deg", "grip": "0..255"})], []),
    }
    mapping = propose(sources)
    check_mapping(mapping, sources)
    assert goes(mapping, "A") == ["x", "yaw", "grip"] and goes(mapping, "B") == ["grip", "x", "yaw"]
    assert mapping.state == {"x": Dimension("m"), "yaw": Dimension("rad"), "grip": Dimension("0..1")}
    scales = [
        affine(number, mapping.state[number.to]) for number in mapping.sources[1].vectors["observation.state"].numbers
    ]
    assert scales == [(pytest.approx(1 / 255), 0), (pytest.approx(0.001), 0), (pytest.approx(0.0174532925), 0)]


def test_positions_and_quaternions_are_known_by_their_usual_names():
    names = ["position.x", "pos_y", "pz", "quat_w", "quat_x", "quat_y", "quat_z"]
    turns = ["rotation_x", "rotation_y", "rotation_z"]  # without a w: angles, not a quaternion
    sources = {
        "A": robot("a", [vector("observation.state", ["x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"])], []),
        "B": robot("b", [vector("observation.state", names)], []),
        "C": robot("c", [vector("observation.state", turns)], []),
    }
    mapping = propose(sources)
    assert goes(mapping, "A") == goes(mapping, "B") == ["x", "y", "z", "qw", "qx", "qy", "qz"]
    assert goes(mapping, "C") == turns
    assert any(note.startswith("x, y, z: no unit is stated") for note in mapping.sources[1].notes)


def test_what_has_no_name_is_nobody_elses():
    unnamed, counted = vector("observation.state", [], size=2), vector("observation.state", ["state_0", "state_1"])
    sources = {"A": robot("a", [unnamed], []), "B": robot("b", [counted], []), "C": robot("a", [unnamed], [])}
    mapping = propose(sources)
    assert goes(mapping, "A") == goes(mapping, "C") == ["a.state_0", "a.state_1"]
    assert goes(mapping, "B") == ["b.state_0", "b.state_1"] and mapping.embodiments == ("a", "b")
    assert all(".state_0, " in source.notes[0] and "no name in" in source.notes[0] for source in mapping.sources)


def test_frames_and_quantities_are_never_mixed():
    sources = {
        "A": robot("a", [vector("observation.state", ["x", "grip"], {"grip": "m"}, "world")], []),
        "B": robot("b", [vector("observation.state", ["x", "grip"], {"grip": "0..1"}, "base")], []),
        "C": robot("c", [vector("observation.state", ["x", "grip"])], []),
        "D": robot("d", [vector("observation.state", ["x", "grip"], {"grip": "mm"}, "base")], []),
    }
    mapping = propose(sources)
    check_mapping(mapping, sources)
    assert [goes(mapping, path)[0] for path in "ABCD"] == ["x @ world", "x @ base", "c.x", "x @ base"]
    grips = [goes(mapping, path)[1] for path in "ABCD"]
    assert grips == ["grip (m) @ world", "grip (0..1) @ base", "c.grip", "grip (m) @ base"]
    assert mapping.state["x @ base"].frame == "base" and mapping.state["grip (m) @ base"].unit == "mm"


def test_other_sensors_are_mapped_kept_or_left_out():
    strange = [
        Sensor("observation.tactile", "vector", (500,), "float32"),
        Sensor("observation.images.front", "depth", (4, 4)),
        Sensor("odometer", "vector", (1,), "float32"),
        Sensor("next.scores", "vector", (3,), "float32"),
    ]
    sources = {"A": arm(), "B": rover(), "C": robot("snake", strange, [])}
    mapping = propose(sources)
    check_mapping(mapping, sources)
    arm_, rover_, snake = mapping.sources
    assert arm_.keep == {"next.reward": "next.reward", "next.done": "next.done"}
    assert rover_.keep == {"observation.points.lidar": "observation.points.rover.lidar"}
    assert goes(mapping, "B", "observation.imu") == ["imu.ax", "imu.wz"]
    assert snake.keep == {"observation.tactile": "observation.snake.tactile"}
    assert set(snake.out) == {"observation.images.front", "odometer", "next.scores"} and not snake.vectors
    assert list(mapping.cameras) == ["observation.images.front", "observation.images.mast", "observation.depth"]


def test_rates_and_sizes():
    small, big = arm("a", fps=10, size=(8, 12)), arm("b", fps=30, size=(48, 64))
    mapping = propose({"A": big, "B": small})
    assert mapping.rows.fps == 10 and mapping.cameras["observation.images.front"] == MergedCamera("image", 8, 12)
    assert any("scaled from 48 x 64 to 8 x 12" in note for note in mapping.sources[0].notes)
    assert propose({"A": big, "B": small}, fps=20).rows.fps == 20
    assert propose({"A": rover()}).rows.fps == 10  # its camera's
    silent = replace(rover(), sensors={"action": vector("action", ["go"])})
    assert propose({"A": silent}).rows.fps == 25  # as its first take shows
    slow = robot("s", [vector("observation.state", ["t"], rate=0.5)], [])
    assert propose({"A": slow}, fps=10).rows.max_gap_s == 6
    with pytest.raises(DatasetError, match="give the fps"):
        propose({"A": robot("r", [vector("action", ["go"])], [], fps=None)})
    with pytest.raises(DatasetError, match="no recordings are given"):
        propose({})


def test_two_robots_of_one_name_stay_two():
    one, other = vector("observation.state", ["x"]), vector("observation.state", ["y"])
    mapping = propose({"A": robot("r", [one], []), "B": robot("r", [other], []), "C": robot("r", [one], [])})
    assert [source.embodiment for source in mapping.sources] == ["r", "r_2", "r"]


def test_what_a_merge_made_is_not_merged_again():
    masked = [
        vector("observation.state", ["x"]),
        Sensor("observation.state_mask", "vector", (1,), "bool", ("x",)),
        Sensor("embodiment", "vector", (1,), "int64"),
        Sensor("observation.images.mask", "image", (4, 4, 3), "uint8"),
        Sensor("observation.face_mask", "vector", (1,), "float32", ("worn",)),
    ]
    (source,) = propose({"A": robot("r", masked, [])}).sources
    assert set(source.out) == {"observation.state_mask", "embodiment"}
    assert set(source.vectors) == {"observation.state", "observation.face_mask"}


labels = st.sampled_from(["x", "X", "x_m", "x_mm", "yaw", "qw", "", "state_1", "grip", "a.b", "pos_x", "elbow"])
stated = st.sampled_from(["", "m", "mm", "rad", "deg", "0..1", "0..255", "ticks"])


@st.composite
def fleets(draw):
    fleet = {}
    for path in "ABC"[: draw(st.integers(1, 3))]:
        sensors = []
        for name in draw(st.lists(st.sampled_from(["action", "observation.state", "observation.imu"]), unique=True)):
            names = draw(st.lists(labels, min_size=1, max_size=5))
            units = {label: draw(stated) for label in names}
            sensors.append(vector(name, names, units, draw(st.sampled_from(["", "base", "world"]))))
        fleet[path] = robot(draw(st.sampled_from(["r", "s"])), sensors, [])
    return fleet


@given(fleets(), st.randoms(use_true_random=False))
def test_every_guess_is_a_mapping_that_holds_whatever_the_order(fleet, random):
    mapping = propose(fleet)
    check_mapping(mapping, fleet)
    for source in mapping.sources:  # every number goes somewhere, whole, and nothing is there that nobody fills
        for name, sensor in fleet[source.path].sensors.items():
            assert len(source.vectors[name].numbers) == len(sensor.names)
            assert all(affine(n, mapping.dimensions(name)[n.to])[0] > 0 for n in source.vectors[name].numbers)
    for key, dimensions in (("action", mapping.action), ("state", mapping.state)):
        filled = {
            n.to
            for s in mapping.sources
            for name, v in s.vectors.items()
            for n in v.numbers
            if (name == "action") == (key == "action")
        }
        assert filled == set(dimensions)

    paths = list(fleet)
    random.shuffle(paths)
    other = propose({path: fleet[path] for path in paths})

    def together(mapping):  # which numbers of which robots share a dimension
        groups = {}
        for source in mapping.sources:
            for name, found in source.vectors.items():
                for place, number in enumerate(found.numbers):
                    groups.setdefault((name == "action", number.to), set()).add((source.path, name, place))
        return {frozenset(group) for group in groups.values()}

    if len({source.robot for source in fleet.values()}) == len(fleet):  # else the second of a name is numbered
        assert together(mapping) == together(other)
        assert set(mapping.state.items()) == set(other.state.items())


words = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
named = words.filter(bool)
numbers = st.one_of(
    st.builds(Number, words, named, words, st.none() | st.floats(0.001, 1e6), st.floats(-1e6, 1e6)),
    st.builds(Number, words, out=named),
)
mappings = st.builds(
    MergeMapping,
    st.builds(
        MergeRows,
        st.floats(0.1, 1000),
        st.sampled_from(["previous", "nearest"]),
        st.sampled_from(["previous", "nearest", "linear"]),
        st.sampled_from(["previous", "nearest", "linear"]),
        st.none() | st.floats(0.01, 100),
    ),
    st.dictionaries(words, st.builds(Dimension, words, words), max_size=3),
    st.dictionaries(words, st.builds(Dimension, words, words), max_size=3),
    st.dictionaries(
        words,
        st.builds(MergedCamera, st.sampled_from(["image", "depth"]), st.integers(1, 999), st.integers(1, 999)),
        max_size=2,
    ),
    st.lists(
        st.builds(
            SourceMapping,
            words,
            words,
            st.none() | st.floats(0.1, 1000),
            st.dictionaries(words, st.builds(Vector, st.lists(numbers, max_size=3).map(tuple), words), max_size=2),
            st.dictionaries(words, words, max_size=2),
            st.dictionaries(words, words, max_size=2),
            st.dictionaries(words, words, max_size=2),
            st.lists(words, max_size=2).map(tuple),
        ),
        min_size=1,
        max_size=2,
    ).map(tuple),
)


@given(mappings)
def test_any_mapping_is_read_as_it_was_written(mapping):
    import tomllib

    assert mapping_of(tomllib.loads(to_toml(mapping))) == mapping


def test_the_file_is_read_back_and_explains_itself(tmp_path):
    mapping = propose({"A": arm(unit="deg"), "B": arm("other"), "C": rover()})
    write_mapping(mapping, tmp_path / "mapping.toml")
    assert read_mapping(tmp_path / "mapping.toml") == mapping
    text = (tmp_path / "mapping.toml").read_text()
    assert '{name = "elbow", to = "elbow", unit = "deg"}, # converted to "rad"' in text and text.count("#") > 15
    with pytest.raises(DatasetError, match="cannot write the mapping"):
        write_mapping(mapping, tmp_path / "missing" / "mapping.toml")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("fps = 10.0", "fps = ", r"line 4"),
        ("fps = 10.0", "", r"\[rows\] lacks 'fps'"),
        ("fps = 10.0", "fps = 0", r"\[rows\] fps = 0 must be positive"),
        ("fps = 10.0", "fps = nan", r"\[rows\] fps = nan must be positive"),
        ("fps = 10.0", "fps = '10'", r"\[rows\] fps = '10' should be of type float"),
        ("[rows]", "[row]", r"unknown key 'row'"),
        (
            'images = "previous"',
            'images = "linear"',
            r"\[rows\] images = 'linear' is unknown; choose previous or nearest",
        ),
        ("height = 8", "height = 0", r"\[cameras\] 'observation.images.front' is 0 x 12"),
        ("height = 8", "height = true", "height = True should be of type int"),
        ('kind = "image"', 'kind = "points"', "choose image or depth"),
        ('"observation.images.front" = {', '"pictures" = {', "'pictures' must begin with 'observation.'"),
        ('embodiment = "arm"', "", "source 1 lacks 'embodiment'"),
        ('path = "B"', 'path = "A"', "two sources have one path"),
        (
            'to = "elbow"',
            'to = "knee"',
            r"source 1 \(arm\) vectors 'observation.state' number 1 \(elbow\) goes to 'knee', which \[state\]",
        ),
        (
            'to = "elbow"',
            'to = "shoulder"',
            r"'shoulder' of \[state\] is filled twice: by .*number 0 .*number 1 \(elbow\)",
        ),
        (', to = "elbow"', "", "needs either `to` or `out`"),
        ('to = "elbow"', 'to = "elbow", out = "both"', "needs either `to` or `out`"),
        ('to = "elbow"', 'to = "elbow", scale = 0', "scale 0"),
        ('to = "elbow"', 'to = "elbow", offset = inf', "offset = inf must be finite"),
        ('to = "elbow"', 'too = "elbow"', "unknown key 'too'; it may have name, to"),
        (
            'to = "elbow", unit = "deg"',
            'to = "elbow", unit = "mm"',
            r"number 1 \(elbow\): 'mm' measures length and 'rad' measures angle",
        ),
        (
            'to = "elbow", unit = "deg"',
            'to = "elbow", unit = "ticks"',
            "no conversion from 'ticks' to 'rad' is known; give its scale",
        ),
        ('frame = "base"\nnumbers', 'frame = "world"\nnumbers', "in the frame 'world' and 'shoulder' in 'base'"),
        (
            '  {name = "elbow", to = "elbow", unit = "deg"}, # converted to "rad"\n',
            "",
            "lists 2 numbers; that sensor is of kind vector, float32 and shape",
        ),
        ('name = "elbow"', 'name = "wrist"', "number 1 is called 'wrist' but is 'elbow' there"),
        (
            '[source.vectors."observation.state"]',
            '[source.vectors."observation.stat"]',
            "there is no sensor 'observation.stat'; it has observation.images",
        ),
        (
            '"observation.images.front" = "observation.images.front"',
            '"observation.images.front" = "observation.images.back"',
            r"which \[cameras\] does not have",
        ),
        ('"next.done" = "next.done"', '"next.done" = "next.reward"', "both fill 'next.reward'"),
        ('"next.done" = "next.done"', '"next.done" = "action_mask"', "'action_mask' cannot name a kept sensor"),
        ('"next.done" = "next.done"', '"next.done" = "observation.done"', "begin both or neither with 'next.'"),
        ('"next.done" = "next.done"', '"next.done" = 7', "= 7 should be of type str"),
        (
            '"next.done" = "next.done"',
            '"observation.state" = "observation.whole"',
            "under vectors and keep; leave it in one",
        ),
        ('"next.done" = "next.done"', '"observation.images.front" = "observation.whole"', "under cameras and keep"),
        ("numbers = [", "numbers = 3\n_ = [", r"unknown key '_'|numbers = 3 should be of type list"),
        ('path = "A"', 'path = "Z"', "has the path 'Z'; the given sources are A, B"),
    ],
)
def test_every_slip_is_named(tmp_path, old, new, said):
    sources = {"A": arm(unit="deg"), "B": arm("other")}
    text = to_toml(propose(sources))
    assert old in text
    (tmp_path / "m.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(DatasetError, match=said):
        check_mapping(read_mapping(tmp_path / "m.toml"), sources)


@given(st.data())
def test_no_damage_to_the_file_is_more_than_an_error(tmp_path_factory, data):
    text = bytearray(to_toml(propose({"A": arm(unit="deg"), "B": rover()})).encode())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text) - 1))
        text[at] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "damaged.toml"
    path.write_bytes(text)
    try:
        check_mapping(read_mapping(path), {"A": arm(unit="deg"), "B": rover()})
    except DatasetError as error:
        assert str(error)


def test_files_that_are_none(tmp_path):
    with pytest.raises(DatasetError, match="cannot be read"):
        read_mapping(tmp_path / "none.toml")
    for text, said in (
        (b"", "no \\[\\[source\\]\\]|lacks 'fps'"),
        (b"\xff", "not TOML"),
        (b"a = " + b"[" * 5000, "not TOML"),
    ):
        (tmp_path / "m.toml").write_bytes(text)
        with pytest.raises(DatasetError, match=said):
            read_mapping(tmp_path / "m.toml")


def test_scales_by_hand_override_units():
    assert affine(Number("g", "g", "0..255", scale=0.08 / 255, offset=0.01), Dimension("m")) == (0.08 / 255, 0.01)


@given(
    st.sampled_from(
        [
            "m",
            "mm",
            "in",
            "rad",
            "deg",
            "turn",
            "0..1",
            "0..255",
            "-1..1",
            "%",
            "K",
            "degC",
            "m/s",
            "km/h",
            "rpm",
            "deg/s",
            "g",
            "m/s^2",
            "mm/s²",
        ]
    ),
    st.sampled_from(["m", "cm", "rad", "deg", "0..1", "-1..1", "0..100", "degC", "m/s", "rpm", "rad/s", "m/s2", "g"]),
    st.floats(-100, 100),
)
def test_units_there_and_back(a, b, x):
    if quantity(a) != quantity(b):
        with pytest.raises(DatasetError, match=re.escape(f"'{a}' measures")):
            convert(a, b)
        return
    scale, offset = convert(a, b)
    back, shift = convert(b, a)
    assert back * (scale * x + offset) + shift == pytest.approx(x, abs=1e-9)
    assert quantity(basic(a)) == quantity(a) and basic(basic(a)) == basic(a)


def test_known_conversions():
    for a, b, x, y in [
        ("deg", "rad", 180, 3.14159265),
        ("mm", "m", 5, 0.005),
        ("0..255", "0..1", 255, 1),
        ("-1..1", "0..1", -1, 0),
        ("degC", "K", 0, 273.15),
        ("rpm", "deg/s", 1, 6),
        ("km/h", "m/s", 36, 10),
        ("g", "m/s2", 1, 9.80665),
    ]:
        scale, offset = convert(a, b)
        assert scale * x + offset == pytest.approx(y)
