"""Runs side by side: what they tell, and that none outlives the fit that started it."""

import json
import os
import pickle
import shutil
import subprocess
import sys

import pytest
import torch
from rich.progress import Progress

from splatart_ns.capture.formats import load_capture
from splatart_ns.errors import InputError
from splatart_ns.plugin import stage_run
from splatart_ns.plugin.companion import Companions
from splatart_ns.plugin.fit import _train
from splatart_ns.plugin.report import Report
from splatart_ns.plugin.settings import Settings
from splatart_ns.plugin.stage_configs import _semantic_config
from splatart_ns.plugin.stage_run import num_processes, run_side_by_side, run_stage


def test_a_checkpoint_that_finds_no_room_is_refused_in_one_sentence(configs, monkeypatch, small_files):
    from nerfstudio.engine.trainer import Trainer

    def train(trainer):
        with small_files():
            trainer.save_checkpoint(0)

    monkeypatch.setattr(Trainer, "train", train)
    with pytest.raises(InputError, match="nerfstudio_models: cannot be written .*checkpoint"):
        run_stage(configs[0], lambda steps: None)


@pytest.fixture
def configs(hinge_capture, tmp_path):
    """A few steps of stage 1 for both states of a capture that a test may spoil."""
    capture = load_capture(shutil.copytree(hinge_capture, tmp_path / "capture"))
    settings = Settings("draft", None, 0).of(capture)
    configs = [_semantic_config(capture, k, tmp_path / "runs", settings) for k in range(2)]
    for config in configs:
        config.max_num_iterations, config.pipeline.model.semantic_start = 4, 2
        config.pipeline.datamanager.seed_gaussians = 100
    return configs


def test_outcomes_come_in_order_and_every_run_is_saved(configs):
    steps = {0: [], 1: []}
    outcomes = list(run_side_by_side(configs, 2, "auto", lambda index, done: steps[index].append(done), Companions()))
    assert [outcome["iterations"] for outcome in outcomes] == [4, 4]
    assert all(outcome["gaussians"] > 0 and outcome["seconds"] > 0 for outcome in outcomes)
    assert all(done == sorted(done) and done[-1] == 4 for done in steps.values())
    assert all(list(config.get_base_dir().glob("nerfstudio_models/step-*.ckpt")) for config in configs)


def test_a_fit_reports_states_side_by_side_in_order_and_takes_them_up_again(configs, monkeypatch, tmp_path):
    monkeypatch.setitem(os.environ, "OMP_NUM_THREADS", "2")
    capture = load_capture(tmp_path / "capture")
    stages = dict(zip(("semantic a", "semantic b"), configs, strict=True))
    for seen in ([], [4, 4]):
        report, progress = Report(tmp_path / "report.json", capture, Settings("draft", None, 0)), Progress()
        assert [entry["iterations"] for entry in report._earlier] == seen
        _train(stages, "auto", report, progress)
        assert all(task.finished for task in progress.tasks)
    told = json.loads((tmp_path / "report.json").read_text())
    assert [stage["name"] for stage in told["stages"]] == list(stages)
    assert told["seconds"] == pytest.approx(sum(stage["wall_seconds"] for stage in told["stages"]), abs=0.02)


@pytest.mark.skipif(torch.cuda.is_available(), reason="gsplat adds gradients up in any order")
def test_one_process_after_the_other_leaves_the_same(configs, tmp_path):
    def saved():
        return [next(c.get_base_dir().glob("nerfstudio_models/step-*.ckpt")).read_bytes() for c in configs]

    list(run_side_by_side(configs, 2, "auto", lambda *_: None, Companions()))
    beside = saved()
    shutil.rmtree(tmp_path / "runs")
    list(run_side_by_side(configs[:1], 2, "auto", lambda *_: None, Companions()))
    list(run_side_by_side(configs[1:], 2, "auto", lambda *_: None, Companions()))
    assert saved() == beside


def test_a_process_trains_one_run_after_the_other(configs):
    with Companions() as companions:
        (companion,) = companions.first(1)
        outcomes = [companion.train(config, "auto", 1, lambda steps: None) for config in configs]
        assert companions.first(1) == [companion]
    assert [outcome["iterations"] for outcome in outcomes] == [4, 4]
    assert companion._process.returncode is not None


def test_a_process_that_died_before_it_was_told_leaves_no_pipe_open(configs):
    with Companions() as companions:
        (companion,) = companions.first(1)
        process = companion._process
        process.kill()
        process.wait()
        with pytest.raises(RuntimeError, match="ended without a result"):
            companion.train(configs[0], "auto", 1, lambda steps: None)
    assert process.stdin.closed and process.stdout.closed


def test_a_users_mistake_in_a_run_is_told_as_one(configs, tmp_path):
    (tmp_path / "capture/state_01/transforms.json").unlink()
    with pytest.raises(InputError):
        list(run_side_by_side(configs, 2, "auto", lambda *_: None, Companions()))


def test_a_run_that_breaks_shows_its_last_words(configs):
    configs[1].pipeline.datamanager.seed = "no number"
    with Companions() as companions, pytest.raises(RuntimeError, match="Traceback"):
        companions.first(1)[0].train(configs[1], "auto", 1, lambda steps: None)


def test_a_run_that_breaks_ends_the_others(configs):
    configs[0].max_num_iterations = configs[1].max_num_iterations = 10**6
    configs[1].pipeline.datamanager.seed = "no number"
    with pytest.raises((RuntimeError, TypeError)):  # of another process, or of this one
        list(run_side_by_side(configs, 2, "auto", lambda *_: None, Companions()))


def test_a_run_ends_with_the_process_that_started_it(configs):
    configs[0].max_num_iterations = 10**6
    process = subprocess.Popen(
        [sys.executable, "-m", "splatart_ns.plugin.companion"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    try:
        pickle.dump((configs[0], "auto", 1), process.stdin)
        process.stdin.flush()
        assert json.loads(process.stdout.readline())["kind"] == "step"
        process.stdin.close()  # as when the other end dies
        assert process.wait(timeout=30) == 1
    finally:
        process.kill()


@pytest.mark.parametrize(("threads", "processes"), [("1", 1), ("8", 2)])
def test_a_gpu_trains_two_runs_at_most(monkeypatch, threads, processes):
    monkeypatch.setattr(stage_run, "default_device", lambda: "cuda")
    monkeypatch.setitem(os.environ, "OMP_NUM_THREADS", threads)
    assert num_processes(5) == processes


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU trains two at most")
@pytest.mark.parametrize(
    ("threads", "runs", "processes"), [("1", 3, 1), ("4", 3, 3), ("4", 8, 4), ("4,2", 8, 4), ("many", 1, 1)]
)
def test_no_more_processes_than_cores_the_user_grants(monkeypatch, threads, runs, processes):
    monkeypatch.setitem(os.environ, "OMP_NUM_THREADS", threads)
    assert num_processes(runs) == processes
