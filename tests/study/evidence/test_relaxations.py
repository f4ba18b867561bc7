"""The choice among relaxations: fewest loops within 10 % of the best, and none where none helps."""

from summaries import relaxations, tried_relaxation

from cconv.study.evidence.relaxations import chosen_relaxation, relaxation_front

PLAIN = tried_relaxation(0, 1.0)


def test_the_fewest_loops_within_ten_percent_of_the_best_are_chosen():
    tried = [PLAIN, tried_relaxation(5, 0.20), tried_relaxation(3, 0.21), tried_relaxation(1, 0.23)]
    assert chosen_relaxation(tried) == 2
    assert chosen_relaxation([*tried, tried_relaxation(3, 0.205)]) == 4
    assert chosen_relaxation([*tried, tried_relaxation(1, 0.22)]) == 4


def test_none_is_chosen_where_none_helps_by_more():
    assert chosen_relaxation([PLAIN]) == 0
    assert chosen_relaxation([PLAIN, tried_relaxation(1, 0.92), tried_relaxation(5, 3.0)]) == 0
    assert chosen_relaxation([PLAIN, tried_relaxation(1, 0.90)]) == 1


def test_one_that_diverges_is_not_chosen_unless_all_do():
    diverging = tried_relaxation(1, 0.1, reason="positions are not finite")
    assert chosen_relaxation([PLAIN, diverging]) == 0
    assert chosen_relaxation([tried_relaxation(0, 1.0, reason="clumped"), diverging]) == 1


def test_no_relaxation_beats_one_of_the_front_in_both():
    tried = relaxations("a").models["a"].tried
    front = relaxation_front(tried)
    assert front == [0, 1, 3, 2]
    for number, each in enumerate(tried):
        worse = [tried[other] for other in front if tried[other].loops <= each.loops]
        assert (number in front) == (each.quality <= min(other.quality for other in worse))
