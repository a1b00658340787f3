"""Reading what stage 1 left."""

import json
from pathlib import Path

import pytest
import torch

from splatart_ns.capture.check import require_valid
from splatart_ns.capture.digest import training_digest
from splatart_ns.capture.view import load_views
from splatart_ns.errors import InputError
from splatart_ns.plugin import semantic_run
from splatart_ns.plugin.semantic_run import find_semantic_runs, learned_views, read_state


def test_semantic_runs_that_are_not_there_are_named_by_state(capture_dir, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="--state 0` first, or name .* by --pipeline.semantic-runs"):
        find_semantic_runs(Path("outputs"), capture_dir, 2)


def test_the_runs_chosen_are_told_and_what_their_settings_differ_in(tmp_path, capsys):
    model = {"sh_degree": 1, "ssim_lambda": 0.2}
    for state, sh_degree in ((0, 1), (1, 2)):
        folder = tmp_path / "runs/door/splatart-semantic" / str(state)
        (folder / "nerfstudio_models").mkdir(parents=True)
        torch.save({}, folder / "nerfstudio_models/step-000000009.ckpt")
        manager = {"data": [str(tmp_path)], "dataparser": {"state": state}, "seed": 0}
        pipeline = {"datamanager": manager, "model": model | {"sh_degree": sh_degree}}
        (folder / "config.yml").write_text(json.dumps({"max_num_iterations": 10, "pipeline": pipeline}))
    runs = find_semantic_runs(tmp_path / "runs", tmp_path, 2)
    first, second, warning = capsys.readouterr().out.splitlines()
    assert (first, second) == (f"State 0: {runs[0]}", f"State 1: {runs[1]}")
    assert warning.startswith("Warning: these runs had different settings (sh_degree), ")


def test_views_are_seen_as_stage_1_left_them(capture_dir):
    capture = require_valid(capture_dir)
    views = load_views(capture, 0, "train")
    labelled = [view.labels is not None for view in views]
    trusted = torch.tensor(labelled)
    trusted[labelled.index(True)] = False
    moved = torch.stack([view.viewmat for view in views]).double() + 0.01
    checkpoint = {"_model.viewmats": moved, "_model.gains": torch.ones(len(views), 3), "_model.trusted": trusted}
    seen = learned_views(capture, 0, checkpoint)
    assert [view.labels is not None for view in seen] == trusted.tolist()
    assert torch.equal(torch.stack([view.viewmat for view in seen]), moved.float())
    small = learned_views(capture, 0, checkpoint, downscale=2)
    assert [(view.width, *view.rgb.shape[:2]) for view in small] == [(32, 32, 32)] * len(views)
    assert all(view.depth is None for view in seen)


def test_opaque_views_show_the_silhouette_of_their_labels_or_of_the_splat(opaque_capture_dir, monkeypatch):
    capture = require_valid(opaque_capture_dir)
    views = load_views(capture, 0, "train")
    ball = {"means": [[0.0] * 3], "scales": [[-1.5] * 3], "quats": [[1.0, 0, 0, 0]], "opacities": [[5.0]]}
    ball |= {"features_dc": [[0.0] * 3], "features_rest": torch.zeros(1, 0, 3), "semantics": [[-9.0, 9.0, -9.0]]}
    checkpoint = {f"_model.gauss_params.{name}": torch.as_tensor(value) for name, value in ball.items()} | {
        "_model.viewmats": torch.stack([view.viewmat for view in views]).double(),
        "_model.gains": torch.ones(len(views), 3),
        "_model.trusted": torch.arange(len(views)) > 0,
        "_model.trained_on": torch.tensor(list(training_digest(capture, 0))),
        "_model.cameras_refined": torch.tensor(False),
    }
    monkeypatch.setattr(semantic_run, "read_checkpoint", lambda *_: checkpoint)
    unlabelled, *others = read_state(capture, 0, Path("config.yml"), 2, "cpu").views
    assert unlabelled.labels is None
    assert (unlabelled.alpha[16, 16], unlabelled.alpha[0, 0]) == (255, 0)  # the ball is where cameras look
    assert all(torch.equal(view.alpha > 0, view.labels > 0) for view in others)


def test_depth_that_no_other_view_confirms_is_left_out(depth_capture_dir):
    capture = require_valid(depth_capture_dir)
    views = load_views(capture, 0, "train")
    checkpoint = {"_model.viewmats": torch.stack([view.viewmat for view in views]).double()}
    checkpoint |= {"_model.gains": torch.ones(len(views), 3), "_model.trusted": torch.ones(len(views)).bool()}
    for view, given in zip(learned_views(capture, 0, checkpoint), views, strict=True):
        known = view.depth > 0
        assert torch.equal(view.depth[known], given.depth[known])
        assert 0.6 * (given.depth > 0).sum() < known.sum() < (given.depth > 0).sum()
