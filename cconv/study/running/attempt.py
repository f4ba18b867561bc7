"""Attempts at a training: one process at a time may write to the folder of a training, and it is ended if it hangs."""

import faulthandler
import uuid
from pathlib import Path
from typing import Self

from cconv.errors import CConvError
from cconv.files import write_text


class Superseded(CConvError):
    """The error that another process has taken the training over."""


class Hanging(CConvError):
    """The error that an earlier attempt hung until its process was ended."""


class Attempt:
    """The right of a process to write to the folder of a training, and a watchdog that ends the process if it hangs.

    A node that was believed dead may come back while another process continues its training; it must not write to the
    records any more. The attempt that began last has the right to write.

    Args:
        folder: Folder of the training.
        seconds: Time after which the process is ended; ``hanging.txt`` then holds its stack trace.
    """

    def __init__(self, folder: Path, seconds: float):
        self._claim, self._trace = folder / "attempt", folder / "hanging.txt"
        self._seconds = seconds
        self._name = uuid.uuid4().hex

    def __enter__(self) -> Self:
        """Take the folder over from any earlier attempt.

        Raises:
            Hanging: If an earlier attempt was ended because it hung.
        """
        if self._trace.is_file() and self._trace.stat().st_size > 0:
            raise Hanging(f"it hung and was ended after {self._seconds:g} seconds; where: {self._trace}")
        write_text(self._claim, self._name)
        self._file = self._trace.open("w")
        faulthandler.dump_traceback_later(self._seconds, exit=True, file=self._file)
        return self

    def __exit__(self, *exception: object) -> None:
        faulthandler.cancel_dump_traceback_later()
        self._file.close()
        if self.holds:
            self._trace.unlink(missing_ok=True)
            self._claim.unlink()

    @property
    def holds(self) -> bool:
        """True if no other attempt has taken the folder over."""
        try:
            return self._claim.read_text() == self._name
        except FileNotFoundError:
            return False

    def check(self) -> None:
        """Raise `Superseded` if another attempt has taken the folder over."""
        if not self.holds:
            raise Superseded(f"{self._claim.parent}: another process has taken this training over.")
