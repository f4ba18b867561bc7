import pytest

from cconv.errors import DataError
from cconv.study.records.run_folder import RunFolder
from cconv.study.stages.finalists import Finalist, finalist_jobs, retrained_finalists

CONFIG = {"stage": "finalists", "parameters": {}, "num_parameters": 12}


@pytest.fixture
def run(tmp_path):
    return RunFolder(tmp_path)


def retrain(run, finalist, seed, outcome="completed", reason="", errors=(0.5, 0.3, 0.4)):
    folder = run.finalist(finalist, seed)
    folder.start(CONFIG | {"init_seed": seed})
    for updates, error in enumerate(errors, start=1):
        folder.append({"updates": updates, "valid_error": error, "seconds": 1.0})
    folder.finish(outcome, reason)


def test_every_finalist_gets_every_seed_after_the_searchs(run):
    jobs = finalist_jobs(
        [Finalist(id="baseline", parameters={}), Finalist(id="a", parameters={"network.layers": 1})], 2, 5, run
    )
    assert [(job.name, job.init_seed) for job in jobs] == [
        ("baseline/seed_5", 5), ("baseline/seed_6", 6), ("a/seed_5", 5), ("a/seed_6", 6),
    ]  # fmt: skip
    assert len({job.folder for job in jobs}) == 4


def test_a_checkpoints_validation_error_is_the_best_of_its_log(run):
    retrain(run, "a", 1)
    retrain(run, "a", 2, errors=(0.2, 0.6))
    (finalist,), failed = retrained_finalists(run, ["a"], 2)
    assert finalist.valid_errors == [0.3, 0.2]
    assert finalist.best_checkpoint == run.finalist("a", 2).checkpoint
    assert failed == {}


@pytest.mark.parametrize("outcome", ["failed", "diverged"])
def test_a_finalist_with_a_lost_seed_is_not_compared_and_said(outcome, run):
    retrain(run, "a", 1)
    retrain(run, "a", 2, outcome, "out of memory")
    retrain(run, "b", 1)
    retrain(run, "b", 2)
    retrained, failed = retrained_finalists(run, ["a", "b"], 2)
    assert [finalist.id for finalist in retrained] == ["b"]
    assert "seed_2" in failed["a"]
    assert outcome in failed["a"]
    assert "out of memory" in failed["a"]


def test_a_finalist_of_two_stages_is_compared_once(run):
    retrain(run, "a", 1)
    retrained, _ = retrained_finalists(run, ["a", "a"], 1)
    assert [finalist.id for finalist in retrained] == ["a"]


def test_a_finalist_with_too_few_seeds_is_not_compared(run):
    retrain(run, "a", 1)
    assert retrained_finalists(run, ["a"], 2) == ([], {"a": "only 1 of 2 seeds were trained"})


def test_a_finalist_without_any_retraining_is_named(run):
    with pytest.raises(DataError, match="no retraining of 'lost' in finalists/"):
        retrained_finalists(run, ["lost"], 2)
