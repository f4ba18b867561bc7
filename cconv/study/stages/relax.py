"""The relax stage finds the SPH relaxation with which the recommended model rolls out best, without any retraining.

Relaxations are compared by validation rollouts of the recommended finalist and of the most accurate one; the test split
is not read. The relaxed model then has to pass the checks of stability as the finalists had.
"""

import shutil
import time
from collections.abc import Sequence
from typing import Literal

from pydantic import Field

from cconv.data.splits import evenly_spaced
from cconv.evaluation.checks.stability import measure_stability
from cconv.evaluation.relaxed_rollouts import FlowErrors, flow_errors, mean_errors, relative_quality
from cconv.models.checkpoint import load_model, read_card, save_model
from cconv.models.model import Model
from cconv.models.relaxation import Relaxation
from cconv.rollout.correctors import correctors_of
from cconv.study.declared.stage import Stage
from cconv.study.evidence.relaxations import chosen_relaxation
from cconv.study.records.found import Found, Relaxed, RelaxedModel, TriedRelaxation
from cconv.study.records.relaxations import read_tried, write_tried
from cconv.study.records.summary import FinalistEntry, Summary
from cconv.study.running.relaxation_search import propose_relaxation
from cconv.study.stages.checked import stability_checks
from cconv.study.stages.session import Session
from cconv.tasks.samples import StepSample, rolled_samples
from cconv.tasks.task import StepTask, as_step
from cconv.validation import Horizon, Real, Whole

OFFERED = "relaxed"  # folder of the recommended model with its relaxation


class RelaxStage(Stage):
    """Search the SPH relaxation of the rollouts of the recommended model, and store it in a checkpoint of its own.

    A search tries at most `candidates` relaxations on `starts` validation rollouts of `frames` frames; None goes on as
    long as frames are stored. It begins none after `seconds` of such rollouts, which the recommended and the most
    accurate finalist share if they are not the same.
    """

    kind: Literal["relax"] = "relax"
    is_single = True
    only_for_steps = True
    uses = ("select",)
    needs_records = True
    candidates: Whole = Field(40, ge=1, le=10_000)
    starts: Whole = Field(4, ge=1, le=1000)
    frames: Horizon | None = None
    seconds: Real = Field(600.0, ge=0.1, le=1e7)

    def run(self, session: Session, name: str) -> Found:
        """Search, write the recommended model with the relaxation that was chosen, and add all to summary.json.

        Raises:
            DataError: If the data have no mass, so that no density at rest is known, or too few validation frames.
        """
        summary, begun = session.run.summary(), time.perf_counter()
        samples = self._samples(session)
        ids = list(dict.fromkeys((summary.recommended.id, summary.selection.best)))
        models = {
            entry.id: self._search(session, name, entry, samples, self.seconds / len(ids))
            for entry in summary.finalists
            if entry.id in ids
        }
        chosen = {finalist: chosen_relaxation(model.tried) for finalist, model in models.items()}
        shutil.rmtree(session.run.path / OFFERED, ignore_errors=True)  # of a choice before the study was extended
        own = models[summary.recommended.id].tried[chosen[summary.recommended.id]]
        checkpoint = _offer(session, summary, own) if own.loops else None
        failures = None if checkpoint is None else _failures(session, checkpoint)
        found = Relaxed(models=models, chosen=chosen, checkpoint=checkpoint, failures=failures)
        seconds = summary.wall_seconds + time.perf_counter() - begun
        session.run.write_summary(summary.model_copy(update={"relaxed": found, "wall_seconds": seconds}))
        return Found(relaxed=found)

    def _samples(self, session: Session) -> list[StepSample]:
        """Choose the validation windows that rollouts begin with."""
        task, dataset = as_step(session.problem.task), session.dataset
        frames = self.frames or _longest_rollout(session, task)
        windows = rolled_samples(dataset, "valid", task, frames)
        return [windows[place] for place in evenly_spaced(len(windows), self.starts)]

    def _search(
        self, session: Session, stage: str, entry: FinalistEntry, samples: Sequence[StepSample], seconds: float
    ) -> RelaxedModel:
        """Try one relaxation after another with a finalist, and record each; what is recorded is not tried again."""
        model = session.load_model(session.run.path / entry.checkpoint)
        facts = {
            "checkpoint": entry.checkpoint,
            "frames": len(samples[0].window.future),
            "rollouts": len(samples),
        }
        recorded = read_tried(session.run, entry.id)
        is_same = recorded is not None and facts == recorded.model_dump(include=set(facts))
        tried = list(recorded.tried) if recorded is not None and is_same else []
        for number in session.progress(range(self.candidates + 1), f"relaxation of {entry.id}"):
            if number < len(tried):
                continue
            if number and sum(each.seconds for each in tried[1:]) > seconds:
                break
            relaxation = propose_relaxation(tried, session.seed_of(stage)) if number else None
            tried.append(_try(model, relaxation, samples, tried))
            write_tried(session.run, entry.id, RelaxedModel(tried=tuple(tried), **facts))
        return RelaxedModel(tried=tuple(tried), **facts)


def _longest_rollout(session: Session, task: StepTask) -> int:
    """Frames after the first window that every validation trajectory has."""
    lengths = [session.dataset.num_frames(block) for block in session.dataset.splits["valid"]]
    return max(1, min(lengths) - task.history)


def _try(
    model: Model, relaxation: Relaxation | None, samples: Sequence[StepSample], tried: Sequence[TriedRelaxation]
) -> TriedRelaxation:
    """Roll a model out with a relaxation from every start; the first of those that were tried is without one."""
    begun = time.perf_counter()
    correctors = correctors_of(model.relaxed_by(relaxation))
    rolled = [flow_errors(model, sample, correctors) for sample in samples]
    found, reasons = mean_errors([errors for errors, _ in rolled]), [reason for _, reason in rolled if reason]
    plain = FlowErrors(mse=tried[0].mse, sinkhorn=tried[0].sinkhorn, density=tried[0].density) if tried else found
    return TriedRelaxation(
        alpha=relaxation.alpha if relaxation else 0.0,
        beta=relaxation.beta if relaxation else 0.0,
        loops=relaxation.loops if relaxation else 0,
        quality=relative_quality(found, plain, samples[0].scene),
        mse=found.mse,
        sinkhorn=found.sinkhorn,
        density=found.density,
        diverged=len(reasons),
        reason=reasons[0] if reasons else "",
        seconds=time.perf_counter() - begun,
    )


def _failures(session: Session, checkpoint: str) -> tuple[str, ...]:
    """Run the checks of stability on the relaxed model; a line for each that it fails."""
    model = session.load_model(session.run.path / checkpoint)
    material, checks = stability_checks(session, model.cutoff)
    seeds = {OFFERED: material.predictor(model)}
    return tuple(measure_stability(seeds, checks, material.counts)["failures"])


def _offer(session: Session, summary: Summary, chosen: TriedRelaxation) -> str:
    """Write the recommended model with its relaxation; return its folder, relative to the run folder."""
    trained = session.run.path / summary.chosen.checkpoint
    relaxation = Relaxation(alpha=chosen.alpha, beta=chosen.beta, loops=chosen.loops)
    save_model(load_model(trained).relaxed_by(relaxation), session.run.path / OFFERED, read_card(trained))
    return OFFERED
