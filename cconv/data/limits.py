"""Limits for foreign data: memory, and text shown in a terminal."""

import psutil

from cconv.errors import DataError

MEMORY_SHARE = 0.5  # of what is available; samples and graphs need the rest
LARGEST_RATIO = 1000  # uncompressed to stored bytes; deflate cannot exceed 1032
SMALL = 64 * 2**20  # bytes that are read whatever their ratio
LONGEST_TEXT = 200


def check_size(size: int, stored: int, place: str, at_once: int | None = None) -> None:
    """Raise `DataError` if what is stored in `stored` bytes would take `size` bytes that no honest file of it needs.

    Args:
        size: Bytes once it is read.
        stored: Bytes in the file.
        place: File and member, for the message.
        at_once: Bytes of the part that is read at a time; None for all.
    """
    room, read = memory_limit(), size if at_once is None else at_once
    if read > room:
        raise DataError(
            f"{place} takes {readable_size(read)}, more than {readable_size(room)}, half of the memory that is free; "
            "cut it into shorter trajectories."
        )
    if size > SMALL and size > LARGEST_RATIO * stored:
        raise DataError(
            f"{place} claims {readable_size(size)} but only {readable_size(stored)} are stored; it was never written: "
            "write it again."
        )


def memory_limit() -> int:
    """Return the number of bytes that one piece of data may take now."""
    return int(MEMORY_SHARE * psutil.virtual_memory().available)


def one_line(value: object, longest: int = LONGEST_TEXT) -> str:
    """Foreign text as one printable line of at most `longest` characters; control characters are shown as ``?``."""
    text = str(value)
    shown = "".join(character if character.isprintable() else "?" for character in text[:longest])
    return shown + (f"... ({len(text)} characters)" if len(text) > longest else "")


def readable_size(size: float) -> str:
    """A number of bytes in the unit that a reader expects, e.g. "1.5 GB"."""
    for unit in ("bytes", "KB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"
