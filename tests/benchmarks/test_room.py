import numpy as np
import pytest
import room

from splatart_ns.capture.rasters import fill_polygon


def disc(radius: float, hole: float = 0.0) -> np.ndarray:
    rows, columns = np.mgrid[:120, :120]
    distance = np.hypot(rows - 60.3, columns - 57.8)
    return (distance < radius) & (distance >= hole)


def filled(mask: np.ndarray) -> np.ndarray:
    drawn = np.zeros(mask.shape, np.uint8)
    for polygon in room._outlines(mask):
        fill_polygon(drawn, np.reshape(polygon, (-1, 2)), 1)
    return drawn > 0


@pytest.mark.parametrize("radius", [12.0, 20.0, 37.5])
def test_outlines_are_neither_too_wide_nor_too_narrow(radius):
    mask = disc(radius)
    wrong = filled(mask) != mask
    assert wrong.sum() < np.pi * radius  # within half a pixel of the border, in the mean
    assert abs(int(filled(mask).sum()) - int(mask.sum())) < 0.15 * 2 * np.pi * radius


def test_outlines_at_the_border_of_an_image_end_there():
    mask = np.zeros((40, 60), bool)
    mask[10:30, 35:] = True
    (polygon,) = room._outlines(mask)
    assert np.reshape(polygon, (-1, 2)).max(0).tolist() == [60.0, 30.0]
    assert (filled(mask) == mask).all()


def test_holes_are_left_out_of_sight_and_specks_are_not_drawn():
    ring = disc(30.0, hole=12.0)
    assert len(room._outlines(ring)) == 1 and filled(ring)[60, 58]
    speck = np.zeros((40, 40), bool)
    speck[5:7, 5:7] = True
    assert room._outlines(speck) == []
