"""Logs for Weights & Biases and MLflow: what they read back is what log.jsonl says, once; nothing is sent anywhere."""

import json
import struct
from importlib import import_module

import pytest
from outcomes import assert_one_clear_line
from systems import configured, problem

from cconv.errors import ConfigError
from cconv.study.declared.configuration import TrainingConfig
from cconv.study.records.trials import TrialFolder
from cconv.study.running import training_logs
from cconv.study.running.mlflow_run import DATABASE
from cconv.study.running.training_log import Training
from cconv.study.running.training_logs import LOGGERS, TrainingLogs, check_loggers
from cconv.study.running.trial import Trial, run_trial

BLOCK = 2**15  # bytes of LevelDB's log

# Of the packages that are tried, not ours.
pytestmark = [pytest.mark.filterwarnings("default"), pytest.mark.integration]


def train(generator, folder, logger, stop_after=None):
    """A small training in a run of a study, at most to an evaluation."""
    asked = Trial(
        stage="random", parameters={}, init_seed=1, data_seed=0, provenance={"study": "vortices"}, loggers=(logger,)
    )
    training = TrainingConfig(updates=6, evaluate_every=2)
    defaults = configured(layers=1, kernel_size=3, message="difference")._replace(training=training)
    for number, _ in enumerate(run_trial(problem(generator), asked, defaults, folder), start=1):
        if number == stop_after:
            break


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "study.json").write_text("{}")
    return TrialFolder(tmp_path / "trials" / "random_0000")


def logged(folder):
    return {entry["updates"]: entry["valid_error"] for entry in folder.log()}


def test_mlflow_reads_what_the_log_says_also_of_a_training_that_goes_on(generator, folder, tmp_path):
    mlflow = pytest.importorskip("mlflow")
    train(generator, folder, "mlflow", stop_after=2)
    train(generator.manual_seed(0), folder, "mlflow")
    client = mlflow.MlflowClient(tracking_uri=f"sqlite:///{tmp_path / DATABASE}")
    experiment = client.get_experiment_by_name("vortices")
    (run,) = client.search_runs([experiment.experiment_id])
    assert (run.info.run_name, run.info.status) == ("trials/random_0000", "FINISHED")
    assert run.data.params["network.kernel_size"] == "3"
    history = client.get_metric_history(run.info.run_id, "valid_error")
    assert {metric.step: metric.value for metric in history} == pytest.approx(logged(folder))
    assert len(history) == 3


def test_wandb_keeps_what_the_log_says_in_an_offline_run(generator, folder):
    pytest.importorskip("wandb")
    train(generator, folder, "wandb", stop_after=2)
    train(generator.manual_seed(0), folder, "wandb")
    (file,) = (folder.path / "wandb").glob("offline-run-*/run-*.wandb")
    assert stored_by_wandb(file) == pytest.approx(logged(folder))


def stored_by_wandb(file):
    """Validation error by number of updates in the file of an offline run, read by the format: LevelDB's log."""
    record, found = import_module("wandb.proto.wandb_internal_pb2").Record, {}
    content, place, whole = file.read_bytes(), 7, b""  # after the header of the file
    while place + 7 <= len(content):
        length, kind = struct.unpack_from("<HB", content, place + 4)  # after a checksum
        whole += content[place + 7 : place + 7 + length]
        place += 7 + length
        place += -place % BLOCK if -place % BLOCK < 7 else 0
        if kind in (2, 3):  # the first part of a record, or a middle one
            continue
        read, whole = record.FromString(whole), b""
        if read.WhichOneof("record_type") == "history":
            items = {(item.key or "/".join(item.nested_key)): json.loads(item.value_json) for item in read.history.item}
            found[items["_step"]] = items["valid_error"]
    return found


@pytest.mark.parametrize("logger", LOGGERS)
def test_a_logger_that_is_not_installed_is_refused_in_one_line(cconv, flow_folder, logger, tmp_path, monkeypatch):
    monkeypatch.setattr(training_logs, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=rf"pip install 'cconv\[{logger}\]'"):
        check_loggers([logger])
    refusal = cconv("train", "experiments/smoke.toml", "--data", flow_folder, "--out", tmp_path / "x", "--log", logger)
    assert_one_clear_line(refusal, logger, "not installed")
    assert not (tmp_path / "x").exists()


def test_a_logger_that_is_not_known_is_refused(cconv, flow_folder, tmp_path):
    refusal = cconv("train", "experiments/smoke.toml", "--data", flow_folder, "--out", tmp_path / "x", "--log", "paper")
    assert_one_clear_line(refusal, "paper", "mlflow", "wandb")


def test_a_logger_that_fails_is_given_up_with_a_warning_and_the_others_go_on(tmp_path, monkeypatch):
    class Fails:
        def __init__(self, training):
            pass

        def write(self, evaluation):
            raise RuntimeError("the server is gone\nand more")

        def close(self):
            raise RuntimeError("nor can it be closed")

    monkeypatch.setitem(training_logs.LOGGERS, "mlflow", Fails)
    training = Training(folder=tmp_path, study="s", stage="random", settings={}, begun=0.0)
    logs = TrainingLogs(training, ["mlflow"])
    entry = {"updates": 1, "seconds": 1.0, "valid_error": 0.5}
    with pytest.warns(UserWarning, match=r"no more is logged for mlflow \(the server is gone\)"):
        logs.append(entry)
    logs.append(entry | {"updates": 2, "seconds": 2.0})
    logs.close()
