"""Whatever is wrong with the input: one sentence with the file, what was found and the mend, and nothing written."""

import json
import shutil
from dataclasses import replace

import cv2
import pytest

from splatart_ns.plugin.settings import Settings, require_fittable

TRANSFORMS = "state_00/transforms.json"


@pytest.fixture
def capture(hinge_capture, tmp_path):
    return shutil.copytree(hinge_capture, tmp_path / "capture")


@pytest.fixture
def bundle(hinge_fit, tmp_path):
    return shutil.copytree(hinge_fit, tmp_path / "bundle", ignore=shutil.ignore_patterns("runs"))


@pytest.fixture
def refused(run_main):
    """Runs a command that must be refused, and returns the sentence that says why."""

    def run(*arguments):
        code, _, errors = run_main(*arguments)
        assert code == 2
        assert errors.startswith("error: ") and errors.endswith(".\n") and errors.count("\n") == 1
        return errors

    return run


def contents(folder):
    return {f.relative_to(folder): f.read_bytes() if f.is_file() else None for f in folder.rglob("*")}


def edit(file, change):
    value = json.loads(file.read_text())
    change(value)
    file.write_text(json.dumps(value))


def cut(file, share):
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])


def relabel(folder, old, new):
    for file in folder.glob("semantics/*.png"):
        labels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        labels[labels == old] = new
        assert cv2.imwrite(str(file), labels)


def pose_entry(value):
    return lambda meta: meta["frames"][2]["transform_matrix"][0].__setitem__(1, value)


def flat_pose(meta):
    meta["frames"][2]["transform_matrix"][0] = [0.0, 0.0, 0.0, 0.0]


def no_labels(capture):
    for state in ("state_00", "state_01"):
        edit(capture / state / "transforms.json", lambda m: [frame.pop("semantics_path") for frame in m["frames"]])


def smaller(file):
    assert cv2.imwrite(str(file), cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[::2, ::2])


BAD_CAPTURES = {
    "one state": (
        lambda c: shutil.rmtree(c / "state_01"),
        ["/capture: ", "only the state state_00", "add the object at a second configuration"],
    ),
    "missing image": (
        lambda c: (c / "state_00/images/0003.png").unlink(),
        ["state_00/images/0003.png: ", "does not exist", "add it"],
    ),
    "truncated image": (
        lambda c: cut(c / "state_00/images/0003.png", 0.5),
        ["state_00/images/0003.png: ", "cut off", "again"],
    ),
    "image of another size than its camera's": (
        lambda c: smaller(c / "state_01/images/0000.png"),
        ["state_01/images/0000.png: ", "32x32", "64x64", ";"],
    ),
    "labels of another size": (
        lambda c: smaller(c / "state_01/semantics/0000.png"),
        ["state_01/semantics/0000.png: ", "32x32", "64x64", ";"],
    ),
    "pose that cannot be inverted": (
        lambda c: edit(c / TRANSFORMS, flat_pose),
        [f"{TRANSFORMS}: ", "transform_matrix of frame 'images/0002.png'", ";"],
    ),
    "pose with NaN": (
        lambda c: edit(c / TRANSFORMS, pose_entry(float("nan"))),
        [f"{TRANSFORMS}: ", "transform_matrix of frame 'images/0002.png'", "nan", ";"],
    ),
    "pose of text": (
        lambda c: edit(c / TRANSFORMS, pose_entry("east")),
        [f"{TRANSFORMS}: ", "transform_matrix of frame 'images/0002.png'", "east", ";"],
    ),
    "part in one state only": (
        lambda c: relabel(c / "state_01", 2, 0),
        ["/capture: ", "part 2 (lid) is not labelled in state_01", "label it in some training frames"],
    ),
    "label above the declared parts": (
        lambda c: relabel(c / "state_00", 2, 9),
        ["state_00/semantics/00", "label 9", "1 to 2", "semantic_classes"],
    ),
    "no labels": (
        no_labels,
        ["/capture: ", "no training frame has part labels", "semantics_path"],
    ),
    "no JSON": (
        lambda c: cut(c / TRANSFORMS, 0.5),
        [f"{TRANSFORMS}: ", "is not JSON", ";"],
    ),
    "empty folder": (
        lambda c: [shutil.rmtree(c), c.mkdir()],
        ["/capture: ", "there is no capture here", "transforms.json"],
    ),
    "no such folder": (
        lambda c: shutil.rmtree(c),
        ["/capture: ", "not a folder", "give the folder"],
    ),
    "file instead of a folder": (
        lambda c: [shutil.rmtree(c), c.write_text("")],
        ["/capture: ", "not a folder", "give the folder"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_CAPTURES)
def test_a_bad_capture_is_refused(refused, run_main, capture, tmp_path, name):
    spoil, expected = BAD_CAPTURES[name]
    spoil(capture)
    sentence = refused("fit", capture, "--output-dir", tmp_path / "new", "--quality", "draft")
    assert [text for text in expected if text not in sentence] == []
    assert not (tmp_path / "new").exists()

    code, output, errors = run_main("check", capture)
    assert code == 2 and errors == ""
    assert sentence.removesuffix(".\n").split(" (and ")[0] in output


def test_a_bad_capture_is_refused_without_traceback_by_the_real_process(start_splatart, capture, tmp_path):
    no_labels(capture)
    process = start_splatart("fit", capture, "--output-dir", tmp_path / "new")
    output, errors = process.communicate()
    assert process.returncode == 2 and output.strip() == ""
    assert errors.startswith(f"error: {capture}: no training frame has part labels; ") and errors.count("\n") == 1


@pytest.mark.parametrize("place", ["file", "file/new", "/proc/new"])
def test_an_output_folder_that_cannot_be_written_is_refused(refused, hinge_capture, tmp_path, place):
    (tmp_path / "file").write_text("mine")
    sentence = refused("fit", hinge_capture, "--output-dir", tmp_path / place, "--quality", "draft")
    assert f"{tmp_path / place} cannot be written" in sentence and "choose another --output-dir" in sentence
    assert contents(tmp_path) == {(tmp_path / "file").relative_to(tmp_path): b"mine"}


def test_an_unknown_root_is_refused(refused, hinge_capture, tmp_path):
    sentence = refused("fit", hinge_capture, "--output-dir", tmp_path / "new", "--root", "door")
    assert str(hinge_capture) in sentence and "no part 'door'" in sentence and "base, lid" in sentence
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("downscale", [-1, 0, 5])
def test_images_made_larger_or_of_no_pixels_are_refused(refused, hinge_capture, tmp_path, downscale):
    sentence = refused("fit", hinge_capture, "--output-dir", tmp_path / "new", "--downscale", downscale)
    assert f"--downscale is {downscale}; give 1 to 4" in sentence and not (tmp_path / "new").exists()


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_an_impossible_seed_is_refused(refused, hinge_capture, tmp_path, seed):
    assert f"--seed is {seed}" in refused("fit", hinge_capture, "--output-dir", tmp_path / "new", "--seed", seed)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("text", ["", "{", "[]", "3", '{"stages": 3}', '{"stages": [{}]}', "\xff", '{"a": 1}'])
def test_a_report_that_is_none_is_refused(refused, hinge_capture, tmp_path, text):
    (tmp_path / "report.json").write_text(text, encoding="latin-1")
    before = contents(tmp_path)
    sentence = refused("fit", hinge_capture, "--output-dir", tmp_path, "--quality", "draft")
    assert str(tmp_path / "report.json") in sentence and "remove it or choose another" in sentence
    assert contents(tmp_path) == before


def change_version(bundle):
    edit(bundle / "articulation.json", lambda a: a.update(format="splatart-articulation-9"))


BAD_BUNDLES = {
    "articulation.json cut short": (
        lambda b: cut(b / "articulation.json", 0.6),
        ["articulation.json: ", "is not JSON", ";"],
    ),
    "PLY cut short": (lambda b: cut(b / "parts/lid.ply", 0.6), ["parts/lid.ply", "bytes", ";"]),
    "PLY cut in its header": (lambda b: cut(b / "parts/lid.ply", 0.001), ["parts/lid.ply", ";"]),
    "PLY missing": (lambda b: (b / "parts/lid.ply").unlink(), ["parts/lid.ply", ";"]),
    "another version": (change_version, ["articulation.json: ", "splatart-articulation-9", "this version reads"]),
    "no bundle": (lambda b: (b / "articulation.json").unlink(), ["articulation.json: ", "give the folder of a bundle"]),
    "no folder": (lambda b: shutil.rmtree(b), ["articulation.json: ", "give the folder of a bundle"]),
    "capture instead of a bundle": (
        lambda b: (b / "articulation.json").write_text('{"frames": []}'),
        ["articulation.json: ", "'format'", ";"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_BUNDLES)
def test_a_bad_bundle_is_refused(refused, hinge_capture, bundle, tmp_path, name):
    spoil, expected = BAD_BUNDLES[name]
    spoil(bundle)
    before = contents(tmp_path)
    for command in (("render", bundle, "--output", tmp_path / "new.gif"), ("eval", bundle, "--data", hinge_capture)):
        sentence = refused(*command)
        assert [text for text in expected if text not in sentence] == []
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (["--resolution", 0], "--resolution is 0; give 1 or more"),
        (["--frames", -1], "--frames is -1; give 1 or more"),
        (["--fps", 0], "--fps is 0.0; give a number above 0"),
        (["--fps", "nan"], "--fps is nan; give a number above 0"),
        (["--azimuth", "inf"], "--azimuth is inf; give a finite angle"),
        (["--elevation", "nan"], "--elevation is nan; give -90 to 90"),
        (["--background", 0, 0, 2], "--background is (0.0, 0.0, 2.0); give three numbers from 0 to 1"),
        (["--set", "door=1"], "no movable joint is called 'door'; there are base_to_lid"),
        (["--set", "base_to_lid"], "'base_to_lid' has no '='; write joint=value"),
        (["--set", "base_to_lid=wide"], "'wide' for joint 'base_to_lid' is no number"),
        (["--set", "base_to_lid=1", "--set", "base_to_lid=2"], "'base_to_lid' is set twice"),
        (["--sweep", "--trajectory", "q.csv"], "--sweep and --trajectory are both given; choose one"),
        (["--trajectory", "nowhere.csv"], "nowhere.csv: cannot be read"),
        (["--data", "nowhere"], "nowhere: the capture is not a folder"),
    ],
    ids=str,
)
def test_bad_options_of_render_are_refused(refused, hinge_fit, tmp_path, arguments, expected):
    assert expected in refused("render", hinge_fit, "--output", tmp_path / "new.gif", *arguments)
    assert contents(tmp_path) == {}


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--data", "c", "--resolution", 64, "--azimuth", 0], "of its own; leave out --resolution and --azimuth."),
        (["--data", "c", "--elevation", 0], "--data has cameras of its own; leave out --elevation."),
        (["--camera", 3], "--data is not given; give it, or leave out --camera."),
        (["--states", 3], "--dataset is not given; give it, or leave out --states."),
        (["--views", "hemisphere", "--seed", 1], "give it, or leave out --views and --seed."),
        (["--channel", "accumulation", "--background", 0, 0, 0], "is shown on black; leave out --background."),
        (["--frames", 3], "--sweep is not given; give it, or leave out --frames."),
        (["--sweep", "--fps", 9], "new is no .gif or .mp4; give one, or leave out --fps."),
        (["--dataset", 9, "--channel", "depth"], "--dataset chooses what it shows; leave out --channel."),
        (["--dataset", 9, "--background", 0, 0, 0, "--azimuth", 0], "leave out --azimuth and --background."),
        (["--dataset", 9, "--sweep", "--fps", 9], "leave out --sweep and --fps."),
    ],
    ids=str,
)
def test_options_that_would_change_nothing_are_refused(refused, hinge_fit, tmp_path, arguments, expected):
    assert expected in refused("render", hinge_fit, "--output", tmp_path / "new", *arguments)
    assert contents(tmp_path) == {}


def test_a_sweep_of_what_did_not_move_is_refused(refused, bundle, tmp_path):
    edit(bundle / "articulation.json", lambda a: a["joints"][0].update(values=[0.0, 0.0], limits=[0.0, 0.0]))
    sentence = refused("render", bundle, "--sweep", "--output", tmp_path / "new.gif")
    assert f"{bundle}: has no joint that moved, for --sweep to show; leave it out." in sentence
    assert not (tmp_path / "new.gif").exists()


def test_a_joint_is_not_set_that_the_trajectory_moves(refused, hinge_fit, tmp_path):
    (tmp_path / "q.csv").write_text("base_to_lid\n0\n1\n")
    arguments = "--trajectory", tmp_path / "q.csv", "--set", "base_to_lid=1"
    sentence = refused("render", hinge_fit, "--output", tmp_path / "new", *arguments)
    assert "q.csv: moves 'base_to_lid', which --set holds; leave out one of them." in sentence
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--resolution", 10**8], "--resolution is 100000000; give 16384 or less"),
        (["--dataset", 10**12], "--dataset is 1000000000000; give at most 10000000 images"),
        (["--dataset", 10**7, "--states", 10**11], "--states is 100000000000; give 100000 or less"),
        (["--set", "base_to_lid=1e300"], "'1e300' for joint 'base_to_lid' is no number"),
    ],
    ids=str,
)
def test_what_no_memory_holds_is_refused_at_once(refused, hinge_fit, tmp_path, arguments, expected):
    assert expected in refused("render", hinge_fit, "--output", tmp_path / "new", *arguments)
    assert contents(tmp_path) == {}


@pytest.mark.parametrize("name", ["a[/b] \x1b[2J\n", "[red]é", "a" * 200])
def test_names_may_be_anything_that_a_folder_is_called(run_main, hinge_fit, tmp_path, name):
    code, output, errors = run_main("render", hinge_fit, "--output", tmp_path / name, "--resolution", 16)
    assert (code, errors) == (0, "") and "".join(name.split()) in "".join(output.split())
    assert (tmp_path / name / "frame_0000.png").is_file()
    code, _, errors = run_main("render", tmp_path / name, "--output", tmp_path / "new")
    assert code == 2 and errors.count("\n") == 1 and "\x1b" not in errors


def test_a_bundle_among_the_files_of_the_capture_is_refused(refused, capture):
    before = contents(capture)
    for output in (capture, capture / "state_00", capture / "state_01" / "new"):
        assert "holds the capture's files" in refused("fit", capture, "--output-dir", output, "--quality", "draft")
    for output in (capture, capture.parent, capture / "state_00"):
        assert "choose another --output-dir" in refused("batch", capture, "--output-dir", output)
    assert contents(capture) == before


def test_states_of_different_worlds_are_refused_before_any_work(refused, capture, tmp_path):
    def move(transforms):
        for frame in transforms["frames"]:
            frame["transform_matrix"][0][3] += 4.0

    edit(capture / "state_01/transforms.json", move)
    sentence = refused("fit", capture, "--output-dir", tmp_path / "new", "--quality", "draft")
    assert f"{capture}/state_01: its cameras do not look where those of state_00 do" in sentence
    assert "--worlds similar" in sentence and not (tmp_path / "new").exists()
    settings = Settings("draft", None, 0)
    for worlds, problems in {"similar": 0, "rigid": 0, "shared": 1}.items():  # the mend is not told who took it
        told = []
        assert require_fittable(capture, replace(settings, worlds=worlds), told.append).path == capture
        assert sum("its cameras do not look where" in problem.message for problem in told) == problems


@pytest.mark.parametrize("output", ["file", "file/new", "file/new.gif", "file/new.mp4", "new.webp"])
def test_pictures_that_cannot_be_written_are_refused(refused, hinge_fit, tmp_path, output):
    (tmp_path / "file").write_text("mine")
    sentence = refused("render", hinge_fit, "--output", tmp_path / output, "--resolution", 16)
    assert str(tmp_path) in sentence and ";" in sentence
    assert contents(tmp_path) == {(tmp_path / "file").relative_to(tmp_path): b"mine"}


def test_eval_needs_the_capture_of_the_bundle(refused, hinge_fit, capture):
    shutil.copytree(capture / "state_01", capture / "state_02")
    sentence = refused("eval", hinge_fit, "--data", capture)
    assert "has 2 states" in sentence and f"{capture} has 3" in sentence
    assert not (hinge_fit / "metrics.json").exists()


@pytest.mark.parametrize("names", [["base", "wing"], ["lid", "base"]], ids=str)
def test_eval_needs_the_parts_of_the_bundle(refused, bundle, capture, names):
    for state in ("state_00", "state_01"):
        edit(capture / state / "transforms.json", lambda t: t.update(semantic_classes=["background", *names]))
    (bundle / "metrics.json").write_text("good")
    assert f"{capture}: has other parts than " in refused("eval", bundle, "--data", capture)
    assert (bundle / "metrics.json").read_text() == "good"


def test_synth_refuses_what_it_cannot_read_or_write(refused, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").write_text("mine")
    (tmp_path / "robot.urdf").write_text("<robot")
    before = contents(tmp_path)
    assert "nowhere.urdf" in refused("synth", "nowhere.urdf", "--output-dir", tmp_path / "new")
    assert "robot.urdf" in refused("synth", tmp_path / "robot.urdf", "--output-dir", tmp_path / "new")
    assert "not empty" in refused("synth", "hinge", "--output-dir", tmp_path / "full")
    assert "cannot be written" in refused("synth", "hinge", "--output-dir", tmp_path / "full/file/new")
    assert "states is 1000000000; give 1000 or less" in refused(
        "synth", "hinge", "--output-dir", tmp_path / "new", "--states", 10**9
    )
    assert "resolution is 0" in refused("synth", "hinge", "--output-dir", tmp_path / "new", "--resolution", 0)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("arguments", [[], ["walk"], ["fit"], ["fit", "capture"], ["check", "a", "b"]], ids=str)
def test_a_command_that_makes_no_sense_is_refused(run_main, arguments):
    code, _, errors = run_main(*arguments)
    assert code == 2 and "Traceback" not in errors
