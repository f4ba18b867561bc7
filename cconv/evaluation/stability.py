"""Where methods fail: errors by regime, in stressed states, at rest, by precision, and of a density over time.

A model that is accurate on average may fail at the free surface, where particles clump (tensile instability), or where
a scene is denser or faster than the training data. Each check gives findings with a limit; a model all of whose seeds
keep every limit is stable.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Protocol

import torch
from torch import Tensor

from cconv.data.trajectory import Frame, Scene
from cconv.evaluation.probes import Probe, Probes, Rollout
from cconv.models.model import Model

NOT_FINITE = 1e9  # stands for an error that is infinite or no number, so that files can hold it
PRECISE_STATES = ("as_it_is", "far_away")  # states in which float32 is compared with float64
USUAL = 0.95  # share of the particles whose density must keep the limit


class Predictor(Protocol):
    """What is checked: a trained model, or anything else that predicts the field of a frame."""

    def predict(self, frame: Frame, scene: Scene) -> Tensor:
        """Field (N, C) at the fluid particles, as it is used."""

    def predict_exactly(self, frame: Frame, scene: Scene) -> Tensor:
        """The same in float64."""


class ModelPredictor:
    """A trained model as a `Predictor`.

    Args:
        model: The model.
    """

    def __init__(self, model: Model):
        self._model, self._exact = model, deepcopy(model).double()

    def predict(self, frame: Frame, scene: Scene) -> Tensor:
        """Field (N, C) in the units of the data, as `Model.predict_frame`."""
        return self._model.predict_frame(frame, scene)

    def predict_exactly(self, frame: Frame, scene: Scene) -> Tensor:
        """The same with weights and inputs in float64."""
        return self._exact.predict(self._model.inputs(frame, scene).double())


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """What a stable model must hold.

    Attributes:
        stressed_error: Largest error in a stressed state, mean square by that of the target over the same particles, or
            by a tenth of the target's variance over the validation frames if that is larger.
        regime_error: The same for the particles of a regime.
        still: Largest rate of density at rest and in uniform motion, by the same measure.
        precision: Largest difference of float32 from float64, by the root of the variance.
        density: Largest deviation of an integrated density, relative; 0.02 as Neural SPH.
    """

    stressed_error: float = 0.1
    regime_error: float = 0.1
    still: float = 0.1
    precision: float = 1e-3
    density: float = 0.02


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What a check measured.

    Attributes:
        check: "regime", "stress", "still", "precision" or "density".
        label: What was looked at: the regime or state.
        value: What was measured.
        limit: What it must not exceed.
        detail: What else a reader needs, such as the frame.
    """

    check: str
    label: str
    value: float
    limit: float
    detail: str = ""

    @property
    def passes(self) -> bool:
        """Whether the limit is kept; what is no number does not keep it."""
        return self.value <= self.limit


def measure_stability(seeds: Mapping[str, Predictor], probes: Probes, thresholds: Thresholds | None = None) -> dict:
    """All checks of a model's seeds, as they stand in summary.json; each number is that of the worst seed.

    Args:
        seeds: Each training of the model, by name.
        probes: What they are asked.
        thresholds: What must hold.

    Returns:
        "regimes", "stress", "still" (tasks that predict a rate), "precision", "density_rollout" (None for others),
        "stable", "failures" (one line each, with the seeds if there are several), "thresholds" and "counts" (seeds and
        frames that were looked at).
    """
    thresholds = thresholds or Thresholds()
    rollouts = {name: density_rollout(seed, probes, thresholds.density) for name, seed in seeds.items()}
    findings = {name: findings_of(seed, probes, thresholds, rollouts[name]) for name, seed in seeds.items()}
    worst = _worst(findings)
    values = {check: {} for check in ("regime", "stress", "still", "precision", "density")}
    for finding in worst:
        values[finding.check][finding.label] = finding.value
    failures = _failures(findings, worst)
    return {
        "regimes": {
            name: {"normalized_mse": value, "share": probes.regimes[name].share}
            for name, value in values["regime"].items()
        },
        "stress": values["stress"],
        **({"still": values["still"]} if values["still"] else {}),
        "precision": max(values["precision"].values()),
        "density_rollout": max(rollouts.values(), key=lambda each: each["largest"]) if probes.rollout else None,
        "stable": not failures,
        "failures": failures,
        "thresholds": asdict(thresholds),
        "counts": {
            "seeds": len(seeds),
            "plain_frames": len(probes.plain),
            "stressed_frames": len({probe.origin for probe in probes.stressed}),
        },
    }


def findings_of(predictor: Predictor, probes: Probes, thresholds: Thresholds, rollout: Mapping | None) -> list[Finding]:
    """What every check finds in one predictor, given its rollout."""
    findings = [
        *(
            Finding(check="regime", label=name, value=error, limit=thresholds.regime_error)
            for name, error in regime_errors(predictor, probes).items()
        ),
        *_of_states("stress", predictor, probes.stressed, thresholds.stressed_error),
        *_of_states("still", predictor, probes.still, thresholds.still),
        *_precision(predictor, probes, thresholds.precision),
    ]
    if rollout is not None:
        first = rollout["first_frame_outside"]
        detail = "" if first is None else f"first at frame {first} of {rollout['frames']}"
        findings.append(
            Finding(
                check="density",
                label="integrated density",
                value=rollout["largest"],
                limit=thresholds.density,
                detail=detail,
            )
        )
    return findings


def regime_errors(predictor: Predictor, probes: Probes) -> dict[str, float]:
    """Mean squared error in each regime by its scale."""
    errors = torch.cat([squared_errors(predictor, probe) for probe in probes.plain])
    return {name: _finite(errors[each.members].mean() / each.scale) for name, each in probes.regimes.items()}


def stressed_error(predictor: Predictor, probe: Probe) -> float:
    """Mean squared error of the affected particles by the probe's scale; 0 if there are none."""
    if not probe.affected.any():
        return 0.0
    return _finite(squared_errors(predictor, probe)[probe.affected].mean() / probe.scale)


def squared_errors(predictor: Predictor, probe: Probe) -> Tensor:
    """Squared error of each fluid particle, mean over components, (N,), float64."""
    return (predictor.predict(probe.frame, probe.scene).double() - probe.target).square().mean(dim=1)


def precision(predictor: Predictor, probe: Probe, typical: float) -> float:
    """Largest difference between predictions in float32 and float64, by the root of the typical mean square."""
    exact = predictor.predict_exactly(probe.frame, probe.scene).double()
    return _finite((predictor.predict(probe.frame, probe.scene).double() - exact).abs().max() / math.sqrt(typical))


def density_rollout(predictor: Predictor, probes: Probes, limit: float = 0.02) -> dict | None:
    r"""Deviation of the density that follows from a predicted rate, along stored frames.

    The analytic rate is exactly the derivative of the summed density (`cconv.sph.density_rate`), so that integrated
    without error it leads back to it, and the predicted rate to

    .. math:: \rho_i(t) + \int_0^t (\dot\rho^\text{model}_i - \dot\rho_i)\, dt'

    Only that integral is taken from stored frames, by the trapezoidal rule: what the rule misses of the rate itself,
    since frames may lie far apart, is common to both rates and cancels.

    Returns:
        "frames"; "drift", the mean relative deviation at the last frame; "largest", the deviation that nineteen of
        twenty particles keep; "first_frame_outside", the first at which it exceeds `limit`, or None;
        "analytic_by_frames", how far the analytic rate alone, integrated over frames, is off. None without a rollout.
    """
    rollout = probes.rollout
    if rollout is None:
        return None
    rates = torch.stack([predictor.predict(frame, rollout.scene)[:, 0].double() for frame in rollout.frames])
    deviations = _integrated(rates - rollout.targets, rollout) / rollout.densities
    usual = deviations.abs().nan_to_num(math.inf).quantile(USUAL, dim=1)
    outside = (~(usual <= limit)).nonzero()[:, 0]
    alone = (rollout.densities[0] + _integrated(rollout.targets, rollout)) / rollout.densities - 1
    return {
        "frames": len(rollout.frames),
        "drift": _finite(deviations[-1].mean()),
        "largest": _finite(usual.max()),
        "first_frame_outside": int(outside[0]) if len(outside) else None,
        "analytic_by_frames": _finite(alone.abs().quantile(USUAL, dim=1).max()),
    }


def _finite(value: Tensor | float) -> float:
    return float(value) if math.isfinite(value) else NOT_FINITE


def _integrated(rates: Tensor, rollout: Rollout) -> Tensor:
    """Integral (T, N) of rates (T, N) from the first frame to each, by the trapezoidal rule."""
    steps = rollout.scene.frame_dt * (rates[1:] + rates[:-1]) / 2
    return torch.cat([torch.zeros_like(rates[:1]), steps.cumsum(dim=0)])


def _of_states(check: str, predictor: Predictor, probes: Sequence[Probe], limit: float) -> Iterable[Finding]:
    """The worst of each state over the frames that were put into it."""
    found = [
        Finding(check=check, label=probe.name, value=stressed_error(predictor, probe), limit=limit, detail=probe.origin)
        for probe in probes
    ]
    return _largest_by_label(found)


def _precision(predictor: Predictor, probes: Probes, limit: float) -> Iterable[Finding]:
    found = [
        Finding(
            check="precision",
            label="float32",
            value=precision(predictor, probe, probes.typical),
            limit=limit,
            detail=f"{probe.name}, {probe.origin}",
        )
        for probe in probes.stressed
        if probe.name in PRECISE_STATES
    ]
    return _largest_by_label(found)


def _largest_by_label(findings: Iterable[Finding]) -> list[Finding]:
    ordered = sorted(findings, key=lambda each: each.label)
    largest = {
        label: max(group, key=lambda each: each.value) for label, group in groupby(ordered, lambda each: each.label)
    }
    return [largest[label] for label in dict.fromkeys(each.label for each in findings)]


def _worst(findings: Mapping[str, Sequence[Finding]]) -> list[Finding]:
    """The finding with the largest value of each check and label, over seeds."""
    return [max(same, key=lambda each: each.value) for same in zip(*findings.values(), strict=True)]


def _failures(findings: Mapping[str, Sequence[Finding]], worst: Sequence[Finding]) -> list[str]:
    """A line for each finding beyond its limit, with the seeds that it is of."""
    lines = []
    for place, finding in enumerate(worst):
        if not finding.passes:
            seeds = [name for name, found in findings.items() if not found[place].passes]
            where = [finding.detail] if finding.detail else []
            where += [f"seeds {', '.join(seeds)} of {len(findings)}"] if len(findings) > 1 else []
            lines.append("; ".join([_in_words(finding), *where]))
    return lines


def _in_words(finding: Finding) -> str:
    limit = f"(limit {finding.limit:g})"
    return {
        "regime": f"error {finding.value:.3g} in regime {finding.label} {limit}",
        "stress": f"error {finding.value:.3g} on the frame {finding.label} {limit}",
        "still": f"rate {finding.value:.3g} where nothing changes, {finding.label} {limit}",
        "precision": f"{finding.label} is {finding.value:.3g} from float64 {limit}",
        "density": f"{finding.label} deviates by {finding.value:.3g} {limit}",
    }[finding.check]
