"""Colours and marks that all charts of a study share, so that a model looks the same wherever it is drawn."""

import seaborn as sns

MARKED = {"recommended": "#2f8f4e", "baseline": "#c44e52", "thesis's best": "#8c564b", "finalist": "#4c72b0"}
ANALYTIC_COLOR = "#222222"
SOLVER_COLOR = "#b8860b"
PUBLISHED_COLOR = "#7f7f7f"
MEAN_COLOR = "#000000"  # of the line of the mean predictor
_STAGES = {
    "closed_form": "#8172b3",
    "initialization": "#8c8c8c",
    "baseline": "#c44e52",
    "random": "#64a5d8",
    "refine": "#55a868",
    "adaptive": "#dd8452",
    "reference": "#ccb974",
}


def stage_colors(stages: list[str]) -> dict[str, str]:
    """A colour for each stage by its name; stages of other names take the rest of the palette in order."""
    others = iter(sns.color_palette("husl", max(1, len(stages))).as_hex())
    return {stage: _STAGES.get(stage) or next(others) for stage in stages}
