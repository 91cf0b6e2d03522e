"""Reading data files that may be damaged or hostile piece by piece: what cannot be read is an error in its place."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pyarrow as pa

from ..core.errors import DatasetError
from ..data.storage.tables import BROKEN, damaged, open_parquet

_BATCH = 64 << 20  # bytes that one piece of numbers may take
_TEXTS = 16  # rows of texts and pictures that are read at once, for nothing says how long they are
_LARGEST, _REPEATED = 4 << 30, 256 << 20  # bytes that a row group may unpack to, and where texts may repeat one another
_A_BYTE = 4  # of such texts and pictures, for each byte of a larger file


def batches(
    path: Path, features: Mapping[str, dict], columns: Sequence[str]
) -> Iterator[tuple[int, int, pa.Table | DatasetError]]:
    """(first row, rows, table) of a data file piece after piece, the largest of some megabytes; DatasetError where it is broken.

    A piece that cannot be read is given as the error itself, and reading goes on with the next row group.
    """
    texts = any(features[name]["dtype"] in ("image", "string") for name in columns)
    wide = 8 + sum(16 * math.prod(features[name]["shape"]) for name in columns if features[name]["dtype"] != "image")
    try:
        file = open_parquet(path)
        few = max(_REPEATED, _A_BYTE * path.stat().st_size)
        step, most = (_TEXTS, few) if texts else (max(1, _BATCH // wide), _LARGEST)
    except BROKEN as error:
        raise damaged(path, error) from error
    with file:
        at = 0
        for number in range(file.num_row_groups):
            rows, done, size = file.metadata.row_group(number).num_rows, 0, 0
            try:
                for batch in file.iter_batches(step, row_groups=[number], columns=list(columns)):
                    size += batch.nbytes
                    if size > most:
                        raise ValueError(f"it unpacks to more than {most:,} bytes")
                    if batch.num_rows:
                        yield at + done, batch.num_rows, pa.Table.from_batches([batch])
                    done += batch.num_rows
                if done < rows:
                    raise ValueError(f"{rows - done} rows are missing")
            except BROKEN as error:
                yield at + done, max(0, rows - done), damaged(path, error)
            at += rows
