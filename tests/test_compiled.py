"""Compiled functions give their results whatever state the cache on disk is in."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

MODULE = """
from cconv.compiled import compile_cached

@compile_cached(error_model="numpy")
def double(value):
    return 2 * value
"""


def call(folder: Path, cache: Path) -> str:
    """Call the function of a module in `folder` in a process of its own."""
    code = "import module; print(module.double(21), type(module.double._cache).__name__)"
    environment = {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": f"{folder}:{':'.join(sys.path)}", "HOME": str(cache)}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=folder)
    assert run.returncode == 0, run.stderr
    return run.stdout.split()[0]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "module.py").write_text(MODULE)
    return tmp_path


GARBAGE = {"empty": b"", "text": b"garbage", "cut short": b"\x80\x04"}
OFTEN = [("nbi", "text"), ("nbc", "cut short")]
OTHERS = [(suffix, kind) for suffix in ("nbi", "nbc") for kind in GARBAGE if (suffix, kind) not in OFTEN]


@pytest.mark.parametrize(
    ("suffix", "kind"), [*OFTEN, *(pytest.param(*case, marks=pytest.mark.slow) for case in OTHERS)]
)
def test_garbage_in_the_cache_is_replaced(folder, tmp_path, suffix, kind):
    cache = tmp_path / "cache"
    assert call(folder, cache) == "42"
    (kept,) = cache.rglob(f"*.{suffix}")
    whole = kept.read_bytes()
    kept.write_bytes(GARBAGE[kind])
    assert call(folder, cache) == "42"
    assert call(folder, cache) == "42"
    (mended,) = cache.rglob(f"*.{suffix}")
    assert len(mended.read_bytes()) >= 0.5 * len(whole)


def test_a_cache_that_cannot_be_written_is_done_without(folder, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert call(folder, blocked / "cache") == "42"
