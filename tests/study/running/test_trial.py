import json

import pytest
from systems import configured, problem

from cconv.models.checkpoint import load_model, read_card
from cconv.study.declared.configuration import TrainingConfig
from cconv.study.records.run_folder import RunFolder
from cconv.study.running.problem import Problem
from cconv.study.running.trial import Trial, run_trial

NETWORK = configured(layers=1, kernel_size=3, message="difference")
TRAINING = TrainingConfig(updates=6, evaluate_every=2)


def trial(given, folder, parameters=None, **options):
    asked = Trial(
        stage="random", parameters=parameters or {}, init_seed=1, data_seed=0, provenance={"task": given.task.name}
    )
    return run_trial(given, asked, NETWORK._replace(training=TRAINING), folder, **options)


def test_log_config_and_checkpoint_agree(generator, tmp_path):
    given, folder = problem(generator), RunFolder(tmp_path).trial("random_0000")
    entries = list(trial(given, folder, {"training.learning_rate": 0.02, "network.kernel_size": 4}))
    record = folder.read()
    assert record.log == entries
    assert [entry["updates"] for entry in entries] == [2, 4, 6]
    assert record.config["network"]["kernel_size"] == 4
    assert record.config["training"]["learning_rate"] == 0.02
    assert load_model(folder.checkpoint).num_parameters == record.config["num_parameters"]
    assert read_card(folder.checkpoint)["valid_error"] == min(e["valid_error"] for e in entries)


def test_the_checkpoint_is_the_best_and_not_the_last(generator, tmp_path, monkeypatch):
    given, folder, errors = problem(generator), RunFolder(tmp_path).trial("random_0000"), iter((0.5, 0.2, 0.4))
    monkeypatch.setattr(Problem, "valid_error", lambda *arguments: next(errors))
    assert [entry["valid_error"] for entry in trial(given, folder)] == [0.5, 0.2, 0.4]
    card = read_card(folder.checkpoint)
    assert (card["valid_error"], card["updates"]) == (0.2, 4)


def test_every_entry_is_on_disk_before_it_is_seen(generator, tmp_path):
    folder = RunFolder(tmp_path).trial("random_0000")
    for count, _ in enumerate(trial(problem(generator), folder), start=1):
        assert len(folder.read().log) == count


def test_divergence_is_a_recorded_outcome(generator, tmp_path):
    """A step this large makes the next loss infinite."""
    folder = RunFolder(tmp_path).trial("random_0000")
    entries = list(
        trial(
            problem(generator),
            folder,
            {"training.learning_rate": 1e3, "network.layers": 12, "network.activation": "leaky_relu"},
        )
    )
    assert entries[-1]["diverged"]
    assert entries[-1]["valid_error"] is None
    assert json.loads((folder.path / "log.jsonl").read_text().splitlines()[-1])["diverged"]


def test_interrupt_before_the_first_evaluation_leaves_a_usable_checkpoint(generator, tmp_path):
    def interrupt(state):
        raise KeyboardInterrupt

    given, folder = problem(generator), RunFolder(tmp_path).trial("random_0000")
    with pytest.raises(KeyboardInterrupt):
        list(trial(given, folder, on_update=interrupt))
    assert load_model(folder.checkpoint).predict(given.valid_samples[0].inputs).isfinite().all()


def test_a_trial_that_was_left_goes_on_to_the_same_log_and_checkpoint(generator, tmp_path):
    """The kill comes after the log's last line, before the progress that belongs to it."""
    given, run = problem(generator), RunFolder(tmp_path)
    whole, cut = run.trial("random_0000"), run.trial("random_0001")
    list(trial(given, whole))
    entries = trial(given, cut)
    next(entries)
    progress = cut.progress.read_bytes()
    next(entries)
    cut.progress.write_bytes(progress)
    rest = list(trial(given, cut))
    assert [entry["updates"] for entry in rest] == [4, 6]
    errors = [[entry["valid_error"] for entry in folder.log()] for folder in (whole, cut)]
    assert errors[0] == pytest.approx(errors[1], rel=1e-6)
    assert read_card(cut.checkpoint)["updates"] == read_card(whole.checkpoint)["updates"]


def test_a_trial_ends_at_its_limit_of_time(generator, tmp_path):
    folder = RunFolder(tmp_path).trial("random_0000")
    assert list(trial(problem(generator), folder, seconds_limit=0.0)) == []


def test_a_trial_says_what_it_costs_before_it_is_trained(generator, tmp_path):
    folder = RunFolder(tmp_path).trial("random_0000")
    next(trial(problem(generator), folder))
    assert folder.read().config["flops_per_particle"] > 0
