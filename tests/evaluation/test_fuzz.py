"""What `splatart eval` reads, whatever is in it: a score, or one sentence. `make fuzz` tries more of it."""

import json
import math
import shutil
from importlib import import_module

import pytest
from fuzzing import damaged_bytes, damaged_json, fuzzed, one_sentence
from hypothesis import given
from hypothesis import strategies as st

from splatart_ns.bundle import save_bundle
from splatart_ns.errors import InputError
from splatart_ns.evaluation.evaluate import evaluate
from splatart_ns.evaluation.ground_truth import load_ground_truth
from splatart_ns.evaluation.tables import format_tables


@pytest.fixture
def copied(capture, tmp_path):
    return shutil.copytree(capture, tmp_path / "capture")


def damage(data, file):
    original = file.read_bytes()
    content = damaged_json(json.loads(original)) if file.suffix == ".json" else damaged_bytes(original)
    file.write_bytes(data.draw(content))
    return original


@given(data=st.data())
@fuzzed
def test_any_ground_truth(copied, data):
    points = sorted((copied / "ground_truth_points").iterdir())
    file = data.draw(st.sampled_from([copied / "ground_truth.json"] * 4 + points))
    original = damage(data, file)
    try:
        if (truth := one_sentence(load_ground_truth, copied)) is not None:
            assert truth.root in truth.parts and set(truth.motions) == set(truth.points) == set(truth.parts)
            assert all(T.isfinite().all() for T in truth.motions.values())
            assert all(len(x) and x.isfinite().all() for x in truth.points.values())
            assert 0 < truth.radius < math.inf
            for joint in truth.joints:
                assert joint.values.isfinite().all() and joint.origin.isfinite().all()
    finally:
        file.write_bytes(original)


@given(data=st.data())
@lambda test: fuzzed(test, one_in=10)  # a second each
def test_any_capture_is_scored_or_refused(copied, bundle, tmp_path, monkeypatch, data):
    scores = dict.fromkeys(("residual", "fitted_residual", "psnr", "part_iou"))
    module = import_module("splatart_ns.evaluation.evaluate")
    # These are slow, and read no file of their own.
    monkeypatch.setattr(module, "held_out_scores", lambda *_: scores)
    monkeypatch.setattr(module, "fitted_residuals", lambda *_: {})
    folder = tmp_path / "bundle"
    save_bundle(bundle, folder)
    (folder / "report.json").write_text('{"seconds": 3.0, "stages": [{"name": "pose", "seconds": 3.0}]}')
    truth = [copied / "ground_truth.json"] * 3 + sorted((copied / "ground_truth_points").iterdir())
    names = ["report.json", "articulation.json", "parts/door.ply"]
    files = truth + [folder / name for name in names] + sorted(copied.glob("*/novel_00/*.json"))
    file = data.draw(st.sampled_from(files))
    (folder / "metrics.json").unlink(missing_ok=True)
    original = damage(data, file)
    try:
        if (metrics := one_sentence(evaluate, folder, copied)) is not None:
            format_tables(metrics)
            json.loads((folder / "metrics.json").read_text())
        else:
            assert not (folder / "metrics.json").exists()
    finally:
        file.write_bytes(original)


@pytest.mark.parametrize("name", ["ground_truth.json", "ground_truth_points"])
def test_truth_that_is_a_link_out_of_the_capture_is_refused(copied, tmp_path, name):
    (copied / name).rename(tmp_path / "elsewhere")
    (copied / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="a link out of the capture"):
        load_ground_truth(copied)
