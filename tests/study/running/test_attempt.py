"""An attempt alone may write, and is ended if it hangs."""

import subprocess
import sys

import pytest
from processes import PATIENCE

from cconv.study.running.attempt import Attempt, Hanging, Superseded

HANG = """
import sys, time
from pathlib import Path
from cconv.study.running.attempt import Attempt
with Attempt(Path(sys.argv[1]), 0.2):
    time.sleep(100)
"""


def test_the_last_attempt_has_the_right_and_leaves_nothing(tmp_path):
    with Attempt(tmp_path, 100) as lost, Attempt(tmp_path, 100) as current:
        current.check()
        with pytest.raises(Superseded, match="another process"):
            lost.check()
    assert list(tmp_path.iterdir()) == []


def test_an_attempt_that_ended_has_no_right(tmp_path):
    with Attempt(tmp_path, 100) as attempt:
        attempt.check()
    with pytest.raises(Superseded):
        attempt.check()


def test_a_superseded_attempt_leaves_its_successor_in_place_when_it_ends(tmp_path):
    lost, current = Attempt(tmp_path, 100), Attempt(tmp_path, 100)
    with lost:
        current.__enter__()
    current.check()
    current.__exit__()


@pytest.mark.integration
def test_a_process_that_hangs_is_ended_and_no_attempt_follows(tmp_path):
    assert subprocess.run([sys.executable, "-c", HANG, tmp_path], timeout=PATIENCE).returncode != 0
    with pytest.raises(Hanging, match=r"hung and was ended after 0\.2 seconds"), Attempt(tmp_path, 0.2):
        pass
