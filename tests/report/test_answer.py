"""The answer says from the numbers alone whether a network pays beside the solver."""

import pytest
from summaries import SAMPLE, changed, solver_comparison

from cconv.report.sections.answer import AnswerSection
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.summary import SolverComparison


def sentence(solver, ms):
    """The sentence on the solver where the recommended model takes so long."""
    summary = RunFolder(SAMPLE).summary()
    entries = [changed(each, cost=changed(each.cost, ms_per_frame=ms)) for each in summary.finalists]
    return AnswerSection().draw(changed(summary, finalists=entries, solver=solver), None)["solver"]


def test_a_field_has_no_sentence_on_the_solver():
    assert sentence(None, 2.0) == ""


def test_a_network_pays_that_errs_less_than_a_solver_of_its_speed():
    found = sentence(solver_comparison(1e-8, 2e-4, network_error=1e-4), 2.0)
    assert found.startswith("A network pays for this scene where an error of 0.0001 is small enough.")
    assert "errs by 1e-08 and takes 8 ms" in found
    assert "errs by 0.0001 and takes 0.25 times as long" in found
    assert "2 times as far apart takes 2 ms and errs by 0.0002" in found


def test_the_solver_with_slow_sound_counts_where_it_is_as_fast_and_the_most_accurate():
    found = sentence(solver_comparison(1e-8, 2e-4, network_error=1e-4, slow=[1e-6, 5e-5]), 2.0)
    assert found.startswith("A network does not pay for this scene: a coarser solver is as fast and no less accurate.")
    assert "with particles 2 times as far apart and 0.5 of the speed of sound takes 2 ms and errs by 5e-05" in found


@pytest.mark.parametrize(
    ("errors", "ms", "start"),
    [
        ((1e-8, 5e-5), 2.0, "A network does not pay for this scene: a coarser solver is as fast and no less accurate."),
        ((1e-8,), 9.0, "A network does not pay for this scene at this size: it is no faster than the solver."),
        ((1e-8, 5e-5), 1.0, "A network pays"),  # the coarser solver is more accurate, and slower
        ((1e-8,), 1.0, "On 4 rollouts"),
    ],
)
def test_a_network_does_not_pay_beside_a_solver_that_is_as_fast_and_as_accurate(errors, ms, start):
    assert sentence(solver_comparison(*errors), ms).startswith(start)


def test_what_was_not_measured_is_said_with_the_reason():
    found = sentence(SolverComparison(why_none="no scene has the case 'X' in 2 dimensions"), 2.0)
    assert found == "The solver that made the data was not measured: no scene has the case 'X' in 2 dimensions."


def test_models_are_called_by_what_they_are_and_the_others_have_reasons():
    summary = RunFolder(SAMPLE).summary()
    drawn = AnswerSection().draw(summary, None)
    assert drawn["words"]["baseline"] == "4 convolutions on grids, 4 cells a side"
    assert drawn["words"]["closed_form_0014_no_walls_no_density"] == "radial layer, 32 terms"
    set_aside = {row["entry"].id: row["why"] for row in drawn["aside"]}
    assert set(set_aside) == {entry.id for entry in summary.finalists} - {summary.recommended.id}
    assert set_aside["baseline"].startswith("failed error 0.974 in regime near_wall")
    assert all(set_aside.values())
