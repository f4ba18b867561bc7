"""What the stages of a search train: random and adaptive trials with ASHA, and the same budget spent otherwise.

Every trial is a function of the study's seeds and of records, never of a sampler's memory. So a search that was killed
goes on as it would have, and one that finished takes more trials.
"""

import math
from collections.abc import Iterator, Mapping, Sequence

from cconv.study.declared.configuration import TrainingConfig
from cconv.study.evidence.strategies import best_so_far, spent_updates
from cconv.study.records.rungs import RungFile
from cconv.study.records.trials import TrialFolder, TrialRecord
from cconv.study.running.sampling import random_parameters, suggest_parameters
from cconv.study.running.trial_queue import Job, NothingStops, StopsByRungs, TrialQueue, job_in
from cconv.study.stages.session import Session


def random_search(session: Session, stage: str) -> dict:
    """Random search with ASHA."""
    settings = session.study.stages[stage]
    space, seed = session.space_of(stage), session.seed_of(stage)

    def jobs() -> Iterator[Job]:
        for number in range(settings.trials):
            yield trial_job(session, stage, number, random_parameters(space, seed, number, session.affordable))

    _search(session, stage, jobs(), settings.trials)
    return {}


def adaptive_search(session: Session, stage: str) -> dict:
    """Tree-structured Parzen estimator with ASHA for error and cost, which learns from the stages that it reads."""
    settings, study = session.study.stages[stage], session.study
    space, earlier = session.space_of(stage), session.read(stage)

    def jobs() -> Iterator[Job]:
        for number in range(settings.trials):
            recorded = session.run.trial(trial_name(stage, number)).parameters
            yield trial_job(session, stage, number, recorded or propose(number))

    def propose(number: int) -> dict:
        known = [*earlier, *session.run.trials_of(stage)]
        costs = {record.id: record.config["flops_per_particle"] for record in known}
        return suggest_parameters(
            space,
            [record for record in known if costs[record.id] is not None],  # the others failed before they began
            number=number,
            seed=session.seed_of(stage),
            full_updates=study.training.updates,
            affordable=session.affordable,
            costs=costs,
            useless_error=session.useless_error,
        )

    _search(session, stage, jobs(), settings.trials)
    return {}


def spend_otherwise(session: Session, stage: str) -> dict:
    """The budget of each search that the stage reads, spent as "train each a little, keep the best".

    Every trial of a search was measured at the first rung. What the search spent beyond that pays for the full training
    of the trials that are best there; those of them that ASHA stopped are trained to the end.
    """
    names = [name for name in session.study.stages if name in _searches_read(session, stage)]
    chosen = {name: _best_at_first_rung(session, name) for name in names}
    to_train = [record for name in names for record in chosen[name]["kept"] if record.outcome == "stopped"]
    jobs = [trial_job(session, stage, number, record.parameters) for number, record in enumerate(to_train)]
    train_all(session, stage, jobs, session.study.training)
    ends = {job.name: record.id for job, record in zip(jobs, to_train, strict=True)}
    strategies = {}
    for name in names:
        records = session.run.trials_of(name)
        strategies[f"{name}, ASHA"] = _by_asha(records)
        strategies[f"{name}, a little each"] = _by_little_each(session, stage, chosen[name], ends)
    shares = {name: spent_updates(session.run.trials_of(name), session.study.training.updates) for name in names}
    return {"references": {"strategies": strategies, "asha_share": shares}}


def train_all(session: Session, stage: str, jobs: Sequence[Job], training: TrainingConfig) -> None:
    """Train every job to the full budget of `training`."""
    session.observer.on_stage(stage, len(jobs), training.updates)
    queue = TrialQueue(jobs, training.updates, NothingStops(), session.observers(mirrored=False))
    if any(not TrialFolder(job.folder).ended for job in jobs):
        session.start_pool().run(queue, stage, training)


def trial_name(stage: str, number: int) -> str:
    """Id of a stage's trial."""
    return f"{stage}_{number:04d}"


def trial_job(session: Session, stage: str, number: int, parameters: Mapping, init_seed: int | None = None) -> Job:
    """A trial of a stage, with the seed that all trials of searches share unless another is given."""
    name = trial_name(stage, number)
    seed = session.study.seeds.init if init_seed is None else init_seed
    return job_in(session.run.trial(name), name, parameters, seed)


def _search(session: Session, stage: str, jobs: Iterator[Job], num_trials: int) -> None:
    study, run = session.study, session.run
    file = RungFile(run.path / "rungs.json")
    table = file.table(stage, study.rungs, study.search.reduction_factor)
    judge = StopsByRungs(file, stage, table, study.search.give_up_above)
    session.observer.on_stage(stage, num_trials, study.training.updates)
    queue = TrialQueue(jobs, study.training.updates, judge, session.observers(mirrored=True))
    session.start_pool().run(queue, stage, study.training)


def _searches_read(session: Session, stage: str) -> set[str]:
    return {record.stage for record in session.read(stage)}


def _best_at_first_rung(session: Session, search: str) -> dict:
    """Number of trials of a search, and those that are best at its first rung, as many as its budget pays for."""
    full, first = session.study.training.updates, session.study.rungs[0]
    records = session.run.trials_of(search)
    spent = sum(record.log[-1]["updates"] for record in records if record.log)
    at_first = {record.id: error for record in records if (error := record.error_at(first)) is not None}
    affordable = max(1, int((spent - len(records) * first) // max(full - first, 1)))
    best = sorted(at_first, key=at_first.__getitem__)[:affordable]
    return {"trials": len(records), "kept": [record for record in records if record.id in best]}


def _by_asha(records: Sequence[TrialRecord]) -> dict:
    """What the search itself spent and found."""
    curve = best_so_far(records)
    return {
        "updates": sum(record.log[-1]["updates"] for record in records if record.log),
        "best_valid": curve[-1][1] if curve else None,
        "curve": [list(point) for point in curve],
    }


def _by_little_each(session: Session, stage: str, chosen: dict, ends: Mapping[str, str]) -> dict:
    """What the kept trials reached: each trial a little, then those that were best, one after another."""
    first, full = session.study.rungs[0], session.study.training.updates
    trained = {ends[record.id]: record for record in session.run.trials_of(stage) if record.id in ends}
    finals = [trained.get(record.id, record) for record in chosen["kept"]]
    spent, best, curve = chosen["trials"] * first, math.inf, []
    for record in finals:
        spent += full - first
        if record.outcome == "completed" and record.last:
            best = min(best, record.last["valid_normalized_mse"])
            curve.append([spent, best])
    return {"updates": spent, "best_valid": best if curve else None, "curve": curve}
