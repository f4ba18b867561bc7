"""Charts of the finalists' rollouts over test trajectories. Each function returns a matplotlib figure of its own."""

from collections.abc import Mapping, Sequence
from itertools import zip_longest

import numpy as np
import pandas as pd
import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.typing import ColorType

from cconv.report.colors import ANALYTIC_COLOR
from cconv.report.plots import new_figure, new_panels
from cconv.study.records.rollouts import FinalistRollouts, FlowSeries, RolledTrajectory

Rollouts = Mapping[str, FinalistRollouts]


def rollout_errors_chart(rollouts: Rollouts) -> Figure:
    """Error of the positions against frames, log axis: median and range over the rollouts that reached the frame.

    A cross is where a rollout ended before its last frame.

    Args:
        rollouts: Rollouts of each finalist.
    """
    figure, axes = new_figure(8.5, 4.2)
    for name, color in _colors(rollouts).items():
        errors = _table([each.mse for each in rollouts[name].rolled])
        frames = np.arange(1, errors.shape[1] + 1)
        axes.plot(frames, np.nanmedian(errors, axis=0), color=color, label=name)
        axes.fill_between(frames, np.nanmin(errors, axis=0), np.nanmax(errors, axis=0), color=color, alpha=0.15, lw=0)
        for each in rollouts[name].rolled:
            if each.ended:
                axes.plot(len(each.mse), each.mse[-1], "x", color=color)
    axes.set(yscale="log", xlabel="frame of the rollout", ylabel="mean squared error of the positions [length²]")
    axes.set_title("error of the rollouts")
    _legend(axes)
    return figure


def energy_chart(rollouts: Rollouts) -> Figure:
    """Kinetic energy against frames, one panel a test trajectory: the stored one, and one line a rollout."""
    trajectories = dict.fromkeys(each.trajectory for found in rollouts.values() for each in found.rolled)
    figure, panels = new_panels(4.2 * len(trajectories) + 1.5, 3.6, columns=len(trajectories))
    for axes, trajectory in zip(panels, trajectories, strict=True):
        for name, color in _colors(rollouts).items():
            own = [each for each in rollouts[name].rolled if each.trajectory == trajectory]
            for number, each in enumerate(own):
                label = None if number else name
                axes.plot(each.looked_at, each.rollout.e_kin, color=color, lw=1.2, marker=".", ms=3, label=label)
        longest = max(_of_trajectory(rollouts, trajectory), key=lambda each: len(each.looked_at))
        axes.plot(longest.looked_at, longest.reference.e_kin, color=ANALYTIC_COLOR, ls="--", label="stored")
        axes.set(yscale="log", xlabel="frame of the rollout", ylabel="kinetic energy [units of the data]")
        axes.set_title(trajectory, parse_math=False)  # a name in the data
    figure.suptitle("kinetic energy of the rollouts, by trajectory")
    _legend(panels[-1])
    return figure


def distributions_chart(rollouts: Rollouts) -> Figure:
    """Shares of particles by number of neighbours and by speed, means over all rollouts, beside the stored ones."""
    figure, panels = new_panels(11, 3.8, columns=2)
    everywhere = [each.reference for found in rollouts.values() for each in found.rolled]
    for axes, name in zip(panels, ("neighbors", "speeds"), strict=True):
        for model, color in _colors(rollouts).items():
            _draw_shares(axes, [each.rollout for each in rollouts[model].rolled], name, color, model)
        _draw_shares(axes, everywhere, name, ANALYTIC_COLOR, "stored")
    panels[0].set(xlabel="neighbours within 1.45 particle spacings", ylabel="share of particles")
    panels[1].set(xlabel="speed, in bins up to the largest stored one", ylabel="share of particles", yscale="log")
    panels[0].set_title("neighbours of the particles")
    panels[1].set_title("speeds of the particles")
    _legend(panels[1])
    return figure


def beyond_table(rollouts: Rollouts) -> pd.DataFrame:
    """What each rollout reached: its last frame, and the first frame beyond the limit of each check that it breaks."""
    rows = [
        {
            "model": name,
            "training": each.seed,
            "trajectory": each.trajectory,
            "frames": f"{len(each.mse)} of {each.stored}",
            "error over all frames": float(np.mean(each.mse)),
            "first frame beyond a limit": ", ".join(f"{key}: {frame}" for key, frame in each.beyond.items()) or "none",
            "ended": each.ended,
        }
        for name, found in rollouts.items()
        for each in found.rolled
    ]
    return pd.DataFrame(rows)


def _colors(rollouts: Rollouts) -> dict[str, ColorType]:
    """A colour for each finalist that has a rollout."""
    names = [name for name, found in rollouts.items() if found.rolled]
    return dict(zip(names, sns.color_palette("husl", len(names)), strict=True))


def _table(series: Sequence[Sequence[float]]) -> np.ndarray:
    """Series of different lengths as rows, nan after their ends."""
    return np.array(list(zip_longest(*series, fillvalue=np.nan))).T


def _of_trajectory(rollouts: Rollouts, trajectory: str) -> list[RolledTrajectory]:
    return [each for found in rollouts.values() for each in found.rolled if each.trajectory == trajectory]


def _draw_shares(axes: Axes, flows: Sequence[FlowSeries], name: str, color: ColorType, label: str) -> None:
    """Draw the mean of the shares of that name over some flows, a step a bin."""
    mean = np.mean([getattr(flow, name) for flow in flows], axis=0)
    axes.step(np.arange(len(mean)), mean, where="mid", color=color, label=label)


def _legend(axes: Axes) -> None:
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
