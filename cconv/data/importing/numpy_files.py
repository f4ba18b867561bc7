"""Arrays that NumPy saved: .npz with names, .npy with positions alone; pickled objects are refused."""

import zipfile
from pathlib import Path

import numpy as np

from cconv.data.importing.table import Table, stacked_tables
from cconv.data.limits import check_size, one_line
from cconv.errors import DataError


def read_npz(file: Path) -> list[Table]:
    """Frames of an .npz file: one, or several where positions are (T, N, D).

    Raises:
        DataError: If an array is pickled or larger than memory, or arrays have different numbers of frames.
    """
    with zipfile.ZipFile(file) as archive:
        for member in archive.infolist():
            check_size(member.file_size, member.compress_size, f"{file}: `{one_line(member.filename)}`")
    with np.load(file, allow_pickle=False) as arrays:
        return stacked_tables(file, {name: _unpickled(arrays, name, file) for name in arrays.files})


def read_npy(file: Path) -> list[Table]:
    """Positions (N, D) or (T, N, D) of an .npy file.

    Raises:
        DataError: If it holds something else.
    """
    check_size(file.stat().st_size, file.stat().st_size, str(file))
    with file.open("rb") as stream:
        values = np.lib.format.read_array(stream, allow_pickle=False)
    if values.ndim not in (2, 3):
        raise DataError(f"{file}: must hold positions (N, D) or (T, N, D) alone; save other arrays as .npz by name.")
    return stacked_tables(file, {"positions": values})


def _unpickled(arrays: np.lib.npyio.NpzFile, name: str, file: Path) -> np.ndarray:
    try:
        return arrays[name]
    except ValueError as error:
        raise DataError(
            f"{file}: `{one_line(name)}` cannot be read without running what it holds ({one_line(error)}); "
            "save plain arrays of numbers."
        ) from error
