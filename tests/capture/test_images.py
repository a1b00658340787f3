import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from splatart_ns.capture.capture import Camera
from splatart_ns.capture.images import (
    depth_unit,
    downscale,
    downscale_labels,
    image_size,
    read_depth,
    read_depth_for,
    read_image,
    read_labels,
    read_mask,
    read_silhouette,
    read_sized,
    undistort,
    undistort_labels,
    undistorted_camera,
    write_depth,
)
from splatart_ns.errors import InputError

RNG = np.random.default_rng(0)
DISTORTED = Camera(50.0, 52.0, 31.0, 25.0, 64, 48, (-0.25, 0.08, 0.01, 0.0, 0.002, -0.001))


def write(path, pixels):
    assert cv2.imwrite(str(path), pixels)
    return path


def test_channels_come_in_rgb_order(tmp_path):
    blue_green_red_alpha = np.zeros((2, 3, 4), np.uint8) + np.array([1, 2, 3, 4], np.uint8)
    rgba = read_image(write(tmp_path / "a.png", blue_green_red_alpha))
    assert rgba.shape == (2, 3, 4) and rgba[0, 0].tolist() == [3, 2, 1, 4]
    rgb = read_image(write(tmp_path / "b.png", blue_green_red_alpha[..., :3]))
    assert rgb.shape == (2, 3, 3) and rgb[0, 0].tolist() == [3, 2, 1]


def test_sixteen_bit_and_grey_images_become_eight_bit_rgb(tmp_path):
    deep = np.array([[0, 65535, 257 * 100, 257 * 100 + 128]], np.uint16)
    assert read_image(write(tmp_path / "a.png", deep))[0, :, 0].tolist() == [0, 255, 100, 100]
    grey = read_image(write(tmp_path / "b.png", np.full((2, 2), 7, np.uint8)))
    assert grey.shape == (2, 2, 3) and (grey == 7).all()


def test_jpeg_is_read(tmp_path):
    image = read_image(write(tmp_path / "a.jpg", np.full((16, 16, 3), (200, 100, 50), np.uint8)))
    assert np.abs(image.astype(int) - [50, 100, 200]).max() < 4


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("keep", [0, 3, 30, 0.5, -1])
def test_a_cut_off_image_is_an_input_error_and_no_more_is_written(tmp_path, capfd, suffix, keep):
    path = write(tmp_path / f"a{suffix}", RNG.integers(0, 255, (32, 32, 3), dtype=np.uint8))
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data)) if 0 < keep < 1 else keep])
    with pytest.raises(InputError, match=rf"a\{suffix}"):
        read_image(path)
    assert capfd.readouterr().err == ""


def test_a_film_behind_a_picture_does_not_make_it_cut_off(tmp_path):
    """Phones append one, whose bytes may be any."""
    pixels = np.full((32, 32, 3), 90, np.uint8)
    path = write(tmp_path / "a.jpg", pixels)
    whole = path.read_bytes()
    path.write_bytes(whole + b"\0ftypmp42\xff\xda\0")
    assert abs(read_image(path).astype(int) - 90).max() < 3
    path.write_bytes(whole[:2] + b"\xff\xff" + whole[2:])  # bytes that may fill the space before a marker
    assert abs(read_image(path).astype(int) - 90).max() < 3
    # A small picture in the header has an end, too; it is not the picture's.
    thumbnail = b"\xff\xe1" + (2 + len(whole)).to_bytes(2, "big") + whole
    path.write_bytes(whole[:2] + thumbnail + whole[2:])
    assert abs(read_image(path).astype(int) - 90).max() < 3
    path.write_bytes(whole[:2] + thumbnail + whole[2:-40])
    with pytest.raises(InputError, match="cut off"):
        read_image(path)


def test_a_missing_file_a_folder_and_a_stranger_are_input_errors(tmp_path):
    (tmp_path / "text.png").write_text("no image")
    for name in ("nothing.png", ".", "text.png"):
        for reader in (read_image, read_labels, read_mask, read_silhouette, read_depth, image_size):
            with pytest.raises(InputError):
                reader(tmp_path / name)


def test_labels_of_eight_and_sixteen_bits_are_the_same(tmp_path):
    ids = np.array([[0, 1, 254, 255]], np.uint8)
    for dtype in (np.uint8, np.uint16):
        labels = read_labels(write(tmp_path / "a.png", ids.astype(dtype)))
        assert labels.dtype == np.uint8 and labels.tolist() == ids.tolist()


def test_labels_above_254_are_an_input_error(tmp_path):
    with pytest.raises(InputError, match="300"):
        read_labels(write(tmp_path / "a.png", np.array([[0, 300]], np.uint16)))


def write_palette(path, ids, colours):
    image = Image.fromarray(np.array(ids, np.uint8), mode="P")
    image.putpalette(np.ravel(colours).astype(np.uint8).tolist())
    image.save(path)
    return path


@pytest.mark.parametrize("largest", [1, 3, 15, 254])
def test_labels_are_the_indices_of_a_palette(tmp_path, largest):
    ids = [[0, 1, largest]]
    assert read_labels(write_palette(tmp_path / "a.png", ids, RNG.integers(0, 256, (largest + 1, 3)))).tolist() == ids
    assert read_labels(write_palette(tmp_path / "b.png", ids, np.arange(768) // 3)).tolist() == ids


def test_greys_of_a_palette_that_are_not_its_indices_are_an_input_error(tmp_path):
    """A program that shrinks files leaves labels of 0, 2 and 3 so."""
    path = write_palette(tmp_path / "a.png", [[0, 1, 2]], np.repeat([0, 2, 3], 3))
    with pytest.raises(InputError, match="greys that are not their indices; save the part ids"):
        read_labels(path)


def test_three_equal_channels_are_labels(tmp_path):
    ids = np.array([[0, 1], [2, 255]], np.uint8)
    for dtype in (np.uint8, np.uint16):
        path = write(tmp_path / "a.png", np.repeat(ids[..., None], 3, axis=2).astype(dtype))
        assert read_labels(path).tolist() == ids.tolist()


def test_coloured_lossy_and_one_bit_labels_are_input_errors(tmp_path):
    ids = np.array([[0, 1], [2, 3]], np.uint8)
    colour = write(tmp_path / "colour.png", np.stack([ids, ids, 0 * ids], axis=2))
    Image.fromarray(ids > 0).save(tmp_path / "bits.png")
    jpeg = write(tmp_path / "lossy.jpg", ids)
    for path, word in ((colour, "RGB"), (tmp_path / "bits.png", "1-bit")):
        with pytest.raises(InputError, match=word):
            read_labels(path)
    with pytest.raises(InputError, match="not a PNG"):
        read_labels(jpeg)


@pytest.mark.parametrize("inside", [1, 3, 90, 128, 255])
def test_masks_of_zero_and_another_value_are_stretched(tmp_path, inside):
    mask = np.array([[0, inside]], np.uint8)
    deep = mask.astype(np.uint16)
    for pixels in (mask, deep, deep * 257, np.repeat(mask[..., None], 3, axis=2)):
        for reader in (read_mask, read_silhouette):
            assert reader(write(tmp_path / "a.png", pixels)).tolist() == [[0, 255]]


def test_silhouettes_keep_their_soft_edges_and_masks_do_not(tmp_path):
    soft = write(tmp_path / "a.png", np.array([[0, 90, 255]], np.uint8))
    assert read_silhouette(soft).tolist() == [[0, 90, 255]]
    assert read_mask(soft).tolist() == [[0, 255, 255]]


@pytest.mark.parametrize(("values", "told"), [([0, 1, 2, 3], "0, 1, 2, 3"), (range(9), "0, 1, 2, ..., 8")])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_silhouette_without_white_is_refused_with_its_values(tmp_path, values, told, dtype):
    path = write(tmp_path / "a.png", np.array([values], dtype))
    with pytest.raises(InputError, match=f"its values are {told}; write 255 where the object is"):
        read_silhouette(path)
    assert read_mask(path).tolist() == [[0] + [255] * (len(values) - 1)]  # what is not 0 counts


def test_a_coloured_mask_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="one grey channel"):
        read_silhouette(write(tmp_path / "a.png", np.array([[[0, 0, 200]]], np.uint8)))


@pytest.mark.parametrize("shown", [0, 200, 255])
@pytest.mark.parametrize("hidden", [0, 255])
def test_a_mask_of_one_colour_has_its_shape_in_the_alpha(tmp_path, shown, hidden):
    alpha = np.array([[0, 100, 255]], np.uint8)
    grey = np.where(alpha > 0, shown, hidden).astype(np.uint8)
    Image.fromarray(np.stack([grey, alpha], axis=-1), mode="LA").save(tmp_path / "la.png")
    write(tmp_path / "rgba.png", np.stack([grey, grey, grey, alpha], axis=-1))
    for file in ("la.png", "rgba.png"):
        assert read_silhouette(tmp_path / file).tolist() == [[0, 100, 255]]


def test_an_alpha_that_is_the_same_everywhere_says_nothing_of_a_mask(tmp_path):
    for alpha in (0, 255):
        mask = np.array([[[0, 0, 0, alpha], [255, 255, 255, alpha]]], np.uint8)
        assert read_silhouette(write(tmp_path / "a.png", mask)).tolist() == [[0, 255]]


def test_a_mask_of_which_colour_and_alpha_differ_is_refused(tmp_path):
    mask = np.array([[[0, 0, 0, 255], [255, 255, 255, 255], [0, 0, 0, 0]]], np.uint8)
    with pytest.raises(InputError, match="colours and an alpha channel; save it with one grey channel"):
        read_silhouette(write(tmp_path / "a.png", mask))


def test_depth_is_in_millimetres_in_both_forms(tmp_path):
    counts = np.array([[0, 1500]], np.uint16)
    np.save(tmp_path / "b.npy", np.array([[np.nan, 1500.0]]))
    for path in (write(tmp_path / "a.png", counts), tmp_path / "b.npy"):
        depth = read_depth(path)
        assert depth.dtype == np.float32
        np.testing.assert_allclose(depth, [[0, 1.5]])


def test_what_is_written_as_depth_is_read_again(tmp_path):
    depth = np.array([[0.0, 0.7], [2.0, 2.9]], np.float32)
    unit = depth_unit(2.9)
    assert unit == pytest.approx(1e-4) and 2 * 2.9 / unit < 65536
    write_depth(tmp_path / "d.png", depth, unit)
    np.testing.assert_allclose(read_depth(tmp_path / "d.png", unit), depth, atol=unit / 2)


def test_pixels_take_the_nearest_of_a_smaller_depth(tmp_path):
    np.save(tmp_path / "d.npy", np.array([[1000.0, 2000.0], [3000.0, 0.0]]))
    depth = read_depth_for(tmp_path / "d.npy", Camera(8.0, 8.0, 4.0, 3.0, 8, 6))
    assert depth.shape == (6, 8)
    corners = np.kron([[1.0, 2.0], [3.0, 0.0]], np.ones((3, 4)))
    np.testing.assert_allclose(depth, corners, rtol=1e-6)


@pytest.mark.parametrize("shape", [(0, 0), (2, 0), (4, 3), (6, 2)])
def test_a_depth_of_another_shape_is_refused(tmp_path, shape):
    np.save(tmp_path / "d.npy", np.ones(shape))
    with pytest.raises(InputError, match="d.npy: the depth is .* pixels, and not a smaller 8x6"):
        read_depth_for(tmp_path / "d.npy", Camera(8.0, 8.0, 4.0, 3.0, 8, 6))


def test_a_pickled_depth_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[{}]], dtype=object), allow_pickle=True)
    with pytest.raises(InputError):
        read_depth(tmp_path / "a.npy")


def test_image_size_is_width_and_height(tmp_path):
    assert image_size(write(tmp_path / "a.png", np.zeros((3, 5), np.uint8))) == (5, 3)
    assert image_size(write(tmp_path / "a.jpg", np.zeros((3, 5), np.uint8))) == (5, 3)


def test_a_file_of_another_size_is_an_input_error(tmp_path):
    path = write(tmp_path / "a.png", np.zeros((3, 5), np.uint8))
    assert read_sized(path, read_mask, Camera(5, 5, 2, 1, 5, 3)).shape == (3, 5)
    with pytest.raises(InputError, match="5x3 pixels, but its camera is 3x5"):
        read_sized(path, read_mask, Camera(5, 5, 2, 1, 3, 5))


def test_a_file_on_its_side_is_to_be_turned_not_resized(tmp_path):
    """Phones store images on their side, with EXIF data that turn them; tools draw masks on what viewers show."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.new("RGB", (5, 3)).save(tmp_path / "a.jpg", exif=exif)
    with pytest.raises(InputError, match=r"camera is 3x5, and EXIF data turn it \(orientation 6\); turn its pixels so"):
        read_sized(tmp_path / "a.jpg", read_image, Camera(5, 5, 1, 2, 3, 5))
    path = write(tmp_path / "a.png", np.zeros((3, 5), np.uint8))
    with pytest.raises(InputError, match="camera is 3x5; turn it on its side, as the pixels of its image are stored"):
        read_sized(path, read_mask, Camera(5, 5, 1, 2, 3, 5))
    with pytest.raises(InputError, match="camera is 4x5; resize the file"):
        read_sized(path, read_mask, Camera(5, 5, 1, 2, 4, 5))


def test_undistortion_gives_the_image_and_camera_of_opencvs_undistort():
    """The steps of nerfstudio's FullImageDatamanager, with pixel centres at integers as OpenCV has them."""
    c = DISTORTED
    image = cv2.GaussianBlur(RNG.integers(0, 255, (c.height, c.width, 3), dtype=np.uint8), (0, 0), 2)
    K = np.array([[c.fx, 0, c.cx - 0.5], [0, c.fy, c.cy - 0.5], [0, 0, 1]])
    k1, k2, k3, _, p1, p2 = c.distortion
    distortion = np.array([k1, k2, p1, p2, k3])
    new_K, (x, y, w, h) = cv2.getOptimalNewCameraMatrix(K, distortion, (c.width, c.height), 0)
    expected = cv2.undistort(image, K, distortion, None, new_K)[y : y + h, x : x + w]
    made = undistort(image, c)
    assert made.shape == expected.shape
    assert np.abs(made.astype(int) - expected).max() <= 2
    new = undistorted_camera(c)
    assert (new.width, new.height, new.distorted) == (w, h, False)
    np.testing.assert_allclose(new.K, new_K + [[0, 0, 0.5 - x], [0, 0, 0.5 - y], [0, 0, 0]])


def test_a_point_lies_where_the_undistorted_camera_projects_it():
    c = DISTORTED
    ray = np.array([0.2, -0.15, 1.0])
    k1, k2, k3, _, p1, p2 = c.distortion
    (x, y), _ = (
        cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), c.K, np.array([k1, k2, p1, p2, k3]))[0].reshape(2),
        None,
    )
    v, u = np.mgrid[: c.height, : c.width] + 0.5
    image = (255 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 8)).astype(np.uint8)
    made = undistort(image, c).astype(float)
    new = undistorted_camera(c)
    v, u = np.mgrid[: new.height, : new.width] + 0.5
    found = np.array([(u * made).sum(), (v * made).sum()]) / made.sum()
    expected = (new.K @ ray)[:2]
    np.testing.assert_allclose(found, expected, atol=0.15)


def test_undistortion_never_mixes_label_ids():
    labels = RNG.choice(np.array([1, 200, 255], np.uint8), (DISTORTED.height, DISTORTED.width))
    made = undistort_labels(labels, DISTORTED)
    new = undistorted_camera(DISTORTED)
    assert made.shape == (new.height, new.width)
    assert set(np.unique(made)) == {1, 200, 255}


def test_without_distortion_nothing_changes():
    camera = Camera(50.0, 50.0, 8.0, 8.0, 16, 16)
    image = RNG.integers(0, 255, (16, 16, 4), dtype=np.uint8)
    assert undistorted_camera(camera) is camera
    assert undistort(image, camera) is image
    assert undistort_labels(image[..., 0], camera).tolist() == image[..., 0].tolist()


def test_downscaling_means_colours_and_cuts_the_remainder():
    image = np.zeros((5, 5, 3), np.uint8)
    image[:2, :2] = [[[0], [100]], [[100], [200]]]
    small = downscale(image, 2)
    assert small.shape == (2, 2, 3)
    assert small[0, 0].tolist() == [100, 100, 100] and small[1, 1].tolist() == [0, 0, 0]


def test_what_is_transparent_does_not_bleed_into_a_smaller_image():
    image = np.zeros((2, 2, 4), np.uint8)
    image[0, 0] = [200, 100, 50, 255]
    image[1, 1] = [255, 255, 255, 0]
    assert downscale(image, 2)[0, 0].tolist() == [200, 100, 50, 64]


@pytest.mark.parametrize("factor", [1, 2, 3, 4])
def test_downscaled_labels_are_the_middle_of_their_block(factor):
    row = np.arange(12, dtype=np.uint8)
    small = downscale_labels(np.tile(row, (12, 1)), factor)
    assert small.shape == (12 // factor, 12 // factor)
    assert small[0].tolist() == (np.arange(12 // factor) * factor + factor // 2).tolist()
