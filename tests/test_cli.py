"""The commands, as a user types them."""

import importlib.metadata
import json
import shutil
from pathlib import Path

import imageio
import numpy as np
import pytest
import torch
from PIL import Image

from splatart_ns import cli
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.procedural import build_object
from splatart_ns.capture.synthesis_options import SynthesisOptions
from splatart_ns.rasterize.rasterization import default_backend, set_backend

JOINT = "base_to_lid"
SMALL = ("--resolution", 48)


@pytest.fixture
def bundle(hinge_fit, tmp_path):
    """A bundle that a command may write into."""
    return shutil.copytree(hinge_fit, tmp_path / "bundle", ignore=shutil.ignore_patterns("runs"))


@pytest.fixture
def render(run_main, hinge_fit):
    def run(output, *arguments):
        code, _, errors = run_main("render", hinge_fit, "--output", output, *SMALL, *arguments)
        assert (code, errors) == (0, "")
        return output

    return run


def picture(path):
    return np.asarray(Image.open(path), dtype=float)


def assert_shows_an_object(frame):
    assert frame.shape == (48, 48, 3)
    assert (frame[0, 0] == 255).all()
    assert 0.05 < (frame.min(axis=2) < 240).mean() < 0.95


def test_the_console_script_is_this_command():
    (script,) = importlib.metadata.entry_points(group="console_scripts", name="splatart")
    assert script.value == "splatart_ns.cli:main"


def test_help_names_every_command(start_splatart):
    process = start_splatart("--help")
    output, errors = process.communicate()
    assert (process.returncode, errors) == (0, "")
    assert all(
        f"• {command} " in output for command in ("fit", "render", "eval", "check", "import", "export", "synth", "demo")
    )


def test_check_has_nothing_to_say_about_a_sound_capture(run_main, hinge_capture):
    code, output, errors = run_main("check", hinge_capture)
    assert (code, errors) == (0, "")
    assert [line.split() for line in output.splitlines()[1:]] == [
        ["base", "12", "of", "12", "12", "of", "12"],
        ["lid", "12", "of", "12", "12", "of", "12"],
        ["0", "errors,", "0", "warnings"],
    ]


def test_a_reader_that_stops_reading_ends_the_command_quietly(start_splatart, hinge_capture):
    process = start_splatart("check", hinge_capture, "--json")
    process.stdout.close()
    assert process.stderr.read() == ""
    assert process.wait() == 141


@pytest.mark.parametrize("arguments", [["check"], ["--help"]], ids=str)
def test_output_that_finds_no_room_ends_the_command_with_a_sentence(start_splatart, hinge_capture, arguments):
    capture = [hinge_capture] if arguments == ["check"] else []
    with open("/dev/full", "w") as full:
        process = start_splatart(*arguments, *capture, stdout=full)
        _, errors = process.communicate()
    assert process.returncode == 2
    assert errors.startswith("error: ") and "(No space left on device)" in errors and errors.count("\n") == 1


def test_pictures_that_find_no_room_are_named_and_gone(run_main, hinge_fit, tmp_path, small_files):
    with small_files():
        code, _, errors = run_main("render", hinge_fit, "--output", tmp_path / "a.gif", *SMALL)
    assert code == 2 and f"{tmp_path / 'a.gif'}: cannot be read or written (File too large)" in errors
    assert list(tmp_path.iterdir()) == []


def _raise(*errors):
    """Raise the first for the second, which is raised for the third, ..."""
    try:
        if errors[1:]:
            _raise(*errors[1:])
    except BaseException as error:
        raise errors[0] from error
    raise errors[0]


def test_ctrl_c_is_an_interruption_whatever_numba_makes_of_it(run_main, monkeypatch):
    for errors in ((KeyboardInterrupt(),), (SystemError("dispatcher"), SystemError("unpickle"), KeyboardInterrupt())):
        monkeypatch.setattr(cli, "_run", lambda errors=errors: _raise(*errors))
        code, output, said = run_main("fit")
        assert (code, output) == (130, "") and said.startswith("Interrupted.") and said.count("\n") == 1
    monkeypatch.setattr(cli, "_run", lambda: _raise(SystemError("bad call"), ValueError()))
    with pytest.raises(SystemError, match="bad call"):
        run_main("fit")


def test_check_tells_all_problems(run_main, hinge_capture, tmp_path):
    capture = shutil.copytree(hinge_capture, tmp_path / "capture")
    (capture / "state_00/images/0001.png").unlink()
    (capture / "state_01/images/0004.png").write_bytes(b"no picture")
    code, output, errors = run_main("check", capture)
    assert code == 2 and errors == ""
    first, second, *_, last = output.splitlines()
    assert first.startswith(f"error: {capture / 'state_00/images/0001.png'}: the file does not exist; ")
    assert second.startswith(f"error: {capture / 'state_01/images/0004.png'}: ")
    assert last == "2 errors, 0 warnings"


def test_a_home_that_the_shell_left_as_it_is_is_found(run_main, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert f"{tmp_path}/nothing: " in run_main("check", "~/nothing")[1]
    assert f"--sheet {tmp_path}/sheet.txt;" in run_main("check", "~/nothing", "--sheet=~/sheet.txt")[2]


def test_a_fitted_bundle_moves_in_a_simulator(run_main, hinge_fit, tmp_path):
    pytest.importorskip("mujoco", reason="mujoco is not installed: extra 'sim'")
    code, output, _ = run_main("export", hinge_fit, "--format", "mjcf", "--output", tmp_path / "robot")
    assert code == 0 and "10 s under gravity" in output
    assert (tmp_path / "robot" / f"{hinge_fit.name}.xml").is_file()


def test_eval_writes_all_metrics(run_main, bundle, hinge_capture):
    code, output, _ = run_main("eval", bundle, "--data", hinge_capture)
    assert code == 0
    assert "lid" in output and "tree_exact: yes" in output
    metrics = json.loads((bundle / "metrics.json").read_text())
    layout = {"joints", "joints_mean", "structure", "parts", "geometry", "images", "held_out", "speed", "notes"}
    assert set(metrics) == layout
    (joint,) = metrics["joints"]
    assert (joint["child"], joint["parent"], joint["type"]) == ("lid", "base", "revolute")
    assert joint["type_correct"] and joint["parent_correct"] and joint["covered_95"] in (True, False)
    for key in ("axis_angle", "axis_position", "pivot_offset", "motion_geodesic", "motion_value", "displacement"):
        assert metrics["joints_mean"]["revolute"][key] == joint[key] < 3
    assert metrics["structure"] == {"tree_exact": True, "edges_precision": 1.0, "edges_recall": 1.0}
    assert {(p["name"], p["state"]) for p in metrics["parts"]} == {("lid", "state_01")}
    assert all(p["part_rotation"] < 3 and p["part_translation"] < 0.02 for p in metrics["parts"])
    assert set(metrics["geometry"]) == {"mesh", "centres"}
    assert {"CD-s", "CD-m", "CD-w"} <= set(metrics["geometry"]["centres"])
    assert set(metrics["images"]) == {"state_00", "state_01", "novel_00"}
    for scores in metrics["images"].values():
        assert {"psnr", "ssim", "lpips", "accumulation_l1", "part_iou"} <= set(scores)
        assert scores["psnr"] > 18 and scores["part_iou"] > 0.7
        assert scores["lpips"] is None and any("lpips" in note for note in metrics["notes"])
    assert metrics["speed"] == json.loads((bundle / "report.json").read_text())


def test_render_without_options_shows_state_0(render, tmp_path):
    assert [f.name for f in render(tmp_path / "frames").iterdir()] == ["frame_0000.png"]
    assert_shows_an_object(picture(tmp_path / "frames/frame_0000.png"))


def test_render_sets_joints(render, tmp_path):
    def shown(folder, *arguments):
        return picture(render(tmp_path / folder, *arguments) / "frame_0000.png")

    at_rest = shown("rest", "--azimuth", 60)
    turned = shown("degrees", "--azimuth", 60, "--set", f"{JOINT}=40deg")
    assert np.abs(at_rest - turned).mean() > 2
    assert (shown("zero", "--azimuth", 60, "--set", f"{JOINT}=0") == at_rest).all()
    assert np.abs(shown("radians", "--azimuth", 60, "--set", f"{JOINT}={np.radians(40)}") - turned).max() <= 1


def test_every_set_counts(run_main, hinge_fit, tmp_path):
    code, _, errors = run_main(
        "render", hinge_fit, "--output", tmp_path / "frames", "--set", "nothing=1", "--set", f"{JOINT}=1"
    )
    assert code == 2 and "'nothing'" in errors
    code, _, errors = run_main("render", hinge_fit, "--output", tmp_path / "frames", "--set", f"{JOINT}=1", "nothing=1")
    assert code == 2 and "'nothing'" in errors


def test_a_saved_configuration_is_shown_and_set_changes_it(render, tmp_path):
    file = tmp_path / "configuration.json"
    file.write_text(json.dumps({JOINT: 0.7}))

    def shown(folder, *arguments):
        return picture(render(tmp_path / folder, "--azimuth", 60, *arguments) / "frame_0000.png")

    saved = shown("saved", "--configuration", file)
    assert (saved == shown("set", "--set", f"{JOINT}=0.7")).all()
    changed = shown("changed", "--configuration", file, "--set", f"{JOINT}=0")
    assert np.abs(changed - saved).mean() > 2 and (changed == shown("rest")).all()


def test_a_sweep_moves_the_joint_there_and_back(render, tmp_path):
    folder = render(tmp_path / "frames", "--sweep", "--frames", 6)
    frames = [picture(folder / f"frame_{i:04d}.png") for i in range(6)]
    assert len(list(folder.iterdir())) == 6
    for frame in frames:
        assert_shows_an_object(frame)
    # There in three steps that all show, and back the same way.
    assert min(np.abs(a - b).mean() for a, b in zip(frames[:3], frames[1:4], strict=True)) > 2
    assert np.abs(frames[1] - frames[5]).mean() < 0.1 and np.abs(frames[2] - frames[4]).mean() < 0.1


def test_a_trajectory_is_followed_row_by_row(render, tmp_path):
    file = tmp_path / "q.csv"
    file.write_text(f"{JOINT}\n0\n0.6\n40deg\n0\n")
    folder = render(tmp_path / "frames", "--trajectory", file)
    frames = [picture(folder / f"frame_{i:04d}.png") for i in range(4)]
    assert len(list(folder.iterdir())) == 4
    assert (frames[0] == frames[3]).all()
    assert np.abs(frames[0] - frames[1]).mean() > 2
    assert np.abs(frames[1] - frames[2]).mean() > 0.2


def test_render_writes_a_gif(render, tmp_path):
    path = render(tmp_path / "sweep.gif", "--sweep", "--frames", 6, "--fps", 10)
    with Image.open(path) as film:
        assert (film.n_frames, film.size, film.info["duration"]) == (6, (48, 48), 100)
    assert [f.name for f in tmp_path.iterdir()] == ["sweep.gif"]


def test_render_writes_an_mp4(render, tmp_path):
    path = render(tmp_path / "sweep.mp4", "--sweep", "--frames", 5, "--fps", 10)
    frames = list(imageio.get_reader(path, "ffmpeg").iter_data())
    assert [frame.shape for frame in frames] == [(48, 48, 3)] * 5
    assert np.abs(frames[0].astype(float) - frames[2]).mean() > 2
    assert [f.name for f in tmp_path.iterdir()] == ["sweep.mp4"]


def test_render_looks_through_a_camera_of_the_capture(run_main, hinge_fit, hinge_capture, tmp_path):
    arguments = "--data", hinge_capture, "--camera", 12
    assert run_main("render", hinge_fit, "--output", tmp_path / "frames", *arguments)[0] == 0
    shown = picture(tmp_path / "frames/frame_0000.png")
    rgba = np.asarray(Image.open(hinge_capture / "state_00/images/0012.png"), dtype=float)
    alpha = rgba[..., 3:] / 255
    true = alpha * rgba[..., :3] + (1 - alpha) * 255
    assert shown.shape == true.shape
    assert -10 * np.log10(((shown - true) ** 2).mean() / 255**2) > 18


def test_render_looks_through_a_camera_as_it_took_its_image(run_main, hinge_fit, hinge_capture, tmp_path):
    capture = shutil.copytree(hinge_capture, tmp_path / "capture")
    file = capture / "state_01/transforms.json"
    meta = json.loads(file.read_text())
    file.write_text(json.dumps(meta | {"k1": -0.2}))
    name = Path(meta["frames"][3]["file_path"]).name
    pictures = []
    for data in (hinge_capture, capture):
        arguments = ("--data", data, "--state", "state_01", "--camera", name)
        assert run_main("render", hinge_fit, "--output", tmp_path / "frames", *arguments)[0] == 0
        pictures.append(picture(tmp_path / "frames/frame_0000.png"))
    assert pictures[0].shape == pictures[1].shape == picture(capture / "state_01/images" / name)[..., :3].shape
    covered = [(shown.min(-1) < 200).sum() for shown in pictures]
    assert 0.8 * covered[0] < covered[1] < covered[0]  # it is drawn towards the centre


def test_a_dataset_is_a_capture_without_problems(run_main, hinge_fit, tmp_path):
    folder = tmp_path / f"capture [red] {'of a long name ' * 8}"  # which is told as it is, on one line
    code, output, errors = run_main("render", hinge_fit, "--dataset", 36, "--states", 3, "--output", folder, *SMALL)
    assert (code, errors) == (0, "") and f"Capture: {folder}" in output
    assert [len(state.frames) for state in load_capture(folder).states] == [12, 12, 12]
    code, output, _ = run_main("check", folder)
    assert code == 0 and "0 errors, 0 warnings" in output


def test_a_dataset_chooses_its_own_configurations(run_main, hinge_fit, tmp_path):
    arguments = "--dataset", 9, "--output", tmp_path / "capture"
    code, _, errors = run_main("render", hinge_fit, *arguments, "--set", f"{JOINT}=0.1")
    assert (
        code == 2
        and "--dataset chooses what it shows; leave out --set." in errors
        and not (tmp_path / "capture").exists()
    )


@pytest.mark.parametrize("channel", ["depth", "accumulation", "parts"])
def test_render_shows_other_channels(render, tmp_path, channel):
    arguments = ("--channel", channel, *(("--background", 0, 0, 0) if channel != "accumulation" else ()))
    frame = picture(render(tmp_path / "frames", *arguments) / "frame_0000.png")
    assert (frame[0, 0] == 0).all()
    assert frame.max() > 200
    grey = (np.ptp(frame, axis=2) < 2).all()
    assert grey == (channel == "accumulation")


def test_synth_renders_a_robot_and_its_own_objects(start_splatart, run_main, tmp_path):
    urdf = build_object("drawer").write(tmp_path / "robot")
    options = ("--train-views", 3, "--test-views", 1, "--resolution", 16)
    process = start_splatart("synth", urdf, "--output-dir", tmp_path / "a", *options)
    _, errors = process.communicate()
    assert (process.returncode, errors) == (0, "")
    assert run_main("synth", "drawer", "--output-dir", tmp_path / "b", *options)[0] == 0
    for name in ("a", "b"):
        capture = load_capture(tmp_path / name)
        assert list(capture.parts.values()) == ["body", "drawer"]
        assert [len(state.frames) for state in capture.states] == [4, 4]
        assert {frame.camera.width for state in capture.states for frame in state.frames} == {16}
        assert (tmp_path / name / "ground_truth.json").is_file()


def test_a_folder_of_an_objects_name_does_not_hide_it(run_main, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hinge").mkdir()
    options = ("--train-views", 3, "--test-views", 1, "--resolution", 16)
    code, output, errors = run_main("synth", "hinge", "--output-dir", "x", *options)
    assert (code, errors) == (0, "") and output.endswith("Capture: x\n")


@pytest.fixture
def restore_rasterizer():
    """After the test, what this process rasterizes with is as before."""
    threads = torch.get_num_threads()
    yield
    set_backend("auto")
    torch.set_num_threads(threads)


def test_the_rasterizer_can_be_chosen(render, tmp_path, restore_rasterizer):
    pictures = []
    for backend in ("numba", "torch"):
        render(tmp_path / backend, "--rasterizer", backend)
        assert default_backend() == backend
        pictures.append(picture(tmp_path / backend / "frame_0000.png"))
    assert abs(pictures[0] - pictures[1]).max() <= 1
    assert_shows_an_object(pictures[0])


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is CUDA here")
def test_a_rasterizer_that_cannot_run_is_refused_before_any_work(run_main, hinge_capture, tmp_path):
    arguments = "fit", hinge_capture, "--output-dir", tmp_path / "out", "--rasterizer", "gsplat"
    code, _, errors = run_main(*arguments)
    assert code == 2 and "CUDA" in errors and "Traceback" not in errors
    assert not (tmp_path / "out").exists()


def test_demo_goes_from_nothing_to_a_film(run_main, monkeypatch, hinge_fit, tmp_path):
    """With the fit itself, which has tests of its own, replaced by a finished one."""

    def fit(capture, output_dir, *settings):
        assert (capture / "ground_truth.json").is_file()
        return shutil.copytree(hinge_fit, output_dir, dirs_exist_ok=True)

    monkeypatch.setattr("splatart_ns.plugin.fit.fit", fit)
    monkeypatch.setattr(
        "splatart_ns.cli.demo.SynthesisOptions",
        lambda **_: SynthesisOptions(train_views=3, test_views=1, resolution=16),
    )
    code, output, _ = run_main("demo", "--output-dir", tmp_path / "demo")
    assert code == 0
    assert sorted(f.name for f in (tmp_path / "demo").iterdir()) == ["bundle", "capture", "sweep.gif"]
    assert (tmp_path / "demo/bundle/metrics.json").is_file()
    code, _, errors = run_main("demo", "--output-dir", tmp_path / "demo", "--object", "drawer")
    assert code == 2 and f"{tmp_path}/demo/capture: shows no drawer" in errors


def test_demo_leaves_a_users_own_folder_alone(run_main, tmp_path):
    image = tmp_path / "capture/state_00/images/IMG_0001.jpg"
    image.parent.mkdir(parents=True)
    image.touch()
    code, _, errors = run_main("demo", "--output-dir", tmp_path)
    assert code == 2 and f"{tmp_path}/capture: is there already" in errors and image.exists()
