"""Sentences on what so many trials can decide say as much as the figures, and never more."""

import pytest
from summaries import changed, importances

from cconv.report.decidable import decidable


@pytest.fixture
def entries():
    return importances()


def test_a_sentence_a_rung_and_none_without_importance(entries):
    assert len(decidable(entries)) == len(entries)
    assert decidable([]) == []


@pytest.mark.parametrize(("share", "percent"), [(0.4801, 49), (0.49, 49), (0.9999, 99)])
def test_the_detectable_share_is_rounded_up(entries, share, percent):
    (sentence,) = decidable([changed(entries[1], detectable_share=share)])
    assert f"decides at least {percent} % of the variance is found four times in five" in sentence
    assert "weaker ones are not shown to be absent" in sentence


def test_only_what_was_found_is_named(entries):
    judged = {name: changed(each, decided=False) for name, each in entries[1].parameters.items()}
    known, unknown = decidable([entries[1], changed(entries[1], parameters=judged)])
    assert known.endswith("Found: network.layers (40 %, 95 % interval 30 to 50 %).")
    assert unknown.endswith("Found: none.")
