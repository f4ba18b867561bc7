"""The verdict on the stability of a model: the findings of every check in all its seeds."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from cconv.evaluation.checks.check import Check, Finding


def measure_stability(seeds: Mapping[str, Any], checks: Sequence[Check], counts: Mapping[str, int]) -> dict:
    """Run all checks on all seeds of a model.

    Args:
        seeds: Each training of the model, by name.
        checks: The checks to run.
        counts: Numbers of frames or rollouts that the checks look at.

    Returns:
        "stable", whether all seeds keep every limit; "findings", those of the worst seed for each check and label;
        "failures", one line for each that is beyond its limit, with the seeds if there are several; "counts" of seeds
        and of what was looked at.
    """
    findings, failures = [], []
    of_seeds = {name: [check.findings(predictor) for check in checks] for name, predictor in seeds.items()}
    for place, check in enumerate(checks):
        found = {name: of_checks[place] for name, of_checks in of_seeds.items()}
        worst = [max(same, key=lambda each: each.value) for same in zip(*found.values(), strict=True)]
        findings += [asdict(finding) for finding in worst]
        failures += _failures(check, found, worst)
    return {
        "stable": not failures,
        "findings": findings,
        "failures": failures,
        "counts": {"seeds": len(seeds), **counts},
    }


def _failures(check: Check, found: Mapping[str, Sequence[Finding]], worst: Sequence[Finding]) -> list[str]:
    """Write a line for each finding beyond its limit, with the seeds that failed."""
    lines = []
    for place, finding in enumerate(worst):
        if not finding.passes:
            seeds = [name for name, findings in found.items() if not findings[place].passes]
            where = f"; seeds {', '.join(seeds)} of {len(found)}" if len(found) > 1 else ""
            lines.append(f"{check.in_words(finding)}{where}")
    return lines
