"""The closed-form stage: least squares for every single linear layer that a search space holds.

Such a layer needs no training and no seed: its coefficients are the solution of linear equations. All candidates are
fitted to a few frames and compared on a few others; the most accurate of those that none beats in error and cost are
fitted to the whole training split and become finalists.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product

import numpy as np

from cconv.data.splits import evenly_spaced
from cconv.data.targets import Sample
from cconv.errors import ConfigError
from cconv.evaluation.cost import flops_per_particle
from cconv.evaluation.metrics import frame_errors, normalized_mse
from cconv.study.config import StudyConfig
from cconv.study.problem import Problem, provenance
from cconv.study.records import RunFolder, TrialFolder, TrialRecord
from cconv.study.selection import choose_finalists
from cconv.study.space import Choice, Parameter, SearchSpace, Value, configure
from cconv.training.checkpoint import save_model
from cconv.training.closed_form import solve_closed_form
from cconv.training.field_model import NetworkConfig

STAGE = "closed_form"
_OF_ANY = ("basis", "relative_cutoff", "window", "normalize", "message")
_OF_BASIS = {"grid": ("kernel_size", "mapping", "interpolation", "align_corners"), "radial": ("radial_terms",)}

Progress = Callable[[Iterable, str], Iterable]


def single_layers(space: SearchSpace, network: NetworkConfig, values_per_range: int) -> list[dict[str, Value]]:
    """Distinct settings of a single linear layer in a space; ranges are sampled evenly, both ends included.

    Args:
        space: The search space.
        network: Settings that the space does not vary.
        values_per_range: Values taken of a range of numbers.
    """
    known = (*_OF_ANY, *_OF_BASIS["grid"], *_OF_BASIS["radial"])
    axes = {name: _values(domain, values_per_range) for name, domain in space.parameters.items() if name in known}
    layers: dict[str, dict] = {}
    for values in product(*axes.values()):
        drawn = {"basis": network.basis, **dict(zip(axes, values, strict=True))}
        applies = (*_OF_ANY, *_OF_BASIS[drawn["basis"]])
        layer = {"layers": 1, **{name: value for name, value in drawn.items() if name in applies}}
        layers.setdefault(repr(sorted(layer.items())), layer)
    return list(layers.values())


def screen_closed_forms(
    study: StudyConfig, space: SearchSpace, problem: Problem, run: RunFolder, progress: Progress
) -> None:
    """Fit every candidate, or as many as the study allows, to a few frames and record its error on a few others."""
    settings = study.closed_form
    layers = single_layers(space, study.network, settings.values_per_range)
    layers = _draw(layers, settings.max_candidates, study.seeds.search)
    train, valid = (
        [samples[place] for place in evenly_spaced(len(samples), settings.screening_frames)]
        for samples in (problem.train_samples, problem.valid_samples)
    )
    for number, parameters in enumerate(progress(layers, "closed forms")):
        folder = run.trial(f"{STAGE}_{number:04d}")
        _fit_and_record(parameters, study, problem, (train, valid), folder, STAGE, study.seeds.init)


def fit_closed_form_finalists(study: StudyConfig, problem: Problem, run: RunFolder, progress: Progress) -> None:
    """Fit the best candidates to the whole training split; each has one retraining, as nothing in it is drawn."""
    records = [record for record in run.trials() if record.stage == STAGE]
    cost = {record.id: flops_of(record, study, problem) for record in records if record.outcome == "completed"}
    chosen = choose_finalists(records, cost, study.closed_form.count)
    for record in progress(chosen, "closed-form finalists"):
        seed = study.seeds.init + 1
        samples = problem.train_samples, problem.valid_samples
        folder = run.finalist(record.id, seed)
        _fit_and_record(record.parameters, study, problem, samples, folder, "finalists", seed)


def flops_of(record: TrialRecord, study: StudyConfig, problem: Problem) -> float:
    """Multiplications and additions of one particle's prediction by a trial's network."""
    network, _ = configure(record.parameters, study.network, study.training)
    return flops_per_particle(problem.build_model(network, 0), problem.valid_samples[0].inputs)


def _fit_and_record(
    parameters: Mapping[str, Value],
    study: StudyConfig,
    problem: Problem,
    samples: tuple[Sequence[Sample], Sequence[Sample]],
    folder: TrialFolder,
    stage: str,
    init_seed: int,
) -> None:
    """Fit a layer to the first of `samples` and record its error on the second. No weight depends on the seed."""
    network, training = configure(parameters, study.network, study.training)
    model = problem.build_model(network, 0)
    config = {
        "stage": stage,
        "parameters": dict(parameters),
        "network": network.model_dump(),
        "training": training.model_dump() | {"updates": 0},
        "init_seed": init_seed,
        "data_seed": study.seeds.data,
        "num_parameters": model.num_parameters,
        "closed_form": True,
    }
    folder.start(config)
    train, valid = samples
    start = time.perf_counter()
    try:
        solve_closed_form(model, train, study.closed_form.ridge)
    except ConfigError as error:
        folder.finish("failed", str(error))
        return
    entry = {
        "updates": 0,
        "train_loss": None,
        "valid_normalized_mse": normalized_mse(frame_errors(model, valid)),
        "learning_rate": None,
        "seconds": time.perf_counter() - start,
        "diverged": False,
    }
    folder.append(entry)
    card = config | provenance(study) | {"valid_normalized_mse": entry["valid_normalized_mse"], "updates": 0}
    save_model(model.eval(), folder.checkpoint, card)
    folder.finish("completed")


def _draw(layers: list[dict[str, Value]], count: int, seed: int) -> list[dict[str, Value]]:
    """At most `count` layers, as many of each basis as there are, drawn at random where there are more."""
    drawn = [layers[index] for index in np.random.default_rng(seed).permutation(len(layers))]
    rank = Counter()
    ranked = []
    for layer in drawn:
        rank[layer["basis"]] += 1
        ranked.append((rank[layer["basis"]], layer))
    chosen = [layer for _, layer in sorted(ranked, key=lambda item: item[0])[:count]]
    return [layer for layer in layers if layer in chosen]


def _values(domain: Parameter, count: int) -> list[Value]:
    if isinstance(domain, Choice):
        return list(domain.values)
    low, high = domain.range
    spaced = np.geomspace(low, high, count) if domain.scale == "log" else np.linspace(low, high, count)
    return sorted({round(value) if domain.type == "int" else float(value) for value in spaced})
