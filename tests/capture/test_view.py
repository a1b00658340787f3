from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import trimesh

from splatart_ns.capture.capture import UNLABELLED, Normalization
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.view import load_points, load_views
from splatart_ns.errors import InputError

FILE = "state_00/transforms.json"


def test_views_hold_the_pixels_of_one_split(capture_folder):
    capture = load_capture(capture_folder)
    views = load_views(capture, 0)
    assert [v.name for v in views] == [f"images/{i:04d}.png" for i in range(6)]
    view = views[0]
    assert (view.width, view.height) == (16, 16)
    assert view.rgb.dtype == view.alpha.dtype == view.labels.dtype == torch.uint8
    assert view.rgb[6, 10].tolist() == [200, 50, 0]
    assert (view.alpha > 0).tolist() == (view.labels > 0).tolist()
    assert view.labels[6, 5] == 1 and view.labels[6, 10] == 2
    assert view.mask is None
    assert len(load_views(capture, capture.states[1], "test")) == 2
    assert load_views(capture, 1, "val") == []


def test_a_world_point_projects_as_through_the_given_opengl_camera(capture_folder):
    capture = load_capture(capture_folder)
    frame, view = capture.states[0].frames[2], load_views(capture, 0)[2]
    x_world = np.array([0.2, -0.3, 0.4])
    x_gl = np.linalg.inv(frame.T_world_camera) @ [*x_world, 1.0]
    c = frame.camera
    expected = [c.cx + c.fx * x_gl[0] / -x_gl[2], c.cy - c.fy * x_gl[1] / -x_gl[2]]
    x = torch.from_numpy(capture.normalization.scale * (x_world - capture.normalization.centre)).float()
    pixel = view.K @ (view.viewmat[:3, :3] @ x + view.viewmat[:3, 3])
    assert pixel[2] > 0
    np.testing.assert_allclose(pixel[:2] / pixel[2], expected, rtol=1e-5)
    assert view.viewmat.dtype == view.K.dtype == torch.float32


def test_an_object_that_fills_the_images_has_radius_one(capture_folder):
    view = load_views(load_capture(capture_folder), 0)[0]
    distance = view.viewmat[2, 3]  # of the normalised world's origin
    assert view.width / 2 * distance / view.K[0, 0] == pytest.approx(1, rel=1e-5)


def test_depth_is_in_the_normalised_world(capture_folder, edit):
    depth = np.zeros((16, 16), np.uint16)
    depth[6, 4:12] = 4000 + 100 * np.arange(8)
    cv2.imwrite(str(capture_folder / "state_00/d.png"), depth)
    edit(capture_folder / FILE, lambda m: m["frames"][0].update(depth_file_path="d.png", depth_unit_scale_factor=1e-3))
    capture = load_capture(capture_folder)
    first, second = load_views(capture, 0)[:2]
    assert second.depth is None and first.depth.dtype == torch.float32
    assert first.depth.numpy() == pytest.approx(depth * 1e-3 * capture.normalization.scale)
    small = load_views(capture, 0, downscale=2)[0]
    assert torch.equal(small.depth, first.depth[1::2, 1::2])  # never a mean of two surfaces
    piece = first.cropped((4, 5, 12, 8))
    assert torch.equal(piece.depth, first.depth[5:8, 4:12])
    camera = first.viewmat[:3, 3]  # where the normalised world's origin is: 4 away, which the object lies about
    assert first.depth[6, 4] == pytest.approx(float(camera[2]) * 4 / np.linalg.norm([4, 1.2]), rel=1e-5)


def test_the_object_mask_cuts_off_what_else_the_images_alpha_shows(capture_folder, edit):
    mask = np.zeros((16, 16), np.uint8)
    mask[:, :6] = 255
    cv2.imwrite(str(capture_folder / "state_00/o.png"), mask)
    edit(capture_folder / FILE, lambda m: m["frames"][0].update(object_mask_path="o.png"))
    first, second = load_views(load_capture(capture_folder), 0)[:2]
    assert first.alpha[:, :7].tolist() == second.alpha[:, :7].tolist()  # the mask's edge is left to the alpha
    assert second.alpha[6, 7] == 255 and not first.alpha[:, 7:].any()


def test_the_loss_mask_is_every_pixel_that_is_not_black(capture_folder, edit):
    mask = np.zeros((16, 16), np.uint8)
    mask[0, 0], mask[0, 1] = 7, 255
    cv2.imwrite(str(capture_folder / "state_00/m.png"), mask)
    edit(capture_folder / FILE, lambda m: m["frames"][0].update(mask_path="m.png"))
    view = load_views(load_capture(capture_folder), 0)[0]
    assert view.mask.dtype == torch.bool
    assert view.mask.nonzero().tolist() == [[0, 0], [0, 1]]
    assert (view.labels == UNLABELLED).nonzero().tolist() == (~view.mask).nonzero().tolist()


def test_frames_without_labels_or_alpha_have_none(capture_folder, edit):
    cv2.imwrite(str(capture_folder / "state_00/images/0000.png"), np.full((16, 16, 3), 9, np.uint8))
    edit(capture_folder / FILE, lambda m: m["frames"][0].pop("semantics_path"))
    view = load_views(load_capture(capture_folder), 0)[0]
    assert view.alpha is None and view.labels is None
    torch.testing.assert_close(view.rgb_on(torch.zeros(3)), torch.full((16, 16, 3), 9 / 255))


def test_an_image_whose_alpha_says_nothing_is_opaque(capture_folder, edit):
    cv2.imwrite(str(capture_folder / "state_00/images/0000.png"), np.full((16, 16, 4), 255, np.uint8))
    assert load_views(load_capture(capture_folder), 0)[0].alpha is None
    cv2.imwrite(str(capture_folder / "state_00/o.png"), np.eye(16, dtype=np.uint8) * 255)
    edit(capture_folder / FILE, lambda m: m["frames"][0].update(object_mask_path="o.png"))
    assert (load_views(load_capture(capture_folder), 0)[0].alpha > 0).tolist() == np.eye(16, dtype=bool).tolist()


def test_an_object_whose_mask_is_grey_is_opaque(capture_folder, edit):
    cv2.imwrite(str(capture_folder / "state_00/images/0000.png"), np.full((16, 16, 3), 200, np.uint8))
    cv2.imwrite(str(capture_folder / "state_00/o.png"), np.eye(16, dtype=np.uint8) * 128)
    edit(capture_folder / FILE, lambda m: m["frames"][0].update(object_mask_path="o.png"))
    assert load_views(load_capture(capture_folder), 0)[0].alpha.tolist() == (255 * np.eye(16)).tolist()


def test_the_image_is_composited_on_a_background(capture_folder):
    view = load_views(load_capture(capture_folder), 0)[0]
    background = torch.tensor([0.0, 0.5, 1.0])
    image = view.rgb_on(background)
    torch.testing.assert_close(image[0, 0], background)
    torch.testing.assert_close(image[6, 10], torch.tensor([200, 50, 0]) / 255)
    view.alpha[6, 10] = 51
    torch.testing.assert_close(view.rgb_on(background)[6, 10], 0.2 * image[6, 10] + 0.8 * background)


def test_smaller_views_have_smaller_cameras_and_unmixed_labels(capture_folder):
    capture = load_capture(capture_folder)
    large, small = load_views(capture, 0)[0], load_views(capture, 0, downscale=4)[0]
    assert (small.width, small.height) == (4, 4)
    assert small.rgb.shape == (4, 4, 3) and small.alpha.shape == small.labels.shape == (4, 4)
    torch.testing.assert_close(small.K[:2], large.K[:2] / 4)
    assert small.labels[1].tolist() == [0, 1, 2, 0]
    with pytest.raises(InputError, match="smaller factor"):
        load_views(capture, 0, downscale=32)


def test_distorted_frames_are_undistorted_together(capture_folder, edit):
    labels = cv2.imread(str(capture_folder / "state_00/labels/0000.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(capture_folder / "state_00/d.png"), 1000 * labels.astype(np.uint16))

    def change(meta):
        meta.update(k1=-0.3)
        meta["frames"][0]["depth_file_path"] = "d.png"

    edit(capture_folder / FILE, change)
    capture = load_capture(capture_folder)
    view = load_views(capture, 0)[0]
    torch.testing.assert_close(view.depth, capture.normalization.scale * view.labels.where(view.labels < 3, 0).float())
    size = (view.height, view.width)
    assert view.rgb.shape[:2] == view.alpha.shape == view.labels.shape == size
    assert view.K[0, 0] != 20
    inside = view.alpha > 250
    assert inside.any() and (view.labels[inside] > 0).all() and set(view.labels.unique().tolist()) == {0, 1, 2}


def test_a_file_of_another_size_is_an_input_error(capture_folder):
    cv2.imwrite(str(capture_folder / "state_00/labels/0001.png"), np.zeros((8, 8), np.uint8))
    with pytest.raises(InputError, match=r"0001\.png: it is 8x8 pixels"):
        load_views(load_capture(capture_folder), 0)


@pytest.mark.parametrize("coloured", [True, False])
def test_points_come_normalised_with_their_colours(tmp_path, coloured):
    xyz = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 1.0]])
    rgb = np.array([[10, 20, 30], [40, 50, 60]], np.uint8)
    trimesh.PointCloud(xyz, colors=rgb if coloured else None).export(tmp_path / "p.ply")
    points, colours = load_points(tmp_path / "p.ply", Normalization(np.array([1.0, 1.0, 1.0]), 2.0))
    torch.testing.assert_close(points, torch.tensor([[0.0, 2.0, 4.0], [-2.0, -2.0, 0.0]]))
    assert colours.tolist() == (rgb.tolist() if coloured else [[128] * 3] * 2)


def test_points_go_where_the_world_of_their_state_goes(tmp_path):
    trimesh.PointCloud([[1.0, 2.0, 3.0]]).export(tmp_path / "p.ply")
    quarter_turn = np.array([[0.0, -2, 0, 5], [2, 0, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1]])  # about z, twice as large
    points, _ = load_points(tmp_path / "p.ply", Normalization(np.zeros(3), 1.0), quarter_turn)
    torch.testing.assert_close(points, torch.tensor([[1.0, 8.0, 13.0]]))


@pytest.mark.parametrize(
    "data", [None, b"", b"ply", b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", b"\x80\x04."]
)
def test_points_that_cannot_be_read_are_an_input_error(tmp_path, data):
    if data is not None:
        (tmp_path / "p.ply").write_bytes(data)
    with pytest.raises(InputError, match=r"p\.ply"):
        load_points(tmp_path / "p.ply", Normalization(np.zeros(3), 1.0))


def test_the_piece_around_the_object_is_seen_by_a_camera_of_its_own(capture_folder):
    view = load_views(load_capture(capture_folder), 0)[0]
    big = replace(view, width=200, height=160, rgb=torch.zeros(160, 200, 3, dtype=torch.uint8), labels=None)
    big.alpha = torch.zeros(160, 200, dtype=torch.uint8)
    big.alpha[70:90, 100:120] = 1
    assert (window := big.object_window()) == (80, 48, 136, 112)  # 16 pixels around, then multiples of 8
    piece = big.cropped(window)
    assert (piece.width, piece.height) == (56, 64) and piece.alpha.shape == (64, 56) and piece.rgb.shape == (64, 56, 3)
    assert piece.alpha.sum() == big.alpha.sum()
    assert (big.K - piece.K)[:2, 2].tolist() == [80, 48] and torch.equal(piece.viewmat, big.viewmat)
    big.alpha[159, 199] = 255
    assert big.object_window() == (80, 48, 200, 160)


@pytest.mark.parametrize("alpha", [None, 0])
def test_where_no_image_says_where_the_object_is_the_piece_is_all(capture_folder, alpha):
    view = load_views(load_capture(capture_folder), 0)[0]
    view.alpha = None if alpha is None else torch.zeros_like(view.alpha)
    assert view.object_window() == (0, 0, 16, 16)
