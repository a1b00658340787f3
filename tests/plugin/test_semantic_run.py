"""Reading what stage 1 left."""

import pytest
import torch

from splatart_ns.capture.check import require_valid
from splatart_ns.capture.view import load_views
from splatart_ns.errors import InputError
from splatart_ns.plugin.semantic_run import find_semantic_runs, learned_views


def test_semantic_runs_that_are_not_there_are_named_by_state(capture_dir, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="--state 0` first, or name .* by --pipeline.semantic-runs"):
        find_semantic_runs(capture_dir, 2)


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


def test_depth_that_no_other_view_confirms_is_left_out(depth_capture_dir):
    capture = require_valid(depth_capture_dir)
    views = load_views(capture, 0, "train")
    checkpoint = {"_model.viewmats": torch.stack([view.viewmat for view in views]).double()}
    checkpoint |= {"_model.gains": torch.ones(len(views), 3), "_model.trusted": torch.ones(len(views)).bool()}
    for view, given in zip(learned_views(capture, 0, checkpoint), views, strict=True):
        known = view.depth > 0
        assert torch.equal(view.depth[known], given.depth[known])
        assert 0.6 * (given.depth > 0).sum() < known.sum() < (given.depth > 0).sum()
