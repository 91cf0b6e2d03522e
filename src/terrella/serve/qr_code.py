"""QR codes of addresses as text, for a phone's camera: ISO/IEC 18004, version 5-L, bytes, mask 0, up to 106 characters."""

import numpy as np

SIZE, DATA, CHECK = 37, 108, 26  # modules of a side; bytes of data, and of Reed-Solomon check
MOST = DATA - 2
FORMAT = 0b111011111000100  # level L, mask 0, with its check bits


def qr_text(text: str) -> str:
    """The code of a text of at most 106 bytes, dark modules as spaces on light ones (a terminal is dark); "" for a longer one."""
    content = text.encode()
    if len(content) > MOST:
        return ""
    light = np.pad(~modules(content), 2, constant_values=True)
    rows = np.pad(light, ((0, 1), (0, 0))).astype(int)
    return "\n".join("".join(" ▄▀█"[2 * a + b] for a, b in zip(*pair)) for pair in zip(rows[::2], rows[1::2]))


def modules(content: bytes) -> np.ndarray:
    """bool [37, 37], True where dark."""
    grid, fixed = _patterns()
    bits = np.unpackbits(np.frombuffer(_with_check(content), np.uint8)).astype(bool).tolist() + [False] * 7
    upward, right = True, SIZE - 1
    while right > 0:  # two columns at a time, from the right, up and down in turn; column 6 is timing
        right -= right == 6
        for row in range(SIZE - 1, -1, -1) if upward else range(SIZE):
            for column in (right, right - 1):
                if not fixed[row, column]:
                    grid[row, column] = bits.pop(0) ^ ((row + column) % 2 == 0)
        upward, right = not upward, right - 2
    return grid


def _patterns() -> tuple[np.ndarray, np.ndarray]:
    """The modules that every code has, and where they are: finders, timing, alignment, format."""
    grid, fixed = np.zeros((2, SIZE, SIZE), bool)
    rings = np.maximum(*np.abs(np.mgrid[-4:5, -4:5]))
    finder = np.isin(rings, (0, 1, 3))
    for row, column in ((0, 0), (0, SIZE - 8), (SIZE - 8, 0)):
        part = slice(row, row + 8), slice(column, column + 8)
        cut = slice(0 if row else 1, 8 if row else 9), slice(0 if column else 1, 8 if column else 9)
        grid[part], fixed[part] = finder[cut], True
    fixed[6], fixed[:, 6] = True, True
    grid[6, 8:-8] = grid[8:-8, 6] = np.arange(SIZE - 16) % 2 == 0
    grid[28:33, 28:33], fixed[28:33, 28:33] = np.isin(rings[2:7, 2:7], (0, 2)), True
    word = [bool(FORMAT >> bit & 1) for bit in range(15)]
    ways = ([(row, 8) for row in (0, 1, 2, 3, 4, 5, 7, 8)] + [(8, column) for column in (7, 5, 4, 3, 2, 1, 0)],
            [(8, SIZE - 1 - at) for at in range(8)] + [(SIZE - 7 + at, 8) for at in range(7)])  # fmt: skip
    for way in ways:
        for (row, column), bit in zip(way, word):
            grid[row, column], fixed[row, column] = bit, True
    grid[SIZE - 8, 8] = fixed[SIZE - 8, 8] = True
    return grid, fixed


def _with_check(content: bytes) -> bytes:
    """The content as the code's bytes, followed by their Reed-Solomon check over GF(256) with polynomial 0x11D."""
    bits = f"0100{len(content):08b}" + "".join(f"{byte:08b}" for byte in content) + "0000"
    bits = bits.ljust(-(-len(bits) // 8) * 8, "0")
    data = [int(bits[at : at + 8], 2) for at in range(0, len(bits), 8)][:DATA]
    data += [(0xEC, 0x11)[at % 2] for at in range(DATA - len(data))]
    powers = [1]
    for _ in range(254):
        powers.append(powers[-1] << 1 ^ (0x11D if powers[-1] & 128 else 0))
    logs = {power: at for at, power in enumerate(powers)}

    def times(a: int, b: int) -> int:
        return powers[(logs[a] + logs[b]) % 255] if a and b else 0

    generator = [1]
    for at in range(CHECK):
        shifted = [*generator, 0]
        for place, factor in enumerate(generator):
            shifted[place + 1] ^= times(factor, powers[at])
        generator = shifted
    rest = data + [0] * CHECK
    for at in range(DATA):
        for place, factor in enumerate(generator):
            rest[at + place] ^= times(factor, rest[at]) if place else 0
    return bytes(data + rest[DATA:])
