"""The section on the search: its trials, their outcomes and their errors."""

from typing import Any

import pandas as pd

from cconv.report.plots import best_so_far_chart, learning_curves_chart
from cconv.report.sections.section import LastingSection, Records
from cconv.report.tables import MEAN_PREDICTOR
from cconv.study.records.summary import Summary


class SearchSection(LastingSection):
    """Show the trials by stage and outcome, their learning curves, and a table of all."""

    name = "search"
    title = "What the search did"

    def draw(self, summary: Summary | None, records: Records) -> dict[str, Any]:
        """Draw the trials, if any was evaluated, and list them by error."""
        charts = {}
        if records.has_errors:
            charts = {
                "curves": learning_curves_chart(records.curves, summary),
                "best": best_so_far_chart(records.trials, summary),
            }
        trials = None if records.trials.empty else _by_error(records.trials, summary)
        return {"charts": charts, "trials": trials}


def _by_error(trials: pd.DataFrame, summary: Summary | None) -> pd.DataFrame:
    """Sort the trials by error, with a row for the mean predictor if its error is known."""
    table = trials.astype(object)  # a row with gaps would turn whole numbers into fractions
    if summary is not None:
        table.loc[len(table), ["trial", "valid_error"]] = [MEAN_PREDICTOR, summary.mean_predictor.valid]
    return table.sort_values("valid_error")
