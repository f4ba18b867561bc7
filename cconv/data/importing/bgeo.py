"""Houdini's classic .bgeo files of points, gzip-compressed or not, as SPlisHSPlasH and Partio write them.

Source: Partio's reader, https://github.com/wdas/partio (BGEO, version 5): big-endian numbers of four bytes, a row for
each point. No package on PyPI reads it.
"""

import gzip
import struct
from pathlib import Path

import numpy as np

from cconv.data.importing.table import Table
from cconv.data.limits import memory_limit, one_line
from cconv.errors import DataError

MAGIC = b"BgeoV\x00\x00\x00\x05"
HEADER = struct.Struct(">8i")  # points, primitives, groups of both, attributes of points, vertices, primitives, detail
MOST_ATTRIBUTES = 100
LONGEST = 64  # numbers of an attribute
FLOATS = (0, 5)  # types of attributes: plain numbers and vectors
INTEGERS = (1, 4)  # whole numbers, and numbers of texts


def read_bgeo(file: Path) -> list[Table]:
    """The points of a .bgeo file with their attributes, as one table.

    Raises:
        DataError: If the file is none, or is damaged.
    """
    content = _Content(file, _unpacked(file))
    if content.take(len(MAGIC)) != MAGIC:
        raise DataError(
            f"{file}: is no .bgeo of version 5 (files of newer Houdini are JSON); save it as .bgeo or .vtp."
        )
    count, *_, num_attributes, _, _, _ = HEADER.unpack(content.take(HEADER.size))
    if count < 1 or not 0 <= num_attributes <= MOST_ATTRIBUTES:
        raise DataError(f"{file}: claims {count} points with {num_attributes} attributes; it is damaged or empty.")
    row = np.dtype([("position", ">f4", (4,)), *(_attribute(content) for _ in range(num_attributes))])
    rows = np.frombuffer(content.take(count * row.itemsize), dtype=row)
    arrays = {name: rows[name].astype(rows[name].dtype.newbyteorder("=")) for name in row.names or ()}
    return [Table(file=file, arrays=arrays | {"position": arrays["position"][:, :3]}, time=None)]


class _Content:
    """The bytes of a file, given out from the first on."""

    def __init__(self, file: Path, content: bytes):
        self.file, self._content, self._begin = file, content, 0

    def take(self, count: int) -> bytes:
        taken = self._content[self._begin : self._begin + count]
        self._begin += count
        if len(taken) < count:
            raise DataError(f"{self.file}: ends too early; it is truncated: copy it again.")
        return taken

    def number(self, form: str) -> int:
        return struct.unpack(form, self.take(struct.calcsize(form)))[0]


def _attribute(content: _Content) -> tuple[str, str, tuple[int, ...]]:
    """Name, type and shape of the next attribute; its default values, or texts, are passed over."""
    name = one_line(content.take(content.number(">H")).decode(errors="replace"), 40)
    size, kind = content.number(">H"), content.number(">i")
    if not 1 <= size <= LONGEST or kind not in (*FLOATS, *INTEGERS):
        raise DataError(f"{content.file}: attribute {name!r} has a type that is not known ({kind}, {size} numbers).")
    if kind == 4:
        for _ in range(content.number(">i")):
            content.take(content.number(">H"))
    else:
        content.take(4 * size)
    return name, ">f4" if kind in FLOATS else ">i4", (size,) if size > 1 else ()


def _unpacked(file: Path) -> bytes:
    room = memory_limit()
    with file.open("rb") as raw:
        is_compressed = raw.read(2) == b"\x1f\x8b"
        raw.seek(0)
        if not is_compressed:
            return raw.read(room)
        with gzip.GzipFile(fileobj=raw) as stream:
            content = stream.read(room + 1)
    if len(content) > room:
        raise DataError(f"{file}: decompresses to more than the {room / 1e9:.3g} GB that fit into memory; cut it.")
    return content
