"""All logs of a training that other programs read: TensorBoard's always, those of loggers that are asked for.

A training that goes on writes them again from the kept entries of log.jsonl, so that no evaluation stands there twice.
A log that cannot be written is given up with a warning, and the training goes on without it.
"""

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.util import find_spec

from cconv.errors import ConfigError, check_choice
from cconv.study.declared.study_file import StudyConfig
from cconv.study.running.event_file import EventFile
from cconv.study.running.mlflow_run import MLflowRun
from cconv.study.running.training_log import Evaluation, Training, TrainingLog
from cconv.study.running.wandb_run import WandbRun

LOGGERS: dict[str, Callable[[Training], TrainingLog]] = {"mlflow": MLflowRun, "wandb": WandbRun}
SCALARS = ("valid_error", "train_loss", "learning_rate")  # of an entry of log.jsonl


def with_loggers(study: StudyConfig, names: Sequence[str]) -> StudyConfig:
    """Return the study with other loggers, which are installed.

    Raises:
        ConfigError: If one is not known or not installed.
    """
    for name in names:
        check_choice("log", name, LOGGERS)
    check_loggers(names)
    return study.model_copy(update={"log": tuple(names)})


def check_loggers(names: Iterable[str]) -> None:
    """Check that loggers are installed.

    Raises:
        ConfigError: With the first that is not.
    """
    for name in names:
        if find_spec(name) is None:
            raise ConfigError(f"`log` {name!r} needs {name}, which is not installed; run pip install 'cconv[{name}]'.")


class TrainingLogs:
    """The logs of a training.

    Args:
        training: The training.
        loggers: Names of `LOGGERS` that are asked for.
    """

    def __init__(self, training: Training, loggers: Sequence[str] = ()):
        self._last: Mapping = {"updates": 0, "seconds": 0.0}
        self._logs: dict[str, TrainingLog] = {}
        for name, make in {"TensorBoard": EventFile, **{name: LOGGERS[name] for name in loggers}}.items():
            try:
                self._logs[name] = make(training)
            except Exception as error:  # loggers of others fail in ways of their own, and no training depends on them
                _warn(name, training, error)
        self._training = training

    def append(self, entry: Mapping) -> None:
        """Add an evaluation, an entry of log.jsonl; values that are not finite are left out."""
        values = {name: entry[name] for name in SCALARS if entry.get(name) is not None}
        seconds, updates = (entry[name] - self._last[name] for name in ("seconds", "updates"))
        if seconds > 0:
            values["updates_per_second"] = updates / seconds
        self._last = entry
        evaluation = Evaluation(updates=entry["updates"], seconds=entry["seconds"], values=values)
        for name, log in list(self._logs.items()):
            try:
                log.write(evaluation)
            except Exception as error:
                _warn(name, self._training, error)
                self._close(name)

    def close(self) -> None:
        """Bring all logs to their end."""
        for name in list(self._logs):
            self._close(name)

    def _close(self, name: str) -> None:
        with suppress(Exception):  # what could not be written is lost
            self._logs.pop(name).close()


def _warn(name: str, training: Training, error: Exception) -> None:
    reason = (str(error) or type(error).__name__).splitlines()[0]
    warnings.warn(f"{training.folder}: no more is logged for {name} ({reason}).", stacklevel=3)


@contextmanager
def training_logs(training: Training, log: Iterable[Mapping], loggers: Sequence[str] = ()) -> Iterator[TrainingLogs]:
    """Write the logs of a training from the entries of log.jsonl, to add to them until the end of the context."""
    logs = TrainingLogs(training, loggers)
    try:
        for entry in log:
            logs.append(entry)
        yield logs
    finally:
        logs.close()
