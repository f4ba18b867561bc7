import json

import pytest
from summaries import SAMPLE, whole_summary

from cconv.errors import ConfigError, DataError
from cconv.files import read_json, write_json
from cconv.study.records.forms import OUTCOMES
from cconv.study.records.found import Found, StageResult
from cconv.study.records.run_folder import FORMAT, RunFolder

CONFIG = {
    "stage": "random",
    "parameters": {"network.kernel_size": 4},
    "num_parameters": 12,
    "flops_per_particle": 9.0,
    "init_seed": 0,
}
STUDY = {"format": FORMAT, "stages": {"random": {"kind": "random"}}}
ENVIRONMENT = {
    "started": "2026-01-01T00:00:00+00:00",
    "packages": {"torch": "2.13.0"},
    "seeds": {"data": 0, "init": 0, "search": 0},
    "data": {"sha256": "0"},
    "data_findings": [],
}
ENTRY = {"updates": 5, "train_loss": 1.0, "valid_error": 0.5, "learning_rate": 1e-3, "seconds": 1.0}


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
    trial.append(ENTRY | {"updates": 10, "valid_error": None})
    assert trial.read().last["updates"] == 5
    assert trial.read().last_error == ENTRY["valid_error"]


@pytest.mark.parametrize("outcome", OUTCOMES)
def test_only_a_completed_training_has_a_final_error(outcome, tmp_path):
    trial = RunFolder(tmp_path).trial("random_0000")
    trial.start(CONFIG)
    trial.append(ENTRY)
    trial.finish(outcome)
    assert trial.read().final_error == (ENTRY["valid_error"] if outcome == "completed" else None)


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
        RunFolder(tmp_path).summary()


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


def recorded(tmp_path, *stages):
    """A run folder with a trial of each stage."""
    run = RunFolder(tmp_path)
    run.write("study.json", {"format": FORMAT, "stages": {stage: {"kind": "random"} for stage in stages}})
    for stage in stages:
        trial = run.trial(f"{stage}_0000")
        trial.start(CONFIG | {"stage": stage})
        trial.append(ENTRY)
        trial.finish("completed")
    return run


def test_trials_are_told_by_their_whole_name(tmp_path):
    run = recorded(tmp_path, "random", "random_wide", "r.ndom")
    assert [record.id for record in run.trials()] == ["random_0000", "random_wide_0000", "r.ndom_0000"]
    assert [record.id for record in run.trials_of("r.ndom")] == ["r.ndom_0000"]
    assert run.trials_of("r[a-z]*") == []


def test_trials_beyond_the_ten_thousandth_keep_their_order(tmp_path):
    run = recorded(tmp_path, "random")
    for number in (9999, 10_000):
        run.trial(f"random_{number}").start(CONFIG)
    assert [record.id for record in run.trials()] == ["random_0000", "random_9999", "random_10000"]


@pytest.mark.parametrize("name", ["../evil", "/etc", "a/b", "", "..", "a..b"])
def test_no_name_of_a_training_leads_out_of_the_run_folder(name, tmp_path):
    for folder in (RunFolder(tmp_path).trial, lambda name: RunFolder(tmp_path).finalist(name, 1)):
        with pytest.raises(ConfigError, match="a name must match"):
            folder(name)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("trials/random_0000/config.json", {"stage": "random"}, "config.json: `parameters` is missing"),
        ("trials/random_0000/config.json", CONFIG | {"stage": "other"}, "`stage` must be 'random', got 'other'"),
        ("trials/random_0000/config.json", CONFIG | {"init_seed": "../.."}, "`init_seed`: input should be a valid int"),
        ("trials/random_0000/config.json", CONFIG | {"parameters": [1]}, "`parameters`: input should be a valid dict"),
        ("trials/random_0000/config.json", CONFIG | {"flops_per_particle": None}, "`flops_per_particle` is missing"),
        ("trials/random_0000/config.json", [], "config.json: input should be a valid dictionary"),
        ("trials/random_0000/outcome.json", {"outcome": "won", "reason": ""}, "outcome.json: `outcome`"),
        ("trials/random_0000/outcome.json", {"outcome": "failed", "reason": 3}, "outcome.json: `reason`"),
        ("trials/random_0000/log.jsonl", ENTRY | {"updates": "5"}, "log.jsonl: line 1 .*`updates`"),
        ("trials/random_0000/log.jsonl", ENTRY | {"seconds": [1]}, "log.jsonl: line 1 .*`seconds`"),
        ("trials/random_0000/log.jsonl", ENTRY | {"updates": True}, "log.jsonl: line 1 .*`updates`"),
        ("study.json", {"format": FORMAT, "stages": {"../evil": {"kind": "random"}}}, "a name must match"),
        ("study.json", {"format": FORMAT, "stages": ["random"]}, "study.json: `stages`: input should be a valid dict"),
    ],
)
def test_a_record_that_does_not_fit_is_named_with_its_key(name, content, message, tmp_path):
    run = recorded(tmp_path, "random")
    (tmp_path / name).write_text(json.dumps(content))
    with pytest.raises(DataError, match=message) as refused:
        run.trials()
    assert str(tmp_path / name) in str(refused.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("state.json", {"state": "running"}, "`stage` is missing"),
        ("state.json", {"state": 5, "stage": "random"}, "`state`"),
        ("rungs.json", {"random": {"updates": 5}}, "`random`: input should be a valid list"),
        ("rungs.json", {"random": [{"updates": 5, "recorded": {"a": "b"}}]}, "`random.0.recorded.a`"),
        ("environment.json", [1], "valid dictionary"),
        ("environment.json", ENVIRONMENT | {"packages": ["torch"]}, "`packages`"),
        ("environment.json", ENVIRONMENT | {"data_findings": ["suspicious"]}, "`data_findings.0`"),
    ],
)
def test_a_file_of_the_run_that_does_not_fit_is_named_with_its_key(name, content, message, tmp_path):
    write_json(tmp_path / name, content)
    with pytest.raises(DataError, match=message) as refused:
        RunFolder(tmp_path).read(name)
    assert str(tmp_path / name) in str(refused.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"kind": "random"}, "`seconds` is missing"),
        ({"kind": "f", "seconds": 1.0, "finalists": {"../x": {}}}, "a name must match"),
        ({"kind": "f", "seconds": 1.0, "refinde": {}}, "unknown key `refinde`. Did you mean 'refined'"),
        ({"kind": "f", "seconds": 1.0, "references": {"strategies": 5, "asha_share": {}}}, "`references.strategies`"),
    ],
)
def test_a_result_that_does_not_fit_is_named_with_its_key(content, message, tmp_path):
    write_json(tmp_path / "stages" / "f.json", content)
    with pytest.raises(DataError, match=rf"f\.json: .*{message}"):
        RunFolder(tmp_path).result("f")


def test_a_stage_is_read_as_it_was_written_with_what_it_found_and_no_more(tmp_path):
    run, found = RunFolder(tmp_path), Found(refined={"layers": "1 or 2"})
    run.write_result("narrow", "refine", 2.5, found)
    assert read_json(tmp_path / "stages" / "narrow.json").keys() == {"kind", "seconds", "refined"}
    assert run.result("narrow") == StageResult(kind="refine", seconds=2.5, refined={"layers": "1 or 2"})
    assert run.result("narrow").found() == found.found() == {"refined": {"layers": "1 or 2"}}


def test_a_summary_is_read_as_it_was_written(tmp_path):
    summary, run = whole_summary(RunFolder(SAMPLE).summary()), RunFolder(tmp_path)
    run.write_summary(summary)
    assert run.summary() == summary


def without(key):
    return lambda content: content.pop(key)


def negative_error(content):
    content["finalists"][1]["test"]["error"] = -1.0


def of_another(content):
    content["recommended"]["id"] = "another"


def elsewhere(path):
    return lambda content: content["finalists"][1].update(checkpoint=path)


def misspelt(content):
    content["selection"]["tide"] = content["selection"].pop("tied")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (without("study"), "`study` is missing"),
        (negative_error, r"`finalists\.1\.test\.error`: .* greater than or equal to 0, got -1"),
        (of_another, "`recommended.id` must be that of one of `finalists`"),
        (elsewhere("../../evil"), r"`finalists\.1\.checkpoint`: a path must lead to a place inside of the folder"),
        (elsewhere("/evil"), r"`finalists\.1\.checkpoint`: a path must lead to a place inside of the folder"),
        (misspelt, r"unknown key `selection\.tide`\. Did you mean 'tied'"),
    ],
)
def test_a_summary_that_does_not_fit_is_named_with_its_key(damage, message, tmp_path):
    content = read_json(SAMPLE / "summary.json")
    damage(content)
    write_json(tmp_path / "summary.json", content)
    with pytest.raises(DataError, match=rf"summary\.json: {message}"):
        RunFolder(tmp_path).summary()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "more than 32 tables or arrays"),
        ("[" * 40 + "]" * 40, "more than 32 tables or arrays"),
        ('{"a": ' + "1" * 5000 + "}", "4300 digits"),
        ('{"a": NaN}', "NaN is no number of JSON"),
        ('{"a": 1, "a": 2}', "'a' stands there twice"),
    ],
)
def test_json_that_no_record_of_ours_is_ends_in_one_line(text, message, tmp_path):
    (tmp_path / "state.json").write_text(text)
    with pytest.raises(DataError, match=f"state.json: not JSON .*{message}"):
        RunFolder(tmp_path).read("state.json")


def test_a_record_that_is_no_text_or_no_file_is_named(tmp_path):
    (tmp_path / "state.json").write_bytes(b'{"state": "\xff"}')
    with pytest.raises(DataError, match=r"state\.json: not a text in UTF-8 .*byte 11"):
        RunFolder(tmp_path).read("state.json")
    (tmp_path / "rungs.json").mkdir()
    with pytest.raises(DataError, match=r"rungs\.json: no regular file"):
        RunFolder(tmp_path).read("rungs.json")


def test_a_retraining_has_the_seed_of_its_folder(tmp_path):
    run = RunFolder(tmp_path)
    run.finalist("baseline", 1).start(CONFIG | {"init_seed": 1})
    assert [record.id for record in run.retrainings()["baseline"]] == ["seed_1"]
    run.finalist("baseline", 2).start(CONFIG | {"init_seed": 1})
    with pytest.raises(DataError, match="seed_2/config.json: `init_seed` is not that of the folder"):
        run.retrainings()
