"""The relaxations that were tried with the finalists, as a chart and a table."""

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from cconv.report.colors import MARKED, MEAN_COLOR
from cconv.report.plots import new_panels
from cconv.study.evidence.relaxations import relaxation_front
from cconv.study.records.found import Relaxed, RelaxedModel, TriedRelaxation

_SPREAD = 0.12  # of the points of a number of loops, so that they do not hide each other


def relaxations_chart(relaxed: Relaxed) -> Figure:
    """Quality of the rollouts, log axis, against the loops of a relaxation, one panel a model; colours are alpha.

    The steps are the front; a ring marks the choice, a cross a relaxation with a rollout that diverged.

    Args:
        relaxed: What was tried.
    """
    count = len(relaxed.models)
    figure, panels = new_panels(5.2 * count + 1.2, 4.0, columns=count)
    alphas = [each.alpha for model in relaxed.models.values() for each in model.tried if each.loops]
    norm = LogNorm(min(alphas, default=0.005), max([*alphas, 0.1]))
    for axes, (name, model) in zip(panels, relaxed.models.items(), strict=True):
        _draw(axes, model, relaxed.chosen[name], norm)
        axes.set_title(name, parse_math=False)
        axes.set(yscale="log", xlabel="loops of the relaxation in a frame, 0 for none")
    panels[0].set_ylabel("measures ÷ without relaxation")
    figure.suptitle("relaxations that were tried, by model")
    points = panels[-1].collections[0]
    figure.colorbar(points, ax=list(panels), label="alpha, size of a shift")
    return figure


def relaxations_table(model: RelaxedModel, chosen: int) -> pd.DataFrame:
    """The front of the relaxations that were tried with a model, with none at all and the chosen one beside it."""
    numbers = dict.fromkeys((0, *relaxation_front(model.tried), chosen))
    return pd.DataFrame([_row(model.tried[number], model.rollouts, number == chosen) for number in numbers])


def _draw(axes: Axes, model: RelaxedModel, chosen: int, norm: LogNorm) -> None:
    tried = model.tried[1:]
    places = [each.loops + _SPREAD * (number % 3 - 1) for number, each in enumerate(tried)]
    for marker, wanted in (("o", False), ("X", True)):
        some = [(place, each) for place, each in zip(places, tried, strict=True) if bool(each.diverged) == wanted]
        axes.scatter(
            [place for place, _ in some],
            [each.quality for _, each in some],
            c=[each.alpha for _, each in some],
            cmap="viridis",
            norm=norm,
            marker=marker,
            s=36,
            zorder=3,
        )
    front = [model.tried[number] for number in relaxation_front(model.tried)]
    axes.step([each.loops for each in front], [each.quality for each in front], where="post", color="#888888", zorder=1)
    axes.axhline(1, color=MEAN_COLOR, ls="--", lw=1)
    axes.plot(0, model.tried[0].quality, "s", color=MEAN_COLOR, zorder=3)
    place = ([0.0, *places])[chosen]
    axes.plot(place, model.tried[chosen].quality, "o", ms=14, mfc="none", mec=MARKED["recommended"], mew=2, zorder=4)
    axes.set_xticks(range(1 + max(each.loops for each in model.tried)))


def _row(tried: TriedRelaxation, rollouts: int, is_chosen: bool) -> dict:
    return {
        "relaxation": f"{tried.loops} loop{'s' * (tried.loops != 1)}" if tried.loops else "none",
        "alpha": f"{tried.alpha:.3g}" if tried.loops else "",
        "beta": f"{tried.beta:.3g}" if tried.loops else "",
        "measures ÷ without": tried.quality,
        "position MSE": tried.mse,
        "Sinkhorn": tried.sinkhorn,
        "density error": tried.density,
        "diverged": f"{tried.diverged} of {rollouts}",
        "": "chosen" if is_chosen else "",
    }
