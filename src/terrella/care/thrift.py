"""Thrift's compact protocol, as far as parquet's headers and footers need it. A struct is {field number: (type, value)}, a list
(type of its items, items)."""

TRUE, FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = range(1, 13)
_DEEPEST, _LONGEST = 32, 1_000_000  # nesting, items of a list; more is damage

Struct = dict[int, tuple[int, object]]


def read_struct(data: bytes | memoryview, at: int = 0, depth: int = 0) -> tuple[Struct, int]:
    """The struct that begins at byte `at`, and the byte after it; ValueError or IndexError where there is none."""
    fields: Struct = {}
    field = 0
    while (head := data[at]) != 0:
        at += 1
        kind, step = head & 15, head >> 4
        if step:
            field += step
        else:
            field, at = _signed(data, at)
        if I16 <= kind <= I64:
            value, at = _signed(data, at)
            fields[field] = (kind, value)
        elif kind in (TRUE, FALSE):
            fields[field] = (kind, kind == TRUE)
        else:
            value, at = _read(kind, data, at, depth)
            fields[field] = (kind, value)
    return fields, at + 1


def _read(kind: int, data: bytes | memoryview, at: int, depth: int) -> tuple[object, int]:
    if depth > _DEEPEST:
        raise ValueError("it is nested too deeply")
    if kind in (BYTE, TRUE, FALSE):  # an item of a list of booleans is a byte
        return data[at], at + 1
    if kind == BINARY:
        size, at = _varint(data, at)
        if size > len(data) - at:
            raise IndexError("a text ends after its file")
        return bytes(data[at : at + size]), at + size
    if kind == LIST:
        head, at = data[at], at + 1
        count, item = head >> 4, head & 15
        if count == 15:
            count, at = _varint(data, at)
        if count > _LONGEST:
            raise ValueError(f"a list claims {count} items")
        items, read = [], _signed if I16 <= item <= I64 else None
        for _ in range(count):
            value, at = read(data, at) if read else _read(item, data, at, depth + 1)
            items.append(value)
        return (item, items), at
    if kind == STRUCT:
        return read_struct(data, at, depth + 1)
    raise ValueError(f"{kind} is no type of parquet")


def _varint(data: bytes | memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 70:
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
        shift += 7
    raise ValueError("a number does not end")


def _signed(data: bytes | memoryview, at: int) -> tuple[int, int]:
    byte = data[at]
    if byte < 128:  # most are
        return (byte >> 1) ^ -(byte & 1), at + 1
    value, at = _varint(data, at)
    return (value >> 1) ^ -(value & 1), at


def write_struct(fields: Struct) -> bytes:
    """The inverse of `read_struct`."""
    out, before = bytearray(), 0
    for field in sorted(fields):
        kind, value = fields[field]
        if kind in (TRUE, FALSE):
            kind = TRUE if value else FALSE
        step = field - before
        out += bytes([step << 4 | kind]) if 0 < step < 16 else bytes([kind]) + _write(I16, field)
        if kind not in (TRUE, FALSE):
            out += _write(kind, value)
        before = field
    return bytes(out) + b"\0"


def _write(kind: int, value) -> bytes:
    if kind in (I16, I32, I64):
        return _put_varint((value << 1) ^ (value >> 63))
    if kind in (BYTE, TRUE, FALSE):
        return bytes([value])
    if kind == BINARY:
        return _put_varint(len(value)) + value
    if kind == LIST:
        item, items = value
        head = bytes([len(items) << 4 | item]) if len(items) < 15 else bytes([15 << 4 | item]) + _put_varint(len(items))
        return head + b"".join(_write(item, each) for each in items)
    return write_struct(value)


def _put_varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])
