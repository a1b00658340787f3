from collections import Counter

import cv2
import numpy as np
import pytest

from splatart_ns.capture.label_steps import blurred_share, count_steps

ROWS = {
    "at once": ([0, 0, 0, 3, 3, 3, 3, 3], [1, 0]),
    "over a pixel between": ([3, 3, 3, 1, 0, 0, 0, 0], [0, 1]),
    "over two pixels between": ([0, 0, 0, 1, 2, 3, 3, 3], [0, 1]),
    "over two pixels of one part": ([0, 0, 0, 2, 2, 3, 3, 3], [0, 1]),
    "over a thin part that is not between": ([0, 0, 0, 3, 3, 2, 2, 2], [0, 0]),
    "from one part to the next": ([0, 0, 0, 1, 1, 1, 1, 1], [0, 0]),
    "to what is unlabelled": ([0, 0, 0, 255, 255, 255, 255, 255], [0, 0]),
    "to a thin part": ([0, 0, 0, 2, 2, 0, 0, 0], [0, 0]),
}


@pytest.mark.parametrize("name", ROWS)
@pytest.mark.parametrize("turned", [False, True])
def test_steps_are_counted_by_what_lies_between(name, turned):
    row, expected = ROWS[name]
    labels = np.array([row, row], np.uint8)
    steps = count_steps(labels.T if turned else labels)
    at_once = sum(number for (_, _, between), number in steps.items() if not between)
    assert [at_once, steps.total() - at_once] == [2 * number for number in expected]


@pytest.mark.parametrize("size", [(0, 0), (1, 1), (5, 7)])
def test_images_too_small_for_a_step_have_none(size):
    assert not count_steps(np.arange(size[0] * size[1], dtype=np.uint8).reshape(size))


def chest():
    """A body (1) that is a rim of a pixel beside drawers (2 to 4), and broad between them."""
    labels = np.zeros((60, 50), np.uint8)
    labels[5:55, 9:41] = 1
    for drawer in (2, 3, 4):
        labels[16 * drawer - 24 : 16 * drawer - 14, 10:40] = drawer
    return labels


def test_a_thin_part_between_others_is_not_blurred():
    steps = count_steps(chest())
    assert steps[0, 2, True] == steps[0, 4, True] == 20 and steps[1, 4, False] == 60 and not steps[0, 4, False]
    assert blurred_share(steps) == 0


@pytest.mark.parametrize(
    "spoilt",
    [
        lambda labels: cv2.blur(labels, (2, 2)),
        lambda labels: cv2.resize(labels, None, fx=1.5, fy=1.5, interpolation=cv2.INTER_LINEAR),
        lambda labels: cv2.resize(labels, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR),
    ],
)
def test_interpolated_labels_are_blurred_though_a_part_is_thin(spoilt):
    assert blurred_share(count_steps(spoilt(chest()))) > 0.3


def test_labels_without_steps_are_not_blurred():
    assert blurred_share(Counter()) == 0
