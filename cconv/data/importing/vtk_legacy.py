"""VTK's legacy files (.vtk) of points, text or binary: unstructured grids and poly data, as DualSPHysics writes them.

Only points and their data are read; cells are passed over. meshio reads no poly data.

Source: VTK file formats, https://docs.vtk.org/en/latest/vtk_file_formats/vtk_legacy_file_format.html
"""

from pathlib import Path

import numpy as np

from cconv.data.importing.table import Table, is_time, plain_array
from cconv.data.importing.vtk_xml import POINTS
from cconv.data.limits import check_size, one_line
from cconv.errors import DataError

DTYPES = {
    "char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2", "int": "i4", "unsigned_int": "u4",
    "long": "i8", "unsigned_long": "u8", "vtktypeint64": "i8", "vtkidtype": "i8", "float": "f4", "double": "f8",
}  # fmt: skip
CELLS = ("VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS", "CELLS")
LONGEST_LINE = 4096


def read_vtk_legacy(file: Path) -> list[Table]:
    """The points of a .vtk file with their data, as one table.

    Raises:
        DataError: If the file is none, holds no points, or has a section that is not known.
    """
    check_size(file.stat().st_size, file.stat().st_size, str(file))
    return [_Reader(file, file.read_bytes()).table()]


class _Reader:
    """Reads a file section by section."""

    def __init__(self, file: Path, content: bytes):
        self._file, self._content, self._begin = file, content, 0
        self._arrays: dict[str, np.ndarray] = {}
        self._time: float | None = None
        self._count = 0  # of what the data of a section belong to
        self._of_points = False
        if not self._line().lower().startswith("# vtk datafile"):
            raise DataError(f"{file}: is no legacy VTK file; copy it again, or give its true ending.")
        self._line()
        self._is_binary = self._line().strip().upper() == "BINARY"

    def table(self) -> Table:
        """Everything that belongs to the points."""
        while self._begin < len(self._content):
            if words := self._line().split():
                self._section(words[0].upper(), words[1:])
        if POINTS not in self._arrays:
            raise DataError(f"{self._file}: holds no points; save them as poly data or an unstructured grid.")
        return Table(file=self._file, arrays=self._arrays, time=self._time)

    def _section(self, kind: str, words: list[str]) -> None:
        if kind == "POINTS":
            self._arrays[POINTS] = self._values(self._whole(words[0]) * 3, words[1]).reshape(-1, 3)
        elif kind in CELLS:
            self._skip_cells(self._whole(words[0]), self._whole(words[1]))
        elif kind == "CELL_TYPES":
            self._values(self._whole(words[0]), "int")
        elif kind in ("POINT_DATA", "CELL_DATA"):
            self._count, self._of_points = self._whole(words[0]), kind == "POINT_DATA"
        elif kind == "FIELD":
            for _ in range(self._whole(words[1])):
                self._field(self._words())
        elif kind in ("VECTORS", "NORMALS"):
            self._keep(words[0], self._values(3 * self._count, words[1]).reshape(-1, 3))
        elif kind == "SCALARS":
            self._scalars(words)
        elif kind == "METADATA":
            while self._line().strip():
                pass
        elif kind != "DATASET":
            raise DataError(f"{self._file}: has a section {one_line(kind, 40)!r}, which is not read; save it as .vtp.")

    def _scalars(self, words: list[str]) -> None:
        components = self._whole(words[2]) if len(words) > 2 else 1
        if self._words()[0].upper() != "LOOKUP_TABLE":
            raise DataError(f"{self._file}: `{one_line(words[0], 40)}` must name a lookup table; save it as .vtp.")
        self._keep(words[0], self._values(components * self._count, words[1]).reshape(-1, components))

    def _field(self, words: list[str]) -> None:
        name, components, count, kind = words[0], self._whole(words[1]), self._whole(words[2]), words[3]
        values = self._values(components * count, kind).reshape(-1, components)
        if is_time(name) and values.size == 1:
            self._time = float(values.ravel()[0])
        else:
            self._keep(name, values)

    def _keep(self, name: str, values: np.ndarray) -> None:
        plain = plain_array(values)
        if self._of_points and plain is not None:
            self._arrays[name] = plain

    def _skip_cells(self, first: int, second: int) -> None:
        """Pass over cells: sizes and numbers of points in one list, or from version 5.1 on offsets and connectivity."""
        begin = self._begin
        words = self._line().split()
        if words and words[0].upper() == "OFFSETS":
            self._values(first, words[1])
            self._values(second, self._words()[1])
        else:
            self._begin = begin
            self._values(second, "int")

    def _values(self, count: int, kind: str) -> np.ndarray:
        """The next `count` numbers of a type, and the end of their line."""
        dtype = np.dtype(DTYPES.get(kind.lower(), "V")).newbyteorder(">")
        if dtype.kind == "V":
            raise DataError(
                f"{self._file}: has numbers of the type {one_line(kind, 40)!r}; save it with float or double."
            )
        if not self._is_binary:
            return self._written(count, dtype)
        size = count * dtype.itemsize
        content = self._content[self._begin : self._begin + size]
        if len(content) < size:
            raise self._truncated()
        self._begin += size
        if self._content[self._begin : self._begin + 1] == b"\n":
            self._begin += 1
        return np.frombuffer(content, dtype=dtype)

    def _written(self, count: int, dtype: np.dtype) -> np.ndarray:
        words: list[bytes] = []
        while len(words) < count:
            if self._begin >= len(self._content):
                raise self._truncated()
            end = self._content.find(b"\n", self._begin)
            end = len(self._content) if end < 0 else end
            words += self._content[self._begin : end].split()
            self._begin = end + 1
        return np.array(words, dtype=dtype)

    def _words(self) -> list[str]:
        """Words of the next line that is not empty."""
        while self._begin < len(self._content):
            if words := self._line().split():
                return [*words, "", "", ""]
        raise self._truncated()

    def _line(self) -> str:
        end = self._content.find(b"\n", self._begin, self._begin + LONGEST_LINE)
        if end < 0:
            end = min(len(self._content), self._begin + LONGEST_LINE)
        line = self._content[self._begin : end].decode(errors="replace")
        self._begin = end + 1
        return line

    def _whole(self, word: str) -> int:
        if not word.isdigit() or int(word) > len(self._content):
            raise DataError(f"{self._file}: has {one_line(word, 40)!r} where a count must stand; it is damaged.")
        return int(word)

    def _truncated(self) -> DataError:
        return DataError(f"{self._file}: ends too early; it is truncated: copy it again.")
