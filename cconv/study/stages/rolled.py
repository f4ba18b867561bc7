"""Rollouts of the finalists over whole test trajectories, recorded by the select stage for the report."""

import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from cconv.data.splits import evenly_spaced
from cconv.data.stored_frames import StoredFrames
from cconv.data.window import window_at
from cconv.evaluation.checks.rolled import SeriesCheck
from cconv.evaluation.recorded_rollout import (
    MOST_SINKHORN,
    RecordedRollout,
    asked_rollout,
    record_rollout,
    write_rollout,
)
from cconv.evaluation.rollout_comparison import FlowMetrics
from cconv.models.checkpoint import load_model
from cconv.models.model import Model
from cconv.rollout.rollout import Diverged
from cconv.study.records.rollouts import (
    FOLDER,
    FRAMES,
    FinalistRollouts,
    FlowSeries,
    RolledTrajectory,
    write_rollouts,
)
from cconv.study.stages.checked import stability_checks
from cconv.study.stages.finalists import Retrained
from cconv.study.stages.session import Session
from cconv.tasks.task import StepTask

MOST_TRAJECTORIES = 3
LOOKS = 40  # frames of a rollout that all measures look at, about


def record_rollouts(session: Session, finalists: Sequence[Retrained], recommended: str) -> tuple[str, ...]:
    """Roll every training of the finalists out over test trajectories, and record the measures.

    The frames of the first rollout of the recommended model are kept, for an animation.

    Returns:
        Ids of the finalists whose rollouts are in ``rollouts/``; none for a field.
    """
    task = session.problem.task
    if not isinstance(task, StepTask):
        return ()
    checks = _series_checks(session, finalists)
    for finalist in session.progress(finalists, "rollouts"):
        animated = session.run.path / FOLDER / FRAMES if finalist.id == recommended else None
        write_rollouts(session.run, finalist.id, _of_finalist(session, task, finalist, checks, animated))
    return tuple(finalist.id for finalist in finalists)


def _series_checks(session: Session, finalists: Sequence[Retrained]) -> list[SeriesCheck]:
    """Make the checks that look at every frame; their limits come from validation trajectories, as in the stage."""
    reach = max(load_model(finalist.best_checkpoint).cutoff for finalist in finalists)
    _, checks = stability_checks(session, reach)
    return [check for check in checks if isinstance(check, SeriesCheck)]


def _of_finalist(
    session: Session, task: StepTask, finalist: Retrained, checks: Sequence[SeriesCheck], animated: Path | None
) -> FinalistRollouts:
    """Roll out every training of a finalist; the first rollout of its best one is written to `animated`."""
    dataset, rolled, lost = session.dataset, [], []
    for record, checkpoint in zip(finalist.records, finalist.checkpoints, strict=True):
        model = session.load_model(checkpoint)
        for number in evenly_spaced(len(dataset.splits["test"]), MOST_TRAJECTORIES):
            stored = StoredFrames(dataset, "test", number)
            is_first = number == 0 and checkpoint == finalist.best_checkpoint
            folder, transported = (animated, MOST_SINKHORN) if is_first else (None, 0)
            try:
                found = _rolled(session, model, task, stored, checks, transported, folder)
            except Diverged as error:
                lost.append(f"{record.id}, trajectory {stored.name}: {error}")
            else:
                rolled.append(RolledTrajectory(seed=record.id, trajectory=stored.name, **found))
    return FinalistRollouts(rolled=tuple(rolled), lost=tuple(lost))


def _rolled(
    session: Session,
    model: Model,
    task: StepTask,
    stored: StoredFrames,
    checks: Sequence[SeriesCheck],
    most_sinkhorn: int,
    animated: Path | None,
) -> dict:
    """Record a rollout over a whole trajectory, as values of `RolledTrajectory`; write it where it is to be animated.

    Raises:
        Diverged: If it has no frame.
        KeyboardInterrupt: After Ctrl-C.
    """
    asked = asked_rollout(task, stored, session.dataset.scene)
    asked = replace(asked, stride=math.ceil(asked.frames / LOOKS), most_sinkhorn=most_sinkhorn)
    frames = [asked.start.present.double()]

    def keep(positions: Tensor, _: Tensor) -> None:
        frames.append(positions)

    if animated is None:
        recorded = record_rollout(model, asked, keep)
    else:
        shutil.rmtree(animated, ignore_errors=True)
        recorded = write_rollout(model, asked, animated, session.dataset.metadata, keep)
    if recorded.ended == "interrupted":
        raise KeyboardInterrupt  # of the study
    whole = stored.between(0, len(stored))
    start = window_at(whole, task.history - 1, task.history, asked.frames)
    beyond = [check.first_beyond(torch.stack(frames), start) for check in checks]
    return _values(recorded, asked.frames) | {"beyond": {key: frame for each in beyond for key, frame in each.items()}}


def _values(recorded: RecordedRollout, stored: int) -> dict:
    """Measures of a rollout by their names in `RolledTrajectory`."""
    metrics = recorded.metrics
    return {
        "stored": stored,
        "mse": tuple(metrics.mse.tolist()),
        "looked_at": tuple(metrics.frames.tolist()),
        "sinkhorn": tuple(metrics.sinkhorn.tolist()),
        "rollout": _series(metrics.rollout),
        "reference": _series(metrics.reference),
        "ended": recorded.ended or "",
    }


def _series(flow: FlowMetrics) -> FlowSeries:
    means = {name: tuple(getattr(flow, name).mean(axis=0).tolist()) for name in ("neighbors", "speeds")}
    return FlowSeries(e_kin=tuple(flow.e_kin.tolist()), **means)
