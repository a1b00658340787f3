import copy
import json
import math
import shutil
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from splatart_ns.capture.seen_surface import SeenSurface
from splatart_ns.geometry.camera import viewmat_from_opengl
from splatart_ns.plugin import semantic
from splatart_ns.plugin.semantic_run import learned_views
from splatart_ns.stages.camera_refinement import PASSES, TRIED
from splatart_ns.stages.hull import Slack
from splatart_ns.stages.semantic import ballots
from splatart_ns.stages.spread import TOLD, spread


def test_growth_stops_at_the_limit(capture_dir, semantic_trainer):
    trainer = semantic_trainer(capture_dir, steps=40, semantic_start=36)
    config = trainer.pipeline.model.config
    start = trainer.pipeline.model.num_points
    config.max_gaussians, config.densify_grad_thresh = start + 25, 1e-9
    strategy = trainer.pipeline.model.strategy
    strategy.refine_start_iter, strategy.refine_every, config.refine_every = 5, 10, 10
    strategy.prune_opa = 0.0
    trainer.train()
    assert start < trainer.pipeline.model.num_points <= start + 25


def test_gaussians_outside_the_silhouettes_fade(capture_dir, semantic_trainer):
    pipeline = semantic_trainer(capture_dir).pipeline
    model, pipeline.datamanager.found = pipeline.model, SeenSurface.nothing()
    with torch.no_grad():
        model.means[:10] = torch.tensor([0.0, 0.0, 5.0])
    before = model.opacities.detach().clone()
    model.config.refine_every = 4
    pipeline._keep_inside(4)
    assert before[:10].sigmoid().min() > 0.05 > model.opacities[:10].sigmoid().max()
    kept = model.opacities[10:] == before[10:]
    assert kept.float().mean() > 0.9


@pytest.mark.parametrize("refines", [False, True])
def test_gaussians_that_views_of_exact_cameras_see_past_fade(capture_dir, semantic_trainer, refines):
    pipeline = semantic_trainer(capture_dir).pipeline
    model = pipeline.model
    widths = model.scales.detach().exp().median(dim=-1).values
    passed = torch.arange(model.num_points) < 20

    def stub(means, given, size):
        assert torch.equal(given, widths) and len(means) == len(given) and size > 0
        return passed

    pipeline.datamanager.found = SimpleNamespace(passed=stub)
    pipeline._refines, model.config.refine_every = refines, 4
    before = model.opacities.detach().clone()
    pipeline._keep_inside(4)
    faded = (model.opacities < before)[:, 0]
    assert faded[:20].all() == (not refines) and faded[20:].float().mean() < 0.1


@pytest.mark.parametrize(
    ("slack", "shown", "stay"), [(Slack(), 255, False), (Slack(views=1), 255, True), (Slack(), 0, True)]
)
def test_gaussians_that_a_view_loses_which_may_err_or_shows_nothing_do_not_fade(
    capture_dir, semantic_trainer, slack, shown, stay
):
    pipeline = semantic_trainer(capture_dir).pipeline
    pipeline.datamanager.found = SeenSurface.nothing()
    before = pipeline.model.opacities.detach().clone()
    alpha = torch.zeros_like(pipeline._views[0].alpha)
    alpha[1, 1] = shown
    pipeline._views[0] = replace(pipeline._views[0], alpha=alpha)
    pipeline._slack, pipeline.model.config.refine_every = slack, 4
    pipeline._keep_inside(4)
    assert ((pipeline.model.opacities == before).float().mean() > 0.9) == stay


def test_only_part_logits_learn_in_the_second_phase(capture_dir, semantic_trainer):
    trainer = semantic_trainer(capture_dir, steps=12, semantic_start=8)
    model = trainer.pipeline.model
    held = {}
    train_iteration = trainer.train_iteration

    def noted(step):
        if step == 9:
            held.update({name: p.detach().clone() for name, p in model.gauss_params.items()})
        return train_iteration(step)

    trainer.train_iteration = noted
    trainer.train()
    changed = {name for name, p in model.gauss_params.items() if not torch.equal(p, held[name])}
    assert changed == {"semantics"}


def test_gaussians_that_no_labelled_frame_shows_have_the_labels_of_those_beside_them(
    capture_dir, semantic_trainer, monkeypatch
):
    """Here those with an even number; they also stay so while the others learn."""
    told = {}

    def ballots_of_odd_ones(splat, views, num_parts):
        votes, shown = ballots(splat, views, num_parts)
        told["odd"] = (shown >= TOLD).any(0) & (torch.arange(len(splat)) % 2 == 1)
        return votes, shown * told["odd"]

    def noted(splat, logits, known):
        assert torch.equal(known, told["odd"])
        told["logits"] = spread(splat, logits, known)
        return told["logits"]

    monkeypatch.setattr(semantic, "ballots", ballots_of_odd_ones)
    monkeypatch.setattr(semantic, "spread", noted)
    trainer = semantic_trainer(capture_dir, steps=12, semantic_start=8)
    trainer.train()
    learned, odd = trainer.pipeline.model.gauss_params["semantics"], told["odd"]
    assert torch.equal(learned[~odd], told["logits"][~odd])
    assert 0 < odd.sum() and not torch.equal(learned[odd], told["logits"][odd])


def test_gaussians_of_the_surroundings_come_on_top_of_the_limit(opaque_capture_dir, semantic_trainer):
    model = semantic_trainer(opaque_capture_dir).pipeline.model
    assert model._for_surroundings == 450  # 3 / 2 of the 300 that start there


def test_labels_that_contradict_the_others_are_not_learned(capture_dir, semantic_trainer, tmp_path):
    capture = shutil.copytree(capture_dir, tmp_path / "capture")
    meta = json.loads((capture / "state_00/transforms.json").read_text())
    wrong = next(f for f in meta["frames"] if "semantics_path" in f and f["file_path"] in meta["train_filenames"])
    file = capture / "state_00" / wrong["semantics_path"]
    labels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(file), np.where(labels > 0, 3 - labels, 0).astype(np.uint8))
    trainer = semantic_trainer(capture, steps=32, semantic_start=30)
    trainer.train()
    assert [note.split(":")[0] for note in trainer.pipeline.notes] == [str(file)]
    frames = trainer.pipeline.datamanager.train_dataset.metadata["frames"]
    trusted = [frame.labels is not None and frame.labels != file for frame in frames]
    assert trainer.pipeline.model.trusted.tolist() == trusted


def test_gaussians_learn_from_depth(depth_capture_dir, semantic_trainer):
    trainer = semantic_trainer(depth_capture_dir, steps=12, semantic_start=10)
    pipeline = trainer.pipeline
    assert pipeline.findings["depth"]["confirmed"] > 0.8 and not pipeline.notes
    pipeline.model.step_cb(trainer.optimizers, 0)
    with torch.no_grad():
        pipeline.model.gauss_params["means"].mul_(0.9)
    _, losses, _ = pipeline.get_train_loss_dict(0)
    assert 0.5 * 0.1 * 0.05 < float(losses["depth"]) < 0.5 * 0.1 * 0.6  # a share of the image, and weighted
    (gradient,) = torch.autograd.grad(losses["depth"], pipeline.model.gauss_params["means"])
    assert gradient.abs().sum() > 0
    pipeline.model.config.num_downscales, pipeline.model.config.resolution_schedule = 1, 100
    assert pipeline.model._get_downscale_factor() == 2
    _, halved, _ = pipeline.get_train_loss_dict(0)
    assert float(halved["depth"]) == pytest.approx(float(losses["depth"]), rel=0.5)  # of another frame


def test_splatfactos_scale_regularization_keeps_gaussians_round(capture_dir, semantic_trainer):
    trainer = semantic_trainer(capture_dir)
    model = trainer.pipeline.model
    model.config.use_scale_regularization, model.config.max_gauss_ratio = True, 2.0
    with torch.no_grad():
        model.gauss_params["scales"][:, 0] = model.gauss_params["scales"][:, 1:].mean(1) + math.log(5)
        model.gauss_params["scales"][:, 1:] = model.gauss_params["scales"][:, :1] - math.log(5)
    model.step_cb(trainer.optimizers, 0)
    losses = trainer.pipeline.get_train_loss_dict(0)[1]
    assert float(losses["scale_reg"].detach()) == pytest.approx(0.1 * (5 - 2), rel=1e-4)
    model.step_cb(trainer.optimizers, 5)
    assert "scale_reg" not in trainer.pipeline.get_train_loss_dict(5)[1]


def test_depth_is_not_read_where_nothing_learns(depth_capture_dir, semantic_trainer):
    config = semantic_trainer(depth_capture_dir).config.pipeline
    pipeline = config.setup(device="cpu", test_mode="inference")
    assert not pipeline.findings and "views" not in pipeline.datamanager.train_dataset.__dict__


@pytest.mark.parametrize("state", [0, 1])
def test_a_state_of_another_world_is_told(capture_dir, semantic_trainer, tmp_path, state):
    capture = shutil.copytree(capture_dir, tmp_path / "capture")
    file = capture / "state_01/transforms.json"
    meta = json.loads(file.read_text())
    for frame in meta["frames"]:
        frame["transform_matrix"][0][3] += 50
    file.write_text(json.dumps(meta))
    config = semantic_trainer(capture).config.pipeline
    config.datamanager.dataparser.state = state
    told = ["--worlds similar" in note for note in config.setup(device="cpu").notes]
    assert any(told) == (state == 1)


def test_depth_that_contradicts_itself_is_told_and_not_used(depth_capture_dir, semantic_trainer, tmp_path):
    capture = shutil.copytree(depth_capture_dir, tmp_path / "capture")
    file = capture / "state_00/transforms.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"depth_unit_scale_factor": 1.0}))
    trainer = semantic_trainer(capture)
    pipeline = trainer.pipeline
    (note,) = pipeline.notes
    assert note.startswith("state_00: other frames confirm ") and "depth_unit_scale_factor" in note
    assert pipeline.findings["depth"]["confirmed"] < 0.3
    pipeline.model.step_cb(trainer.optimizers, 0)
    assert float(pipeline.get_train_loss_dict(0)[1]["depth"]) == 0


@pytest.mark.parametrize(("uneven", "evened"), [(0.06, False), (0.16, True)])
def test_frames_are_evened_where_their_gains_are_uneven(capture_dir, semantic_trainer, monkeypatch, uneven, evened):
    pipeline = semantic_trainer(capture_dir, steps=301, semantic_start=300).pipeline
    pipeline.model.gauss_params["opacities"].data.fill_(5)
    monkeypatch.setattr(semantic, "unevenness", lambda gains, views: uneven)
    for step in (60, 120, 180):
        pipeline._even_exposures(step)
    assert bool(pipeline.notes) == evened == bool((pipeline.model.gains != 1).any())


def test_frames_of_different_exposures_are_evened_also_for_the_next_stage(capture_dir, semantic_trainer, tmp_path):
    capture, gains = shutil.copytree(capture_dir, tmp_path / "capture"), {}
    meta = json.loads((capture / "state_00/transforms.json").read_text())
    for k, name in enumerate(sorted(meta["train_filenames"])):
        gains[name] = 0.6 if k % 2 else 1.0
        image = cv2.imread(str(capture / "state_00" / name), cv2.IMREAD_UNCHANGED)
        image[..., :3] = (image[..., :3] * gains[name]).round()
        cv2.imwrite(str(capture / "state_00" / name), image)

    pipeline = semantic_trainer(capture, steps=301, semantic_start=300).pipeline
    pipeline.model.gauss_params["opacities"].data.fill_(5)
    before = shown_once(pipeline.datamanager)
    for step in (60, 120, 180):
        pipeline._even_exposures(step)
    assert pipeline.notes and "exposure" in pipeline.findings

    names = [f.image.relative_to(capture / "state_00") for f in pipeline.datamanager.train_dataset.metadata["frames"]]
    dark = torch.tensor([gains[str(name)] < 1 for name in names])
    found = pipeline.model.gains.mean(1)
    assert float(found[dark].mean() / found[~dark].mean()) == pytest.approx(0.6, abs=0.06)
    after = shown_once(pipeline.datamanager)
    assert before.keys() == after.keys() == set(range(len(names)))
    for k, image in after.items():
        brighter = float(image[..., :3].float().mean() / before[k][..., :3].float().mean())
        assert (brighter > 1) == bool(dark[k])
        assert torch.equal(image[..., 3:], before[k][..., 3:])
    checkpoint = {f"_model.{name}": getattr(pipeline.model, name) for name in ("viewmats", "gains", "trusted")}
    for view, kept in zip(learned_views(pipeline.datamanager.capture, 0, checkpoint), pipeline._views, strict=True):
        assert torch.equal(view.rgb, kept.rgb)


def shown_once(datamanager):
    """The images of all training frames as training sees them, by index."""
    batches = [datamanager.next_train(0)[1] for _ in datamanager.train_dataset.views]
    return {batch["image_idx"]: batch["image"].clone() for batch in batches}


def test_what_was_cut_off_in_bright_frames_stays_out_of_their_gains(capture_dir, semantic_trainer, tmp_path):
    """Also after they were evened once, and are darker than white."""
    capture = shutil.copytree(capture_dir, tmp_path / "capture")
    meta = json.loads((capture / "state_00/transforms.json").read_text())
    for k, name in enumerate(sorted(meta["train_filenames"])):
        image = cv2.imread(str(capture / "state_00" / name), cv2.IMREAD_UNCHANGED)
        image[..., :3] = (image[..., :3] * (2.0 if k % 2 else 1.0)).clip(0, 255).round()
        cv2.imwrite(str(capture / "state_00" / name), image)
    pipeline = semantic_trainer(capture, steps=301, semantic_start=300).pipeline
    pipeline.model.gauss_params["opacities"].data.fill_(5)
    found = []
    for step in (60, 120, 180):
        pipeline._even_exposures(step)
        found.append(pipeline.model.gains)
    assert pipeline.notes and all(torch.allclose(gains, found[0], rtol=1e-4) for gains in found)


def test_refined_cameras_stay_after_an_evaluation_which_loads_images_again(capture_dir, semantic_trainer):
    pipeline = semantic_trainer(capture_dir, steps=301, semantic_start=300).pipeline
    assert pipeline.datamanager.cached_train  # is loaded, and the cameras with it
    pipeline.datamanager.train_cameras = copy.deepcopy(pipeline.datamanager.train_cameras)  # as on a GPU
    given = pipeline.datamanager.train_dataset.cameras.camera_to_worlds.clone()
    pipeline._refines = True
    pipeline._refine_cameras(round(PASSES[0].at * 300))
    refined = pipeline.datamanager.train_cameras.camera_to_worlds
    assert not torch.equal(refined, given)
    assert torch.equal(pipeline.datamanager.train_dataset.cameras.camera_to_worlds, refined)
    assert torch.allclose(viewmat_from_opengl(refined), pipeline.model.viewmats.float(), atol=1e-4)


@pytest.mark.parametrize(("asked", "refines"), [("on", True), ("auto", False)])
def test_cameras_without_contradictions_are_refined_if_that_is_asked_for(capture_dir, semantic_trainer, asked, refines):
    config = semantic_trainer(capture_dir).config.pipeline
    config.model.refine_cameras = asked
    assert config.setup(device="cpu")._refines == refines


@pytest.mark.parametrize("now, told", [(3, "and now do so by 3."), (13, "refining them did not help")])
def test_cameras_that_contradict_each_other_as_much_as_before_are_not_called_mended(
    capture_dir, semantic_trainer, now, told
):
    pipeline = semantic_trainer(capture_dir).pipeline
    pipeline.datamanager.slack, pipeline._slack = Slack(pixels=13), Slack(pixels=now)
    pipeline._note_cameras()
    assert told in pipeline.notes[-1]


@pytest.mark.parametrize("pixels", [0.1, 2.0])
def test_parts_thinner_than_a_pixel_are_named_where_cameras_hardly_moved_and_still_contradict_each_other(
    capture_dir, semantic_trainer, pixels
):
    """A cable's silhouettes have gaps, which are not those of the other views, however exact the cameras are."""
    pipeline = semantic_trainer(capture_dir).pipeline
    pipeline.datamanager.slack = pipeline._slack = Slack(pixels=4)
    viewmats, focal = pipeline._given.clone(), torch.stack([view.K[0, 0] for view in pipeline._views])
    viewmats[:, 0, 3] += pixels * viewmats[:, 2, 3] / focal
    pipeline.model.viewmats = viewmats
    pipeline._note_cameras()
    note = pipeline.notes[-1]
    assert note.endswith(" check poses, intrinsics and masks.")
    assert ("0.1 pixels in the images; if no part is thinner than a pixel, as cables are," in note) == (pixels < 1)


@pytest.mark.parametrize("pixels, moved", [(0.3, False), (1.0, True)])
def test_cameras_of_images_without_silhouettes_move_if_that_is_by_pixels(
    opaque_capture_dir, semantic_trainer, monkeypatch, pixels, moved
):
    pipeline = semantic_trainer(opaque_capture_dir, steps=301, semantic_start=300).pipeline
    given = pipeline.model.viewmats.clone()
    assert pipeline.datamanager.cached_train  # is loaded, and the cameras with it

    def shifted(splat, views, given, compared, hull):
        assert len(hull[0]) > 0  # the labelled frames say where the object may be
        found = given.clone()
        found[:, 0, 3] += pixels * given[:, 2, 3] / torch.stack([view.K[0, 0] for view in views])
        return found

    monkeypatch.setattr(semantic, "refine_cameras", shifted)
    for each in PASSES:
        pipeline._refine_cameras(round(each.at * 300))
        assert torch.equal(pipeline.model.viewmats, given) == (not moved and each.at >= TRIED.at)
    assert bool(pipeline.model.cameras_refined) == moved
    assert ("cameras" in pipeline.findings) == moved == any("1.0 pixels" in note for note in pipeline.notes)
    seen = torch.stack([view.viewmat for view in pipeline._views])
    assert torch.equal(seen, pipeline.model.viewmats.float().cpu())


def test_a_checkpoint_is_looked_at(capture_dir, semantic_trainer):
    trainer = semantic_trainer(capture_dir)
    trainer.save_checkpoint(3)
    file = trainer.checkpoint_dir / "step-000000003.ckpt"
    looked_at = trainer.config.pipeline.setup(device="cpu", test_mode="test")
    looked_at.load_pipeline(torch.load(file)["pipeline"], 3)
    assert torch.equal(looked_at.model.means, trainer.pipeline.model.means)


def test_masked_pixels_count_in_no_loss_of_colour_and_silhouette(capture_dir, semantic_trainer, tmp_path):
    capture = shutil.copytree(capture_dir, tmp_path / "capture")
    file = capture / "state_00/transforms.json"
    meta = json.loads(file.read_text())
    for frame in meta["frames"]:
        frame["mask_path"] = "mask.png"
    file.write_text(json.dumps(meta))
    mask = np.repeat([[255, 0]], 32, axis=1).repeat(64, axis=0).astype(np.uint8)
    assert cv2.imwrite(str(capture / "state_00/mask.png"), mask)
    trainer = semantic_trainer(capture)
    model = trainer.pipeline.model
    model.step_cb(trainer.optimizers, 0)
    camera, batch = trainer.pipeline.datamanager.next_train(0)
    assert not batch["mask"].all() and batch["mask"].any()
    outputs = model(camera)
    spoiled = batch | {"image": torch.where(batch["mask"], batch["image"], 1.0)}
    losses, spoiled = (model.get_loss_dict(outputs, data) for data in (batch, spoiled))
    assert {name: float(x) for name, x in losses.items()} == pytest.approx({n: float(x) for n, x in spoiled.items()})
