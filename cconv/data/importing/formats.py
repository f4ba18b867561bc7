"""Readers of particle files by the endings of their names."""

import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

from cconv.data.importing.bgeo import read_bgeo
from cconv.data.importing.hdf5_frames import read_hdf5
from cconv.data.importing.numpy_files import read_npy, read_npz
from cconv.data.importing.table import Table
from cconv.data.importing.text import read_text_table
from cconv.data.importing.vtk_legacy import read_vtk_legacy
from cconv.data.importing.vtk_xml import read_vtk_xml
from cconv.data.limits import one_line
from cconv.errors import CConvError, DataError

READERS: dict[str, Callable[[Path], list[Table]]] = {
    ".vtu": read_vtk_xml,
    ".vtp": read_vtk_xml,
    ".vtk": read_vtk_legacy,
    ".bgeo": read_bgeo,
    ".csv": read_text_table,
    ".txt": read_text_table,
    ".dat": read_text_table,
    ".npz": read_npz,
    ".npy": read_npy,
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
}
DAMAGES = (
    OSError, EOFError, ValueError, KeyError, IndexError, TypeError, RuntimeError, MemoryError, OverflowError,
    struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


def read_tables(file: Path) -> list[Table]:
    """Frames of a file: one, or several where the file holds a whole run.

    Raises:
        DataError: If there is no reader for its ending, or the file is not what its ending says, or damaged.
    """
    if file.suffix.lower() not in READERS:
        raise DataError(f"{file}: has an ending that is not read; known are {', '.join(READERS)} and .pvd: convert it.")
    if not file.is_file():
        raise DataError(f"{file}: is no regular file; name files or a pattern.")
    if file.stat().st_size == 0:
        raise DataError(f"{file}: is empty; copy it again.")
    try:
        return READERS[file.suffix.lower()](file)
    except CConvError:
        raise
    except DAMAGES as error:
        what = f"is damaged or not what its ending {file.suffix} says ({one_line(error) or type(error).__name__})"
        raise DataError(f"{file}: {what}; copy it again, or give its true ending.") from error
