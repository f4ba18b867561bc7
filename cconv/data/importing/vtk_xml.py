"""VTK's XML files of points: unstructured grids (.vtu), poly data (.vtp), and collections of files (.pvd).

Only points and their data are read, cells are not. meshio reads neither poly data nor attributes that are spelled with
a capital, as SPHinXsys writes them, so both kinds are read here.

Source: VTK file formats, https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html
"""

import base64
import math
import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from cconv.data.importing.table import Table, is_time, plain_array
from cconv.data.limits import check_size, memory_limit, one_line
from cconv.errors import DataError
from cconv.files import read_text

POINTS = "Points"  # what positions are called here, whatever the file calls them
DTYPES = {f"{kind}{8 * size}": f"{code}{size}" for kind, code in (("Int", "i"), ("UInt", "u")) for size in (1, 2, 4, 8)}
DTYPES |= {"Float32": "f4", "Float64": "f8"}
ZLIB = "vtkZLibDataCompressor"
MOST_BLOCKS = 2**20  # of a compressed array


def read_vtk_xml(file: Path) -> list[Table]:
    """The points of a .vtu or .vtp file, all its pieces together, as one table.

    Raises:
        DataError: If the file is none, is damaged, or is encoded in a way that is not read.
    """
    check_size(file.stat().st_size, file.stat().st_size, str(file))
    root, appended = _parsed(file, file.read_bytes())
    kind = _get(root, "type")
    if root.tag != "VTKFile" or kind not in ("UnstructuredGrid", "PolyData"):
        raise DataError(f"{file}: is VTK of the type {one_line(kind)!r}; save its points as .vtu or .vtp.")
    grid = root.find(kind)
    pieces = [] if grid is None else grid.findall("Piece")
    if not pieces:
        raise DataError(f"{file}: has no piece with points; write it again.")
    decoder = _Decoder(file, root, appended)
    read = [dict(_piece_arrays(piece, decoder)) for piece in pieces]
    if any(set(arrays) != set(read[0]) for arrays in read):
        raise DataError(f"{file}: its pieces hold different arrays; write them as one piece.")
    return [
        Table(
            file=file,
            arrays={name: np.concatenate([arrays[name] for arrays in read]) for name in read[0]},
            time=_time(root, decoder),
        )
    ]


def read_collection(file: Path) -> list[tuple[Path, float]]:
    """Files of a .pvd collection with their times; all of them must be there.

    Raises:
        DataError: If it is no collection, names a file outside of its folder or one that is missing.
    """
    root, _ = _parsed(file, read_text(file).encode())
    entries = []
    for element in root.iter("DataSet"):
        name, time = _get(element, "file"), _number(_get(element, "timestep"), file)
        path = file.parent / name
        if not name or Path(name).is_absolute() or ".." in Path(name).parts:
            raise DataError(f"{file}: names {one_line(name)!r}, outside of its folder; put the files beside it.")
        if not path.is_file():
            raise DataError(
                f"{file}: names {one_line(name)}, which is missing; add it, or name the files by a pattern."
            )
        entries.append((path, time))
    if not entries:
        raise DataError(f"{file}: names no files; it must be a VTK collection of data sets.")
    return entries


@dataclass(frozen=True)
class _Decoder:
    """Turns elements `DataArray` into arrays, by the encoding that the whole file has."""

    file: Path
    root: Element
    appended: bytes

    @property
    def header(self) -> np.dtype:
        """Type of the numbers that stand before encoded values."""
        return self._ordered(DTYPES.get(_get(self.root, "header_type") or "UInt32", ""))

    def values(self, element: Element, count: int | None) -> np.ndarray:
        """Values of an array, (N,) or (N, C); `count` is N, or None for whatever it is."""
        name = one_line(_get(element, "Name") or POINTS, 40)
        dtype = DTYPES.get(_get(element, "type"))
        if dtype is None:
            raise DataError(f"{self.file}: `{name}` has the type {one_line(_get(element, 'type'))!r}, no numbers.")
        components = max(1, int(_number(_get(element, "NumberOfComponents") or "1", self.file)))
        values = self._flat(element, dtype, name)
        if count is not None and values.size != count * components:
            raise DataError(
                f"{self.file}: `{name}` has {values.size} numbers, but {count} points with {components} each need "
                f"{count * components}; the file is damaged: write it again."
            )
        return values.reshape(-1, components) if components > 1 else values

    def _flat(self, element: Element, dtype: str, name: str) -> np.ndarray:
        encoding = (_get(element, "format") or "ascii").lower()
        if encoding == "ascii":
            return np.array((element.text or "").split(), dtype=dtype)
        if encoding == "binary":
            content = "".join((element.text or "").split()).encode()
            return self._decoded(content, True, dtype, name)
        offset = int(_number(_get(element, "offset"), self.file))
        place = self.root.find("AppendedData")
        is_text = place is not None and _get(place, "encoding") == "base64"
        if encoding != "appended" or not 0 <= offset < len(self.appended):
            raise DataError(f"{self.file}: `{name}` lies outside of the file; it is truncated: copy it again.")
        return self._decoded(self.appended[offset:], is_text, dtype, name)

    def _decoded(self, content: bytes, is_text: bool, dtype: str, name: str) -> np.ndarray:
        compressor = _get(self.root, "compressor")
        if compressor not in ("", ZLIB):
            raise DataError(f"{self.file}: is compressed by {one_line(compressor)}; save it with zlib or uncompressed.")
        place = f"{self.file}: `{name}`"
        read = _inflated if compressor else _plain
        return np.frombuffer(read(_Bytes(content, is_text), self.header, place), dtype=self._ordered(dtype))

    def _ordered(self, dtype: str) -> np.dtype:
        if not dtype:
            raise DataError(f"{self.file}: has an unknown header_type; write it again.")
        return np.dtype(dtype).newbyteorder(">" if _get(self.root, "byte_order") == "BigEndian" else "<")


class _Bytes:
    """Bytes that are given out from the first on; base64 is decoded group by group, as VTK writes it."""

    def __init__(self, content: bytes, is_text: bool):
        self._content, self._is_text, self._begin, self._left = content, is_text, 0, b""

    def take(self, count: int, place: str) -> bytes:
        """The next `count` bytes."""
        if self._is_text:
            while len(self._left) < count and self._begin < len(self._content):
                self._decode(count - len(self._left))
            taken, self._left = self._left[:count], self._left[count:]
        else:
            taken = self._content[self._begin : self._begin + count]
            self._begin += count
        if len(taken) < count:
            raise DataError(f"{place} ends too early; the file is truncated: copy it again.")
        return taken

    def _decode(self, count: int) -> None:
        """Decode at least `count` further bytes, up to the next padding, which ends a group."""
        length = 4 * math.ceil(count / 3)
        group = self._content[self._begin : self._begin + length]
        padding = group.find(b"=")
        if padding >= 0:
            group = group[: 4 * (padding // 4 + 1)]
        self._begin += len(group) or length
        self._left += base64.b64decode(group, validate=True)


def _plain(content: _Bytes, header: np.dtype, place: str) -> bytes:
    (size,) = np.frombuffer(content.take(header.itemsize, place), dtype=header).tolist()
    return content.take(min(size, memory_limit()), place)


def _inflated(content: _Bytes, header: np.dtype, place: str) -> bytes:
    """Decompressed blocks: their number, the size of each and of the last, their compressed sizes, then themselves."""
    blocks, size, last = np.frombuffer(content.take(3 * header.itemsize, place), dtype=header).tolist()
    if blocks > MOST_BLOCKS:
        raise DataError(f"{place} claims {blocks} blocks; the file is damaged: write it again.")
    lengths = np.frombuffer(content.take(blocks * header.itemsize, place), dtype=header).tolist()
    check_size(blocks * size, sum(lengths), place)
    sizes = [size] * (blocks - 1) + [last or size] if blocks else []
    pieces = []
    for length, wanted in zip(lengths, sizes, strict=True):
        piece = zlib.decompressobj().decompress(content.take(length, place), wanted)
        if len(piece) < wanted:
            raise DataError(f"{place} ends too early; the file is truncated: copy it again.")
        pieces.append(piece)
    return b"".join(pieces)


def _parsed(file: Path, content: bytes) -> tuple[Element, bytes]:
    """The XML of a file, and what is appended to it, which need not be XML."""
    begin, appended = content.find(b"<AppendedData"), b""
    if begin >= 0:
        tag, _, rest = content[begin:].partition(b">")
        appended = rest[rest.find(b"_") + 1 :]
        content = content[:begin] + tag.rstrip(b"/") + b"/></VTKFile>"
    try:
        return fromstring(content), appended
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise DataError(
            f"{file}: is no XML of VTK ({one_line(error)}); copy it again, or give its true ending."
        ) from error


def _piece_arrays(piece: Element, decoder: _Decoder) -> Iterator[tuple[str, np.ndarray]]:
    """Names and values of the arrays of a piece, positions first; arrays of text are passed over."""
    count = int(_number(_get(piece, "NumberOfPoints"), decoder.file))
    points = piece.find("Points/DataArray")
    if points is None:
        raise DataError(f"{decoder.file}: has a piece without points; write it again.")
    yield POINTS, decoder.values(points, count).reshape(count, -1)
    for element in piece.findall("PointData/DataArray"):
        if _get(element, "type") in DTYPES:
            values = plain_array(decoder.values(element, count))
            if values is not None:
                yield _get(element, "Name"), values


def _time(root: Element, decoder: _Decoder) -> float | None:
    """Time in the field data of the file."""
    for element in root.iterfind(".//FieldData/DataArray"):
        if is_time(_get(element, "Name")) and (values := decoder.values(element, None)).size == 1:
            return float(values.ravel()[0])
    return None


def _get(element: Element, name: str) -> str:
    """An attribute, whatever the case of its first letter; empty if there is none."""
    return element.get(name) or element.get(name[0].swapcase() + name[1:]) or ""


def _number(text: str, file: Path) -> float:
    if not re.fullmatch(r"[-+0-9.eE]{1,40}", text):
        raise DataError(f"{file}: has {one_line(text)!r} where a number must stand; write it again.")
    return float(text)
