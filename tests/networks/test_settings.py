"""Settings of every network say in words what it is."""

import pytest

from cconv.networks import ARCHITECTURES


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_a_network_is_named_by_what_it_is(architecture):
    usual, deeper = (ARCHITECTURES[architecture](**settings) for settings in ({}, {"layers": 7}))
    assert usual.in_words != deeper.in_words
    assert "7" in deeper.in_words
    assert "_" not in usual.in_words
