"""Text files of others: what is read, and what is refused before it costs memory or time."""

import pytest

from cconv.errors import ConfigError, DataError, shown, visible
from cconv.files import DEEPEST, parse_json, parse_toml, read_json, read_text, read_toml


def test_what_is_well_formed_is_read(tmp_path):
    (tmp_path / "a.json").write_text('{"a": [1, 2.5, "é", null, true]}', encoding="utf-8")
    (tmp_path / "a.toml").write_text('a.b = [0.1, 0.2]\n"quoted.key" = "a.b.c"\n')
    assert read_json(tmp_path / "a.json") == {"a": [1, 2.5, "é", None, True]}
    assert read_toml(tmp_path / "a.toml") == {"a": {"b": [0.1, 0.2]}, "quoted.key": "a.b.c"}


def test_as_deep_as_allowed_is_read_and_one_deeper_is_not():
    for parse, start in ((parse_json, ""), (parse_toml, "x = ")):
        depth = DEEPEST - bool(start)  # the table of the file counts
        parse(start + "[" * depth + "]" * depth)
        with pytest.raises(ValueError, match="inside each other"):
            parse(start + "[" * (depth + 1) + "]" * (depth + 1))


def test_numbers_in_an_array_and_prose_are_no_long_key():
    numbers = ", ".join(["0.5"] * 1000)
    prose = "e.g. this one, i.e. version 1.2.3 of it. " * 100
    assert len(parse_toml(f'x = [{numbers}]\ny = "{prose}"')["x"]) == 1000


@pytest.mark.parametrize("text", ["a." * 100_000, "a" * 10**6, '"a".' * 100_000, "'a' . " * 100_000, '"' * 10**6])
def test_long_keys_are_refused_in_little_time(text):
    with pytest.raises(ValueError, match="key|line|Expected|Cannot|Unterminated|Illegal"):
        parse_toml(f"{text}x = 1\n=")


def test_the_kind_of_error_is_the_caller_s(tmp_path):
    for error in (ConfigError, DataError):
        with pytest.raises(error, match="no such file"):
            read_text(tmp_path / "none", error=error)
    (tmp_path / "large").write_text("123456")
    with pytest.raises(DataError, match="6 bytes, and such a file has at most 5"):
        read_text(tmp_path / "large", largest=5)


def test_a_value_is_shown_in_one_short_line():
    assert shown("a\nb") == r"'a\nb'"
    assert shown(10**5000) == "a int that is too long to show"
    assert len(shown("x" * 10**6)) < 110
    assert visible("a\nb\x1b[2Jé\ud800") == r"a\nb\x1b[2Jé\ud800"
