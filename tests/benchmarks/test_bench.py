import copy
import json
import math
import time
from dataclasses import replace

import bench
import pytest
from bench_plan import FULL, QUICK, SLOW_GROUPS, Point, Scene, growths, trade_offs
from bench_report import write_report
from drawers_urdf import write_drawers
from fit_with import apply, parse
from sampling_profiler import SamplingProfiler

from splatart_ns.capture.robot import read_urdf
from splatart_ns.plugin import settings as efforts
from splatart_ns.plugin import stage_configs
from splatart_ns.plugin.model import refuse_unread

MACHINE = {"commit": "abc", "cores": 2, "OMP_NUM_THREADS": None, "python": "3.11", "architecture": "x"}


def record(point, seconds, motion, load=0.0, **others):
    errors = {"motion": motion, "axis": 0.1, "image": 0.02, "parts": 0.05, "wrong joints": 0.0}
    return {
        "key": point.key,
        "group": point.group,
        "label": point.label,
        "capture": point.scene.name,
        "size": point.size,
        "seed": point.seed,
        "quality": point.quality,
        "busy_before": load,
        "machine": MACHINE,
        "seconds": seconds,
        "import_seconds": 4.0,
        "process_seconds": seconds + 5,
        "stage_seconds": {"semantic": 0.6 * seconds, "pose": 0.3 * seconds, "joint": 0.1},
        "gaussians": 5000,
        "peak_memory_mb": 900,
        "errors": errors,
        **others,
    }


def written(tmp_path, plan, records):
    write_report(plan, records, tmp_path, MACHINE, "--quick")
    return (tmp_path / "benchmarks.md").read_text()


@pytest.mark.parametrize("extent", [QUICK, FULL], ids=["quick", "full"])
def test_a_plan_has_every_setting_once_on_every_object(extent, tmp_path):
    plan = [*trade_offs(extent, [tmp_path]), *growths(extent, extent.seeds)]
    assert len({p.key for p in plan}) == len(plan)
    per_object = {}
    for p in plan:
        if not p.of_growth:
            per_object.setdefault(((p.truth or p.scene).name, p.seed), []).append((p.group, p.label))
    made = [set(v) for (name, _), v in per_object.items() if name.startswith("object")]
    slow = {(group, label) for group, label in made[0] if group in SLOW_GROUPS or label == "high"}
    others = made[0] if extent.slow_everywhere else made[0] - slow
    assert len(made) == len(extent.parts) * extent.seeds and all(v == others for v in made[1:])
    assert {g for g, _ in made[0]} >= {
        "preset",
        "Gaussians",
        "SH degree",
        "iterations",
        "poses",
        "joints",
        "image scale",
    }
    given = set(per_object[tmp_path.name, 0])
    assert given == {(group, label) for group, label in others if group not in ("image scale", "labelled frames")}


@pytest.mark.parametrize("extent", [QUICK, FULL], ids=["quick", "full"])
def test_no_setting_of_a_plan_is_refused_by_the_stage_that_it_is_for(extent, tmp_path, monkeypatch):
    for settings in {p.settings for p in trade_offs(extent, [tmp_path])}:
        with monkeypatch.context() as patch:
            patch.setattr(efforts, "EFFORTS", dict(efforts.EFFORTS))
            methods = {stage: copy.deepcopy(getattr(stage_configs, f"{stage}_method")) for stage in ("pose", "joint")}
            patch.setattr(stage_configs, "semantic_method", copy.deepcopy(stage_configs.semantic_method))
            for stage, method in methods.items():
                patch.setattr(stage_configs, f"{stage}_method", method)
            apply(settings, extent.base)
            for stage, method in methods.items():
                refuse_unread(method.config.pipeline.model, stage)


def test_the_document_has_fronts_ratios_and_what_was_left_out(tmp_path):
    plan = trade_offs(replace(QUICK, parts=(2,)), [])
    by_name = {(p.group, p.label): p for p in plan}
    records = [
        record(by_name["preset", "draft"], 10.0, 1.0),
        record(by_name["preset", "standard"], 30.0, 0.25),
        record(by_name["SH degree", "0"], 5.0, 2.0),
        record(by_name["SH degree", "2"], 20.0, None),
        record(by_name["image scale", "1 / 2"], 6.0, 3.0),
    ]
    text = written(tmp_path, plan, [*records, *[None] * (len(plan) - len(records))])
    rows = {cells[0]: cells[1:] for line in text.splitlines() if len(cells := line.strip("| ").split(" | ")) > 5}
    assert f"5 fits of {len(plan)} planned" in text and "not to be trusted" not in text
    assert rows["SH degree 0"][:3] == ["1", "0.5", "2"] and rows["SH degree 0"][-1] == "1, 1"
    assert rows["SH degree 2"][:3] == ["1", "2", "-"] and rows["SH degree 2"][-1] == "0, 0"
    assert rows["image scale 1 / 2"][:3] == ["1", "0.6", "3"]  # of the same object as the draft
    assert "| motion, % of the radius | 5 | draft | 10 | 1 |" in text
    assert "| motion, % of the radius | 1.5 | standard | 30 | 0.25 |" in text
    assert len(json.loads((tmp_path / "benchmarks.json").read_text())["fits"]) == 5
    assert all((tmp_path / "images" / f"bench_{name}.png").stat().st_size > 0 for name in ("settings", "stages"))


def test_fits_kept_from_an_earlier_run_are_told_to_be_of_its_version(tmp_path):
    plan = trade_offs(QUICK, [])[:2]
    records = [record(point, 10.0, 1.0) for point in plan]
    for kept in records:
        kept["machine"] = kept["machine"] | {"commit": "earlier"}
    assert "Commit earlier, " in written(tmp_path, plan, records)
    records[1]["machine"]["commit"] = "later"
    assert "Commit earlier and later, " in written(tmp_path, plan, records)


def test_the_document_says_when_the_machine_was_busy_and_what_failed(tmp_path):
    plan = trade_offs(QUICK, [])[:2]
    busy = record(plan[0], 10.0, 1.0, load=4.0)
    failed = {
        k: v for k, v in record(plan[1], 1.0, 1.0).items() if k in ("key", "size", "group", "busy_before", "machine")
    }
    text = written(tmp_path, plan, [busy, failed | {"failed": "error: no parts"}])
    assert "1 fits began while the machine had other work" in text and f"- {plan[1].key}: error: no parts" in text


def test_growth_and_profile_are_told(tmp_path):
    plan = [p for p in growths(QUICK, 1) if p.group == "parts"]
    records = [record(p, 2.0 * p.size, None) for p in plan]
    profile = {"rasterization": 6.0, "image losses": 1.0, "imports": 3.0}
    records.append(record(replace(plan[0], group="profile", size=None), 10.0, 1.0, profile=profile))
    text = written(tmp_path, plan, records)
    assert "| parts | 2 to 8 | all | 4 to 16 | 1.00 | 1.00 | 900 to 900 |" in text
    assert "Outside rasterization and image losses: **30%**" in text and "| rasterization | 6.0 | 60.0% |" in text


def test_a_fit_is_run_with_its_settings_and_scored(tmp_path):
    scene = Scene("tiny", "random-102-2", tuple("--resolution 64 --train-views 10 --test-views 1".split()))
    few = Point("iterations", "few", scene, settings=("effort.steps=60", "effort.merge_steps=20"))
    found = bench.run(few, tmp_path)
    assert found.get("failed") is None and found["errors"].keys() == record(few, 1.0, 1.0)["errors"].keys()
    assert 0 < found["errors"]["image"] < 0.5 and found["settings"] == list(few.settings)
    assert "1 fits of 1 planned" in written(tmp_path, [few], [found])


def test_finished_fits_are_read_back_and_half_a_line_is_not(tmp_path):
    results = tmp_path / "results.jsonl"
    assert bench.read(results) == {}
    results.write_text('{"key": "a", "seconds": 1}\n{"key": "b", "sec')
    assert bench.read(results) == {"a": {"key": "a", "seconds": 1}}


def test_time_of_a_fit_is_foreseen_from_those_before():
    plan = trade_offs(QUICK, [])
    draft, high = (next(p for p in plan if p.label == q) for q in ("draft", "high"))
    assert bench.expected_seconds(high, plan, {}) == pytest.approx(9 * bench.expected_seconds(draft, plan, {}))
    assert bench.expected_seconds(high, plan, {draft.key: {"process_seconds": 10.0}}) == pytest.approx(1.3 * 90)


def test_errors_of_a_fit_that_missed_a_joint_are_unknown():
    joint = {"displacement_percent": 0.5, "axis_angle": 0.1, "type_correct": True, "parent_correct": True}
    missed = {"displacement_percent": None, "axis_angle": None, "type_correct": False, "parent_correct": False}
    images = {"state_00": {"psnr": 40.0, "part_iou": 0.9}, "novel_00": {"psnr": 10.0, "part_iou": 0.0}}
    found = bench.errors({"joints": [joint, missed], "images": images})
    assert found["motion"] is None and found["wrong joints"] == 1
    assert found["image"] == pytest.approx(0.01) and found["parts"] == pytest.approx(0.1)
    assert bench.errors({"joints": [joint], "images": images})["motion"] == 0.5


def test_settings_take_the_type_of_what_is_there():
    assert parse("*0.5", 9, "x") == 4 and parse("3", 1, "x") == 3 and parse("false", True, "x") is False
    assert parse("file", "registration", "x") == "file"
    with pytest.raises(SystemExit, match="effort.colour=1: there is no such setting"):
        parse("1", None, "effort.colour=1")


def test_drawers_have_as_many_parts_as_asked_for(tmp_path):
    write_drawers(tmp_path / "drawers.urdf", 30)
    robot = read_urdf(tmp_path / "drawers.urdf")
    assert len(robot.links) == 30 and len(robot.joints) == 29


def test_the_profiler_accounts_for_all_seconds_by_the_innermost_known_file():
    def spin(seconds):
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            pass

    def inside(file, function):
        """A function that calls another one from a file of that name."""
        scope = {"function": function}
        exec(compile("def call():\n    function()", file, "exec"), scope)
        return scope["call"]

    step = inside("site-packages/torch/optim/adam.py", lambda: spin(0.2))
    train = inside("site-packages/nerfstudio/engine/trainer.py", lambda: (spin(0.1), step()))
    start = time.perf_counter()
    with SamplingProfiler() as profiler:
        train()
    seconds = time.perf_counter() - start
    assert 0.9 * seconds - 0.02 < math.fsum(profiler.seconds.values()) <= seconds
    assert set(profiler.seconds) <= {"optimizer steps", "nerfstudio's trainer", "other"}
    assert profiler.seconds["optimizer steps"] > 0.15 and profiler.seconds["nerfstudio's trainer"] > 0.05


def test_a_scene_that_is_there_is_not_made():
    assert not Scene("mine", "/captures/mine").made and Scene("object 2", "random-102-2").made


def test_what_is_a_setting_and_also_grows_is_plotted_by_its_sizes_alone(tmp_path):
    settings = [p for p in trade_offs(replace(QUICK, parts=(2,)), []) if p.group == "Gaussians"]
    sizes = [p for p in growths(QUICK, 1) if p.group == "Gaussians"]
    plan = [*settings, *sizes]
    document = written(tmp_path, plan, [record(p, 10.0 + (p.size or 0) / 1e4, 1.0) for p in plan])
    assert f"| Gaussians | {min(p.size for p in sizes)} to {max(p.size for p in sizes)} | all |" in document
