"""Time that a study adds to each of its trainings: scheduling, reports, records; what Ray and our own queue cost.

    python experiments/benchmarks/overhead.py --data FOLDER [--workers 2] [--trials 20]

Trials of a single gradient update run one after another in reused processes, as in a search. What such a trial takes by
itself, in this process without Ray, is subtracted from the time between the ends of two trials. Any small data set will
do, e.g. `cconv data generate taylor_green_2d --size small --out FOLDER`.
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import torch

from cconv.study.declared.study_file import StudyConfig
from cconv.study.records.trials import TrialFolder
from cconv.study.running.problem import (
    Problem,
    load_problem,
    open_study_data,
    provenance,
    study_task,
    with_data_path,
)
from cconv.study.running.ray_pool import ray_pool
from cconv.study.running.trial import Trial, run_trial
from cconv.study.running.trial_queue import Job, NothingStops, TrialQueue
from cconv.study.studies import load_study

SMOKE = Path(__file__).parents[1] / "smoke.toml"
ONE_UPDATE = ("training.updates=1", "training.evaluate_every=1", "search.grace_updates=1")


class Ends:
    """Observer that notes when trials end."""

    def __init__(self):
        self.times: list[float] = []

    def on_stage(self, stage, num_trials, training): ...

    def on_trial_start(self, trial, parameters): ...

    def on_trial_result(self, trial, entry): ...

    def on_trial_end(self, trial, outcome, reason):
        """Note the time."""
        self.times.append(time.perf_counter())


def seconds_alone(study: StudyConfig, problem: Problem, folder: Path, repeats: int = 12) -> float:
    """Median time of a trial in this process."""
    taken = []
    for job in jobs(folder, repeats):
        start = time.perf_counter()
        seeds = {"init_seed": job.init_seed, "data_seed": study.seeds.data}
        folder_of_job = TrialFolder(job.folder)
        trial = Trial(stage="alone", parameters={}, provenance=provenance(study), **seeds)
        list(run_trial(problem, trial, study.configuration, folder_of_job))
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)


def seconds_between_ends(study: StudyConfig, problem: Problem, folder: Path, trials: int) -> float:
    """Mean time from the end of a trial to that of the next, without the start of the processes."""
    ends = Ends()
    with ray_pool(study, problem, folder / "ray") as pool:
        queue = TrialQueue(jobs(folder / "trials", trials), study.training, NothingStops(), [ends])
        pool.run(queue, "overhead", study.training)
    return (ends.times[-1] - ends.times[0]) / (trials - 1)


def jobs(folder: Path, count: int) -> list[Job]:
    """Trials of the study's own network."""
    names = [f"trial_{number}" for number in range(count)]
    return [Job(folder=folder / name, name=name, parameters={}, init_seed=seed) for seed, name in enumerate(names)]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="folder of a data set")
    parser.add_argument("--workers", type=int, default=1, help="trainings at once")
    parser.add_argument("--trials", type=int, default=20, help="trials of the search, two at least")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    study = with_data_path(load_study(SMOKE, [*ONE_UPDATE, f"search.concurrency={arguments.workers}"]), arguments.data)
    dataset = open_study_data(study.data, study.seeds.data)
    problem = load_problem(study, dataset, study_task(study, dataset.scene))
    with tempfile.TemporaryDirectory(prefix="cconv_") as folder:
        alone = seconds_alone(study, problem, Path(folder) / "alone")
        between = seconds_between_ends(study, problem, Path(folder), arguments.trials)
    busy = between * arguments.workers
    print(f"a trial alone: {alone:.3f} s; {arguments.workers} at once: one ends every {between:.3f} s")
    print(f"overhead: {between - alone / arguments.workers:.3f} s a trial, {busy - alone:.3f} s of a process's time")


if __name__ == "__main__":
    main()
