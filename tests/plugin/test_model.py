import socket
from pathlib import Path

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils.colormaps import ColormapOptions, apply_colormap
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerElement

from splatart_ns.errors import InputError
from splatart_ns.plugin.joint import JointModelConfig
from splatart_ns.plugin.model import SplatartModel, SplatartModelConfig, refuse_unread
from splatart_ns.plugin.pose import PoseModelConfig
from splatart_ns.splats.palette import part_colours

GEOMETRY = ("means", "scales", "quats", "opacities", "features_dc", "features_rest")


def eval_batch(trainer: Trainer) -> tuple[Cameras, dict]:
    return trainer.pipeline.datamanager.fixed_indices_eval_dataloader[0]


def iterate(trainer: Trainer, step: int) -> tuple:
    """One step as nerfstudio's Trainer makes it."""
    trainer.pipeline.train()
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
    result = trainer.train_iteration(step)
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
    return result


def parameters(model: SplatartModel) -> dict[str, torch.Tensor]:
    return {name: p.detach().clone() for name, p in model.gauss_params.items()}


def test_a_rasterizer_for_the_cpu_is_refused_on_a_gpu(monkeypatch) -> None:
    monkeypatch.setattr("splatart_ns.plugin.model.set_backend", lambda _: None)
    config = SplatartModelConfig(rasterizer="numba")
    with pytest.raises(InputError, match="--machine.device-type cpu"):
        config.setup(scene_box=None, num_train_data=1, metadata={}, device="cuda")


def test_cameras_that_later_stages_would_not_know_of_are_not_optimised() -> None:
    config = SplatartModelConfig()
    config.camera_optimizer.mode = "SO3xR3"
    with pytest.raises(InputError, match="mode is SO3xR3, .*--pipeline.model.refine-cameras on"):
        config.setup(scene_box=None, num_train_data=1, metadata={})


def test_a_bilateral_grid_is_refused() -> None:
    with pytest.raises(InputError, match="use-bilateral-grid is True, .* leave it out"):
        SplatartModelConfig(use_bilateral_grid=True).setup(scene_box=None, num_train_data=1, metadata={})


@pytest.mark.parametrize("degree", [-1, 4])
def test_spherical_harmonics_of_other_degrees_are_refused(degree: int) -> None:
    with pytest.raises(InputError, match=f"sh-degree is {degree}; give 0 to 3"):
        SplatartModelConfig(sh_degree=degree).setup(scene_box=None, num_train_data=1, metadata={})


def test_no_random_gaussians_at_all_are_refused() -> None:
    with pytest.raises(InputError, match="num-random is 0; give 1 or more"):
        SplatartModelConfig(num_random=0).setup(scene_box=None, num_train_data=1, metadata={})


def test_metrics_that_are_not_computed_are_refused() -> None:
    with pytest.raises(InputError, match="color-corrected-metrics is True, .* leave it out"):
        SplatartModelConfig(color_corrected_metrics=True).setup(scene_box=None, num_train_data=1, metadata={})


@pytest.mark.parametrize(
    "option", [{"use_scale_regularization": True}, {"ssim_lambda": 0.3}, {"sh_degree": 3}, {"cull_alpha_thresh": 0.5}]
)
def test_options_of_training_on_images_are_refused_where_it_is_over(option: dict) -> None:
    refuse_unread(PoseModelConfig(), "splatart-pose")
    refuse_unread(JointModelConfig(background_color="black", rasterize_mode="antialiased"), "splatart-joint")
    ((name, value),) = option.items()
    dashed = name.replace("_", "-")
    for config in (PoseModelConfig, JointModelConfig):
        with pytest.raises(InputError, match=f"--pipeline.model.{dashed} is {value}, but splatart-x does not read it"):
            refuse_unread(config(**option), "splatart-x")


def test_nothing_is_asked_of_the_network(semantic_trainer, capture_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_, **__):
        raise AssertionError("a connection was opened")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    trainer = semantic_trainer(capture_dir)
    iterate(trainer, 0)
    metrics = trainer.pipeline.get_average_eval_image_metrics(0)
    assert metrics.keys() >= {"psnr", "ssim"} and "lpips" not in metrics


def test_the_viewer_can_show_every_output(semantic_trainer, capture_dir: Path) -> None:
    trainer = semantic_trainer(capture_dir)
    model = trainer.pipeline.model.eval()
    camera, _ = eval_batch(trainer)
    outputs = model.get_outputs_for_camera(camera)
    assert list(outputs)[0] == "rgb"
    assert outputs.keys() >= {"depth", "accumulation", "parts", "part_confidence"}
    for image in outputs.values():
        shown = apply_colormap(image, ColormapOptions())
        assert shown.shape == (64, 64, 3) and torch.isfinite(shown).all() and not shown.requires_grad
    assert 0 <= outputs["part_confidence"].min() and outputs["part_confidence"].max() <= 1 + 1e-5


def test_the_viewers_walk_over_all_attributes_finds_the_start_view(semantic_trainer, capture_dir: Path) -> None:
    pipeline = semantic_trainer(capture_dir).pipeline
    assert parse_object(pipeline, ViewerElement, "Custom Elements") == []
    assert [control for _, control in parse_object(pipeline, ViewerControl, "")] == [pipeline.model.start_view]


def test_an_object_alone_is_compared_with_opaque_images_within_its_rendered_silhouette(
    semantic_trainer, capture_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trainer = semantic_trainer(capture_dir)
    model = trainer.pipeline.model.eval()
    camera, batch = eval_batch(trainer)
    outputs = model.get_outputs_for_camera(camera)
    opaque = {"image": torch.zeros(64, 64, 3)}
    whole, _ = model.get_image_metrics_and_images(outputs, opaque)
    assert "rendered_silhouette" not in whole  # object and surroundings are compared with all of the image
    monkeypatch.setattr(type(model), "shows_surroundings", False)
    for _ in range(2):
        within, _ = model.get_image_metrics_and_images(outputs, opaque)
    assert within["rendered_silhouette"] == 1 and within["psnr"] > whole["psnr"] + 3
    assert capsys.readouterr().out.count("within its rendered silhouette") == 1
    given, _ = model.get_image_metrics_and_images(outputs, batch)
    assert given["rendered_silhouette"] == 0


def test_rgba_over_the_background_is_the_rendered_image(semantic_trainer, capture_dir: Path) -> None:
    trainer = semantic_trainer(capture_dir)
    model = trainer.pipeline.model.eval()
    model.set_background(torch.tensor([0.2, 0.5, 0.9]))
    outputs = model.get_outputs_for_camera(eval_batch(trainer)[0])
    rgba = model.get_rgba_image(outputs)
    over = rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:]) * outputs["background"]
    assert torch.allclose(over, outputs["rgb"], atol=2e-3)


def test_cropping_leaves_out_what_is_outside_the_box(semantic_trainer, capture_dir: Path) -> None:
    from nerfstudio.data.scene_box import OrientedBox

    trainer = semantic_trainer(capture_dir)
    model = trainer.pipeline.model.eval()
    far = OrientedBox.from_params((50.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    camera, _ = eval_batch(trainer)
    assert model.get_outputs_for_camera(camera)["accumulation"].max() > 0.1
    assert model.get_outputs_for_camera(camera, far)["accumulation"].max() == 0


def test_geometry_learns_first_and_part_logits_alone_after_it(semantic_trainer, capture_dir: Path) -> None:
    trainer = semantic_trainer(capture_dir, steps=12, semantic_start=8)
    model = trainer.pipeline.model
    start = parameters(model)
    for step in range(8):
        _, losses, _ = iterate(trainer, step)
    assert losses.keys() == {"main_loss", "accumulation"}
    middle = parameters(model)
    assert all(not torch.equal(start[name], middle[name]) for name in GEOMETRY if name != "features_rest")
    assert torch.equal(start["semantics"], middle["semantics"])

    seen = []
    next_train = trainer.pipeline.datamanager.next_train
    trainer.pipeline.datamanager.next_train = lambda step: (seen.append(next_train(step)), seen[-1])[1]
    for step in range(8, 12):
        _, losses, _ = iterate(trainer, step)
    assert losses.keys() == {"segmentation"}
    end = parameters(model)
    assert all(torch.equal(middle[name], end[name]) for name in GEOMETRY)
    assert not torch.equal(middle["semantics"], end["semantics"])
    # Votes of the few labelled frames began it.
    parts = end["semantics"].argmax(-1)
    assert set(parts.tolist()) >= {1, 2}


def test_frames_without_labels_are_passed_over_when_parts_learn(semantic_trainer, capture_dir: Path) -> None:
    pipeline = semantic_trainer(capture_dir).pipeline
    frames = pipeline.datamanager.train_dataset.metadata["frames"]
    drawn = [pipeline._next_labelled(step)[1]["image_idx"] for step in range(len(frames))]
    assert all(frames[i].labels is not None for i in drawn)
    assert set(drawn) == {i for i, frame in enumerate(frames) if frame.labels is not None}


def test_a_capture_without_alpha_trains_object_and_surroundings(semantic_trainer, opaque_capture_dir: Path) -> None:
    trainer = semantic_trainer(opaque_capture_dir, steps=60, semantic_start=50)
    around = trainer.pipeline.datamanager.train_dataset.metadata["points3D_around"]
    assert trainer.pipeline.model.num_points > around > 0
    before = trainer.pipeline.get_average_eval_image_metrics(0)["psnr"]
    for step in range(60):
        _, losses, _ = iterate(trainer, step)
        assert losses.keys() == ({"main_loss"} if step < 50 else {"segmentation"})
    assert trainer.pipeline.get_average_eval_image_metrics(60)["psnr"] > before + 2


def test_a_run_that_would_end_before_parts_are_learned_is_refused(semantic_trainer, capture_dir: Path) -> None:
    with pytest.raises(InputError, match="semantic-start"):
        semantic_trainer(capture_dir, steps=8, semantic_start=8)


def test_a_checkpoint_of_another_size_loads(semantic_trainer, capture_dir: Path) -> None:
    trainer = semantic_trainer(capture_dir)
    iterate(trainer, 0)
    model = trainer.pipeline.model
    smaller = {k: v[:100] if k.startswith("gauss_params.") else v for k, v in model.state_dict().items()}
    model.load_state_dict(smaller)
    assert model.num_points == 100
    assert model.eval().get_outputs_for_camera(eval_batch(trainer)[0])["rgb"].shape == (64, 64, 3)


def test_gaussians_do_not_grow_beyond_their_number(semantic_trainer, capture_dir: Path) -> None:
    trainer = semantic_trainer(capture_dir)
    model = trainer.pipeline.model
    iterate(trainer, 0)
    generator = torch.Generator().manual_seed(0)
    need = torch.rand(model.num_points, generator=generator)
    model.strategy_state.update(grad2d=need, count=torch.ones(model.num_points))
    model.config.max_gaussians = model.num_points + 10
    model._limit_growth()
    assert (need > model.strategy.grow_grad2d).sum() == 10
    model.config.max_gaussians = model.num_points
    model._limit_growth()
    assert (need > model.strategy.grow_grad2d).sum() == 0


def test_gaussians_grow_in_proportion_to_the_points_they_started_from(semantic_trainer, capture_dir: Path) -> None:
    trainer = semantic_trainer(capture_dir)
    model = trainer.pipeline.model
    started = model.num_points
    model.strategy_state.update(grad2d=torch.arange(1.0, started + 1), count=torch.ones(started))
    model.config.max_gaussians = 10**6
    model._limit_growth()
    grow = (model.strategy_state["grad2d"] > model.strategy.grow_grad2d).sum()
    assert grow == started // 2


def test_the_strategy_and_the_metrics_measure_pieces_as_shares_of_the_image(semantic_trainer, capture_dir: Path):
    trainer = semantic_trainer(capture_dir)
    model, manager = trainer.pipeline.model, trainer.pipeline.datamanager
    iterate(trainer, 0)
    camera, batch = manager.next_train(0)
    camera.metadata["whole"] = (10 * int(camera.width), 10 * int(camera.height))
    outputs = model(camera)
    factor = model._get_downscale_factor()
    assert (model.info["width"], model.info["height"]) == tuple(
        10 * int(x) // factor for x in (camera.width, camera.height)
    )
    whole, piece = ({"share": share, **{k: v for k, v in batch.items() if k != "share"}} for share in (1.0, 0.01))
    psnr = [float(model.get_metrics_dict(outputs, data)["psnr"]) for data in (whole, piece)]
    assert psnr[1] - psnr[0] == pytest.approx(20, abs=1e-3)
    losses = [model.get_loss_dict(outputs, data) for data in (whole, piece)]
    for name in ("main_loss", "accumulation"):
        assert float(losses[1][name]) == pytest.approx(0.01 * float(losses[0][name]))


def test_colours_of_parts_differ() -> None:
    colours = part_colours(12)
    assert colours.shape == (13, 3) and torch.equal(colours[0], torch.zeros(3))
    assert torch.pdist(colours).min() > 0.1
