"""Pictures of studies as SVG: what is on them is inside of them, and their axes can be read."""

import re

import pytest

from pup.transfer.study import Study, StudySettings
from pup.transfer.trial import Purpose, Result, Trial, TrialState
from services.gateway import drawing


def study(*distances: float) -> Study:
    trials = (
        Trial(
            "walks",
            number,
            (0.0,),
            Purpose.INITIAL,
            TrialState.SUCCEEDED,
            agent="op2",
            result=Result(TrialState.SUCCEEDED, distance, 10.0),
        )
        for number, distance in enumerate(distances, 1)
    )
    return Study("walks", StudySettings("darwin_op2", "a" * 64), trials=tuple(trials))


@pytest.mark.parametrize("distances", [(-0.1, -0.5, -0.3), (-0.6, 0.0, 0.9), (0.4,), (-0.4,)])
def test_walks_backwards_are_on_the_picture(distances):
    picture = drawing.progress(study(*distances))
    marks = re.findall(r'<circle class="initial" cx="([^"]*)" cy="([^"]*)"', picture)
    assert len(marks) == len(distances) and picture.count("grid") >= 3
    line = re.findall(r'points="([^"]*)"', picture)[0].split()
    for x, y in (*marks, *(point.split(",") for point in line)):
        assert drawing.LEFT <= float(x) <= drawing.WIDTH - drawing.RIGHT
        assert drawing.TOP <= float(y) <= drawing.HEIGHT - drawing.BOTTOM


def test_the_farthest_so_far_is_a_stair():
    (line,) = re.findall(r'class="best" points="([^"]*)"', drawing.progress(study(0.2, 0.1, 0.3)))
    heights = [float(point.split(",")[1]) for point in line.split()]
    assert heights[0] == heights[1] == heights[2] == heights[3] > heights[4] == heights[5]


@pytest.mark.parametrize("value", [0.0, 0.5, 15.0, 9999.0, -3.0])
def test_numbers_beside_an_even_line_can_be_told_apart(value):
    axes = drawing.Axes((0.0, 1.0), (value, value), drawing.WIDTH)
    numbers = re.findall(r'class="end">([^<]*)<', "".join(axes.frame("x", "y", [])))
    assert len(numbers) == len(set(numbers)) >= 3
