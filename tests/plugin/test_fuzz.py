"""What stages read of earlier runs, whatever is in it: all they need, or one sentence. `make fuzz` tries more."""

import io
import os
import pickle
from types import SimpleNamespace

import pytest
import torch
from fuzzing import damaged_bytes, damaged_json, fuzzed, one_sentence
from hypothesis import given

from splatart_ns.errors import InputError
from splatart_ns.plugin.compat import finished_runs, read_checkpoint, read_run_config, run_setting
from splatart_ns.plugin.gaussians import SPLAT_SHAPES, splat_from_state
from splatart_ns.plugin.report import Report
from splatart_ns.plugin.semantic_run import find_semantic_runs
from splatart_ns.plugin.settings import Settings

CONFIG = """!!python/object:splatart_ns.plugin.joint.JointTrainerConfig
max_num_iterations: 10
method_name: splatart-semantic
pipeline: !!python/object:a.B
  datamanager: !!python/object:c.D
    data: &id001 !!python/object/apply:pathlib.PosixPath
    - /
    - capture
    dataparser: !!python/object:e.F
      data: *id001
      state: 1
_target: !!python/name:os.system ''
"""
TREE = {
    "max_num_iterations": 10,
    "pipeline": {"datamanager": {"data": ["/", "capture"], "dataparser": {"data": ["/", "capture"], "state": 1}}},
}


@pytest.fixture
def run(tmp_path, monkeypatch):
    """The config.yml of a finished run under outputs/."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "outputs/capture/splatart-semantic/fit"
    (folder / "nerfstudio_models").mkdir(parents=True)
    (folder / "nerfstudio_models/step-000000009.ckpt").write_bytes(CHECKPOINT)
    return folder / "config.yml"


def checkpoint(**more):
    sizes = {"Gaussians": 4, "parts": 3, "coefficients": 3}
    state = {name: torch.ones([sizes.get(s, s) for s in shape]) for name, shape in SPLAT_SHAPES.items()}
    file = io.BytesIO()
    torch.save({"step": 9, "pipeline": state, **more}, file)
    return file.getvalue()


CHECKPOINT = checkpoint()


@given(data=damaged_bytes(CONFIG.encode()) | damaged_json(TREE))
@fuzzed
def test_any_config_of_a_run(run, tmp_path, data):
    run.write_bytes(data)
    config = one_sentence(read_run_config, run)
    assert config is None or isinstance(config, dict)
    one_sentence(run_setting, run, "pipeline", "datamanager", "dataparser", "state")
    one_sentence(finished_runs, tmp_path / "outputs", tmp_path / "capture", "splatart-semantic")
    one_sentence(find_semantic_runs, tmp_path / "outputs", tmp_path / "capture", 2)


@given(data=damaged_bytes(CHECKPOINT))
@fuzzed
def test_any_checkpoint(run, data):
    (run.parent / "nerfstudio_models/step-000000009.ckpt").write_bytes(data)
    if (state := one_sentence(read_checkpoint, run, SPLAT_SHAPES)) is not None:
        assert len(splat_from_state(state)) == len(state["_model.gauss_params.means"])


class Code:
    def __init__(self, witness):
        self.witness = witness

    def __reduce__(self):
        return os.mkdir, (str(self.witness),)


@pytest.mark.parametrize("kind", ["zip", "pickle"])
def test_a_checkpoint_runs_nothing(run, tmp_path, kind):
    file, code = run.parent / "nerfstudio_models/step-000000010.ckpt", Code(tmp_path / "witness")
    file.write_bytes(checkpoint(code=code) if kind == "zip" else pickle.dumps({"pipeline": code}))
    with pytest.raises(InputError, match="cannot be read"):
        read_checkpoint(run, {})
    assert not (tmp_path / "witness").exists()


@pytest.mark.parametrize(
    "state",
    [
        None,
        [],
        {},
        {"_model.gauss_params.means": 3},
        {"_model.gauss_params.means": torch.ones(4, 2)},
        {"_model.gauss_params.means": torch.ones(4, 3).to_sparse()},
        {name: torch.ones([{"Gaussians": 4}.get(s, 3) for s in shape]) for name, shape in SPLAT_SHAPES.items()}
        | {"_model.gauss_params.quats": torch.ones(5, 4)},
    ],
    ids=["null", "list", "nothing", "number", "shape", "sparse", "other count"],
)
def test_a_checkpoint_without_the_tensors_that_a_stage_needs_is_refused(run, state):
    torch.save({"pipeline": state}, run.parent / "nerfstudio_models/step-000000010.ckpt")
    with pytest.raises(InputError, match="has no '_model.gauss_params"):
        read_checkpoint(run, SPLAT_SHAPES)


REPORT = {
    "capture": "/c",
    "capture_sha256": "d",
    "settings": {"quality": "draft", "root": None, "joints": [], "worlds": "shared", "seed": 0},
    "device": "cpu",
    "rasterizer": "numba",
    "versions": {"splatart-ns": "1"},
    "stages": [
        {"name": "semantic a", "seconds": 2, "wall_seconds": 1.5},
        {"name": "joint", "seconds": 1},
    ],
    "seconds": 2.5,
}


@given(data=damaged_json(REPORT))
@fuzzed
def test_any_report_of_an_interrupted_fit(tmp_path, monkeypatch, data):
    """It goes on from there, or starts over, or says that the file is none."""
    head = {key: value for key, value in REPORT.items() if key not in ("stages", "seconds")}
    monkeypatch.setattr("splatart_ns.plugin.report.report_head", lambda *_: head)
    file = tmp_path / "report.json"
    file.write_bytes(data)
    report = one_sentence(Report, file, SimpleNamespace(), Settings("draft", None, 0))
    if report is None:
        assert file.read_bytes() == data
        return
    for stage in ("semantic a", "joint"):
        if not report.resume(stage, whole=True):
            report.add(stage, {"seconds": 1.0, "notes": []})
    assert [stage["name"] for stage in report.data["stages"]] == ["semantic a", "joint"]
