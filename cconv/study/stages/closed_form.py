"""The closed-form stage fits single linear layers of the search space by least squares.

Such a layer needs no training and no seed: its coefficients are the solution of linear equations. Candidates are fitted
to a few training frames and compared on a few validation frames. The best on the Pareto front of error and cost are
later fitted to the whole training split and become finalists.
"""

import math
import random
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import accumulate, chain
from typing import Any, Literal

import numpy as np
from pydantic import Field

from cconv.data.splits import evenly_spaced
from cconv.devices import home_of
from cconv.errors import ConfigError
from cconv.models.checkpoint import save_model
from cconv.networks import ARCHITECTURES
from cconv.networks.network import NetworkSettings
from cconv.study.declared.configuration import (
    ARCHITECTURE,
    EXTERNAL_FORCE,
    HISTORY,
    NETWORK,
    OPTIONAL_FEATURES,
    TRAINING,
    WITH_PREDICTOR,
    configure,
    feature_path,
)
from cconv.study.declared.domains import Choice, Parameter, SearchSpace
from cconv.study.declared.stage import Ridge, Stage, reads_of
from cconv.study.evidence.recommendation import choose_finalists
from cconv.study.records.found import Found
from cconv.study.records.trials import TrialFolder, TrialRecord, identity
from cconv.study.running.problem import Problem, provenance
from cconv.study.running.trial import Trial, describe
from cconv.study.stages.jobs import trial_name
from cconv.study.stages.session import Session
from cconv.tasks.samples import Sample
from cconv.validation import Value, Whole

MOST_LAYERS = 50_000  # listed at most; a space may hold any number of single layers


class ClosedFormStage(Stage):
    """Fit the single linear layers of the space by least squares.

    At most `max_candidates` layers are fitted to `screening_frames` frames; a numeric range contributes
    `values_per_range` values. The stage of the finalists fits the `count` best to all frames.
    """

    kind: Literal["closed_form"] = "closed_form"
    fits_squares = True
    count: Whole = Field(3, ge=1, le=1000)
    max_candidates: Whole = Field(200, ge=1, le=10_000)
    screening_frames: Whole = Field(4, ge=1, le=10_000)
    values_per_range: Whole = Field(3, ge=2, le=100)
    ridge: Ridge = 1e-10

    def run(self, session: Session, name: str) -> Found:
        """Fit candidates to a few training frames and record their errors on a few validation frames.

        Half of the candidates are drawn from all single layers of the space, as many of each architecture. The others
        are proposed from the records of the candidates before them.
        """
        layers = single_layers(session.space, session.study.network, self.values_per_range)
        screened = self._screening(session.problem)
        untried = {identity(layer): layer for layer in layers}
        batch = _draw(layers, (self.max_candidates + 1) // 2, session.seed_of(name))
        number = 0
        while batch and number < self.max_candidates:
            for layer in batch:
                del untried[identity(layer)]
            affordable = [layer for layer in batch if session.affordable(layer)][: self.max_candidates - number]
            for layer in session.progress(affordable, "closed forms"):
                folder = session.run.trial(trial_name(name, number))
                _fit_and_record(session, layer, screened, folder, name, session.study.seeds.init, self.ridge)
                number += 1
            batch = propose(self.winners(session, name), list(untried.values()))
        return Found()

    def winners(self, session: Session, name: str) -> list[TrialRecord]:
        """Return the candidates so far that would become finalists, most accurate first."""
        records = session.run.trials_of(name)
        cost = {record.id: record.config["flops_per_particle"] for record in records}
        return choose_finalists(records, cost, self.count, session.study.selection.accurate_enough)

    def _screening(self, problem: Problem) -> tuple[list[int], list[Sample]]:
        """Choose places of training samples, and validation samples, evenly spaced."""
        train, valid = (
            evenly_spaced(len(split), self.screening_frames) for split in (problem.train_samples, problem.valid_samples)
        )
        return train, [problem.valid_samples[place] for place in valid]


def single_layers(space: SearchSpace, network: NetworkSettings, values_per_range: int) -> list[dict[str, Value]]:
    """List the distinct settings of a single linear layer in a space; ranges are sampled evenly, both ends included.

    Conditions hold as in the search. A space of deeper networks also has single layers, to compare the deeper ones
    with. If there are more than `MOST_LAYERS`, that many are drawn at random.

    Args:
        space: The search space.
        network: Settings that the space does not vary.
        values_per_range: Values taken of a range of numbers.
    """
    linear = {name: settings for name, settings in ARCHITECTURES.items() if settings.linear_with}
    always = chain.from_iterable(_paths(settings.linear_with).items() for settings in linear.values())
    single = {path: [value] for path, value in always}
    matters = {ARCHITECTURE, *single, *chain.from_iterable(map(_applies, linear.values()))}
    drawn: list[dict] = [{}]
    for name in [name for name in space.parents_first if name in matters]:
        values = single.get(name) or _values(space.parameters[name], values_per_range)
        choices = [{name: value} for value in values]
        drawn = _extended(drawn, [choices if space.is_active(name, layer) else [{}] for layer in drawn])
    layers: dict[str, dict] = {}
    for assignment in drawn:
        architecture = assignment.get(ARCHITECTURE, network.architecture)
        if settings := linear.get(architecture):
            of_it = {path: value for path, value in assignment.items() if path in _applies(settings)}
            layer = {**_paths(settings.linear_with), ARCHITECTURE: architecture, **of_it}
            layers.setdefault(identity(layer), layer)
    return list(layers.values())


def _paths(settings: Mapping[str, Value]) -> dict[str, Value]:
    """Map the paths of network settings to their values."""
    return {f"{NETWORK}.{name}": value for name, value in settings.items()}


def _applies(settings: type[NetworkSettings]) -> set[str]:
    """List the paths of the hyperparameters that a single layer of an architecture has."""
    of_network = (f"{NETWORK}.{name}" for name in settings.linear_settings)
    return {
        *of_network,
        HISTORY,
        WITH_PREDICTOR,
        EXTERNAL_FORCE,
        *map(feature_path, OPTIONAL_FEATURES),
        f"{TRAINING}.noise",
        f"{TRAINING}.loss",
    }


def _extended(layers: Sequence[dict], choices: Sequence[Sequence[dict]]) -> list[dict]:
    """Combine each layer with each of its choices, in order; draw `MOST_LAYERS` at random if there are more."""
    ends = list(accumulate(map(len, choices)))
    places: Sequence[int] = range(ends[-1])
    if len(places) > MOST_LAYERS:
        places = sorted(random.Random(0).sample(places, MOST_LAYERS))
    owners = ((place, bisect_right(ends, place)) for place in places)
    return [layers[owner] | choices[owner][place - ends[owner]] for place, owner in owners]


def propose(winners: Sequence[TrialRecord], untried: Sequence[dict[str, Value]]) -> list[dict[str, Value]]:
    """Propose the layers to fit next, near those that would become finalists now; return none if all were tried.

    The first proposals are the winners with every other number of basis functions, the most important setting. The
    next ones differ from a winner in one setting. The most accurate winner comes first.
    """
    with_other_terms = [layer for record in winners for layer in untried if _same_but_basis_size(record, layer)]
    if with_other_terms:
        return list({identity(layer): layer for layer in with_other_terms}.values())
    return next(filter(None, (_neighbors(record.parameters, untried) for record in winners)), [])


def _same_but_basis_size(record: TrialRecord, layer: Mapping[str, Value]) -> bool:
    """Tell whether a layer differs from the layer of a record only in its number of basis functions."""
    path = f"{NETWORK}.{ARCHITECTURES[str(layer[ARCHITECTURE])].basis_size}"
    return path in layer and record.parameters | {path: layer[path]} == layer


def _neighbors(layer: Mapping[str, Value], others: Iterable[dict[str, Value]]) -> list[dict[str, Value]]:
    """List the layers that differ in one setting; settings that only one of two architectures has are ignored."""
    return [other for other in others if sum(layer[name] != other[name] for name in layer if name in other) == 1]


def fit_closed_form_finalists(session: Session, stage: str, seed: int) -> dict[str, dict[str, Value]]:
    """Fit the best candidates to the whole training split, without the features that they do not need.

    Each is fitted once, because a closed form has no random initial weights.

    Args:
        session: The study.
        stage: Name of the stage of the finalists, which reads the stages of closed forms.
        seed: Seed that names the folder.

    Returns:
        Hyperparameters of the finalists, by id; the id of a finalist that lost a feature says so.
    """
    study = session.study
    chosen: dict[str, tuple[str, dict[str, Value]]] = {}
    for name in reads_of(study.stages, stage):
        settings = study.stages[name]
        if isinstance(settings, ClosedFormStage):
            for record in session.progress(settings.winners(session, name), "closed-form finalists"):
                finalist, parameters = without_unneeded_features(session, record, seed, settings.ridge)
                chosen.setdefault(identity(parameters), (finalist, parameters))
    return dict(chosen.values())


def without_unneeded_features(
    session: Session, candidate: TrialRecord, seed: int, ridge: float
) -> tuple[str, dict[str, Value]]:
    """Drop each optional feature (walls, density) that a candidate does not need.

    A feature is dropped if the space allows it and the validation error grows by no more than the margin of
    non-inferiority.

    Returns:
        The id of the model that remains, which names the dropped features, and its hyperparameters.
    """

    def fitted(finalist: str, parameters: Mapping[str, Value]) -> float:
        folder = session.run.finalist(finalist, seed)
        fit_whole(session, parameters, folder, "finalists", seed, ridge)
        return folder.read().best

    finalist, parameters = candidate.id, candidate.parameters
    error = fitted(finalist, parameters)
    for feature in OPTIONAL_FEATURES:
        path = feature_path(feature)
        if parameters.get(path) and session.space.parameters[path].holds(False):
            leaner, fewer = f"{finalist}_no_{feature}", parameters | {path: False}
            error_without = fitted(leaner, fewer)
            if error_without <= error * (1 + session.study.selection.margin):
                finalist, parameters, error = leaner, fewer, error_without
    return finalist, parameters


def fit_whole(
    session: Session, parameters: Mapping[str, Value], folder: TrialFolder, stage: str, seed: int, ridge: float
) -> None:
    """Fit a layer to the whole training split and record its error on the whole validation split."""
    samples = range(len(session.problem.train_samples)), session.problem.valid_samples
    _fit_and_record(session, parameters, samples, folder, stage, seed, ridge)


def _fit_and_record(
    session: Session,
    parameters: Mapping[str, Value],
    samples: tuple[Sequence[int], Sequence[Sample]],
    folder: TrialFolder,
    stage: str,
    init_seed: int,
    ridge: float,
) -> None:
    """Fit a layer to the training samples at some places, and record its error on others.

    No weight depends on the seed.
    """
    folder.check_begun_with(parameters)
    if folder.ended:
        return
    study, problem = session.study, session.problem
    configuration = configure(parameters, study.configuration)
    model = problem.build_model(configuration, 0).to(home_of(session.device))
    untrained = configuration.training.model_copy(update={"updates": 0})
    seeds: dict[str, Any] = {"init_seed": init_seed, "data_seed": study.seeds.data}
    trial = Trial(stage=stage, parameters=parameters, provenance=provenance(study), **seeds)
    config = describe(problem, trial, model, untrained) | {"closed_form": True, "ridge": ridge}
    folder.start(config)
    places, valid = samples
    start, began = time.perf_counter(), time.process_time()
    try:
        problem.solve_closed_form(model, configuration.training, places, ridge, study.seeds.data)
    except ConfigError as error:
        folder.finish("failed", str(error))
        return
    fitted = time.process_time() - began
    valid_error = problem.objective.error(model, valid)
    if not math.isfinite(valid_error):
        folder.finish("failed", "its predictions are not finite")
        return
    entry = {
        "updates": 0,
        "train_loss": None,
        "valid_error": valid_error,
        "learning_rate": None,
        "seconds": time.perf_counter() - start,
        "cpu_seconds": fitted,
        "diverged": False,
    }
    folder.append(entry)
    card = config | dict(trial.provenance) | {"valid_error": valid_error, "updates": 0}
    save_model(model.eval(), folder.checkpoint, card)
    folder.finish("completed")


def _draw(layers: list[dict[str, Value]], count: int, seed: int) -> list[dict[str, Value]]:
    """Draw at most `count` layers at random, equally many of each architecture as far as there are enough."""
    drawn = [layers[index] for index in np.random.default_rng(seed).permutation(len(layers))]
    rank: Counter[Value] = Counter()
    ranked = []
    for layer in drawn:
        rank[layer[ARCHITECTURE]] += 1
        ranked.append((rank[layer[ARCHITECTURE]], layer))
    chosen = [layer for _, layer in sorted(ranked, key=lambda item: item[0])[:count]]
    return [layer for layer in layers if layer in chosen]


def _values(domain: Parameter, count: int) -> list[Value]:
    if isinstance(domain, Choice):
        return list(domain.values)
    low, high = domain.range
    spaced = np.geomspace(low, high, count) if domain.scale == "log" else np.linspace(low, high, count)
    return sorted({round(value) if domain.type == "int" else float(value) for value in spaced})
