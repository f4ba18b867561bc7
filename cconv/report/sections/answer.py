"""The answer: the recommended model and its figures, compared with the baseline, the analytic field and the solver."""

from typing import Any

from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import ComparedModel, FinalistEntry, SolverComparison, SolverPoint, Summary


class AnswerSection(Section):
    """Show the recommended model, its figures, the reason, and why the others are set aside."""

    name = "answer"
    title = "Answer"
    part = "recommended"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Return names of the finalists in words, why the others are set aside, and the baseline as ratios."""
        baseline = summary.finalist(summary.baseline)
        other = None if baseline is summary.chosen else baseline
        return {
            "words": {entry.id: entry.in_words or entry.id for entry in summary.finalists},
            "aside": _set_aside(summary),
            "baseline": other,
            "ratios": {} if other is None else _ratios(other, summary.chosen),
            "solver": _beside_the_solver(summary.solver, summary.chosen.cost.ms_per_frame) if summary.solver else "",
        }


def _set_aside(summary: Summary) -> list[dict[str, Any]]:
    """The finalists that are not recommended, fastest first, each with the reason."""
    compared = {each.id: each for each in summary.selection.comparisons}
    chosen, entries = compared.pop(summary.recommended.id), {entry.id: entry for entry in summary.finalists}
    return [
        {"entry": entries[each.id], "why": each.why_not or _no_better(each, chosen)}
        for each in compared.values()
        if each.id in entries
    ]


def _no_better(model: ComparedModel, chosen: ComparedModel) -> str:
    return "slower" if model.ms_per_frame > chosen.ms_per_frame else "as fast within the noise, and less accurate"


def _ratios(baseline: FinalistEntry, chosen: FinalistEntry) -> dict[str, float | None]:
    """Divide error, time and size of the baseline by those of the recommended model; no ratio to an error of 0."""
    return {
        "error": baseline.test.error / chosen.test.error if chosen.test.error else None,
        "time": baseline.cost.ms_per_frame / chosen.cost.ms_per_frame,
        "size": baseline.num_parameters / chosen.num_parameters,
    }


def _beside_the_solver(solver: SolverComparison, ms: float) -> str:
    """Say whether the recommended model, which takes `ms` for a frame, pays beside the solver that made the data."""
    if not solver.points or solver.network_error is None:
        return f"The solver that made the data was not measured: {solver.why_none}."
    full, *cheaper = solver.points
    own = solver.network_error
    figures = (
        f"On {solver.rollouts} rollout{'s' * (solver.rollouts != 1)} of the test split the solver that made the data, "
        f"restarted from the same frames, errs by {full.error:.3g} and takes {full.ms_per_frame:.3g} ms for a frame; "
        f"the recommended network errs by {own:.3g} and takes {ms / full.ms_per_frame:.3g} times as long."
    )
    if ms >= full.ms_per_frame:
        return f"A network does not pay for this scene at this size: it is no faster than the solver. {figures}"
    if not cheaper:
        return f"{figures} The solver cannot be run coarser in this scene."
    as_fast = [point for point in cheaper if point.ms_per_frame <= ms]
    best = min(as_fast or cheaper, key=lambda point: point.error if as_fast else point.ms_per_frame)
    coarse = (
        f"The solver {_as_it_is_run(best, full)}{'' if as_fast else ', its fastest form,'}"
        f" takes {best.ms_per_frame:.3g} ms and errs by {best.error:.3g}."
    )
    pays = f"A network pays for this scene where an error of {own:.3g} is small enough."
    if as_fast and best.error <= own:
        pays = "A network does not pay for this scene: a coarser solver is as fast and no less accurate."
    return f"{pays} {figures} {coarse}"


def _as_it_is_run(point: SolverPoint, full: SolverPoint) -> str:
    """Say how a cheaper form of the solver differs from that of the data."""
    apart = [f"particles {point.factor:.3g} times as far apart"] if point.factor != 1 else []
    slow = [f"{point.sound_ratio / full.sound_ratio:.3g} of the speed of sound"]
    return f"with {' and '.join(apart + slow * (point.sound_ratio != full.sound_ratio))}"
