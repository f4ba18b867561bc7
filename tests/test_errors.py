import pytest

from cconv.errors import CConvError, ConfigError, DataError, ShapeError, check_choice, check_shape, did_you_mean


@pytest.mark.parametrize("error", [ShapeError, ConfigError, DataError])
def test_every_error_can_be_caught_as_the_package_s_own_and_as_a_value_error(error):
    assert issubclass(error, CConvError)
    assert issubclass(error, ValueError)


@pytest.mark.parametrize(
    ("shape", "expected"),
    [((), ()), ((5,), (5,)), ((5, 3), ("particles", 3)), ((0, 2), ("particles", "dim")), ([4, 1], (4, 1))],
)
def test_fitting_shape_passes(shape, expected):
    check_shape("positions", shape, expected)


@pytest.mark.parametrize(
    ("shape", "expected"),
    [((), (1,)), ((5,), (4,)), ((5, 2), ("particles", 3)), ((5,), ("particles", 3)), ((1, 5, 3), ("particles", 3))],
)
def test_other_shape_is_refused(shape, expected):
    with pytest.raises(ShapeError):
        check_shape("positions", shape, expected)


def test_shape_message_says_what_must_hold_and_what_came():
    with pytest.raises(ShapeError) as caught:
        check_shape("positions", (100, 4), ("particles", 3))
    assert str(caught.value) == "`positions` must have shape (particles, 3), got (100, 4)."


def test_known_choice_passes():
    check_choice("window", "poly6", ["none", "poly6"])


def test_choices_may_come_from_an_iterator():
    with pytest.raises(ConfigError, match="must be one of none, poly6, got 'cubic'"):
        check_choice("window", "cubic", iter(["none", "poly6"]))


def test_choice_message_lists_the_known_and_names_the_nearest():
    with pytest.raises(ConfigError) as caught:
        check_choice("window", "ploy6", ["none", "poly6", "gaussian"])
    message = "`window` must be one of none, poly6, gaussian, got 'ploy6'. Did you mean 'poly6'?"
    assert str(caught.value) == message


@pytest.mark.parametrize("value", [None, 3, 2.5, True])
def test_choice_of_another_type_is_refused(value):
    with pytest.raises(ConfigError):
        check_choice("window", value, ["none", "poly6"])


def test_nothing_near_gives_no_hint():
    assert did_you_mean("wall", ["poly6", "gaussian"]) == ""


def test_hint_for_a_value_that_is_no_string():
    assert did_you_mean(12, ["13", "poly6"]) == " Did you mean '13'?"
