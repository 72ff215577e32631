"""The drawing of losses: where its lines are, and what is left out of them."""

import math
import re
import xml.etree.ElementTree as ElementTree

import pytest

from warpshadow.viewer.loss_plot import COLORS, loss_plot


def lines(svg):
    """Points and color of each polyline."""
    found = []
    for line in ElementTree.fromstring(svg).iter("polyline"):
        points = [tuple(map(float, point.split(","))) for point in line.get("points").split()]
        found.append((points, line.get("stroke")))
    return found


def test_each_descent_is_a_line_in_the_color_of_its_stage_one_after_another():
    drawn = lines(loss_plot([[[1.0, 0.5], [2.0]], [[0.1, 0.01, 0.001]]]))
    assert [color for _, color in drawn] == [COLORS[0], COLORS[0], COLORS[1]]
    assert [len(points) for points, _ in drawn] == [2, 1, 3]
    columns = [x for points, _ in drawn for x, _ in points]
    assert columns == sorted(columns) and len(set(columns)) == 6


def test_equal_factors_are_equal_heights():
    ((points, _),) = lines(loss_plot([[[1.0, 0.1, 0.01]]]))
    first, second, third = (y for _, y in points)
    assert first < second < third  # downwards
    assert second - first == pytest.approx(third - second, abs=0.11)  # of a tenth of a pixel


def test_lines_stay_within_the_drawing_and_labels_say_what_they_are_at():
    svg = loss_plot([[[3.0, 0.004]]])
    width, height = map(float, re.search(r'viewBox="0 0 (\d+) (\d+)"', svg).groups())
    assert all(0 <= x <= width and 0 <= y <= height for points, _ in lines(svg) for x, y in points)
    labels = {text.text: float(text.get("y")) for text in ElementTree.fromstring(svg).iter("text")}
    assert {"1", "0.1", "0.01", "2 iterations"} <= set(labels)
    assert labels["1"] < labels["0.1"] < labels["0.01"]


def test_many_iterations_are_drawn_by_few_points_the_last_among_them():
    losses = [1 / (1 + n) for n in range(100_000)]
    ((points, _),) = lines(loss_plot([[losses]]))
    assert len(points) < 700
    ((ends, _),) = lines(loss_plot([[losses[:1] + [0.5] * 99_998 + losses[-1:]]]))
    assert points[-1] == ends[-1]


@pytest.mark.parametrize("stages", [[], [[]], [[[]], [[]]], [[[0.0, math.nan, math.inf]]]])
def test_without_a_loss_there_is_nothing_to_draw(stages):
    assert loss_plot(stages) == ""


def test_losses_of_0_are_left_out():
    ((points, _),) = lines(loss_plot([[[1.0, 0.0, 0.1]]]))
    assert len(points) == 2
