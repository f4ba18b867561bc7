"""What a call of the command line must give."""


def assert_one_clear_line(outcome, *words):
    """Bad input: exit status 2, nothing on stdout, one line on stderr that holds the words."""
    status, out, error = outcome
    assert status == 2
    assert out == ""
    assert error.startswith("cconv: ")
    assert error.count("\n") == 1
    assert "Traceback" not in error
    assert [word for word in words if word not in error] == []
