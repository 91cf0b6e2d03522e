"""QR codes of addresses: the modules that a reader looks for, and the text read back as a reader does."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from terrella.serve import http_server
from terrella.serve.qr_code import MOST, SIZE, _patterns, modules, qr_text


def read_back(grid: np.ndarray) -> bytes:
    """The bytes of a code: columns in pairs from the right, up and down in turn, mask 0 taken off."""
    fixed, bits = _patterns()[1], []
    columns = [right - (right <= 6) for right in range(SIZE - 1, 0, -2)]
    for turn, right in enumerate(columns):
        for row in range(SIZE) if turn % 2 else reversed(range(SIZE)):
            bits += [grid[row, at] ^ ((row + at) % 2 == 0) for at in (right, right - 1) if not fixed[row, at]]
    data = np.packbits(np.array(bits, bool)[: 8 * 134]).tobytes()
    assert data[0] >> 4 == 4, "bytes"
    length = (data[0] & 15) << 4 | data[1] >> 4
    return bytes((data[at] & 15) << 4 | data[at + 1] >> 4 for at in range(1, length + 1))


@pytest.mark.parametrize("text", ["http://192.168.1.23:8765/?token=abcdefghijklmnopqrstuv", "a", "é" * 53])
def test_a_code_reads_back(text):
    assert read_back(modules(text.encode())) == text.encode()


def test_the_modules_are_those_of_another_encoder():
    grid = modules(b"x" * MOST)  # as segno 1.6 draws it: version 5, level L, mask 0
    assert hashlib.sha256(np.packbits(grid).tobytes()).hexdigest()[:16] == "2c17b08283ed13dd"


def test_a_code_is_drawn_in_half_as_many_lines_and_not_for_long_texts():
    lines = qr_text("http://10.0.0.7:8765/").splitlines()
    assert len(lines) == 21 and {len(line) for line in lines} == {SIZE + 4} and qr_text("x" * (MOST + 1)) == ""


def test_a_page_for_the_network_has_an_address_that_a_phone_can_open():
    address = http_server.page_address("0.0.0.0", 8765, "secret")
    assert address == f"http://{http_server.own_address()}:8765/?token=secret" and "0.0.0.0" not in address
    assert http_server.page_address("127.0.0.1", 1, None) == "http://127.0.0.1:1/"
