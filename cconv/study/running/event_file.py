"""The evaluations of a training as an event file of TensorBoard, beside log.jsonl, which alone is read by cconv.

The file is written by the calls that make it, without a thread of its own, so that a kill loses nothing of it. A
training that goes on writes it again from the kept entries of its log, so that no step stands there twice.
"""

import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from tensorboardX.proto.event_pb2 import Event
from tensorboardX.proto.summary_pb2 import Summary
from tensorboardX.record_writer import RecordWriter

EVENT_FILE = "events.out.tfevents.0.cconv"  # TensorBoard finds files by the middle of their names
SCALARS = ("valid_error", "train_loss", "learning_rate")
VERSION = "brain.Event:2"  # of the format, which the first record says


class EventFile:
    """The event file of a training; one that cannot be written is given up, and the training goes on without it.

    Args:
        folder: Folder of the training.
        log: Entries of its log so far.
    """

    def __init__(self, folder: Path, log: Iterable[Mapping]):
        log = list(log)
        self._begun = time.time() - (log[-1]["seconds"] if log else 0.0)
        self._last: Mapping = {"updates": 0, "seconds": 0.0}
        self._writer: RecordWriter | None = None
        try:
            # A relative name may mean a cloud's storage.
            self._writer = RecordWriter(str(folder.absolute() / EVENT_FILE))
            self._write(Event(wall_time=self._begun, file_version=VERSION))
        except OSError:
            self._give_up()
        for entry in log:
            self.append(entry)

    def append(self, entry: Mapping) -> None:
        """Add an evaluation, an entry of the log, whose finite values become scalars at its number of updates."""
        values = {name: entry[name] for name in SCALARS if entry.get(name) is not None}
        seconds, updates = (entry[name] - self._last[name] for name in ("seconds", "updates"))
        if seconds > 0:
            values["updates_per_second"] = updates / seconds
        self._last = entry
        summary = Summary(value=[Summary.Value(tag=name, simple_value=value) for name, value in values.items()])
        try:
            self._write(Event(wall_time=self._begun + entry["seconds"], step=entry["updates"], summary=summary))
        except OSError:
            self._give_up()

    def close(self) -> None:
        """Close the file."""
        try:
            if self._writer is not None:
                self._writer.close()
        except OSError:  # what could not be written is lost
            self._writer = None

    def _write(self, event: Event) -> None:
        if self._writer is not None:
            self._writer.write(event.SerializeToString())
            self._writer.flush()

    def _give_up(self) -> None:
        self.close()
        self._writer = None


@contextmanager
def event_file(folder: Path, log: Iterable[Mapping]) -> Iterator[EventFile]:
    """Write the event file of a training again from its log, to add to it until the end of the context."""
    file = EventFile(folder, log)
    try:
        yield file
    finally:
        file.close()
