"""Fixtures that all tests share."""

import pytest
import torch


@pytest.fixture
def generator():
    """A seeded source of random numbers; a test's draws do not depend on other tests."""
    return torch.Generator().manual_seed(0)
