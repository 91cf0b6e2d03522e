"""What an episode is about reaches training: its text, its number, and its embedding."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from layouts import layout_of

from terrella.core.instruction import INSTRUCTION_SIZE, embed, embed_all
from terrella.data import ClipCache, Clips, ClipsConfig, Dataset, Recorder


@given(st.text(max_size=40))
def test_an_embedding_has_length_one_or_says_nothing(text):
    found = embed(text)
    assert found.shape == (INSTRUCTION_SIZE,) and found.dtype == np.float32
    assert abs(np.linalg.norm(found) - 1) < 1e-5 or not found.any()
    assert np.array_equal(found, embed(text)) and np.array_equal(embed(f" {text}! "), found)


def test_texts_that_share_words_are_near_and_order_counts():
    red, near, far = embed_all(["pick up the red cup", "pick up the red cups", "open a drawer"])
    assert red @ near > 0.7 > 0.4 > abs(red @ far)
    assert embed("red on blue") @ embed("blue on red") < 0.99
    assert embed_all([]).shape == (0, INSTRUCTION_SIZE)


def test_every_row_of_a_batch_says_what_it_is_about(tmp_path):
    said = ["lift the cup", "turn left", "lift the cup"]
    with Recorder(tmp_path / "recording", layout_of(10, ("go",), pose=True)) as recorder:
        for task in said:
            recorder.task = task
            for i in range(8):
                if task == "turn left" and i == 4:
                    recorder.say("now turn right")
                recorder.add({"pose": np.arange(7) + i}, [i])
            recorder.end_episode()
    expected = [said[0]] * 8 + [said[1]] * 4 + ["now turn right"] * 4 + [said[2]] * 8
    cache = ClipCache.open(tmp_path / "recording", (8, 8))
    assert cache.task is not None and [cache.tasks[number] for number in cache.task] == expected
    for source in (str(tmp_path / "recording"), f"file://{tmp_path}/recording"):
        clips = Clips(
            source, ClipsConfig(3, ("row", "task", "instruction", "action"), 4, (8, 8), cache_dir=tmp_path / "cache")
        )
        for batch in clips:
            assert batch["instruction"].shape == (4, 3, INSTRUCTION_SIZE)
            texts = [expected[row] for row in batch["row"].reshape(-1)]
            assert [clips.tasks[number] for number in batch["task"].reshape(-1)] == texts
            assert np.array_equal(batch["instruction"].reshape(12, -1), embed_all(texts))


def test_what_is_said_before_the_first_row_is_what_the_episode_is_about(tmp_path):
    with Recorder(tmp_path / "recording", layout_of(10, ("go",), pose=True)) as recorder:
        recorder.task = "none"
        for said in ("lift the cup", None):
            if said:
                recorder.say(said)
            for i in range(3):
                recorder.add({"pose": np.arange(7) + i}, [i])
            recorder.end_episode()
    dataset = Dataset(tmp_path / "recording")
    assert [episode.tasks for episode in dataset.episodes] == [("lift the cup",), ("none",)]
