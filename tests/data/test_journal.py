"""The journal: what was written is read up to the first damage, and no farther."""

from __future__ import annotations

import pytest

from terrella.data.storage.journal import Journal, read_about, read_records


@pytest.fixture
def journal(tmp_path):
    """A journal of three readings, and its content."""
    path = tmp_path / "journal"
    log = Journal(path, {"robot": "r"})
    for at in range(3):
        log.add(at, 0.1 * at, bytes([at] * 8))
    log.close()
    return path, path.read_bytes()


def test_what_was_written_is_read(journal):
    path, _ = journal
    assert read_about(path) == {"robot": "r"}
    assert list(read_records(path)) == [(at, 0.1 * at, bytes([at] * 8)) for at in range(3)]


@pytest.mark.parametrize("back", [1, 8, 17])  # a byte of the values, and of the time
def test_a_record_that_does_not_match_its_checksum_ends_the_journal(journal, back):
    path, content = journal
    whole = len(content) - 26  # a record: 8 bytes of head, 10 of sensor and time, 8 of values
    at = whole - back
    path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
    assert [sensor for sensor, _, _ in read_records(path)] == [0]


def test_a_torn_tail_loses_its_own_record_alone(journal):
    path, content = journal
    path.write_bytes(content[:-1])
    assert [sensor for sensor, _, _ in read_records(path)] == [0, 1]
