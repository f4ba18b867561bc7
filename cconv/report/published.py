"""What others report for their networks on LagrangeBench's data sets, beside what a study finds."""

from functools import cache
from importlib.resources import files
from pathlib import PurePath

import pandas as pd

from cconv.study.records.summary import Summary

HORIZON = 20  # frames behind the published errors
CHECKPOINTS = "checkpoints"  # the source with errors of pretrained networks
BUDGET = "500,000 updates on an A6000"  # of every published network


@cache
def published_table() -> pd.DataFrame:
    """All published figures, `published.csv`, whose head says where they come from.

    Columns: data (how the name of the folder begins), network, source; parameters; ms, of a forward pass on an A6000;
    mse5, mse20; frames of a longer rollout, its mse, sinkhorn divergence and e_kin, the squared error of the kinetic
    energy. What a source does not give is NaN.
    """
    with files("cconv.report").joinpath("published.csv").open() as file:
        return pd.read_csv(file, comment="#")


def published_results(summary: Summary) -> pd.DataFrame:
    """The rows of `published_table` for the data of a study; none if they do not have a name of LagrangeBench's."""
    table, folder = published_table(), PurePath(summary.dataset.path).name
    return table[[folder.startswith(name) for name in table["data"]]]


def published_errors(summary: Summary) -> dict[str, float]:
    """MSE20 of the published checkpoints by network, if the rollouts of a study are as long; else none."""
    if summary.task.horizon != HORIZON:
        return {}
    found = published_results(summary)
    found = found[found["source"] == CHECKPOINTS]
    return dict(zip(found["network"], found["mse20"], strict=True))
