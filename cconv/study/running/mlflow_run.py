"""A training as a run of MLflow, in a database file of the whole run (`mlflow ui --backend-store-uri sqlite:///...`)."""

import logging
import os
from importlib import import_module
from typing import Any

from filelock import FileLock

from cconv.files import write_text
from cconv.study.running.training_log import Evaluation, Training

DATABASE, ARTIFACTS = "mlflow.db", "mlflow_artifacts"  # in the folder of the run
RUN_ID = "mlflow_run"  # in the folder of the training
LONGEST_PARAMETER = 6000  # characters of a value that MLflow takes


class MLflowRun:
    """A run of the experiment that is called as the study; a run of an earlier attempt is deleted.

    Args:
        training: The training.
    """

    def __init__(self, training: Training):
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")  # asked for when the package is imported
        mlflow = import_module("mlflow")
        for chatty in ("mlflow", "alembic"):
            logging.getLogger(chatty).setLevel(logging.WARNING)
        self._begun, place = training.begun, training.run.absolute()
        with FileLock(place / f".{DATABASE}.lock"):  # tables and experiments are made once
            self._client = mlflow.MlflowClient(tracking_uri=f"sqlite:///{place / DATABASE}")
            experiment = self._experiment(training.study, (place / ARTIFACTS).as_uri())
            self._delete_earlier(training)
        milliseconds = round(1000 * self._begun)
        self._id = self._client.create_run(experiment, start_time=milliseconds, run_name=training.name).info.run_id
        write_text(training.folder / RUN_ID, self._id)
        self._describe(training)

    def write(self, evaluation: Evaluation) -> None:
        """Add the values of an evaluation at its number of updates."""
        time = round(1000 * (self._begun + evaluation.seconds))
        metric = import_module("mlflow.entities").Metric
        found = [metric(name, value, time, evaluation.updates) for name, value in evaluation.values.items()]
        self._client.log_batch(self._id, metrics=found)

    def close(self) -> None:
        """End the run."""
        self._client.set_terminated(self._id)

    def _experiment(self, name: str, artifacts: str) -> str:
        known = self._client.get_experiment_by_name(name)
        return self._client.create_experiment(name, artifacts) if known is None else known.experiment_id

    def _delete_earlier(self, training: Training) -> None:
        if (training.folder / RUN_ID).is_file():
            self._client.delete_run((training.folder / RUN_ID).read_text())

    def _describe(self, training: Training) -> None:
        """Note the settings as parameters, those of tables under dotted names."""
        self._client.set_tag(self._id, "stage", training.stage)
        parameter = import_module("mlflow.entities").Param
        found = [parameter(name, str(value)[:LONGEST_PARAMETER]) for name, value in _flat(training.settings).items()]
        self._client.log_batch(self._id, params=found)


def _flat(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Settings without tables inside others: their keys are joined by dots."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        found |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found
