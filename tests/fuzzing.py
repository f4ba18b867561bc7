"""Hostile values for fuzz tests, changes of valid documents and bytes, and what must hold of each call."""

import contextlib
import copy
import io
import json
import resource
import signal
import sys
import tomllib
from pathlib import Path
from unittest import mock

import pytest
import tomli_w
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from cconv.cli import main

SECONDS, BYTES = 20, 2 * 2**30  # of one call


def examples(count):
    """The same `count` examples in every run."""
    checks = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example]
    return settings(max_examples=count, derandomize=True, database=None, deadline=None, suppress_health_check=checks)


def nested(depth):
    value = []
    for _ in range(depth):
        value = [value]
    return value


numbers = st.sampled_from([0, 1, -1, 2**31, 2**63, 2**64, 10**400, 0.0, -0.5, 1e-300, 1e300, 1e12, True, False]) | (
    st.floats() | st.integers()
)
strings = st.sampled_from(
    [
        "",
        "a",
        "../../evil",
        "/tmp/evil",
        "r[0-9]*",
        "[/red]",
        "a\nb",
        "\x1b[2J",
        "\x00",
        "x" * 5000,
        "random_0",
        "baseline",
    ]
) | st.text(max_size=8)
containers = st.sampled_from([[], {}, [[]], nested(40), nested(200), [1000, 1000], [float("nan")], {"a": {"b": 1}}])
values = numbers | strings | containers


def places(document, above=()):
    """Path of every value of a nested document, tables and arrays too."""
    inner = document.items() if isinstance(document, dict) else enumerate(document)
    for key, value in inner:
        yield (*above, key)
        if isinstance(value, dict | list):
            yield from places(value, (*above, key))


@st.composite
def changed(draw, document):
    """A document with one value replaced, taken away or put under another key."""
    document = copy.deepcopy(document)
    *above, key = draw(st.sampled_from(list(places(document))))
    place = document
    for step in above:
        place = place[step]
    change = draw(st.sampled_from(["replace", "replace", "remove", "rename"]))
    if change == "replace":
        place[key] = draw(values)
    else:
        value = place.pop(key)
        if change == "rename" and isinstance(place, dict):
            place[draw(strings)] = value
    return document


@st.composite
def changed_bytes(draw, content):
    """Bytes with a piece cut out, doubled or replaced."""
    start = draw(st.integers(0, len(content)))
    stop = min(len(content), start + draw(st.integers(0, 200)))
    piece = draw(st.binary(max_size=20) | st.sampled_from([content[start:stop] * 2, b"[" * 3000, b'"', b"a." * 3000]))
    return content[:start] + piece + content[stop:]


def changed_text(text, document, write):
    """Three times in four a changed document, written again; else changed bytes."""
    written = changed(document).map(lambda document: write(document).encode(errors="surrogatepass"))
    return st.integers(0, 3).flatmap(lambda number: written if number else changed_bytes(text.encode()))


def changed_toml(text):
    return changed_text(text, tomllib.loads(text), tomli_w.dumps)


def changed_json(text):
    return changed_text(text, json.loads(text), json.dumps)


@contextlib.contextmanager
def limits():
    """An exception for what takes too much processor time or memory."""
    data = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmData"))
    before = resource.getrlimit(resource.RLIMIT_DATA)

    def stop(number, frame):
        raise TimeoutError(f"more than {SECONDS} s of processor time")

    earlier = signal.signal(signal.SIGPROF, stop)
    resource.setrlimit(resource.RLIMIT_DATA, (int(data.split()[1]) * 1024 + BYTES, before[1]))
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        resource.setrlimit(resource.RLIMIT_DATA, before)
        signal.signal(signal.SIGPROF, earlier)


def check_call(*arguments, statuses=(0, 2)):
    """Run the command line; its status is one of `statuses`, and 2 comes with one line."""
    out, error = io.StringIO(), io.StringIO()
    arguments = ["cconv", *(str(argument) for argument in arguments)]
    with contextlib.ExitStack() as stack:
        for context in (contextlib.redirect_stdout(out), contextlib.redirect_stderr(error), limits()):
            stack.enter_context(context)
        stack.enter_context(mock.patch.object(sys, "argv", arguments))
        ended = stack.enter_context(pytest.raises(SystemExit))
        main()
    status = ended.value.code or 0
    assert status in statuses
    if status == 2:
        assert out.getvalue() == ""
        assert error.getvalue().startswith("cconv: ")
        assert error.getvalue().count("\n") == 1
        assert "\x1b" not in error.getvalue()
    return status
