"""Event files of trainings: what TensorBoard reads is what the log says, once."""

import errno
import os
import struct

import pytest
from systems import configured, problem
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.record_writer import RecordWriter

from cconv.study.declared.configuration import TrainingConfig
from cconv.study.records.trials import TrialFolder
from cconv.study.running.event_file import EVENT_FILE, VERSION
from cconv.study.running.training_log import Training
from cconv.study.running.training_logs import training_logs
from cconv.study.running.trial import Trial, run_trial

TRAINING = TrainingConfig(updates=6, evaluate_every=2)


def entry(updates, **values):
    given = {"valid_error": 0.5, "train_loss": 0.25, "learning_rate": 1e-3, "seconds": updates / 4, "diverged": False}
    return {"updates": updates} | given | values


def events(folder):
    """Records of an event file, read by the format: length, checksum, record, checksum."""
    content, found = (folder / EVENT_FILE).read_bytes(), []
    while content:
        (length,) = struct.unpack("<Q", content[:8])
        found.append(Event.FromString(content[12 : 12 + length]))
        content = content[16 + length :]
    assert found[0].file_version == VERSION
    return found[1:]


def scalars(folder):
    """Scalars of an event file by number of updates."""
    return {event.step: {value.tag: value.simple_value for value in event.summary.value} for event in events(folder)}


def train(generator, folder, stop_after=None):
    """Run the same small training, at most to an evaluation, and give its entries."""
    asked = Trial(stage="random", parameters={}, init_seed=1, data_seed=0, provenance={})
    defaults = configured(layers=1, kernel_size=3, message="difference")._replace(training=TRAINING)
    seen = []
    for each in run_trial(problem(generator), asked, defaults, folder):
        seen.append(each)
        if len(seen) == stop_after:
            break
    return seen


def test_a_training_is_written_as_its_log_says(generator, tmp_path):
    folder = TrialFolder(tmp_path / "trial")
    entries = train(generator, folder)
    found = scalars(folder.path)
    assert list(found) == [2, 4, 6]
    for each in entries:
        written = found[each["updates"]]
        assert written["valid_error"] == pytest.approx(each["valid_error"])
        assert written["train_loss"] == pytest.approx(each["train_loss"])
        assert written["learning_rate"] == pytest.approx(each["learning_rate"])
        assert written["updates_per_second"] > 0


def test_a_training_that_goes_on_has_each_step_once(generator, tmp_path):
    folder = TrialFolder(tmp_path / "trial")
    train(generator, folder, stop_after=2)
    assert [event.step for event in events(folder.path)] == [2, 4]
    train(generator.manual_seed(0), folder)
    assert [event.step for event in events(folder.path)] == [2, 4, 6]
    times = [event.wall_time for event in events(folder.path)]
    assert times == sorted(times)


def test_the_rate_is_that_between_two_evaluations_and_missing_values_are_left_out(tmp_path):
    training = Training(folder=tmp_path, study="s", stage="random", settings={}, begun=0.0)
    with training_logs(training, [entry(4, seconds=2.0)]) as file:
        file.append(entry(10, seconds=3.0, valid_error=None, train_loss=None))
    assert scalars(tmp_path)[4]["updates_per_second"] == 2
    assert scalars(tmp_path)[10].keys() == {"learning_rate", "updates_per_second"}
    assert scalars(tmp_path)[10]["updates_per_second"] == 6


def test_a_folder_where_nothing_can_be_written_stops_no_training(generator, tmp_path):
    folder = TrialFolder(tmp_path / "trial")
    (folder.path / EVENT_FILE).mkdir(parents=True)  # so that the file cannot be opened
    with pytest.warns(UserWarning, match="no more is logged for TensorBoard"):
        assert [each["updates"] for each in train(generator, folder)] == [2, 4, 6]


def test_a_write_that_fails_ends_the_file_and_no_training(generator, tmp_path, monkeypatch):
    def fail(self, data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(RecordWriter, "write", fail)
    with pytest.warns(UserWarning, match="no more is logged for TensorBoard"):
        assert [each["updates"] for each in train(generator, TrialFolder(tmp_path / "trial"))] == [2, 4, 6]
