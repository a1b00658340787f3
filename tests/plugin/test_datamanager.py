import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.utils.colormaps import apply_colormap

from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.view import View
from splatart_ns.errors import InputError
from splatart_ns.plugin.datamanager import SplatartDatamanager, SplatartDatamanagerConfig
from splatart_ns.plugin.dataparser import SplatartDataParserConfig
from splatart_ns.stages.hull import inside_silhouettes
from splatart_ns.stages.silhouette import with_silhouette


def manage(capture: Path, test_mode: str = "val", **settings) -> SplatartDatamanager:
    config = SplatartDatamanagerConfig(data=capture, dataparser=SplatartDataParserConfig(state=1), **settings)
    return config.setup(device="cpu", test_mode=test_mode)


def test_batches_have_alpha_and_labels_and_frames_without_labels_say_so(capture_dir: Path) -> None:
    manager = manage(capture_dir)
    frames = load_capture(capture_dir).states[1].split("train")
    labelled = set()
    for step in range(len(frames)):
        _, batch = manager.next_train(step)
        image, labels = batch["image"], batch["semantics"]
        assert image.shape == (64, 64, 4) and image.dtype == torch.float32
        assert labels.shape == (64, 64, 1) and labels.dtype == torch.int64
        if set(labels.unique().tolist()) != {255}:
            labelled.add(batch["image_idx"])
            assert set(labels.unique().tolist()) <= {0, 1, 2}
            # Labels lie on the object.
            assert (image[..., 3:][labels > 0] > 0).float().mean() > 0.95
    assert labelled == {i for i, frame in enumerate(frames) if frame.labels is not None}
    assert 0 < len(labelled) < len(frames)


def test_other_data_parsers_are_refused(capture_dir: Path) -> None:
    config = SplatartDatamanagerConfig(dataparser=NerfstudioDataParserConfig(data=capture_dir / "state_00"))
    with pytest.raises(InputError, match="is NerfstudioDataParserConfig, .* splatart-capture"):
        config.setup(device="cpu")


@pytest.mark.parametrize("factor", [0.4, 2.0, 0.66, 0.33, 0.0, -0.5, 1e-9, math.inf, math.nan])
def test_images_that_would_not_be_a_whole_number_of_times_smaller_are_refused(capture_dir: Path, factor: float) -> None:
    with pytest.raises(InputError, match=f"camera-res-scale-factor is {factor}; give 1 / n"):
        manage(capture_dir, camera_res_scale_factor=factor)


@pytest.mark.parametrize(("factor", "side"), [(1.0, 64), (0.5, 32), (0.25, 16), (0.333, 21), (0.1667, 10), (1 / 60, 1)])
def test_cameras_are_as_large_as_images_that_are_made_smaller(capture_dir: Path, factor: float, side: int) -> None:
    manager = manage(capture_dir, camera_res_scale_factor=factor)
    camera, batch = manager.next_train(0)
    assert batch["image"].shape == (side, side, 4) and camera.metadata["whole"] == (side, side)
    view = manager.train_dataset.views[batch["image_idx"]]
    K, (left, top, *_) = view.K, view.object_window()
    expected = torch.tensor([K[0, 0], K[1, 1], K[0, 2] - left, K[1, 2] - top])
    assert torch.allclose(torch.cat([camera.fx, camera.fy, camera.cx, camera.cy], -1), expected)


def test_images_to_show_are_over_white_as_renders_are(capture_dir: Path, opaque_capture_dir: Path) -> None:
    dataset = manage(capture_dir, test_mode="test").eval_dataset
    batch = dataset.get_data(0)
    shown, alpha = dataset[0], batch["image"][..., 3:]
    assert shown.keys() == batch.keys()
    assert torch.allclose(shown["image"], batch["image"][..., :3] * alpha + 1 - alpha)
    assert torch.equal(apply_colormap(shown["image"]), shown["image"])  # what ns-render does with `gt-rgb`
    opaque = manage(opaque_capture_dir).train_dataset
    assert torch.equal(opaque[0]["image"], opaque.get_data(0)["image"])


def test_opaque_images_start_from_points_on_the_object_and_on_what_surrounds_it(opaque_capture_dir: Path) -> None:
    manager = manage(opaque_capture_dir, seed_gaussians=100)
    assert manager.next_train(0)[1]["image"].shape == (32, 32, 3)
    xyz = manager.train_dataparser_outputs.metadata["points3D_xyz"]
    labelled = [with_silhouette(manager.train_dataset.get_view(i)) for i in range(len(manager.train_dataset))]
    inside = inside_silhouettes(labelled, xyz, dilate=2)
    assert inside[:-100].float().mean() > 0.95 and inside[-100:].float().mean() < 0.5
    assert inside[:-100].sum() >= 100


@pytest.mark.parametrize("with_hull", [True, False])
def test_points_of_ones_own_are_kept_where_silhouettes_tell_nothing(
    opaque_capture_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, with_hull: bool
) -> None:
    capture = shutil.copytree(opaque_capture_dir, tmp_path / "capture")
    places, colours = np.eye(7, 3), np.zeros((7, 3), np.uint8)
    trimesh.PointCloud(places, colours).export(capture / "state_01/cloud.ply")
    file = capture / "state_01/transforms.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"ply_file_path": "cloud.ply"}))
    if not with_hull:
        monkeypatch.setattr("splatart_ns.plugin.datamanager.visual_hull", lambda *_: None)
    points = manage(capture, seed_gaussians=50).train_dataparser_outputs.metadata["points3D_xyz"]
    assert len(points) > 50 if with_hull else len(points) == 7


def test_one_labelled_opaque_image_says_where_the_object_may_be(opaque_capture_dir: Path, tmp_path: Path) -> None:
    capture = shutil.copytree(opaque_capture_dir, tmp_path / "capture")
    file = capture / "state_01/transforms.json"
    meta = json.loads(file.read_text())
    for frame in meta["frames"][1:]:
        frame.pop("semantics_path")
    file.write_text(json.dumps(meta))
    manager = manage(capture, seed_gaussians=100)
    assert len(manager.train_dataparser_outputs.metadata["points3D_xyz"]) >= 200


@pytest.mark.parametrize("image_type", ["float32", "uint8"])
def test_images_that_are_changed_are_not_those_of_the_views(opaque_capture_dir: Path, image_type: str) -> None:
    dataset = manage(opaque_capture_dir).train_dataset
    before = dataset.views[0].rgb.clone()
    dataset.get_data(0, image_type)["image"].zero_()
    assert torch.equal(dataset.views[0].rgb, before)


def test_seed_points_lie_inside_every_silhouette(capture_dir: Path) -> None:
    manager = manage(capture_dir, seed_gaussians=200)
    xyz = manager.train_dataparser_outputs.metadata["points3D_xyz"]
    assert len(xyz) >= 200
    for i in range(len(manager.train_dataset)):
        view = manager.train_dataset.get_view(i)
        seen = xyz @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        u, v = (seen @ view.K.T)[:, :2].T / seen[:, 2]
        inside = view.alpha[v.long().clamp(0, 63), u.long().clamp(0, 63)] > 0
        assert inside.float().mean() > 0.95


def test_points_start_in_the_hull_whatever_cloud_there_is_and_whichever_silhouette_is_empty(
    capture_dir: Path, tmp_path: Path
) -> None:
    def points(capture: Path) -> torch.Tensor:
        return manage(capture, seed_gaussians=200).train_dataparser_outputs.metadata["points3D_xyz"]

    alone = points(capture_dir)
    capture = shutil.copytree(capture_dir, tmp_path / "capture")
    trimesh.PointCloud(5 * np.eye(7, 3)).export(capture / "state_01/cloud.ply")
    file = capture / "state_01/transforms.json"
    meta = json.loads(file.read_text()) | {"ply_file_path": "cloud.ply"}
    file.write_text(json.dumps(meta))
    assert torch.equal(points(capture), alone)
    image = capture / "state_01" / meta["frames"][0]["file_path"]
    cv2.imwrite(str(image), np.zeros_like(cv2.imread(str(image), cv2.IMREAD_UNCHANGED)))
    without = points(capture)
    assert len(without) >= 200 and (without.amax(0) - alone.amax(0)).abs().max() < 0.1


def test_normals_come_with_points_on_surfaces(capture_dir: Path, opaque_capture_dir: Path) -> None:
    pytest.importorskip("numba", reason="stereo is found by numba kernels")
    for capture in (capture_dir, opaque_capture_dir):
        manager = manage(capture, seed_gaussians=200)
        normals = manager.train_dataset.metadata["points3D_normals"]
        assert normals.shape == manager.train_dataparser_outputs.metadata["points3D_xyz"].shape
        length = normals.norm(dim=-1)
        assert ((length == 0) | ((length - 1).abs() < 1e-4)).all()
        assert (length > 0).any() or capture == opaque_capture_dir


@pytest.mark.parametrize("test_mode", ["test", "inference"])
def test_no_seed_points_where_a_checkpoint_brings_the_gaussians(capture_dir: Path, test_mode: str) -> None:
    assert "points3D_xyz" not in manage(capture_dir, test_mode, seed_gaussians=200).train_dataparser_outputs.metadata


def test_images_can_be_kept_on_the_cpu_of_a_machine_without_accelerator(capture_dir: Path) -> None:
    manager = manage(capture_dir, cache_images="cpu", cache_images_type="uint8")
    assert manager.next_train(0)[1]["image"].dtype == torch.uint8
    (camera, batch), *rest = manager.fixed_indices_eval_dataloader
    assert len(rest) == 2 and batch["image"].shape == (64, 64, 4) and camera.width.item() == 64


def test_training_sees_the_piece_of_a_frame_that_shows_the_object(capture_dir: Path) -> None:
    manager = manage(capture_dir)
    cached, views = manager.cached_train, manager.train_dataset.views
    views[:] = [framed(view, 64) for view in views]
    cached[:] = [manager.train_dataset.get_data(i) for i in range(len(views))]
    manager.train_cameras.width[:] = manager.train_cameras.height[:] = 192
    manager.train_cameras.cx += 64
    manager.train_cameras.cy += 64
    for step in range(len(views)):
        camera, batch = manager.next_train(step)
        view = views[batch["image_idx"]]
        left, top, right, bottom = view.object_window()
        assert (int(camera.width), int(camera.height)) == (right - left, bottom - top) != (192, 192)
        assert camera.metadata["whole"] == (192, 192)
        assert batch["share"] == (right - left) * (bottom - top) / 192**2
        assert batch["image"].shape == (bottom - top, right - left, 4)
        assert batch["semantics"].shape == (bottom - top, right - left, 1)
        assert batch["image"][..., 3].sum() * 255 == pytest.approx(float(view.alpha.sum()))
        assert [float(camera.cx) + left, float(camera.cy) + top] == pytest.approx(view.K[:2, 2].tolist())
    assert manager.train_cameras.width.unique().tolist() == [192]


def test_batches_have_the_depth_that_other_frames_confirm(capture_dir: Path, depth_capture_dir: Path) -> None:
    manager = manage(depth_capture_dir, seed_gaussians=200)
    xyz, normals = (manager.train_dataparser_outputs.metadata["points3D_xyz"], manager.measured.normals)
    assert (normals.norm(dim=-1) > 0).any()
    assert torch.cdist(xyz, manager.measured.xyz).amin(1).quantile(0.6) < 0.02  # the rest is underneath
    for step in range(3):
        camera, batch = manager.next_train(step)
        view = manager.train_dataset.views[batch["image_idx"]]
        left, top, right, bottom = view.object_window()
        trusted, given = batch["depth"], view.depth[top:bottom, left:right]
        assert trusted.shape == batch["image"].shape[:2] and camera.metadata["depth"]
        assert ((trusted == given) | (trusted == 0)).all()
        assert 0.7 * (given > 0).sum() < (trusted > 0).sum() < (given > 0).sum()
    camera, batch = manage(capture_dir).next_train(0)
    assert "depth" not in batch and "depth" not in camera.metadata


@pytest.mark.parametrize("change", [lambda T: T @ np.diag([1.0, -1, -1, 1]), np.linalg.inv])
def test_poses_of_another_convention_are_refused_before_anything_learns(capture_dir: Path, tmp_path: Path, change):
    capture = shutil.copytree(capture_dir, tmp_path / "capture")
    for file in capture.glob("state_*/transforms.json"):
        meta = json.loads(file.read_text())
        for frame in meta["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
        file.write_text(json.dumps(meta))
    with pytest.raises(InputError, match="state_01: the silhouettes contradict each other.*camera-to-world in OpenGL"):
        manage(capture, seed_gaussians=200)


def framed(view: View, border: int) -> View:
    """The view with nothing around it."""
    pixels = {name: getattr(view, name) for name in ("rgb", "alpha", "labels")}
    padded = {
        name: None if x is None else torch.nn.functional.pad(x, (*[0] * 2 * (x.ndim - 2), *[border] * 4))
        for name, x in pixels.items()
    }
    K = view.K + border * torch.tensor([[0.0, 0, 1], [0, 0, 1], [0, 0, 0]])
    return replace(view, K=K, width=view.width + 2 * border, height=view.height + 2 * border, **padded)
