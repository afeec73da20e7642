"""Statistics of scores, against published ones."""

import pytest

from pup.blind.statistics import calibration, rate


def test_intervals_are_those_of_clopper_and_pearson() -> None:
    assert rate(0, 150)["ci95"] == [0.0, pytest.approx(1 - 0.025 ** (1 / 150))]
    assert rate(77, 100)["ci95"] == pytest.approx([0.6751, 0.8483], abs=1e-4)
    assert rate(0, 0) == {"hits": 0, "of": 0, "rate": None, "ci95": None}
    assert calibration([], [])["ece"] is None


def test_few_claims_are_off_by_chance_and_many_are_not() -> None:
    few, many = [0.8] * 10, [0.8] * 1000
    told = calibration(few, [True] * 6 + [False] * 4)
    assert told["ece"] == pytest.approx(0.2)
    assert told["ece_chance"] == pytest.approx(0.2)  # 6 of 10 or nearer: 97 % of binomial draws
    assert calibration(many, [True] * 800 + [False] * 200)["ece_chance"] < 0.03
    assert calibration([1.0], [True])["ece_chance"] == 0.0
