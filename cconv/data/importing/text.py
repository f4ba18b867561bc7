"""Tables of text: .csv and its relatives, with a line of names and a row for each particle."""

import warnings
from pathlib import Path

import numpy as np
import pandas as pd

from cconv.data.importing.table import Table, is_time, plain_array
from cconv.data.limits import check_size, one_line
from cconv.errors import DataError

SEPARATORS = (",", ";", "\t")
LONGEST_LINE = 2**16
COPIES = 4  # of the text, in memory at the same time
ORDERS = ("frame", "step", "timestep", "iteration")  # columns that order frames without being times


def read_text_table(file: Path) -> list[Table]:
    """Frames of a text file: one for each value of its column of times (or frames), or a single one.

    Raises:
        DataError: If it has no names of columns, or no rows.
    """
    check_size(COPIES * file.stat().st_size, file.stat().st_size, str(file))
    header, separator, ends = _header(file)
    with warnings.catch_warnings():
        # Values beyond the last name are a warning; what follows a separator at the end of every line is none.
        warnings.simplefilter("ignore" if ends else "error", pd.errors.ParserWarning)
        try:
            frame = pd.read_csv(file, sep=separator, skipinitialspace=True, header=0, names=header, index_col=False)
        except pd.errors.ParserWarning as warning:
            raise DataError(f"{file}: has more values in a row than its first line has names; correct it.") from warning
    if frame.empty:
        raise DataError(f"{file}: has no rows; copy it again.")
    column = next((name for name in header if is_time(name)), None)
    column = column or next((name for name in header if name.lower() in ORDERS), None)
    if column is None:
        return [Table(file=file, arrays=_arrays(frame), time=None)]
    if frame[column].dtype.kind not in "fiu" or frame[column].isna().any():
        raise DataError(f"{file}: `{one_line(column)}` must be a number in every row; correct it.")
    return [
        Table(file=file, arrays=_arrays(rows.drop(columns=column)), time=float(time) if is_time(column) else None)
        for time, rows in frame.groupby(column, sort=True)
    ]


def _header(file: Path) -> tuple[list[str], str, bool]:
    """Names in the first line, without units in brackets, what separates them, and whether it ends the line too."""
    with file.open(encoding="utf-8-sig") as stream:
        line = stream.readline(LONGEST_LINE).strip().lstrip("#").strip()
    separator = next((each for each in SEPARATORS if each in line), r"\s+")
    ends = line.endswith(separator)
    line = line.removesuffix(separator)
    parts = line.split() if separator == r"\s+" else line.split(separator)
    names = [part.partition("[")[0].strip().strip('"') if " [" in part else part.strip().strip('"') for part in parts]
    if len(set(names)) < len(names) or not all(names) or all(map(_is_number, names)):
        raise DataError(f"{file}: its first line must name the columns, each once, such as x,y,vx,vy; add it.")
    return names, separator, ends


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _arrays(frame: pd.DataFrame) -> dict[str, np.ndarray]:
    columns = {str(name): plain_array(frame[name].to_numpy()) for name in frame.columns}
    return {name: values for name, values in columns.items() if values is not None}
