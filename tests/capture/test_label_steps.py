import numpy as np
import pytest

from splatart_ns.capture.label_steps import count_steps

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
    assert (count_steps(labels.T if turned else labels) == 2 * np.array(expected)).all()


@pytest.mark.parametrize("size", [(0, 0), (1, 1), (5, 7)])
def test_images_too_small_for_a_step_have_none(size):
    assert not count_steps(np.arange(size[0] * size[1], dtype=np.uint8).reshape(size)).any()
