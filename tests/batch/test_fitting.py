"""`splatart batch` of real captures."""

import csv
import json
import shutil
import sys

import pytest
import torch
from bundle_of_two import save_box

from splatart_ns.batch import fitting
from splatart_ns.batch.entry import Entry
from splatart_ns.batch.fitting import Fitting
from splatart_ns.batch.stage import Work
from splatart_ns.batch.storage import open_storage
from splatart_ns.bundle import export
from splatart_ns.capture.procedural import synthesize_object
from splatart_ns.capture.synthesis_options import SynthesisOptions

SETTINGS = {"quality": "draft", "root": None, "seed": 0, "downscale": None, "joints": []}


@pytest.fixture(scope="module")
def fitted(hinge_capture, start_splatart, tmp_path_factory):
    """A batch of a capture, one that is corrupt and one that cannot be fitted; the folder and the process."""
    folder = tmp_path_factory.mktemp("batch")
    for name in ("corrupt", "hinge", "still"):
        shutil.copytree(hinge_capture, folder / "captures" / name)
    image = folder / "captures/corrupt/state_01/images/0002.png"
    image.write_bytes(image.read_bytes()[:300])
    shutil.rmtree(folder / "captures/still/state_01")
    arguments = ("batch", folder / "captures", "--output-dir", folder / "out", "--quality", "draft")
    process = start_splatart(*arguments, "--export", "ply", "html")
    process.told, process.errors = process.communicate()
    return folder, process


def rows(folder):
    with open(folder / "out/report.csv", newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


@pytest.mark.skipif(torch.cuda.is_available(), reason="gsplat adds gradients up in any order")
def test_the_bundle_is_that_of_a_single_fit_bit_for_bit(fitted, hinge_fit):
    folder, process = fitted
    assert process.errors == ""
    bundle = folder / "out/hinge"
    assert (bundle / "articulation.json").read_bytes() == (hinge_fit / "articulation.json").read_bytes()
    for ply in (hinge_fit / "parts").iterdir():
        assert (bundle / "parts" / ply.name).read_bytes() == ply.read_bytes()
    assert (bundle / "export/ply/export.json").exists() and (bundle / "export/html/hinge.html").exists()
    ours, single = (json.loads((folder / "report.json").read_text()) for folder in (bundle, hinge_fit))
    for key in ("device", "rasterizer"):
        assert ours[key] == single[key]


def test_stages_without_a_gpu_take_what_runs_there(monkeypatch):
    """Of a batch by gsplat only what trains is on a GPU."""
    asked = []
    monkeypatch.setattr(sys.modules["splatart_ns.rasterize.rasterization"], "set_backend", asked.append)
    monkeypatch.setattr(fitting, "_summarize", lambda work: {})
    monkeypatch.setattr(fitting, "_train", lambda *_: ({}, []))
    monkeypatch.setattr(Fitting, "_settings", lambda *_: None)
    for stage in ("semantic state_00", "pose", "joint", "summary"):
        Fitting(rasterizer="gsplat").run(stage, None)
    Fitting(rasterizer="torch").run("summary", None)
    assert asked == ["gsplat", "gsplat", "auto", "auto", "torch"]


def test_captures_that_cannot_be_fitted_are_told_with_their_reasons(fitted):
    folder, process = fitted
    assert process.returncode == 3
    assert "1 of 3 objects done, 2 failed" in process.told
    found = rows(folder)
    assert {name: row["status"] for name, row in found.items()} == {
        "corrupt": "failed", "hinge": "done", "still": "failed",
    }  # fmt: skip
    assert "state_01/images/0002.png: the image is cut off" in found["corrupt"]["reason"]
    assert "there is only the state state_00" in found["still"]["reason"]
    assert found["hinge"]["joints"] == "lid:base=revolute"


def test_the_report_shows_two_pictures(fitted):
    folder, _ = fitted
    assert (folder / "out/report.html").read_text().count("data:image/jpeg;base64,") == 2


def test_a_second_run_leaves_it_alone_and_says_the_same(fitted, run_main):
    folder, _ = fitted
    before = {file: file.stat().st_mtime_ns for file in (folder / "out/hinge").rglob("*") if file.is_file()}
    arguments = ("--output-dir", folder / "out", "--quality", "draft", "--export", "ply", "html")
    code, told, _ = run_main("batch", folder / "captures", *arguments)
    assert code == 3 and "1 of 3 objects done, 2 failed" in told
    assert {file: file.stat().st_mtime_ns for file in before} == before
    assert len(before) == sum(1 for file in (folder / "out/hinge").rglob("*") if file.is_file())


def test_fit_goes_on_from_what_a_batch_left(fitted, run_main, tmp_path):
    folder, _ = fitted
    bundle = folder / "out/hinge"
    report = json.loads((bundle / "report.json").read_text())
    assert [stage["name"] for stage in report["stages"]] == ["semantic state_00", "semantic state_01", "pose", "joint"]
    before = (bundle / "articulation.json").stat().st_mtime_ns
    code, _, _ = run_main("fit", folder / "captures/hinge", "--output-dir", bundle, "--quality", "draft")
    assert code == 0 and (bundle / "articulation.json").stat().st_mtime_ns == before


def test_nerfstudio_opens_the_runs_where_they_lie(fitted):
    from nerfstudio.utils.eval_utils import eval_setup

    folder, _ = fitted
    run = folder / "out/hinge/runs/all/splatart-joint/fit"
    _, _, checkpoint, _ = eval_setup(run / "config.yml")
    assert checkpoint.parent.parent == run


def test_a_page_of_a_bundle_takes_no_meshes(tmp_path, monkeypatch):
    save_box(tmp_path / "out/box", seed=0)
    monkeypatch.setattr(export, "part_shapes", None)
    (tmp_path / "work").mkdir()
    work = Work(Entry("box", ""), open_storage(str(tmp_path / "out")), tmp_path / "work")
    outcome, kept = Fitting(exports=("html",)).run("export html", work)
    assert outcome["failed_checks"] == [] and kept == ["export/html"]
    assert (tmp_path / "work/export/html/box.html").exists()


def test_a_new_bundle_has_neither_exports_nor_metrics_of_the_one_before(tmp_path):
    save_box(tmp_path / "out/box", seed=0)
    for old in ("metrics.json", "export/urdf/box.urdf", "export/urdf/meshes/a.stl"):
        (tmp_path / "out/box" / old).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "out/box" / old).touch()
    work = Work(Entry("box", ""), open_storage(str(tmp_path / "out")), tmp_path / "work")
    for _ in range(2):  # the second time there is none
        work.discard("metrics.json", "export")
        assert {f.suffix for f in (tmp_path / "out/box").rglob("*") if f.is_file()} == {".json", ".ply"}
        assert not (tmp_path / "out/box/metrics.json").exists()


def stages(settings, told, **recipe):
    return {stage.name: stage for stage in Fitting(**recipe).stages(Entry("a", "", SETTINGS | settings), "files", told)}


def test_smaller_images_of_one_state_train_the_others_anew(hinge_capture, tmp_path, monkeypatch):
    """Where they are too small to be looked at half as large, as those of all states are."""
    monkeypatch.setattr("splatart_ns.plugin.settings.SMALLEST", 30)
    shutil.copytree(hinge_capture, tmp_path / "capture")
    entry = Entry("hinge", str(tmp_path / "capture"), SETTINGS)

    def checked():
        told, _ = Fitting().run("check", Work(entry, open_storage(str(tmp_path)), tmp_path / "work"))
        return told, {stage.name: stage.key for stage in Fitting().stages(entry, "files", told)}

    before, keys = checked()
    small = synthesize_object(
        "hinge", tmp_path / "small", SynthesisOptions(train_views=12, test_views=2, resolution=32)
    )
    shutil.rmtree(tmp_path / "capture/state_01")
    shutil.copytree(small / "state_01", tmp_path / "capture/state_01")
    after, new_keys = checked()
    assert before["states"][0]["digest"] == after["states"][0]["digest"]
    assert (before["downscale"], after["downscale"]) == (2, 1)
    assert 4 * before["states"][0]["pixels"] == after["states"][0]["pixels"]
    assert keys["semantic state_00"] != new_keys["semantic state_00"]
    asked = Entry("hinge", str(tmp_path / "capture"), SETTINGS | {"downscale": 2})
    told, _ = Fitting().run("check", Work(asked, open_storage(str(tmp_path)), tmp_path / "work"))
    assert told["downscale"] == 2


def test_what_depends_on_a_setting_or_a_state_has_another_key():
    states = [{"name": n, "digest": n, "pixels": 10**6} for n in ("s0", "s1")]
    told = {"digest": "all", "worlds": "shared", "downscale": 1, "states": states}
    other_state = told | {"digest": "new", "states": [states[0], states[1] | {"digest": "new"}]}
    first = stages({}, told, exports=("urdf",))

    def changed(settings, told, before=first):
        return {
            name for name, stage in stages(settings, told, exports=("urdf",)).items() if stage.key != before[name].key
        }

    last = {"joint", "export urdf", "summary"}
    assert changed({}, told) == set()
    assert changed({"root": "lid"}, told) == last | {"check"}
    apart = told | {"worlds": "similar"}
    assert changed({"root": "lid"}, apart, stages({}, apart, exports=("urdf",))) == last | {"check", "pose"}
    assert changed({"seed": 1}, told) == last | {"semantic s0", "semantic s1", "pose"}
    assert changed({}, told | {"downscale": 2}) == last | {"semantic s0", "semantic s1", "pose"}
    assert changed({"quality": "high"}, told) == set(first)
    assert changed({"downscale": 2}, told) == {"check"}  # which tells of it
    assert changed({}, other_state) == last | {"semantic s1", "pose"}
    assert first["pose"].after == ("semantic s0", "semantic s1") and first["semantic s0"].after == ("check",)
    assert first["semantic s0"].needs.gpu and not first["joint"].needs.gpu
    assert first["pose"].needs.memory_mb > first["semantic s0"].needs.memory_mb


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["nowhere"], "no such folder"),
        (["list.csv"], "cannot be read"),
        (["nowhere", "--seed", "-1"], "--seed is -1"),
        (["nothing://bucket"], "nothing://bucket"),
    ],
)
def test_a_mistake_in_what_was_asked_is_one_sentence(run_main, tmp_path, monkeypatch, arguments, told):
    monkeypatch.chdir(tmp_path)
    code, _, errors = run_main("batch", *arguments, "--output-dir", tmp_path / "out")
    assert code == 2 and told in errors and errors.count("\n") == 1
    assert not (tmp_path / "out").exists()
