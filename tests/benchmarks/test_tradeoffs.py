import math

import pytest
from tradeoffs import growth, paired_ratio, pareto_front


def test_front_has_what_no_point_beats():
    points = [(3.0, 1.0), (1.0, 5.0), (2.0, 2.0), (2.5, 2.0), (4.0, 3.0), (3.0, 1.0)]
    assert pareto_front(points) == [1, 2, 0, 5]


def test_points_without_a_figure_are_not_on_the_front():
    assert pareto_front([(math.nan, 0.0), (1.0, math.inf), (2.0, 3.0)]) == [2]
    assert pareto_front([]) == []


def test_growth_finds_the_power():
    sizes = [1.0, 2.0, 4.0, 8.0]
    found = growth(sizes, [3 * s**1.5 for s in sizes])
    assert found.slope == pytest.approx(1.5) and found.last == pytest.approx(1.5)


def test_a_constant_part_flattens_the_slope_and_less_so_at_the_end():
    sizes = [1.0, 2.0, 4.0, 8.0]
    found = growth(sizes, [5 + s for s in sizes])
    assert found.slope < found.last < 1


def test_growth_takes_the_median_of_repeated_sizes_at_the_end():
    assert growth([1, 1, 1, 2, 2, 2], [1, 1, 1, 2, 2, 50]).last == pytest.approx(1)
    assert growth([3, 3], [1, 2]) is None


def test_ratios_are_of_runs_that_both_have():
    ratio, count = paired_ratio({"a": 2.0, "b": 8.0, "c": 100.0, "d": math.inf}, {"a": 1.0, "b": 1.0, "d": 1.0})
    assert ratio == pytest.approx(4) and count == 2
    assert math.isnan(paired_ratio({"a": 1.0}, {"b": 1.0})[0])
