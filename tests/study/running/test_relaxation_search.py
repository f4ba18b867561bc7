"""Proposals of relaxations follow from seed and records alone, and go where good ones were found."""

import math

import pytest
from summaries import tried_relaxation

from cconv.study.records.found import TriedRelaxation
from cconv.study.running.relaxation_search import ALPHA, BETA, LOOPS, PUBLISHED, propose_relaxation

PLAIN = tried_relaxation(0, 1.0)


def judged(relaxation):
    """A record of a relaxation whose quality is best at alpha 0.01."""
    quality = 0.1 + math.log(relaxation.alpha / 0.01) ** 2
    return TriedRelaxation(**tried_relaxation(1, quality).model_dump() | relaxation.model_dump())


def searched(count, seed=0):
    tried = [PLAIN]
    for _ in range(count):
        tried.append(judged(propose_relaxation(tried, seed)))
    return tried


def test_the_published_settings_come_first():
    found = searched(4)[1:]
    assert [(each.alpha, each.beta, each.loops) for each in found[:3]] == [
        (each.alpha, each.beta, each.loops) for each in PUBLISHED
    ]


def test_a_search_that_was_interrupted_goes_on_as_if_it_had_not_been():
    tried = searched(12)
    assert judged(propose_relaxation(tried[:9], 0)) == tried[9]
    assert judged(propose_relaxation(tried[:9], 1)) != tried[9]


def test_proposals_are_within_the_ranges_and_come_near_the_best():
    tried = searched(30)[1:]
    for each in tried:
        for value, (low, high) in ((each.alpha, ALPHA), (each.beta, BETA), (each.loops, LOOPS)):
            assert low <= value <= high
    assert min(each.quality for each in tried) == pytest.approx(0.1, abs=0.05)
