"""A training that was left goes on as if it had not been."""

import itertools
from dataclasses import replace

import pytest
import torch
from safetensors.torch import save_file
from systems import configured, problem

from cconv.errors import DataError
from cconv.training.examples import StoredExamples
from cconv.training.loop import Optimization, train
from cconv.training.progress import begin, load_progress, save_progress

NETWORKS = [configured(layers=2, kernel_size=3), configured(layers=2, architecture="radial_net", radial_terms=4)]
ASKED = Optimization(updates=12, evaluate_every=3, learning_rate=0.01, batch_size=2, average=0.8)


@pytest.fixture
def one_thread():
    """As trials train: sums over several threads round differently from run to run."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("network", NETWORKS, ids=lambda each: each.network.architecture)
@pytest.mark.parametrize("left_at", [1, 6, 11])
def test_losses_and_weights_are_the_same_to_the_last_bit(generator, tmp_path, network, left_at):
    given = problem(generator)
    whole = given.build_model(network, 0)
    *_, judged = states = list(train(whole, StoredExamples(given.train_samples), given.valid_error, ASKED))
    losses = [(state.train_loss, state.valid_error) for state in states]
    first = given.build_model(network, 0)
    progress = begin(first)
    states = train(first, StoredExamples(given.train_samples), given.valid_error, ASKED, progress=progress)
    for state in states:
        if state.updates == left_at:
            break
    save_progress(tmp_path / "progress", first, progress)
    second = given.build_model(network, 1)
    restored = load_progress(tmp_path / "progress", second)
    rest = list(train(second, StoredExamples(given.train_samples), given.valid_error, ASKED, progress=restored))
    assert [(state.train_loss, state.valid_error) for state in rest] == losses[left_at:]
    assert same(second, whole)
    assert same(rest[-1].model, judged.model)
    assert not same(judged.model, whole)


def same(ours, theirs):
    return all(torch.equal(*pair) for pair in zip(ours.parameters(), theirs.parameters(), strict=True))


def test_a_restored_training_counts_its_seconds_from_where_it_was(generator, monkeypatch):
    """A clock of our own: every look at it takes a second."""
    monkeypatch.setattr("cconv.training.loop.time.perf_counter", itertools.count().__next__)
    given = problem(generator)
    model = given.build_model(NETWORKS[0], 0)
    progress = begin(model)
    progress.seconds = 100
    states = train(model, StoredExamples(given.train_samples), given.valid_error, ASKED, progress=progress)
    assert [next(states).seconds for _ in range(3)] == [101, 102, 103]


def clocked(monkeypatch):
    """Every look at the clock of the process takes a second, so that each update does."""
    monkeypatch.setattr("cconv.training.loop.time.process_time", itertools.count().__next__)


def test_a_restored_training_spends_what_is_left_of_its_time(generator, monkeypatch, tmp_path):
    clocked(monkeypatch)
    given, asked = problem(generator), replace(ASKED, updates=1000, cpu_seconds=7.0)
    model = given.build_model(NETWORKS[0], 0)
    progress = begin(model)
    states = train(model, StoredExamples(given.train_samples), given.valid_error, asked, progress=progress)
    rates = [next(states).learning_rate for _ in range(4)]
    save_progress(tmp_path / "progress", model, progress)
    restored = load_progress(tmp_path / "progress", model)
    rest = list(train(model, StoredExamples(given.train_samples), given.valid_error, asked, progress=restored))
    assert [(state.updates, state.cpu_seconds) for state in rest] == [(5, 5), (6, 6), (7, 7)]
    rates += [state.learning_rate for state in rest]
    assert rates == [asked.rate_at(spent / 7) for spent in range(7)]
    assert list(train(model, StoredExamples(given.train_samples), given.valid_error, asked, progress=restored)) == []


def test_a_damaged_file_is_named(generator, tmp_path):
    (tmp_path / "progress").write_bytes(b"nothing")
    with pytest.raises(DataError, match="delete it to begin again"):
        load_progress(tmp_path / "progress", problem(generator).build_model(NETWORKS[0], 0))


def test_the_progress_of_another_network_is_refused(generator, tmp_path):
    given = problem(generator)
    model = given.build_model(NETWORKS[0], 0)
    save_progress(tmp_path / "progress", model, begin(model))
    with pytest.raises(DataError, match="no progress of this training"):
        load_progress(tmp_path / "progress", given.build_model(NETWORKS[1], 0))
    assert [path.name for path in tmp_path.iterdir()] == ["progress"]


@pytest.mark.parametrize("counts", ['{"updates": true, "seconds": 1.0}', '{"updates": 3}', "[" * 10_000, "[1]", None])
def test_counts_that_are_none_are_refused(counts, generator, tmp_path):
    model = problem(generator).build_model(NETWORKS[0], 0)
    tensors = {f"weights.{name}": value for name, value in model.state_dict().items()}
    save_file(tensors, tmp_path / "progress", counts and {"counts": counts})
    with pytest.raises(DataError, match="no progress of this training") as refused:
        load_progress(tmp_path / "progress", model)
    assert "\n" not in str(refused.value)


def test_moments_of_another_shape_are_refused(generator, tmp_path):
    model = problem(generator).build_model(NETWORKS[0], 0)
    name, _ = next(iter(model.named_parameters()))
    tensors = {f"weights.{name}": value for name, value in model.state_dict().items()}
    tensors |= {f"adam.{key}.{name}": torch.zeros(1) for key in ("step", "exp_avg", "exp_avg_sq")}
    save_file(tensors, tmp_path / "progress", {"counts": '{"updates": 3, "seconds": 1.0}'})
    with pytest.raises(DataError, match="moments of .* have another shape"):
        load_progress(tmp_path / "progress", model)
