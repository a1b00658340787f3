"""A bundle from a stranger: one that is sound, or one sentence. `make fuzz` tries more of it."""

import json
import os

import pytest
from fuzzing import damaged_bytes, damaged_json, fuzzed
from hypothesis import given
from hypothesis import strategies as st

from splatart_ns.bundle import load_bundle, save_bundle
from splatart_ns.errors import InputError
from splatart_ns.splats.ply import read_ply


@pytest.fixture
def folder(bundle, tmp_path):
    save_bundle(bundle, tmp_path / "bundle")
    return tmp_path / "bundle"


def one_sentence(function, path):
    try:
        return function(path)
    except InputError as error:
        assert "\n" not in str(error).split("is not JSON")[0]
        return None


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
