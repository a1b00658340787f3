"""`splatart fit`: what it leaves, and that it goes on where it was ended."""

import errno
import fcntl
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from splatart_ns.bundle import load_bundle
from splatart_ns.bundle.export.folder import export_folder
from splatart_ns.errors import InputError
from splatart_ns.plugin.fit_lock import alone_in

STAGES = ["semantic state_00", "semantic state_01", "pose", "joint"]
RUNS = ["state_00/splatart-semantic", "state_01/splatart-semantic", "all/splatart-pose", "all/splatart-joint"]


@pytest.fixture
def fit_copy(hinge_fit, tmp_path):
    return shutil.copytree(hinge_fit, tmp_path / "bundle")


def contents(folder):
    """Every file's bytes and time of change."""
    return {f.relative_to(folder): (f.read_bytes(), f.stat().st_mtime_ns) for f in folder.rglob("*") if f.is_file()}


SETTINGS = {
    "quality": "draft",
    "root": None,
    "seed": 0,
    "rasterizer": "auto",
    "joints": [],
    "worlds": "shared",
    "refine_cameras": "auto",
    "downscale": 1,
}


def change_json(file, change):
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def results(folder):
    """The bytes of what a fit is for."""
    return {f.relative_to(folder): f.read_bytes() for f in [folder / "articulation.json", *folder.glob("parts/*")]}


def finished_stages(folder):
    report = folder / "report.json"
    return [stage["name"] for stage in json.loads(report.read_text())["stages"]] if report.exists() else []


def test_the_bundle_is_complete(hinge_fit):
    bundle = load_bundle(hinge_fit)
    assert [(part.id, part.name) for part in bundle.parts] == [(1, "base"), (2, "lid")]
    assert bundle.states == ["state_00", "state_01"]
    assert bundle.length_unit == "metre"
    assert sorted(f.name for f in (hinge_fit / "parts").iterdir()) == ["base.ply", "lid.ply"]
    assert all(len(part.splat) > 100 for part in bundle.parts)
    assert bundle.provenance["seed"] == 0
    assert bundle.provenance["settings"] == SETTINGS
    assert sorted(f.name for f in hinge_fit.iterdir()) == ["articulation.json", "parts", "report.json", "runs"]


def test_the_joint_is_the_true_one(hinge_fit, hinge_capture):
    (true,) = json.loads((hinge_capture / "ground_truth.json").read_text())["joints"]
    (joint,) = load_bundle(hinge_fit).joints
    assert (joint.type, joint.parent, joint.child, joint.in_tree) == ("revolute", "base", "lid", True)
    axis, origin = (torch.tensor(true[key], dtype=torch.float64) for key in ("axis", "origin"))
    cosine = float(joint.axis @ axis)
    assert math.degrees(math.acos(min(abs(cosine), 1))) < 3
    assert float(torch.linalg.cross(joint.origin - origin, axis).norm()) < 0.01
    turned = true["values"][1] - true["values"][0]
    assert abs(float(joint.values[1]) * math.copysign(1, cosine) - turned) < math.radians(3)


def test_the_report_tells_what_every_stage_took(hinge_fit):
    report = json.loads((hinge_fit / "report.json").read_text())
    assert [stage["name"] for stage in report["stages"]] == STAGES
    for stage in report["stages"]:
        assert all(stage[key] > 0 for key in ("seconds", "iterations", "gaussians", "peak_memory_mb"))
    assert report["seconds"] == pytest.approx(sum(stage["wall_seconds"] for stage in report["stages"]), abs=0.01)
    assert report["settings"] == SETTINGS
    assert {"python", "torch", "nerfstudio", "splatart-ns"} <= set(report["versions"])
    pose = report["stages"][STAGES.index("pose")]
    assert [state["state"] for state in pose["images"]] == ["state_00", "state_01"]
    assert all(24 < state["psnr"] < 60 for state in pose["images"])
    thinned = pose["thinned"]
    assert thinned["gaussians"][0] > thinned["gaussians"][1] == report["stages"][-1]["gaussians"]
    assert report["stages"][-1]["gaussians"] == sum(len(part.splat) for part in load_bundle(hinge_fit).parts)


@pytest.mark.parametrize("stage", range(4))
def test_nerfstudio_opens_the_runs(hinge_fit, stage):
    from nerfstudio.utils.eval_utils import eval_setup

    config = hinge_fit / "runs" / RUNS[stage] / "fit/config.yml"
    _, pipeline, checkpoint, _ = eval_setup(config)
    assert checkpoint.parent.parent == config.parent
    report = json.loads((hinge_fit / "report.json").read_text())
    assert pipeline.model.num_points == report["stages"][stage]["gaussians"]
    camera = pipeline.datamanager.eval_dataset.cameras[:1]
    assert float(pipeline.model.get_outputs_for_camera(camera)["accumulation"].max()) > 0.9


@pytest.mark.skipif(torch.cuda.is_available(), reason="gsplat adds gradients up in any order")
def test_an_interrupted_fit_ends_like_an_uninterrupted_one(hinge_fit, hinge_capture, start_splatart, tmp_path):
    """A fit of the same seed in another folder, ended in the middle of every stage, has the same bytes at the end."""
    bundle = tmp_path / "bundle"
    arguments = ("fit", hinge_capture, "--output-dir", bundle, "--quality", "draft")
    for sign, finished, run in [
        (signal.SIGKILL, [], RUNS[0]),
        (signal.SIGINT, [], RUNS[0]),
        (signal.SIGKILL, STAGES[:2], RUNS[2]),
    ]:
        shutil.rmtree(bundle / "runs" / run, ignore_errors=True)
        process = start_splatart(*arguments)
        while process.poll() is None and finished_stages(bundle) != finished:
            time.sleep(0.02)
        while process.poll() is None and not (bundle / "runs" / run / "fit/dataparser_transforms.json").exists():
            time.sleep(0.02)
        time.sleep(0.5)
        process.send_signal(sign)
        _, errors = process.communicate()
        assert finished_stages(bundle) == finished
        assert not (bundle / "articulation.json").exists()
        if sign == signal.SIGINT:
            assert process.returncode == 130
            assert errors.startswith("Interrupted. ") and errors.count("\n") == 1
        else:
            assert process.returncode == -sign

    process = start_splatart(*arguments)
    _, errors = process.communicate()
    assert (process.returncode, errors) == (0, "")
    assert finished_stages(bundle) == STAGES
    assert results(bundle) == results(hinge_fit)


def test_a_finished_fit_is_left_alone_and_told_again(fit_copy, hinge_capture, run_main):
    before = contents(fit_copy)
    code, told, _ = run_main("fit", hinge_capture, "--output-dir", fit_copy, "--quality", "draft")
    assert code == 0 and contents(fit_copy) == before
    *_, root, lid, error, bundle, config = told.splitlines()
    assert root == "base: the root" and lid.startswith("  lid: revolute on base, axis ± ") and "degree" in lid
    report = json.loads((fit_copy / "report.json").read_text())
    assert error.startswith("PSNR of training images: state_00 ") and error.endswith(f" dB; {report['seconds']:.0f} s")
    assert bundle == f"Bundle: {fit_copy}" and Path(config.removeprefix("Config: ")).exists()


def test_a_finished_fit_is_left_alone_however_its_capture_is_spelled(fit_copy, hinge_capture, run_main, monkeypatch):
    before = contents(fit_copy)
    monkeypatch.chdir(hinge_capture)
    again = f"../{hinge_capture.name}"
    assert run_main("fit", again, "--output-dir", fit_copy, "--quality", "draft")[0] == 0
    assert contents(fit_copy) == before


def test_a_fit_does_not_go_among_the_images(hinge_capture, run_main, tmp_path):
    capture = tmp_path / "capture"
    shutil.copytree(hinge_capture, capture)
    frames = []
    for k in range(2):
        meta = json.loads((capture / f"state_{k:02d}/transforms.json").read_text())
        for frame in meta.pop("frames"):
            paths = {key: f"state_{k:02d}/{value}" for key, value in frame.items() if key.endswith("path")}
            frames.append({**frame, **paths, "state": k})
        (capture / f"state_{k:02d}/transforms.json").unlink()
    shared = {key: value for key, value in meta.items() if not key.endswith("filenames")}
    (capture / "transforms.json").write_text(json.dumps({**shared, "frames": frames}))
    code, _, errors = run_main("fit", capture, "--output-dir", capture / "state_00/images/out", "--quality", "draft")
    assert code == 2 and "holds the capture's files" in errors


def test_a_damaged_bundle_is_written_again(fit_copy, hinge_fit, hinge_capture, run_main):
    (fit_copy / "articulation.json").write_text("{")
    (fit_copy / "parts/lid.ply").unlink()
    assert run_main("fit", hinge_capture, "--output-dir", fit_copy, "--quality", "draft")[0] == 0
    assert results(fit_copy) == results(hinge_fit)


def test_another_root_takes_the_last_stage_only(fit_copy, hinge_capture, run_main):
    before = contents(fit_copy)
    assert run_main("fit", hinge_capture, "--output-dir", fit_copy, "--quality", "draft", "--root", "lid")[0] == 0
    after = contents(fit_copy)
    runs = [fit_copy / "runs" / run for run in RUNS[:3]]
    assert all(after[f] == before[f] for f in before if any((fit_copy / f).is_relative_to(run) for run in runs))
    bundle = load_bundle(fit_copy)
    assert bundle.root == "lid"
    assert [(joint.parent, joint.child) for joint in bundle.joints] == [("lid", "base")]
    assert finished_stages(fit_copy) == STAGES


def test_the_users_word_on_a_joint_holds(fit_copy, hinge_capture, run_main):
    arguments = ("fit", hinge_capture, "--output-dir", fit_copy, "--quality", "draft")
    assert run_main(*arguments, "--joint", "lid:base=prismatic")[0] == 0
    assert [joint.type for joint in load_bundle(fit_copy).joints] == ["prismatic"]
    assert finished_stages(fit_copy) == STAGES
    code, _, errors = run_main(*arguments, "--joint", "lid:body")
    assert code == 2 and "body" in errors and "base, lid" in errors


@pytest.mark.parametrize(
    ("first", "others", "times"),
    [
        ((256, 300), (800, 800), (2, 1, 1)),
        ((255, 300), (800, 800), (1, 1, 1)),
        ((801, 600), (800, 800), (4, 2, 1)),
        ((1080, 1920), (1080, 1920), (6, 3, 2)),
        ((4032, 3024), (800, 800), (6, 6, 3)),
    ],
)
def test_large_images_and_those_of_drafts_are_looked_at_smaller_where_enough_is_left(
    hinge_capture, tmp_path, first, others, times
):
    from splatart_ns.capture.formats import load_capture
    from splatart_ns.plugin.settings import Settings
    from splatart_ns.plugin.stage_configs import stage_configs

    capture = load_capture(hinge_capture)
    sizes = iter([first])

    def resized(frame):
        width, height = next(sizes, others)
        return replace(frame, camera=replace(frame.camera, width=width, height=height))

    states = [replace(state, frames=tuple(map(resized, state.frames))) for state in capture.states]
    capture = replace(capture, states=states)
    for quality, expected in zip(("draft", "standard", "high"), times, strict=True):
        for downscale, wanted in [(None, expected), (1, 1), (5, 5)]:
            settings = Settings(quality, None, 0, downscale=downscale)
            for config in stage_configs(capture, tmp_path, settings).values():
                assert config.pipeline.datamanager.camera_res_scale_factor == 1 / wanted


def test_what_is_asked_for_reaches_the_stages(hinge_capture, tmp_path):
    from splatart_ns.capture.formats import load_capture
    from splatart_ns.plugin.settings import Settings
    from splatart_ns.plugin.stage_configs import stage_configs

    capture, settings = load_capture(hinge_capture), Settings("draft", "lid", 7, worlds="similar", refine_cameras="on")
    *semantic, pose, joint = stage_configs(capture, tmp_path, settings).values()
    for config in (*semantic, pose, joint):
        assert (config.machine.seed, config.pipeline.datamanager.dataparser.worlds) == (7, "similar")
    for config in semantic:
        assert (config.pipeline.model.refine_cameras, config.pipeline.datamanager.seed) == ("on", 7)
    assert (pose.pipeline.seed, joint.pipeline.seed) == (7, 7)
    assert (pose.pipeline.root, joint.pipeline.root) == ("lid", "lid")
    *_, pose, joint = stage_configs(capture, tmp_path, replace(settings, worlds="shared")).values()
    assert (pose.pipeline.root, joint.pipeline.root) == (None, "lid")  # poses in one world do not hang on it


def test_a_fit_says_how_much_smaller_it_looks_at_images(hinge_capture, tmp_path, monkeypatch, capsys):
    from splatart_ns.plugin import fit as fits
    from splatart_ns.plugin import settings

    monkeypatch.setattr(fits, "_train", lambda *_, **__: None)
    monkeypatch.setattr(fits, "_tell", lambda *_: None)
    monkeypatch.setattr(settings, "SMALLEST", 20)
    for downscale, told in {None: True, 2: False}.items():
        fits.fit(hinge_capture, tmp_path / f"new_{downscale}", "draft", downscale=downscale)
        assert ("1/2 of their size; --downscale 1" in " ".join(capsys.readouterr().out.split())) == told


def test_a_fit_says_first_what_check_warns_of(hinge_capture, tmp_path, monkeypatch, capsys):
    from splatart_ns.plugin import fit as fits

    capture = shutil.copytree(hinge_capture, tmp_path / "capture")
    for file in capture.glob("state_*/semantics/*.png"):
        labels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(file), cv2.blur(labels, (2, 2)))
    monkeypatch.setattr(fits, "_train", lambda *_, **__: None)
    monkeypatch.setattr(fits, "_tell", lambda *_: None)
    monkeypatch.setattr(fits, "MOST_WARNINGS", 1)
    fits.fit(capture, tmp_path / "bundle")
    told = " ".join(capsys.readouterr().out.split())
    assert told.count("Warning: ") == 1 and "seem to be resized or anti-aliased" in told
    assert "And 1 more warnings, see `splatart check" in told


def test_a_second_fit_in_a_folder_is_refused_while_the_first_one_runs(hinge_capture, tmp_path, monkeypatch, run_main):
    from splatart_ns.plugin import fit as fits

    arguments = ("fit", hinge_capture, "--output-dir", tmp_path / "bundle")
    said = []

    def train(*_, **__):
        said.append(run_main(*arguments))

    monkeypatch.setattr(fits, "_train", train)
    monkeypatch.setattr(fits, "_tell", lambda *_: None)
    assert run_main(*arguments)[0] == 0
    assert len(said) == 3  # stages, each of which was the first fit's
    for code, _, errors in said:
        assert code == 2 and "another fit is at work there" in errors and errors.count("\n") == 1
    assert [path.name for path in (tmp_path / "bundle").iterdir()] == ["runs"]


def test_a_fit_that_was_killed_leaves_no_lock(tmp_path):
    code = (
        "import os, pathlib, signal\n"
        "from splatart_ns.plugin.fit_lock import alone_in\n"
        f"with alone_in(pathlib.Path({str(tmp_path)!r})):\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == -signal.SIGKILL
    with alone_in(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_fit_goes_on_where_the_file_system_has_no_locks(tmp_path, monkeypatch):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with alone_in(tmp_path), alone_in(tmp_path):
        pass


class TestResuming:
    """What of an earlier run counts."""

    @pytest.fixture
    def report(self):
        from splatart_ns.capture.formats import load_capture
        from splatart_ns.plugin.report import Report
        from splatart_ns.plugin.settings import Settings

        def make(bundle, capture, quality="draft", root=None, seed=0, rasterizer="auto", joints=(), worlds=None):
            settings = Settings(quality, root, seed, rasterizer, list(joints), worlds)
            return Report(bundle / "report.json", load_capture(capture), settings)

        return make

    def test_all_stages_of_the_same_fit(self, report, fit_copy, hinge_capture):
        again = report(fit_copy, hinge_capture)
        assert all(again.resume(stage, whole=True) for stage in STAGES)

    @pytest.mark.parametrize("other", [{"seed": 1}, {"quality": "high"}, {"rasterizer": "torch"}])
    def test_none_with_other_settings(self, report, fit_copy, hinge_capture, other):
        assert not report(fit_copy, hinge_capture, **other).resume(STAGES[0], whole=True)
        assert finished_stages(fit_copy) == []

    def test_none_with_another_root_that_brought_worlds_together(self, report, hinge_capture, tmp_path):
        report(tmp_path, hinge_capture, root="lid", worlds="similar").add(STAGES[0], {"seconds": 1.0})
        for root, known in (("lid", True), ("base", False)):
            again = report(tmp_path, hinge_capture, root=root, worlds="similar")
            assert again.resume(STAGES[0], whole=True) == known

    def test_none_of_another_version(self, report, fit_copy, hinge_capture, capsys):
        change_json(fit_copy / "report.json", lambda told: told["versions"].update({"splatart-ns": "0.0.1"}))
        assert not report(fit_copy, hinge_capture).resume(STAGES[0], whole=True)
        assert "holds a fit by splatart-ns 0.0.1; starting over" in " ".join(capsys.readouterr().out.split())

    def test_the_machine_that_trained_stays_in_the_report(self, report, fit_copy, hinge_capture):
        change_json(fit_copy / "report.json", lambda told: told.update(device="cuda: a GPU", rasterizer="gsplat"))
        again = report(fit_copy, hinge_capture)
        assert all(again.resume(stage, whole=True) for stage in STAGES[:-1])
        again.add("joint", {})
        assert (again.data["device"], again.data["rasterizer"]) == ("cuda: a GPU", "gsplat")
        again.add("pose", {})
        assert again.data["device"] != "cuda: a GPU"

    def test_none_of_a_capture_that_was_changed(self, report, fit_copy, hinge_capture, tmp_path):
        changed = shutil.copytree(hinge_capture, tmp_path / "changed")
        file = fit_copy / "report.json"
        file.write_text(file.read_text().replace(json.dumps(str(hinge_capture)), json.dumps(str(changed))))
        assert report(fit_copy, changed).resume(STAGES[0], whole=True)
        labels = changed / "state_01/semantics/0003.png"
        image = cv2.imread(str(labels), cv2.IMREAD_UNCHANGED)
        assert cv2.imwrite(str(labels), np.where(image == 2, 0, image).astype(np.uint8))
        assert not report(fit_copy, changed).resume(STAGES[0], whole=True)

    def test_a_fit_of_another_capture_is_refused(self, report, fit_copy, hinge_capture):
        def moved(told):
            told["capture"] = "/elsewhere"

        change_json(fit_copy / "report.json", moved)
        assert not report(fit_copy, hinge_capture).resume(STAGES[0], whole=True)
        change_json(fit_copy / "report.json", lambda told: (moved(told), told.update(capture_sha256="0")))
        before = contents(fit_copy)
        with pytest.raises(InputError, match="bundle holds a fit of /elsewhere; choose another --output-dir"):
            report(fit_copy, hinge_capture)
        assert contents(fit_copy) == before

    def test_none_after_one_that_is_done_again(self, report, fit_copy, hinge_capture):
        again = report(fit_copy, hinge_capture)
        assert again.resume(STAGES[0], whole=True)
        assert not again.resume(STAGES[1], whole=False)
        assert finished_stages(fit_copy) == STAGES[:1]
        assert not again.resume(STAGES[2], whole=True)

    def test_what_describes_the_earlier_fit_goes_before_a_stage_runs_again(self, report, fit_copy, hinge_capture):
        (fit_copy / "metrics.json").write_text("{}")
        with export_folder(fit_copy / "export/ply", {}) as folder:
            (folder / "bundle.ply").touch()
        (fit_copy / "notes.txt").write_text("mine")
        assert report(fit_copy, hinge_capture).resume(STAGES[0], whole=True)
        assert (fit_copy / "metrics.json").exists()
        assert not report(fit_copy, hinge_capture, seed=1).resume(STAGES[0], whole=True)
        assert sorted(f.name for f in fit_copy.iterdir()) == ["notes.txt", "report.json", "runs"]

    def test_a_folder_without_a_fit_keeps_its_files(self, report, hinge_capture, tmp_path):
        (tmp_path / "parts").mkdir()
        for name in ("parts/mine.ply", "metrics.json"):
            (tmp_path / name).write_text("mine")
        assert not report(tmp_path, hinge_capture).resume(STAGES[0], whole=True)
        assert (tmp_path / "metrics.json").exists() and (tmp_path / "parts/mine.ply").exists()

    def test_a_bundle_whose_report_was_removed_goes_too(self, report, fit_copy, hinge_capture):
        (fit_copy / "report.json").unlink()
        assert not report(fit_copy, hinge_capture).resume(STAGES[0], whole=True)
        assert sorted(f.name for f in fit_copy.iterdir()) == ["report.json", "runs"]
