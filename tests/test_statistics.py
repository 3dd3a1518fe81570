"""Statistics of result tables against numbers worked out by hand, or printed in the paper."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_dce.experiments.paper import gym_rows, leaders, paper_score, paper_scores, paper_total
from sb3_dce.experiments.statistics import (
    N_RESAMPLES,
    Interval,
    bootstrap_interval,
    iqm,
    mean_interval,
    mean_of_tasks,
    performance_profile,
    probability_of_improvement,
    sample_std,
    total,
    trimmed_mean,
)
from sb3_dce.student import std_factors, student_quantile


def test_interquartile_mean_of_one_to_eight() -> None:
    assert iqm([np.arange(1, 5), np.arange(5, 9)]) == 4.5


def test_interquartile_mean_gives_edges_the_rest_of_their_weight() -> None:
    # half of the weight of five numbers is 2.5: all of the third, three quarters of the second and fourth
    assert trimmed_mean(np.array([0.0, 1.0, 2.0, 5.0, 100.0])) == pytest.approx((0.75 * 1 + 2 + 0.75 * 5) / 2.5)
    assert trimmed_mean(np.array([[3.0], [4.0]])).tolist() == [3.0, 4.0]


def test_probability_of_improvement_of_the_checked_example() -> None:
    assert probability_of_improvement([np.array([1, 2, 3])], [np.array([2, 2, 4])]) == pytest.approx(1 / 3)


def test_probability_of_improvement_is_averaged_over_tasks_of_different_size() -> None:
    better, equal = (np.array([2.0, 3.0]), np.array([1.0])), (np.array([5.0]), np.array([5.0, 5.0, 5.0]))
    assert probability_of_improvement([better[0], equal[0]], [better[1], equal[1]]) == pytest.approx(0.75)


def test_deviation_has_divisor_n_minus_one() -> None:
    assert sample_std(np.array([1.0, 2.0, 3.0, 4.0])) == pytest.approx(1.2909944)
    assert np.isnan(sample_std(np.array([1.0])))


def test_performance_profile_is_the_share_above_each_threshold() -> None:
    scores = [np.array([0.0, 10.0]), np.array([20.0, 30.0])]
    assert performance_profile(scores, np.array([-1.0, 0.0, 15.0, 30.0])).tolist() == [1.0, 0.75, 0.5, 0.0]


def test_bootstrap_draws_seeds_within_tasks() -> None:
    # every task is constant: whatever is drawn, the mean stays, though the tasks lie far apart
    assert bootstrap_interval([np.full(3, 0.0), np.full(5, 100.0)]) == Interval(50.0, 50.0)


def test_bootstrap_interval_of_a_large_sample_is_that_of_the_normal_distribution() -> None:
    values = np.random.default_rng(1).standard_normal(400)
    low, high = bootstrap_interval([values])
    half = 1.96 * values.std(ddof=1) / np.sqrt(400)
    assert low == pytest.approx(values.mean() - half, abs=0.02) and high == pytest.approx(values.mean() + half, abs=0.02)


def test_bootstrap_has_a_fixed_seed_and_takes_any_aggregate() -> None:
    scores = [np.array([1.0, 5.0, 9.0]), np.array([2.0, 4.0, 6.0])]
    assert bootstrap_interval(scores, iqm) == bootstrap_interval(scores, iqm)
    assert bootstrap_interval(scores, iqm) != bootstrap_interval(scores, mean_of_tasks)


@pytest.mark.parametrize(
    ("method", "mean", "printed", "std", "standard_error"),
    [
        ("DCE", 791.8, 73.3, 28.1, 12.6),
        ("PBRL", 805.3, 78.6, 37.3, 16.7),
        ("IQL", 720.8, 60.0, 22.3, 10.0),
        ("TD3-BC", 698.5, 53.7, 23.5, 10.5),
        ("CQL", 729.0, 34.2, 12.8, 5.7),
    ],
)
def test_paper_prints_the_sum_of_the_row_deviations(
    method: str, mean: float, printed: float, std: float, standard_error: float
) -> None:
    found = paper_total(method, gym_rows())
    assert found is not None
    assert (round(found.mean, 1), round(found.paper_std, 1), round(found.std, 1)) == (mean, printed, std)
    assert round(found.std / np.sqrt(5), 1) == standard_error


def test_total_counts_a_row_without_deviation_as_exact() -> None:
    assert total([1.0, 2.0], [float("nan"), 3.0]) == (3.0, 3.0, 3.0)


def test_printed_tables_are_read_whole() -> None:
    assert len(paper_scores()) == 203 and len(gym_rows()) == 12
    assert paper_score("pen-human-v0", "DCE") == (85.1, 37.0, True)
    assert paper_score("halfcheetah-medium-v2", "PBRL") == (57.9, 1.5, True)
    kitchen = paper_total("DCE", ["kitchen-complete-v0", "kitchen-partial-v0", "kitchen-mixed-v0"])
    assert kitchen is not None and kitchen.mean == pytest.approx(157.8)
    assert paper_total("PBRL", ["kitchen-mixed-v0"]) is None, "a dash is no number"
    assert sum(leader == "DCE" for name, leader in leaders(gym_rows()).items() if "expert" not in name) == 5


def test_bootstrap_interval_has_the_percentiles_of_the_binomial_distribution() -> None:
    # Bin(50, 1/2): P(X <= 17) = 0.016, P(X <= 18) = 0.032
    assert bootstrap_interval([np.repeat([0.0, 1.0], 25)]) == pytest.approx((18 / 50, 32 / 50))
    # as many draws as seeds: Bin(4, 1/4), P(X = 4) = 0.004, P(X >= 3) = 0.051
    assert bootstrap_interval([np.array([0.0, 0.0, 0.0, 1.0])]) == (0.0, 0.75)
    assert N_RESAMPLES == 2000, "the least that the protocol asks for"


def test_intervals_that_touch_overlap() -> None:
    assert Interval(0.0, 1.0).overlaps(Interval(1.0, 2.0)) and Interval(1.0, 2.0).overlaps(Interval(0.0, 1.0))
    assert not Interval(0.0, 1.0).overlaps(Interval(1.1, 2.0))


def test_iqm_is_over_all_runs_and_not_over_tasks() -> None:
    # 0 0 [0 0 1 2] 3 100
    assert iqm([np.zeros(4), np.array([1.0, 2.0, 3.0, 100.0])]) == 0.75


def test_a_task_with_more_seeds_weighs_no_more() -> None:
    few, many = [np.array([10.0]), np.array([0.0, 30.0])], [np.array([10.0]), np.array([0.0, 0.0, 0.0, 30.0, 30.0, 30.0])]
    assert iqm(few) == pytest.approx(iqm(many)) == 10.0
    limits = np.array([5.0, 15.0])
    assert performance_profile(few, limits).tolist() == performance_profile(many, limits).tolist() == [0.75, 0.25]


@pytest.mark.parametrize(("freedom", "quantile"), [(1, 12.706), (2, 4.303), (4, 2.776), (7, 2.365), (20, 2.086), (60, 2.000)])
def test_student_quantile_is_that_of_the_tables(freedom: float, quantile: float) -> None:
    assert student_quantile(freedom) == pytest.approx(quantile, rel=3e-4)


@pytest.mark.parametrize(("level", "quantile"), [(0.99, 4.604), (0.999, 8.610)])
def test_student_quantile_of_other_levels(level: float, quantile: float) -> None:
    assert student_quantile(4, level) == pytest.approx(quantile, rel=3e-4)


@pytest.mark.parametrize(
    ("n", "level", "factors"), [(5, 0.95, (0.599, 2.874)), (2, 0.95, (0.446, 31.91)), (5, 0.99, (0.519, 4.396))]
)
def test_interval_of_a_standard_deviation_is_that_of_chi_square(n: int, level: float, factors: tuple[float, float]) -> None:
    assert std_factors(n, level) == pytest.approx(factors, rel=2e-3)


def test_interval_of_a_mean_reaches_beyond_the_range_of_three_seeds() -> None:
    low, high = mean_interval(np.array([1.0, 2.0, 3.0]))
    assert (low, high) == pytest.approx((2.0 - 4.3027 / 3**0.5, 2.0 + 4.3027 / 3**0.5), abs=1e-4)
