import math

import numpy as np
import pytest
import torch

from splatart_ns.bundle import ArticulatedSplat, Camera, configured_motions, load, orbit_camera, save_bundle
from splatart_ns.errors import InputError

SIZE = (48, 40)


@pytest.fixture
def solid(bundle):
    """The bundle's object, opaque."""
    for part in bundle.parts:
        part.splat.log_scales += 1.0
        part.splat.opacity_logits[:] = 8.0
    return ArticulatedSplat(bundle)


@pytest.fixture
def cameras(solid):
    views = [orbit_camera(solid.centre, solid.radius, azimuth, 0.5, *SIZE) for azimuth in (-1.2, 0.3, 2.0)]
    return Camera(torch.stack([view.T_world_camera for view in views]), views[0].K, *SIZE)


@pytest.fixture
def camera(cameras):
    return Camera(cameras.T_world_camera[0], cameras.K, *SIZE)


def test_a_bundle_is_loaded_from_its_folder(bundle, tmp_path):
    save_bundle(bundle, tmp_path / "bundle")
    splat = load(str(tmp_path / "bundle"), device="cpu")
    assert list(splat.joints) == ["hinge", "slide"] and splat.part_names == ["base", "door", "latch"]
    with pytest.raises(InputError, match="nowhere"):
        load(tmp_path / "nowhere")


def test_link_poses_of_a_batch_are_those_one_by_one(solid):
    hinge = [0.0, 0.5, math.pi, -1.0]
    poses = solid.link_poses({"hinge": hinge, "slide": np.array([0.1])})
    for i, value in enumerate(hinge):
        for name, T in configured_motions(solid.bundle, {"hinge": value, "slide": 0.1}).items():
            assert poses[name].shape == (4, 4, 4)
            torch.testing.assert_close(poses[name][i], T)
    assert solid.link_poses()["latch"].shape == (4, 4)


def test_link_poses_of_joints_of_several_freedoms(bundle):
    bundle.joints[0].type, bundle.joints[0].values = "spherical", torch.zeros(2, 3, dtype=torch.float64)
    splat = ArticulatedSplat(bundle)
    one = splat.link_poses({"slide": [0.1, 0.2, 0.3], "hinge": 0.4})["latch"]
    turns = torch.tensor([[0.0, 0, 0], [0.1, 0.2, 0.3]])
    torch.testing.assert_close(splat.link_poses({"slide": turns, "hinge": 0.4})["latch"][1], one)
    with pytest.raises(InputError, match="takes 3 values"):
        splat.link_poses({"slide": 0.1})


def test_link_poses_have_gradients(solid):
    def height(hinge):
        return solid.link_poses({"hinge": hinge})["latch"][..., 1, 3]

    assert torch.autograd.gradcheck(height, torch.tensor([0.3, 0.0], dtype=torch.float64, requires_grad=True))


def test_a_picture_is_consistent(solid, camera):
    picture = solid.render(camera)
    height, width = SIZE[::-1]
    assert picture.rgb.shape == (height, width, 3) and picture.part_shares.shape == (height, width, 3)
    torch.testing.assert_close(picture.part_shares.sum(-1), picture.alpha, atol=1e-4, rtol=0)
    assert set(picture.part_ids.unique().tolist()) == {0, 1, 2, 7}
    assert ((picture.part_ids == 0) == (picture.alpha < 0.5)).float().mean() > 0.95
    covered = picture.alpha > 0.9
    distance = (camera.T_world_camera[:3, 3] - torch.from_numpy(solid.centre)).norm()
    assert ((picture.depth[covered] - distance).abs() < 1.5 * solid.radius).all() and picture.depth[
        covered
    ].std() > 0.05
    assert (picture.depth[picture.alpha == 0] == 0).all()
    white = picture.over(torch.ones(3))
    assert (white[picture.alpha == 0] == 1).all()


def test_depth_is_in_the_unit_of_the_bundle(solid, camera):
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 3] = torch.tensor([0.0, 0.0, 5.0])
    solid.bundle.parts[0].splat.means[:] = torch.tensor([0.0, 0.0, 1.5])
    above = ArticulatedSplat(solid.bundle).render(Camera(T, (40, 40, 8, 8), 16, 16), parts=["base"])
    assert float(above.depth[8, 8]) == pytest.approx(3.5, abs=1e-3)


def test_batches_of_cameras_and_of_configurations_give_the_pictures_one_by_one(solid, cameras):
    q = {"hinge": [0.0, 0.7, 1.5], "slide": 0.2}

    def single(camera, configuration):
        one = Camera(cameras.T_world_camera[camera], cameras.K, *SIZE)
        return solid.render(one, {"hinge": q["hinge"][configuration], "slide": 0.2})

    pairs = {"cameras": [(0, 0), (1, 0), (2, 0)], "configurations": [(0, 0), (0, 1), (0, 2)]}
    pairs["both"] = [(0, 0), (1, 1), (2, 2)]
    first = Camera(cameras.T_world_camera[0], cameras.K, *SIZE)
    made = {
        "cameras": solid.render(cameras, {"hinge": 0.0, "slide": 0.2}),
        "configurations": solid.render(first, q),
        "both": solid.render(cameras, q),
    }
    for name, picture in made.items():
        for i, pair in enumerate(pairs[name]):
            expected = single(*pair)
            for field in ("rgb", "alpha", "depth", "part_shares"):
                torch.testing.assert_close(getattr(picture, field)[i], getattr(expected, field), atol=1e-5, rtol=1e-5)
        assert picture.part_ids.shape == (3, SIZE[1], SIZE[0])
    assert not torch.equal(made["both"].rgb[0], made["both"].rgb[1])


def test_parts_can_be_left_out(solid, camera):
    assert set(solid.render(camera, parts=["door"]).part_ids.unique().tolist()) == {0, 2}
    nothing = solid.render(camera, parts=[])
    assert not nothing.rgb.any() and not nothing.alpha.any() and not nothing.part_ids.any()


def test_a_part_may_be_named_alone(solid, camera):
    torch.testing.assert_close(solid.render(camera, parts="door").rgb, solid.render(camera, parts=["door"]).rgb)


def test_backgrounds_are_colours_or_images(solid, camera):
    picture = solid.render(camera)
    white = picture.over(torch.ones(3))
    for same in ([1, 1, 1], np.ones(3), torch.ones(40, 48, 3)):
        torch.testing.assert_close(picture.over(same), white)
    for wrong in (1.0, [1, 1], np.ones((7, 7, 3)), "white"):
        with pytest.raises(InputError, match="the background is no colour"):
            picture.over(wrong)
    for wrong, found in (([math.nan] * 3, "nan"), ([255] * 3, "255"), (np.full((40, 48, 3), -100.0), "-100")):
        with pytest.raises(InputError, match=f"the background has a number of {found}; give colours of 0 to 1"):
            picture.over(wrong)
    with pytest.raises(InputError, match="the background is no colour"):
        picture.over(torch.ones(3).to_sparse())


def test_a_device_that_is_not_there_is_refused(bundle):
    for device in ("foo", "cuda:99"):
        with pytest.raises(InputError, match=f"the device '{device}' cannot be used"):
            ArticulatedSplat(bundle, device)


def test_pictures_have_gradients_by_the_camera_whatever_the_default_dtype(solid, camera):
    sideways = torch.zeros(4, 4, dtype=torch.float64)
    sideways[0, 3] = solid.radius
    target = solid.render(Camera(camera.T_world_camera + 0.05 * sideways, camera.K, *SIZE)).rgb

    def loss(shift):
        moved = Camera(camera.T_world_camera + shift * sideways, camera.K, *SIZE)
        return (solid.render(moved).rgb - target).square().sum()

    shift = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    torch.set_default_dtype(torch.float64)
    try:
        (slope,) = torch.autograd.grad(loss(shift), shift)
    finally:
        torch.set_default_dtype(torch.float32)
    with torch.no_grad():
        numeric = (loss(0.01) - loss(-0.01)) / 0.02
    assert float(slope) == pytest.approx(float(numeric), rel=0.1)


def test_depth_and_labels_are_not_made_unless_asked_for(solid, camera):
    picture = solid.render(camera, depth=False, labels=False)
    assert picture.depth is None and picture.part_shares is None
    torch.testing.assert_close(picture.rgb, solid.render(camera).rgb)
    with pytest.raises(InputError, match="labels=True"):
        _ = picture.part_ids


def test_pictures_have_gradients_by_joint_values(solid, camera):
    target = solid.render(camera, {"hinge": 0.5}).rgb

    def loss(value):
        return (solid.render(camera, {"hinge": value}, labels=False, depth=False).rgb - target).square().sum()

    value = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(loss(value), value)
    step = 3e-3
    with torch.no_grad():
        numeric = (loss(value + step) - loss(value - step)) / (2 * step)
    assert float(slope) == pytest.approx(float(numeric), rel=0.05)


@pytest.mark.parametrize(
    ("q", "found"),
    [
        ({"nobody": 0.1}, "no tree joint is called nobody; there are hinge, slide"),
        ({"hinge": [0.1, 0.2], "slide": [0.1, 0.2, 0.3]}, r"different batches: hinge \[2\], slide \[3\]"),
        ({"hinge": "wide"}, "'wide' are no numbers"),
        ({"hinge": math.inf}, "not finite"),
        ({"hinge": 1e300}, r"has a value of 1e\+300"),
        ({"slide": [0.1, -1e18]}, r"has a value of 1e\+18"),
        (None, "the configuration is None; give a dict"),
        ([0.1], r"the configuration is \[0.1\]; give a dict"),
    ],
)
def test_configurations_that_cannot_be_are_refused(solid, camera, q, found):
    for ask in (solid.link_poses, lambda q: solid.render(camera, q)):
        with pytest.raises(InputError, match=found):
            ask(q)


def test_what_is_nearly_beyond_all_use_gives_a_picture(solid, camera):
    far = camera.T_world_camera.clone()
    far[:3, 3] = 9e17
    assert not solid.render(Camera(far, camera.K, *SIZE)).alpha.any()
    assert solid.render(camera, {"hinge": 9e17, "slide": 9e17}).rgb.isfinite().all()


def test_other_things_than_cameras_and_folders_are_refused(solid, camera):
    with pytest.raises(InputError, match="the camera is None; give a Camera"):
        solid.render(None)
    with pytest.raises(InputError, match="the bundle's folder is None; give its path"):
        load(None)


def test_batches_that_do_not_go_together_are_refused(solid, cameras):
    with pytest.raises(InputError, match=r"configurations \[2\] and cameras \[3\]"):
        solid.render(cameras, {"hinge": [0.1, 0.2]})
    with pytest.raises(InputError, match=r"configurations \[2, 3\]"):
        solid.render(cameras, {"hinge": torch.zeros(2, 3)})


def test_an_empty_batch_has_poses_and_no_picture(solid, camera):
    assert solid.link_poses({"hinge": []})["door"].shape == (0, 4, 4)
    with pytest.raises(InputError, match="the batch is empty"):
        solid.render(camera, {"hinge": []})


def test_an_unknown_part_is_refused(solid, camera):
    with pytest.raises(InputError, match="no part is called lid; there are base, door, latch"):
        solid.render(camera, parts=["lid"])
