"""Summaries with everything that a study may record, for tests of the report."""

import copy

import numpy as np


def whole_summary(summary: dict) -> dict:
    """A summary with all optional keys, made of one that has none of them."""
    whole = copy.deepcopy(summary)
    ids = [entry["id"] for entry in whole["finalists"]]
    whole["search_points"] = _search_points()
    whole["analytic"] = {"ms_per_frame": 2.2, "ms_low": 2.1, "ms_high": 2.35, "geometry_ms": 1.5, "network_ms": 0.7}
    whole["analytic"]["turns_ms"] = [2.1, 2.2, 2.35]
    whole["front"] = {
        "attainment": [
            {"ms_per_frame": 1.5, "median": None, "low": None, "high": None},
            {"ms_per_frame": 3.6, "median": 2.3e-3, "low": 2.0e-3, "high": 2.8e-3},
            {"ms_per_frame": 4.2, "median": 9.5e-4, "low": 8.0e-4, "high": 1.2e-3},
        ],
        "hypervolume": {"value": 7.52, "ci95": [7.21, 7.93], "why_no_interval": "", "reference": [10.0, 1.58]},
    }
    whole["growth"] = {
        "sizes": [1000, 100_000],
        "models": {name: [_size(1000), _size(100_000)] for name in ids},
        "exponents": dict.fromkeys(ids, 1.03),
    }
    whole["rung_audit"] = [
        _rung(15, None, "undecided"),
        _rung(45, 0.6, "loses good trials"),
        _rung(135, 0.9, "keeps the best"),
    ]
    whole["references"] = {
        "strategies": {
            "ASHA": {"updates": 4000, "best_valid": 9e-4, "curve": [[400, 0.01], [4000, 9e-4]]},
            "a little, keep the best": {"updates": 3900, "best_valid": 1.2e-3, "curve": [[3900, 1.2e-3]]},
        },
        "asha_share": {"random": {"updates": 4000, "full_updates": 17857, "share": 0.224}},
    }
    whole["importance"] = importances()
    whole["partial_dependence"] = [dependence("choice", ["poly6", "none"]), dependence("log", [1e-3, 1e-2])]
    whole["ablation"] = {
        "path": [
            {"change": "baseline", "parameters": 9000, "valid_error": 0.016, "low": 0.012, "high": 0.02},
            {"change": "lost", "parameters": 90, "valid_error": None, "low": None, "high": None},
            {"change": "layers: 2", "parameters": 900, "valid_error": 0.002, "low": 0.001, "high": 0.003},
        ],
        "branches": [
            {"left_out": "dense", "normalized_mse": 0.004, "ms_per_frame": 3.9, "ratio": 4.21},
            {
                "left_out": "walls",
                "valid_error": 0.002,
                "of": 0.001,
                "flops_per_particle": 900.0,
                "parameters": {"task.features.walls": True},
            },
            {"left_out": "density", "valid_error": None, "of": 0.001, "flops_per_particle": None},
        ],
    }
    whole["mean_predictor"] = {"valid": 4.5, "test": 1.58}
    whole["selection"] = {
        "units": 5,
        "margin": 0.05,
        "best": ids[0],
        "tied": ids[:2],
        "by_rule": {"one_standard_error": ids[0], "accurate_enough": None},
        "comparisons": [_comparison(name, number) for number, name in enumerate(ids)],
        "retrained": {"normalized_mse": 0.0321, "choices": {ids[0]: 4, ids[1]: 1}},
    }
    whole["refined"] = {"network.layers": "narrowed to 1 and 2: no better trial has more"}
    whole["checks"] = {name: f"Errors of {name}." for name in ("regimes", "stress", "precision")}
    for entry in whole["finalists"]:
        entry["stability"] = stability(entry["test"]["normalized_mse"])
    return whole


def stability(error: float) -> dict:
    """Stability of a model that has this error everywhere."""
    failures = [] if error <= 0.05 else [f"error {error:.3g} on the frame clumped (limit 0.05)"]
    findings = [
        finding("regimes", "bulk", error, 0.5, "90 % of particles"),
        finding("regimes", "near_wall", error, 0.5, "10 % of particles"),
        finding("stress", "clumped", error, 0.05, "trajectory 0, frame 3"),
        finding("precision", "float32", 1e-6, 1e-3),
    ]
    counts = {"seeds": 3, "plain_frames": 20, "stressed_frames": 3}
    return {"stable": not failures, "findings": findings, "failures": failures, "counts": counts}


def finding(check: str, label: str, value: float, limit: float, detail: str = "") -> dict:
    """What a check of stability found, as it stands in a summary."""
    return {"check": check, "label": label, "value": value, "limit": limit, "detail": detail}


def importances() -> list[dict]:
    """Importances at three rungs, unknown at the first."""
    return [_unknown_importance(15), _importance(45), _importance(135)]


def dependence(scale: str, values: list) -> dict:
    """Partial dependence of a hyperparameter with these values."""
    error = [0.1 * (position + 1) for position in range(len(values))]
    return {
        "parameter": f"of {scale}",
        "scale": scale,
        "updates": 1000,
        "trials": 3,
        "surrogate_r2": None if scale == "linear" else 0.5,
        "values": values,
        "error": error,
        "low": [each / 2 for each in error],
        "high": [each * 2 for each in error],
        "points": [{"value": values[0], "error": 0.2}, {"value": values[-1], "error": 0.7}],
    }


def explanation(dim: int = 2, components: int = 1, particles: int = 60) -> dict[str, np.ndarray]:
    """Arrays as `cconv.evaluation.explanation` gives them, of an imaginary model."""
    rng = np.random.default_rng(0)
    line, radii = np.linspace(-0.2, 0.2, 21), np.linspace(0.01, 0.2, 10)
    filters = rng.normal(size=(dim, 21, dim + 2, components))
    return {
        "task": np.array("density_gradient" if components > 1 else "density_rate"),
        "particle_spacing": np.array(0.1),
        "positions": rng.uniform(size=(particles, dim)),
        "target": rng.normal(size=(particles, components)),
        "prediction": rng.normal(size=(particles, components)),
        "error": rng.uniform(size=particles),
        "feature_names": np.array(["1", *(f"v_{axis}" for axis in "xyz"[:dim]), "ρ"]),
        "is_combined": np.array(False),
        "unexplained": np.array(0.0123),
        "cutoff": np.array(0.2),
        "support": np.array(0.2),
        "line": line,
        "learned_on_axes": filters,
        "analytic_on_axes": filters + 0.1,
        "radii": radii,
        "learned_radial": -radii,
        "learned_radial_low": -radii - 0.1,
        "learned_radial_high": -radii + 0.1,
        "analytic_radial": -radii,
        "error_bins": np.logspace(-8, 3, 56),
        "error_counts": np.bincount(rng.integers(10, 40, particles), minlength=55),
        "error_levels": np.array([0.5, 1.0]),
        "error_quantiles": np.array([0.01, 0.1]),
    }


def _search_points() -> list[dict]:
    outcomes = ("completed", "stopped", "diverged")
    points = [
        {
            "id": f"{stage}_{number:04d}",
            "stage": stage,
            "valid_error": 10.0 ** (number - 3),
            "ms_per_frame": 2.0 + number,
            "measured": stage == "closed_form",
            "num_parameters": 100 * number + 7,
            "outcome": "completed" if stage == "closed_form" else outcomes[number % 3],
            "parameters": {"network.layers": 2, "network.window": "poly6", "training.learning_rate": 0.0012345},
        }
        for stage in ("closed_form", "random", "second look")
        for number in range(5)
    ]
    return [*points, points[-1] | {"id": "lost", "outcome": "diverged", "valid_error": None}]


def _size(num_particles: int) -> dict:
    ms = num_particles / 1000
    parts = {"geometry_ms": 0.6 * ms, "network_ms": 0.4 * ms}
    return {"num_particles": num_particles, "ms_per_frame": ms, "ms_low": 0.9 * ms, "ms_high": 1.1 * ms} | parts


def _rung(updates: int, value: float | None, verdict: str) -> dict:
    interval = None if value is None else [value - 0.1, value + 0.1]
    reason = "2 trials, and at least 12 are needed" if value is None else ""
    measures = dict.fromkeys(("spearman", "recall", "regret"), value)
    facts = {"updates": updates, "trials": 16, "verdict": verdict}
    return facts | measures | {"spearman_ci95": interval, "why_no_interval": reason}


def _importance(updates: int) -> dict:
    found = {"share": 0.4, "low": 0.3, "high": 0.5, "p_value": 0.01, "decided": True, "f_anova": 0.35, "ped_anova": 0.2}
    weak = found | {"share": 0.1, "low": 0.0, "p_value": 0.6, "decided": False}
    constant = weak | dict.fromkeys(("share", "low", "high", "p_value"))
    facts = {"updates": updates, "trials": 16, "censored": True, "clipped": 0, "why_none": ""}
    measured = {"detectable_share": 0.62, "surrogate_r2": 0.7, "best_share": 0.3}
    return (
        facts
        | measured
        | {"parameters": {"network.layers": found, "network.window": weak, "network.message": constant}}
    )


def _unknown_importance(updates: int) -> dict:
    facts = {"updates": updates, "trials": 16, "censored": False, "clipped": 15}
    reason = "15 of 16 trials are no better than predicting the mean"
    unknown = dict.fromkeys(("detectable_share", "surrogate_r2", "best_share"))
    return facts | unknown | {"why_none": reason, "parameters": {}}


def _comparison(name: str, number: int) -> dict:
    worse = number > 0
    return {
        "id": name,
        "error": 1e-3 * (number + 1),
        "ms_per_frame": 2.0 + number,
        "ratio": 1.0 + number,
        "ci95": [0.8 + number, 1.3 + number] if worse else [1.0, 1.0],
        "log_standard_error": 0.12 * number,
        "within_one_se": not worse,
        "non_inferior": not worse,
        "accurate_enough": None,
        "stable": True,
        "why_not": "less accurate than the margin allows" if worse else "",
    }
