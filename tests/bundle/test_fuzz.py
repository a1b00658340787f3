"""A bundle from a stranger: one that is sound, or one sentence. `make fuzz` tries more of it."""

import json
import os

import numpy as np
import pytest
import torch
from fuzzing import damaged_bytes, damaged_json, fuzzed, one_sentence
from hypothesis import given
from hypothesis import strategies as st

from splatart_ns.bundle import ArticulatedSplat, load_bundle, save_bundle
from splatart_ns.bundle.animation import render_frames
from splatart_ns.bundle.camera import bounding_sphere, orbit_camera
from splatart_ns.bundle.configurations import parse_settings, read_configuration, read_trajectory, sweep
from splatart_ns.bundle.dataset import Dataset, DatasetOptions
from splatart_ns.bundle.dataset_capture import write_dataset
from splatart_ns.bundle.motion_file import read_motions
from splatart_ns.errors import InputError
from splatart_ns.splats.ply import read_ply


@pytest.fixture
def folder(bundle, tmp_path):
    save_bundle(bundle, tmp_path / "bundle")
    return tmp_path / "bundle"


@given(data=st.data())
@fuzzed
def test_any_articulation_file(folder, data):
    file = folder / "articulation.json"
    original = file.read_bytes()
    try:
        file.write_bytes(data.draw(damaged_json(json.loads(original))))
        if (bundle := one_sentence(load_bundle, folder)) is not None:
            assert all(part.motion.isfinite().all() for part in bundle.parts)
            assert all(1 <= part.id <= 254 for part in bundle.parts)
            assert bundle.root in bundle.part_names
            for joint in bundle.joints:
                assert joint.axis.isfinite().all() and abs(float(joint.axis.norm()) - 1) < 1e-3
                assert joint.values.isfinite().all() and joint.origin.isfinite().all()
    finally:
        file.write_bytes(original)


@given(data=st.data())
@fuzzed
def test_any_splat_file(folder, data):
    file = folder / "parts/door.ply"
    original = file.read_bytes()
    try:
        file.write_bytes(data.draw(damaged_bytes(original)))
        if (splat := one_sentence(read_ply, file)) is not None:
            assert splat.means.isfinite().all() and splat.sh.isfinite().all()
            assert (splat.quats.norm(dim=-1) > 0).all()
    finally:
        file.write_bytes(original)


MOTIONS = {"parts": [{"name": name, "motion": torch.eye(4).repeat(2, 1, 1).tolist()} for name in ("base", "door")]}


@given(data=damaged_json(MOTIONS))
@fuzzed
def test_any_motion_file(tmp_path, data):
    (tmp_path / "motions.json").write_bytes(data)
    motions = one_sentence(lambda path: read_motions(path, ["base", "door"], 2), tmp_path / "motions.json")
    assert motions is None or (motions.shape == (2, 2, 4, 4) and motions.isfinite().all())


VALUES = {"hinge": 0.5, "slide": -0.1}
CSV = "hinge,slide\n0.5,-0.1\n30deg,0\n"


@given(data=damaged_json(VALUES) | damaged_bytes(CSV.encode()))
@fuzzed
def test_any_configuration_and_trajectory_is_rendered(bundle, tmp_path, data):
    file, splat = tmp_path / "q", ArticulatedSplat(bundle)
    file.write_bytes(data)
    path = [one_sentence(lambda file: read_configuration(file, bundle), file)]
    path = path if path[0] is not None else one_sentence(lambda file: read_trajectory(file, bundle), file)
    for q in (path or [])[:1]:
        assert all(np.isfinite(value).all() for value in q.values())
        centre, radius = bounding_sphere(bundle, [q])
        assert np.isfinite(centre).all() and np.isfinite(radius)
        view = orbit_camera(centre, radius, 0.1, 0.2, 8, 8)
        assert [frame.shape for frame in render_frames(splat, [q], view)] == [(8, 8, 3)]
        sweep(bundle, q, 3)


@pytest.mark.parametrize("text", ["hinge=1e300", "hinge=1e18", "slide=1e300", "slide=-1e19", "hinge=1e999"])
def test_values_that_no_joint_can_have_are_refused(bundle, text):
    with pytest.raises(InputError, match="is no number"):
        parse_settings([text], bundle)


@given(data=damaged_json({"format": "splatart-dataset-1", "bundle": "digest", "states": 2, "resolution": 16}))
@fuzzed
def test_any_note_of_what_a_dataset_holds(bundle, tmp_path, data):
    """A folder that holds something else is left as it is."""
    folder = tmp_path / "dataset"
    folder.mkdir(exist_ok=True)
    (folder / "dataset.json").write_bytes(data)
    dataset = Dataset(ArticulatedSplat(bundle), DatasetOptions(2, 16))
    assert one_sentence(lambda folder: write_dataset(dataset, folder, 2), folder) is None
    assert [file.name for file in folder.iterdir()] == ["dataset.json"]


@pytest.mark.parametrize("make", [lambda f: os.symlink(f, f), os.mkfifo], ids=["link in a circle", "pipe"])
@pytest.mark.parametrize("name", ["articulation.json", "parts/door.ply"])
def test_links_in_circles_and_pipes_are_refused(folder, make, name):
    (folder / name).unlink()
    make(folder / name)
    with pytest.raises(InputError):
        load_bundle(folder)


def test_a_part_that_is_a_link_out_of_the_bundle_is_refused(folder, tmp_path):
    (folder / "parts/door.ply").rename(tmp_path / "elsewhere.ply")
    os.symlink(tmp_path / "elsewhere.ply", folder / "parts/door.ply")
    with pytest.raises(InputError, match="inside the bundle's folder"):
        load_bundle(folder)
