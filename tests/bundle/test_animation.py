from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatart_ns.bundle.animation import bundle_colours, render_frames, write_frames
from splatart_ns.bundle.articulated_splat import ArticulatedSplat
from splatart_ns.bundle.camera import bounding_sphere, orbit_camera
from splatart_ns.errors import InputError

FRAMES = [np.full((31, 41, 3), value, np.uint8) for value in (10, 128, 250)]


@pytest.fixture
def view(bundle):
    return orbit_camera(*bounding_sphere(bundle, [{}, {"hinge": 1.5}]), -1.2, 0.5, 48, 40)


def test_a_joint_moves_what_hangs_on_it_alone(bundle, view):
    base, door = bundle.parts[0].splat, bundle.parts[1:]
    base.log_scales += 0.5
    for part in door:
        part.splat.opacity_logits[:] = -12.0
    still, moved = render_frames(ArticulatedSplat(bundle), [{}, {"hinge": 1.5}], view)
    assert still.shape == (40, 48, 3) and still.dtype == np.uint8
    assert np.array_equal(still, moved) and (still < 255).any()
    for part in door:
        part.splat.opacity_logits[:] = 3.0
    still, moved = render_frames(ArticulatedSplat(bundle), [{}, {"hinge": 1.5}], view)
    assert not np.array_equal(still, moved)


def test_the_background_is_the_colour_asked_for(bundle, view):
    (frame,) = render_frames(ArticulatedSplat(bundle), [{}], view, background=(0.0, 0.2, 1.0))
    assert frame[0, 0].tolist() == [0, 51, 255]


def test_parts_have_their_colours(bundle, view):
    for part in bundle.parts:
        part.splat.log_scales += 0.7
        part.splat.opacity_logits[:] = 8.0
    (frame,) = render_frames(ArticulatedSplat(bundle), [{}], view, "parts", background=(0.0, 0.0, 0.0))
    pixels = torch.from_numpy(frame).float().reshape(-1, 3) / 255
    distances = torch.cdist(bundle_colours(bundle), pixels).amin(1)
    assert (distances < 0.06).all()


def test_accumulation_is_grey_and_what_is_near_is_red_and_what_is_far_blue(bundle):
    for part in bundle.parts:
        part.splat.log_scales += 0.7
    view = orbit_camera(*bounding_sphere(bundle, [{}]), 0.0, 0.2, 48, 40)
    splat = ArticulatedSplat(bundle)
    (accumulation,) = render_frames(splat, [{}], view, "accumulation")
    assert (accumulation[..., 0] == accumulation[..., 2]).all() and accumulation.max() > 200
    (shown,) = render_frames(splat, [{}], view, "depth", background=(0.0, 0.0, 0.0))
    covered = accumulation[..., 0] > 200
    colours, depths = shown[covered].astype(int), splat.render(view, {}, depth=True).depth.numpy()[covered]
    near, far = colours[depths.argsort()][[0, -1]]
    assert near[0] > near[2] and far[2] > far[0]
    assert len(np.unique(colours, axis=0)) > 5


@pytest.mark.parametrize("output", ["rgb", "depth", "accumulation", "parts"])
def test_the_unit_of_length_does_not_matter(bundle, view, output):
    def frame(scale):
        for part in bundle.parts:
            part.splat.means *= scale
            part.splat.log_scales += np.log(scale)
        for joint in bundle.joints:
            joint.origin *= scale
        bundle.joints[0].values *= scale  # the one that slides
        T = view.T_world_camera.clone()
        T[:3, 3] *= scale
        return next(render_frames(ArticulatedSplat(bundle), [{}], replace(view, T_world_camera=T), output)).astype(int)

    assert np.abs(frame(1.0) - frame(2.0**-10)).max() <= 2


def test_pngs_replace_those_of_a_longer_run(tmp_path):
    write_frames(iter(FRAMES + FRAMES[:2]), tmp_path)
    (tmp_path / "other.png").write_bytes(b"")
    assert write_frames(iter(FRAMES), tmp_path) == 3
    names = sorted(p.name for p in tmp_path.iterdir())
    assert names == ["frame_0000.png", "frame_0001.png", "frame_0002.png", "other.png"]
    assert np.array_equal(np.asarray(Image.open(tmp_path / "frame_0001.png")), FRAMES[1])


def test_pngs_that_others_named_stay(tmp_path):
    theirs = ["frame_00001.png", "frame_0007.png", "frame_7.png", "frame_\u0661\u0662\u0663\u0664.png"]
    for name in theirs:
        (tmp_path / name).write_bytes(b"theirs")
    write_frames(iter(FRAMES), tmp_path)
    assert {p.name for p in tmp_path.iterdir() if p.read_bytes() == b"theirs"} == set(theirs)


def test_a_gif_has_all_frames(tmp_path):
    assert write_frames(iter(FRAMES), tmp_path / "new" / "a.gif", fps=10) == 3
    with Image.open(tmp_path / "new" / "a.gif") as image:
        assert image.n_frames == 3 and image.size == (41, 31) and image.info["duration"] == 100
        image.seek(2)
        assert abs(int(np.asarray(image.convert("RGB"))[0, 0, 0]) - 250) < 5


@pytest.mark.parametrize("fps", [0.001, 30])
def test_a_gif_shows_frames_that_are_alike_as_long_as_they_last(tmp_path, fps):
    frames = [FRAMES[0], FRAMES[0], FRAMES[1]]
    assert write_frames(iter(frames), tmp_path / "a.gif", fps=fps) == 3
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 2
        assert image.info["duration"] == pytest.approx(min(2000 / fps, 655350), abs=10)  # of 16 bits, at most


def test_a_video_goes_where_a_name_looks_like_a_protocol(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert write_frames(iter(FRAMES), Path("2024-05-01T10:30/a.mp4")) == 3


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("mine")
    with pytest.raises(InputError, match="a.csv: is a file; give"):
        write_frames(iter(FRAMES), tmp_path / "a.csv")


def test_a_video_has_all_frames_and_an_even_size(tmp_path):
    import imageio_ffmpeg

    assert write_frames(iter(FRAMES), tmp_path / "a.mp4", fps=10) == 3
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    assert next(reader)["source_size"] == (42, 32)
    values = [np.frombuffer(frame, np.uint8).mean() for frame in reader]
    assert values == pytest.approx([10, 128, 250], abs=6)


def test_a_run_that_dies_leaves_the_last_good_file(tmp_path):
    def dying():
        yield FRAMES[0]
        raise RuntimeError("power cut")

    for name in ("a.gif", "a.mp4"):
        (tmp_path / name).write_bytes(b"good")
        with pytest.raises(RuntimeError, match="power cut"):
            write_frames(dying(), tmp_path / name)
        assert (tmp_path / name).read_bytes() == b"good"
    assert len(list(tmp_path.iterdir())) == 2


def test_other_formats_are_refused(tmp_path):
    with pytest.raises(InputError, match="'.avi' cannot be written"):
        write_frames(iter(FRAMES), tmp_path / "a.avi")


@pytest.mark.parametrize("fps", [30, 60, 1000, 1e-9])
def test_a_gif_keeps_to_durations_that_programs_show(tmp_path, fps):
    write_frames(iter(FRAMES), tmp_path / "a.gif", fps)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.info["duration"] == {30: 30, 60: 20, 1000: 20, 1e-9: 655350}[fps]


@pytest.mark.parametrize("name", ["run_0.5", "a.GIF", "a.avi"])
def test_a_folder_may_have_a_dot(tmp_path, name):
    if name != "run_0.5":
        (tmp_path / name).mkdir()
    assert write_frames(iter(FRAMES), tmp_path / name) == 3
    assert len(list((tmp_path / name).glob("frame_*.png"))) == 3


def test_a_film_for_which_there_is_no_room_leaves_the_last_good_one(tmp_path, small_files):
    (tmp_path / "a.mp4").write_bytes(b"good")
    with pytest.raises(InputError, match="a.mp4: ffmpeg could not write it"), small_files():
        write_frames(iter(FRAMES), tmp_path / "a.mp4")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {"a.mp4": b"good"}


@pytest.mark.parametrize("program", ["/bin/false", "/nowhere"])
def test_an_ffmpeg_that_does_not_work_is_told(tmp_path, monkeypatch, program):
    from imageio_ffmpeg import _io

    monkeypatch.setattr(_io, "get_first_available_h264_encoder", _io.get_first_available_h264_encoder.__wrapped__)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", program)
    with pytest.raises(InputError, match="a.mp4: ffmpeg could not write it"):
        write_frames(iter(FRAMES), tmp_path / "a.mp4")
    assert list(tmp_path.iterdir()) == []
