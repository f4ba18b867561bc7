import json

import pytest

from cconv.errors import ConfigError, DataError
from cconv.study.records import FORMAT, RunFolder, write_json

CONFIG = {"stage": "random", "parameters": {"kernel_size": 4}, "num_parameters": 12, "flops_per_particle": 9.0, "init_seed": 0}
STUDY = {"format": FORMAT, "stages": {"random": {"kind": "random"}}}
ENTRY = {"updates": 5, "train_loss": 1.0, "valid_normalized_mse": 0.5, "learning_rate": 1e-3, "seconds": 1.0}


def test_a_trial_reads_back_as_written(tmp_path):
    write_json(tmp_path / "study.json", STUDY)
    trial = RunFolder(tmp_path).trial("random_0000")
    trial.start(CONFIG)
    trial.append(ENTRY)
    trial.finish("stopped")
    (record,) = RunFolder(tmp_path).trials()
    assert (record.id, record.stage, record.outcome) == ("random_0000", "random", "stopped")
    assert record.log == [ENTRY]
    assert record.last == ENTRY


def test_a_trial_without_an_end_was_interrupted(tmp_path):
    trial = RunFolder(tmp_path).trial("random_0000")
    trial.start(CONFIG)
    assert trial.read().outcome == "interrupted"
    assert trial.read().last is None


def test_a_log_line_cut_short_by_a_kill_is_left_out(tmp_path):
    trial = RunFolder(tmp_path).trial("random_0000")
    trial.start(CONFIG)
    trial.append(ENTRY)
    with (trial.path / "log.jsonl").open("a") as file:
        file.write('{"updates": 10, "valid')
    assert trial.read().log == [ENTRY]


def test_a_diverged_last_entry_is_no_error(tmp_path):
    trial = RunFolder(tmp_path).trial("random_0000")
    trial.start(CONFIG)
    trial.append(ENTRY)
    trial.append(ENTRY | {"updates": 10, "valid_normalized_mse": None})
    assert trial.read().last["updates"] == 5


def test_writing_leaves_no_temporary_file(tmp_path):
    write_json(tmp_path / "a.json", {"x": 1})
    write_json(tmp_path / "a.json", {"x": 2})
    assert json.loads((tmp_path / "a.json").read_text()) == {"x": 2}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_an_existing_folder_is_refused_and_only_a_run_is_replaced(tmp_path):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "thesis.txt").write_text("precious")
    for overwrite in (False, True):
        with pytest.raises(ConfigError, match="exists already"):
            RunFolder.create(tmp_path / "own", overwrite)
    assert (tmp_path / "own" / "thesis.txt").read_text() == "precious"
    run = RunFolder.create(tmp_path / "run")
    run.write("study.json", {})
    with pytest.raises(ConfigError, match="--overwrite"):
        RunFolder.create(tmp_path / "run")
    RunFolder.create(tmp_path / "run", overwrite=True)
    assert list((tmp_path / "run").iterdir()) == []


def test_what_is_no_run_folder_is_named(tmp_path):
    with pytest.raises(DataError, match=r"no study\.json"):
        RunFolder.open(tmp_path)


def test_damaged_json_is_named(tmp_path):
    (tmp_path / "summary.json").write_text("{")
    with pytest.raises(DataError, match=r"summary\.json: not JSON"):
        RunFolder(tmp_path).read("summary.json")


def test_a_run_folder_of_another_format_is_refused(tmp_path):
    write_json(tmp_path / "study.json", STUDY | {"format": FORMAT + 1})
    with pytest.raises(DataError, match=f"format {FORMAT + 1}, and this version of cconv reads format {FORMAT}"):
        RunFolder.open(tmp_path)
    write_json(tmp_path / "study.json", {"name": "of the first version"})
    with pytest.raises(DataError, match="format 1"):
        RunFolder.open(tmp_path)


def test_a_corrupt_line_is_named_with_its_number(tmp_path):
    trial = RunFolder(tmp_path).trial("random_0000")
    trial.start(CONFIG)
    trial.append(ENTRY)
    with (trial.path / "log.jsonl").open("a") as file:
        file.write('{"updates": 10}\n')
    trial.append(ENTRY)
    with pytest.raises(DataError, match=r"log\.jsonl: line 2 .*delete that line"):
        trial.read()


def test_a_folder_is_held_by_one_run_at_a_time(tmp_path):
    refused = pytest.raises(ConfigError, match="another run works in this folder")
    with RunFolder(tmp_path).locked(), refused, RunFolder(tmp_path).locked():
        pass
    with RunFolder(tmp_path).locked():
        pass


def test_what_was_logged_after_the_progress_is_dropped(tmp_path):
    trial = RunFolder(tmp_path).trial("random_0000")
    trial.start(CONFIG)
    for updates in (5, 10, 15):
        trial.append(ENTRY | {"updates": updates})
    trial.go_on(10)
    assert [entry["updates"] for entry in trial.log()] == [5, 10]
