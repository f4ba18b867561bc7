"""Do the thesis's findings follow from its own trials? The analysis of our studies, on its two published searches.

    python experiments/thesis_claims.py --data FOLDER --out experiments/benchmarks/results/thesis_trials

The folder holds `search2_random_asha.csv` (100 random trials under ASHA) and `search3_bayesian.csv` (100 trials of one
budget, drawn by a Bayesian search). Writes `claims.json` with every figure, `claims.md` with the answers, and charts.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import scipy.stats
from numpy.typing import NDArray

from cconv.errors import DataError
from cconv.files import write_json
from cconv.report.decidable import decidable
from cconv.report.importance_plots import importance_chart, partial_dependence_chart
from cconv.study.declared.domains import Choice, FloatRange, IntRange, SearchSpace
from cconv.study.evidence.effects import effects
from cconv.study.evidence.importance import importance_by_rung
from cconv.study.evidence.partial_dependence import partial_dependence
from cconv.study.evidence.rung_audit import spearman_interval
from cconv.study.records.found import RungImportance
from cconv.study.records.trials import TrialRecord

SIZE, KERNEL, EXTENT = "num_parameters", "kernel_size", "filter_extent"
SHAPE = (KERNEL, "hidden_units", "input_channels", "hidden_layers")  # what the number of parameters follows from
NUMBERS = (SIZE, *SHAPE, EXTENT, "learning_rate")
SAID_WEAK = ("window", "coordinate_mapping", "activation")
SURE, MATTERS = 0.95, 0.10  # share of resamples that counts as sure; share of the spread from which on a choice matters
RESAMPLES = 2000  # of who leads
SURVIVED, STOPPED = 0.01, 0.1  # in place of errors that are not recorded; only their order counts
_WHERE = {"survival": "Search 2, survival:", "complete": "Search 3:"}


def _choice(*values) -> Choice:
    return Choice(type="choice", values=list(values), baseline=values[0], reason="as searched")


def _real(low: float, high: float, scale: str = "linear") -> FloatRange:
    return FloatRange(type="float", range=(low, high), scale=scale, baseline=low, reason="as searched")


def _whole(low: int, high: int) -> IntRange:
    return IntRange(type="int", range=(low, high), baseline=low, reason="as searched")


SEARCH_2 = SearchSpace(
    name="search 2",
    description="The thesis's random search.",
    parameters={
        "coordinate_mapping": _choice("identity", "ball_to_cube_radial", "ball_to_cube_volume_preserving"),
        "window": _choice("none", "poly6", "gaussian"),
        EXTENT: _real(0.075, 0.19, "log"),
        KERNEL: _choice(1, 2, 3, 4, 8),
        "hidden_units": _choice(16, 32, 48, 64, 128),
        "input_channels": _choice(4, 8, 16, 32, 64),
        "hidden_layers": _whole(0, 4),
        "activation": _choice("ReLU", "Tanh", "GeLU", "Leaky_ReLU"),
        "interpolation": _choice("linear", "nearest_neighbor"),
        "learning_rate": _real(1e-4, 1e-2, "log"),
        "ignore_query_points": _choice(False, True),
        "dense_center_flag": _choice(False, True),
    },
)
SEARCH_3 = SearchSpace(
    name="search 3",
    description="The thesis's Bayesian search; it drew real numbers for all and cut off their fractions.",
    parameters={
        EXTENT: _real(0.12, 0.25),
        KERNEL: _whole(3, 7),
        "hidden_units": _whole(16, 64),
        "input_channels": _whole(8, 32),
        "hidden_layers": _whole(1, 3),
        "learning_rate": _real(2e-4, 6e-3),
    },
)
SEARCH_3_DRAWN = {EXTENT: (0.12, 0.25), KERNEL: (3, 7), "hidden_units": (16, 65), "input_channels": (8, 33),
                  "hidden_layers": (1, 4), "learning_rate": (2e-4, 6e-3)}  # fmt: skip


@dataclass(frozen=True)
class Sample:
    """Trials that may be compared with each other.

    Attributes:
        name: Short name.
        title: What the outcome is and whose.
        trials: Hyperparameters, and the number of parameters.
        errors: Outcome of each trial, smaller is better.
        space: Space that they were drawn from.
        updates: Age at which all were judged; None if they differ.
    """

    name: str
    title: str
    trials: pd.DataFrame
    errors: NDArray[np.float64]
    space: SearchSpace
    updates: int | None


def read_trials(folder: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Trials of searches 2 and 3 as published.

    Raises:
        DataError: If a file is missing.
    """
    files = [folder / name for name in ("search2_random_asha.csv", "search3_bayesian.csv")]
    for file in files:
        if not file.is_file():
            raise DataError(f"{file}: no such file; give the folder with the thesis's trials.")
    search_2, search_3 = (pd.read_csv(file, keep_default_na=False) for file in files)
    return search_2, search_3


def samples(search_2: pd.DataFrame, search_3: pd.DataFrame) -> list[Sample]:
    """What is comparable in the two searches, and last what the thesis compared although it is not.

    The networks of search 3 were built with the whole part of the numbers drawn.
    """
    search_3 = search_3.assign(**{name: search_3[name].astype(int) for name in SHAPE})
    steps = search_2["step"]
    first = int(steps.min())
    survived = np.where(steps > first, SURVIVED, STOPPED)
    losers = search_2[steps == first]
    full = int(search_3["step"].max())
    return [
        Sample("survival", f"search 2: who survived the first decision, after {first} updates", search_2, survived,
               SEARCH_2, first),
        Sample("stopped", f"search 2: error of those stopped after {first} updates", losers,
               losers["val_loss"].to_numpy(), SEARCH_2, first),
        Sample("complete", f"search 3: error after {full} updates", search_3, search_3["val_loss"].to_numpy(),
               SEARCH_3, full),
        Sample("mixed", "search 2: last error at whatever age, as the thesis read it", search_2,
               search_2["val_loss"].to_numpy(), SEARCH_2, None),
    ]  # fmt: skip


def count_parameters(trial: Mapping) -> int:
    """Number of weights of the thesis's network: boundary, fluid and dense branch, hidden layers, one output."""
    cells, width = int(trial[KERNEL]) ** 3, int(trial["hidden_units"])
    first = int(trial["input_channels"])
    sizes = [3 * first, *[width] * int(trial["hidden_layers"]), 1]
    branches = (3 * cells + 1) * first + (5 * cells + 1) * first + 6 * first
    return branches + sum(((cells + 1) * a + 2) * b for a, b in zip(sizes, sizes[1:], strict=False))


def correlations(sample: Sample, rng: np.random.Generator) -> dict:
    """Spearman's rank correlation of each number with the outcome, its interval, and how often it leads."""
    values = sample.trials[list(NUMBERS)].to_numpy(dtype=np.float64)
    count = len(values)
    draws = [np.arange(count), *rng.integers(count, size=(RESAMPLES, count))]
    found = np.array([_spearman(values[drawn], sample.errors[drawn]) for drawn in draws])
    intervals = [spearman_interval(float(each), count) for each in found[0]]
    order = np.argsort(-np.abs(found[1:]), axis=1)
    both = np.isin(order[:, :2], [NUMBERS.index(SIZE), NUMBERS.index(KERNEL)]).all(axis=1)
    return {
        "both_lead": float(both.mean()),
        "numbers": {
            name: {
                "correlation": float(found[0, k]),
                "low": intervals[k][0],
                "high": intervals[k][1],
                "leads": float(np.mean(order[:, 0] == k)),
            }
            for k, name in enumerate(NUMBERS)
        },
    }


def _spearman(values: NDArray[np.float64], errors: NDArray[np.float64]) -> NDArray[np.float64]:
    ranks = scipy.stats.rankdata(np.column_stack([values, errors]), axis=0)
    ranks -= ranks.mean(axis=0)
    scale = np.sqrt((ranks**2).sum(axis=0))
    return ranks[:, :-1].T @ ranks[:, -1] / np.maximum(scale[:-1] * scale[-1], np.finfo(float).tiny)


def influence_of_choice(sample: Sample, name: str) -> dict:
    """Share of the spread of ranks between the values of a choice, its 95 % interval, p-value, and who survived."""
    words = sample.trials[name].astype(str).to_numpy()
    columns = np.equal.outer(words, np.unique(words)).astype(np.float64)
    found = effects(columns, scipy.stats.rankdata(sample.errors))
    low, high = found.interval95
    return {
        "share": float(found.share),
        "low": float(low),
        "high": float(high),
        "p_value": float(found.p_value),
        "survived": {word: float(np.mean(sample.errors[words == word] == SURVIVED)) for word in np.unique(words)},
    }


def as_records(sample: Sample, space: SearchSpace) -> list[TrialRecord]:
    """The sample's trials as records of one stage."""
    rows = sample.trials[list(space.parameters)].to_dict("records")
    return [
        TrialRecord(
            id=f"{sample.name}_{number:04d}",
            stage="random",
            parameters=row,
            config={},
            log=[{"updates": sample.updates, "valid_error": float(error)}],
            outcome="completed",
            reason="",
        )
        for number, (row, error) in enumerate(zip(rows, sample.errors, strict=True))
    ]


def with_size(sample: Sample) -> SearchSpace:
    """The space with the number of parameters in place of the four numbers that it follows from."""
    sizes = sample.trials[SIZE]
    kept = {name: each for name, each in sample.space.parameters.items() if name not in SHAPE}
    size = _real(float(sizes.min()), float(sizes.max()), "log")
    return SearchSpace(name=sample.space.name, description=sample.space.description, parameters={SIZE: size} | kept)


def importance(sample: Sample, space: SearchSpace) -> dict:
    """Importances of the sample, by all methods."""
    (entry,) = importance_by_rung(as_records(sample, space), space, [sample.updates], useless_error=1.0)
    return entry.model_dump()


def departure_from_uniform(search_3: pd.DataFrame) -> dict[str, float]:
    """p-value of a Kolmogorov–Smirnov test that search 3 drew a number uniformly from its range, by number."""
    return {
        name: float(scipy.stats.kstest((search_3[name] - low) / (high - low), "uniform").pvalue)
        for name, (low, high) in SEARCH_3_DRAWN.items()
    }


def analyse(search_2: pd.DataFrame, search_3: pd.DataFrame) -> dict:
    """Every figure that the answers rest on, by sample."""
    rng = np.random.default_rng(0)
    figures = {}
    for sample in samples(search_2, search_3):
        figures[sample.name] = {
            "title": sample.title,
            "trials": len(sample.errors),
            "correlations": correlations(sample, rng),
        }
        if sample.updates is not None:
            figures[sample.name]["importance"] = importance(sample, sample.space)
            figures[sample.name]["importance_with_size"] = importance(sample, with_size(sample))
    survival = samples(search_2, search_3)[0]
    figures["survival"]["choices"] = {name: influence_of_choice(survival, name) for name in SAID_WEAK}
    drawn = pd.concat([search_2, search_3])
    counted = [count_parameters(trial) for trial in drawn.to_dict("records")]
    return figures | {
        "counted_parameters_agree": float(np.mean(counted == drawn[SIZE])),
        "search_3_departure_from_uniform": departure_from_uniform(search_3),
        "sizes": {
            name: search[SIZE].agg(["min", "max"]).tolist() for name, search in (("2", search_2), ("3", search_3))
        },
        "best_of_search_3": search_3.nsmallest(10, "val_loss")[EXTENT].agg(["min", "max"]).tolist(),
    }


def answers(figures: Mapping) -> Iterator[dict]:
    """Each claim with "holds", "does not hold" or "cannot be decided", and why."""
    fair = {name: figures[name]["correlations"] for name in ("survival", "complete")}
    yield _larger_is_better(fair)
    yield _strongest(fair)
    yield _extent(fair, figures)
    yield from (_weak(name, figures["survival"]) for name in SAID_WEAK)
    yield _undecided("Initial weights have a negligible influence.", "Every configuration was trained once.")
    yield _undecided(
        "Identity mapping without normalisation is enough.",
        "All trials of both searches are without normalisation, and all of search 3 have the identity mapping.",
    )


def _larger_is_better(fair: Mapping) -> dict:
    numbers = [found["numbers"][name] for found in fair.values() for name in (SIZE, KERNEL)]
    holds = all(each["high"] < 0 for each in numbers)
    refuted = any(each["low"] > 0 for each in numbers)
    return {
        "claim": "More parameters and larger kernels go with smaller errors.",
        "verdict": "holds" if holds else "does not hold" if refuted else "cannot be decided",
        "why": " ".join(f"{_WHERE[name]} {_quoted(found, (SIZE, KERNEL))}." for name, found in fair.items()),
    }


def _strongest(fair: Mapping) -> dict:
    others = {name: _leader(found, set(NUMBERS) - {SIZE, KERNEL}) for name, found in fair.items()}
    holds = all(found["both_lead"] >= SURE for found in fair.values())
    refuted = any(leads >= SURE for _, leads in others.values())
    lines = []
    for name, found in fair.items():
        other, leads = others[name]
        lines.append(
            f"{_WHERE[name]} the two lead in {found['both_lead']:.0%} of the resamples, "
            f"the {_called(other)} in {leads:.0%} ({_quoted(found, (other,))})."
        )
    return {
        "claim": "The number of parameters and the kernel size are the strongest predictors.",
        "verdict": "holds" if holds else "does not hold" if refuted else "cannot be decided",
        "why": " ".join(lines),
    }


def _extent(fair: Mapping, figures: Mapping) -> dict:
    leads = {name: found["numbers"][EXTENT]["leads"] for name, found in fair.items()}
    judged = {name: figures[name]["importance"]["parameters"][EXTENT] for name in fair}
    smallest, largest = figures["best_of_search_3"]
    weak = all(each["high"] <= MATTERS for each in judged.values())
    return {
        "claim": "The filter extent is not among what matters most (the thesis does not name it).",
        "verdict": "does not hold" if max(leads.values()) >= SURE else "holds" if weak else "cannot be decided",
        "why": " ".join(
            f"{_WHERE[name]} {_quoted(found, (EXTENT,))}, share of the variance {_share(judged[name])}."
            for name, found in fair.items()
        )
        + f" The ten best of search 3 have extents from {smallest:.3f} to {largest:.3f}, of a range up to 0.25.",
    }


def _weak(name: str, survival: Mapping) -> dict:
    choice = survival["choices"][name]
    matters = choice["p_value"] < (1 - SURE) / len(SAID_WEAK)
    weak = choice["high"] <= MATTERS
    rates = ", ".join(
        f"{word} {rate:.0%}" for word, rate in sorted(choice["survived"].items(), key=lambda item: -item[1])
    )
    return {
        "claim": f"The {_called(name)} has little influence.",
        "verdict": "does not hold" if matters else "holds" if weak else "cannot be decided",
        "why": f"Share of the spread {_share(choice)}, p = {choice['p_value']:.2g}. "
        f"Survived the first decision: {rates}.",
    }


def _undecided(claim: str, why: str) -> dict:
    return {"claim": claim, "verdict": "cannot be decided", "why": why}


def _leader(found: Mapping, names: set[str]) -> tuple[str, float]:
    leads = {name: found["numbers"][name]["leads"] for name in sorted(names)}
    leader = max(leads, key=lambda name: (leads[name], abs(found["numbers"][name]["correlation"])))
    return leader, leads[leader]


def _quoted(found: Mapping, names: Sequence[str]) -> str:
    numbers = {name: found["numbers"][name] for name in names}
    return ", ".join(
        f"{_called(name)} {each['correlation']:+.2f} ({each['low']:+.2f} to {each['high']:+.2f})"
        for name, each in numbers.items()
    )


def _called(name: str) -> str:
    return {SIZE: "number of parameters"}.get(name, name.replace("_", " "))


def _share(found: Mapping) -> str:
    return f"{found['share']:.2f} ({found['low']:.2f} to {found['high']:.2f})"


def page(figures: Mapping, verdicts: Sequence[Mapping]) -> str:
    """The answers in words, as Markdown."""
    table = "\n".join(f"| {each['claim']} | **{each['verdict']}** | {each['why']} |" for each in verdicts)
    rows = "\n".join(f"| {_called(name)} | {' | '.join(_cells(figures, name))} |" for name in NUMBERS)
    uniform = min(figures["search_3_departure_from_uniform"].values())
    return _PAGE.format(
        table=table,
        rows=rows,
        titles=" | ".join(figures[name]["title"] for name in _COLUMNS),
        lines="|".join("---" for _ in _COLUMNS),
        counts=" | ".join(str(figures[name]["trials"]) for name in _COLUMNS),
        agree=f"{figures['counted_parameters_agree']:.0%}",
        uniform=f"{uniform:.2g}",
        sure=f"{SURE:.0%}",
        matters=f"{MATTERS:g}",
        smallest_2=figures["sizes"]["2"][0],
        largest_2=figures["sizes"]["2"][1],
        smallest_3=figures["sizes"]["3"][0],
        largest_3=figures["sizes"]["3"][1],
        importance="\n".join(_importance_line(figures[name]) for name in _COLUMNS[:3]),
    )


def _cells(figures: Mapping, name: str) -> Iterator[str]:
    for sample in _COLUMNS:
        each = figures[sample]["correlations"]["numbers"][name]
        yield f"{each['correlation']:+.2f} ({each['low']:+.2f} to {each['high']:+.2f}), leads in {each['leads']:.0%}"


def _importance_line(figures: Mapping) -> str:
    entry = figures["importance"]
    (sentence,) = decidable([RungImportance(**entry)])
    strongest = "; ".join(
        f"{called} {', '.join(_strongest_by(entry, method))}"
        for called, method in (("by f-ANOVA", "f_anova"), ("by PED-ANOVA", "ped_anova"))
    )
    return f"- {figures['title']}. {sentence} Without intervals, the strongest {strongest}."


def _strongest_by(entry: Mapping, method: str) -> list[str]:
    values = {name: each[method] for name, each in entry["parameters"].items()}
    return [f"{_called(name)} {values[name]:.2f}" for name in sorted(values, key=values.__getitem__)[:-4:-1]]


_COLUMNS = ("survival", "stopped", "complete", "mixed")
_PAGE = """# What the thesis's own trials say of its claims

Written by `experiments/thesis_claims.py`; every figure is in `claims.json`.

| claim | answer | figures |
|---|---|---|
{table}

Figures in brackets are 95 % intervals: of a rank correlation by Bonett and Wright, of a share by the noncentral F
distribution. A claim about order holds, or does not, if it is so in {sure} of the resamples of trials. A choice has
little influence if it makes up no more than {matters} of the spread of ranks at the upper end of its interval; it has
influence if p is below 0.05 / 3, as three are tested. Between the two nothing is decided: absence of evidence is not
weakness.

## Which trials may be compared

Search 2 stopped trials by ASHA and its table holds only each trial's last error, at ages from 330 to 2,640 updates.
Those errors are not comparable, and the survivors' errors at 330 updates are not recorded. Comparable are: who survived
the first decision, which fell on all trials at one age; and the errors of those that were stopped there, who are a
selection by error themselves. Search 3 trained all trials to one age. It was meant to be adaptive, yet its draws can
hardly be told from uniform ones (smallest p of a Kolmogorov-Smirnov test over six hyperparameters: {uniform}), so that
importances may be read from it. It drew real numbers and built networks with their whole part: counted so, the number
of parameters agrees in {agree} of all trials. The last column is what the thesis compared, and is no evidence.

## Rank correlation with error

| | {titles} |
|---|{lines}|
| trials | {counts} |
{rows}

Minus: the larger, the better.

## Importance of what was drawn

{importance}

Charts: `importance_search_2.png`, `importance_search_3.png`, `partial_dependence_search_3.png`.

## Limits

Importance is relative to the ranges searched. Search 2 has kernels from 1 to 8, extents from 0.075 to 0.19 and networks
from {smallest_2:,} to {largest_2:,} parameters; search 3 has kernels from 3 to 7, extents from 0.12 to 0.25 and from
{smallest_3:,} to {largest_3:,} parameters. Survival was decided after 330 updates: what it says, that the window has
little influence above all, holds for the beginning of training. Each configuration has one seed. Frames were split at
random, so that errors on unseen scenes are unknown.
"""


def draw(search_2: pd.DataFrame, search_3: pd.DataFrame, figures: Mapping, out: Path) -> None:
    """Charts of importance in both searches, and of partial dependence in the complete one."""
    for name, search in (("survival", "search_2"), ("complete", "search_3")):
        chart = importance_chart([RungImportance(**figures[name]["importance"])], title=figures[name]["title"])
        chart.savefig(out / f"importance_{search}.png", dpi=90)
    sample = next(sample for sample in samples(search_2, search_3) if sample.name == "complete")
    records, judged = as_records(sample, sample.space), figures["complete"]["importance"]["parameters"]
    order = sorted(judged, key=lambda name: -judged[name]["share"])
    dependences = [partial_dependence(records, sample.space, sample.updates, name, useless_error=1.0) for name in order]
    partial_dependence_chart(dependences).savefig(out / "partial_dependence_search_3.png", dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder with the thesis's trials")
    parser.add_argument("--out", type=Path, default=Path("runs/thesis_trials"), help="folder to write")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    search_2, search_3 = read_trials(arguments.data)
    figures = analyse(search_2, search_3)
    verdicts = list(answers(figures))
    write_json(arguments.out / "claims.json", {"answers": verdicts, "figures": figures})
    (arguments.out / "claims.md").write_text(page(figures, verdicts))
    draw(search_2, search_3, figures, arguments.out)
    for each in verdicts:
        print(f"{each['verdict']:18s} {each['claim']}")


if __name__ == "__main__":
    main()
