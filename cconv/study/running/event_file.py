"""The event file of a training for TensorBoard, beside log.jsonl, which alone is read by cconv.

The file is written by the calls that make it, without a thread of its own, so that a kill loses nothing of it.
"""

from tensorboardX.proto.event_pb2 import Event
from tensorboardX.proto.summary_pb2 import Summary
from tensorboardX.record_writer import RecordWriter

from cconv.study.running.training_log import Evaluation, Training

EVENT_FILE = "events.out.tfevents.0.cconv"  # TensorBoard finds files by the middle of their names
VERSION = "brain.Event:2"  # of the format, which the first record says


class EventFile:
    """The event file of a training, written from its beginning on.

    Args:
        training: The training.

    Raises:
        OSError: If the file cannot be written.
    """

    def __init__(self, training: Training):
        # A relative name may mean a cloud's storage.
        self._writer = RecordWriter(str(training.folder.absolute() / EVENT_FILE))
        self._begun = training.begun
        try:
            self._write(Event(wall_time=self._begun, file_version=VERSION))
        except OSError:
            self.close()
            raise

    def write(self, evaluation: Evaluation) -> None:
        """Add the values of an evaluation as scalars at its number of updates."""
        found = [Summary.Value(tag=name, simple_value=value) for name, value in evaluation.values.items()]
        time = self._begun + evaluation.seconds
        self._write(Event(wall_time=time, step=evaluation.updates, summary=Summary(value=found)))

    def close(self) -> None:
        """Close the file."""
        self._writer.close()

    def _write(self, event: Event) -> None:
        self._writer.write(event.SerializeToString())
        self._writer.flush()
