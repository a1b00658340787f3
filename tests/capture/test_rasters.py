import cv2
import numpy as np
import pytest
from pycocotools import mask as coco
from skimage.measure import approximate_polygon, find_contours

from splatart_ns.capture import rasters
from splatart_ns.capture.rasters import decode_runs, decompress_runs


def fill_polygon(corners, width, height):
    image = np.zeros((height, width), np.uint8)
    rasters.fill_polygon(image, corners, 1)
    return image.astype(bool)


def test_a_polygon_takes_the_pixels_whose_centre_it_holds():
    corners = np.array([[1.0, 1.0], [4.0, 1.0], [4.0, 3.0], [1.0, 3.0]])
    expected = np.zeros((5, 6), bool)
    expected[1:3, 1:4] = True
    for around in (corners, corners[::-1], np.roll(corners, 1, axis=0), corners + 0.49, corners - 0.49):
        np.testing.assert_array_equal(fill_polygon(around, 6, 5), expected)


def test_a_polygon_agrees_with_the_centres_tested_one_by_one():
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:40, :50] + 0.5
    beyond = np.array([[2, 0], [8, 0], [10, 2], [50, 2], [50, 36], [46, 40], [2, 40], [0, 38], [0, 2]], float)
    drawn = [rng.uniform(-20, 70, (n, 2)) for n in (3, 5, 9, 600)]
    drawn += [rng.integers(0, 40, (9, 2)).astype(float), rng.integers(0, 80, (9, 2)) / 2]
    for corners in (*drawn, beyond, beyond - 2):
        crossings = np.zeros((40, 50), int)
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            with np.errstate(divide="ignore", invalid="ignore"):
                crossings += ((y0 > y) != (y1 > y)) & (x >= x0 + (y - y0) / (y1 - y0) * (x1 - x0))
        np.testing.assert_array_equal(fill_polygon(corners, 50, 40), crossings % 2 == 1)


def test_polygons_that_share_edges_leave_no_gap_and_share_no_pixel():
    rng = np.random.default_rng(0)
    middle = rng.uniform(10, 20, 2)
    rim = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 30.0], [0.0, 30.0]])
    fan = [np.stack([middle, rim[i], rim[(i + 1) % 4]]) for i in range(4)]
    np.testing.assert_array_equal(sum(fill_polygon(c, 30, 30).astype(int) for c in fan), 1)


@pytest.mark.parametrize("far", [1e11, -1e11])
def test_a_polygon_far_away_or_empty_has_no_pixel(far):
    assert not fill_polygon(np.array([[far, far], [far + 9, far], [far, far + 9]]), 8, 8).any()
    assert not fill_polygon(np.full((3, 2), 2.5), 8, 8).any()


def test_polygons_agree_with_pycocotools_but_for_pixels_on_the_edge():
    angle = np.linspace(0, 2 * np.pi, 30)[:-1]
    corners = 50 + np.stack([40 * np.cos(angle), 30 * np.sin(angle)], axis=1)
    theirs = coco.decode(coco.frPyObjects([corners.ravel().tolist()], 100, 100))[..., 0].astype(bool)
    differ = fill_polygon(corners, 100, 100) != theirs
    edge = cv2.polylines(np.zeros((100, 100), np.uint8), [np.rint(corners).astype(np.int32)], True, 1, 3)
    assert not differ[edge == 0].any() and differ.sum() < 200


def blobs(seed):
    """A mask [90, 120] of a few smooth blobs without holes, some at the border."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(90, 120)), (0, 0), 6)
    found = cv2.findContours((noise > 0.03).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    large = [c for c in found if cv2.contourArea(c) > 30]
    return cv2.drawContours(np.zeros((90, 120), np.uint8), large, -1, 1, cv2.FILLED).astype(bool)


@pytest.mark.parametrize("approximation", [cv2.CHAIN_APPROX_NONE, cv2.CHAIN_APPROX_SIMPLE])
@pytest.mark.parametrize("seed", range(3))
def test_a_contour_of_a_mask_by_opencv_is_the_mask(seed, approximation):
    mask = blobs(seed)
    contours = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, approximation)[0]
    assert len(contours) > 1
    again = np.zeros(mask.shape, bool)
    for contour in contours:
        shares = contour[:, 0] / [120, 90]
        written = np.array([[float(f"{x:g}") for x in corner] for corner in shares]) * [120, 90]  # as YOLO's tools do
        for corners in (contour[:, 0].astype(float), written):
            again |= (one := fill_polygon(corners, 120, 90))
            np.testing.assert_array_equal(one, fill_polygon(corners[::-1], 120, 90))
    np.testing.assert_array_equal(again, mask)


@pytest.mark.parametrize("seed", range(3))
def test_a_contour_of_a_mask_by_scikit_image_is_the_mask(seed):
    mask = blobs(seed)
    contours = [c[:, ::-1] - 1 for c in find_contours(np.pad(mask, 1).astype(float), 0.5)]
    assert len(contours) > 1
    again = sum(fill_polygon(c[:-1].clip(0), 120, 90) for c in contours)
    np.testing.assert_array_equal(again, mask)
    again = sum(fill_polygon(approximate_polygon(c, 1.0).clip(0), 120, 90) for c in contours) > 0
    aside = [np.roll(mask, [y, x], [0, 1]) for y, x in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    assert (again != mask).sum() < min((other != mask).sum() for other in aside)


def test_a_polygon_along_pixel_borders_is_no_contour_of_a_mask():
    heights = np.random.default_rng(0).integers(1, 20, 30)
    x = np.repeat(np.arange(31), 2)
    corners = np.stack([x, [0, *np.repeat(heights, 2), 0]], axis=1).astype(float)
    expected = np.pad(np.arange(20)[:, None] < heights, [(0, 5), (0, 5)])
    np.testing.assert_array_equal(fill_polygon(corners, 35, 25), expected)


@pytest.mark.parametrize("shape", [(7, 5), (1, 1), (1, 300), (300, 1), (200, 180)])
def test_runs_agree_with_pycocotools(shape):
    rng = np.random.default_rng(0)
    for density in (0.0, 0.01, 0.5, 1.0):
        mask = rng.random(shape) < density
        text = coco.encode(np.asfortranarray(mask.astype(np.uint8)))["counts"].decode()
        np.testing.assert_array_equal(decode_runs(decompress_runs(text), shape[1], shape[0]), mask)
