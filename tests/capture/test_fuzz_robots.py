"""URDFs and meshes, whatever is in them: a robot that is rendered, or one sentence. `make fuzz` tries more of it."""

import io
import logging
import re
import shutil
import zipfile

import numpy as np
import pytest
import trimesh
from fuzzing import STRANGE, damaged_bytes, fuzzed, one_sentence
from hypothesis import given
from hypothesis import strategies as st

from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.meshes import load_mesh
from splatart_ns.capture.robot import read_urdf
from splatart_ns.capture.synthesis import synthesize
from splatart_ns.capture.synthesis_options import SynthesisOptions
from splatart_ns.errors import InputError

URDF = """<robot name="crane">
  <material name="paint"><color rgba="0.1 0.2 0.3 1"/></material>
  <link name="base"><visual><geometry><box size="1 1 1"/></geometry></visual></link>
  <link name="boom"><visual><origin xyz="0 0 2" rpy="0 0 0"/>
    <geometry><mesh filename="box.obj" scale="1 2 1"/></geometry><material name="paint"/></visual></link>
  <link name="hook"><visual><geometry><sphere radius="0.5"/></geometry></visual></link>
  <link name="left"><visual><geometry><cylinder radius="0.5" length="2"/></geometry></visual></link>
  <joint name="swing" type="revolute"><parent link="base"/><child link="boom"/>
    <origin xyz="1 0 0" rpy="0.1 -0.4 0.7"/><axis xyz="0 0 2"/><limit lower="-1" upper="2"/></joint>
  <joint name="hoist" type="prismatic"><parent link="boom"/><child link="hook"/>
    <axis xyz="0 0 -1"/><limit lower="0.5" upper="3"/></joint>
  <joint name="follow" type="continuous"><parent link="base"/><child link="left"/>
    <axis xyz="0 1 0"/><mimic joint="swing" multiplier="-2" offset="0.25"/></joint>
</robot>"""
VALUES = [str(v) for v in STRANGE if isinstance(v, int | float | str)]
VALUES += ["0 0 0", "1e300 0 0", "nan 0 0", "1e11 1e11 1e11", "-1", "<>&", "package://a/b.obj", "file:///etc/passwd"]
VALUES += ["base", "swing", "hook", "follow", "fixed", "floating"]
VALUES = [value.translate({ord(c): f"&#{ord(c)};" for c in '<>&"'}) for value in VALUES]


@st.composite
def damaged_urdf(draw: st.DrawFn) -> bytes:
    """Values replaced, elements taken out or repeated; now and then no XML any more."""
    text = URDF
    for _ in range(draw(st.integers(1, 3))):
        kind = draw(st.sampled_from(["value", "value", "value", "away", "twice"]))
        found = list(re.finditer(r'="[^"]*"' if kind == "value" else r"<(\w+)\b[^<>]*/>|<(\w+)\b[^<>]*>", text))
        at = draw(st.sampled_from(found)) if found else None
        if at is not None:
            new = {"away": "", "twice": 2 * at[0], "value": f'="{draw(st.sampled_from(VALUES))}"'}
            text = text[: at.start()] + new[kind] + text[at.end() :]
    data = text.encode(errors="replace")
    return draw(damaged_bytes(data)) if draw(st.integers(0, 4)) == 0 else data


@pytest.fixture
def folder(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.obj")
    return tmp_path


@given(data=damaged_urdf())
@fuzzed
def test_any_urdf(folder, data):
    (folder / "robot.urdf").write_bytes(data)
    if (robot := one_sentence(read_urdf, folder / "robot.urdf")) is not None:
        poses = robot.link_poses({})
        assert set(poses) == set(robot.links) and len(robot.parts()) >= 1


@given(data=damaged_urdf())
@fuzzed
def test_any_urdf_is_rendered(folder, data):
    (folder / "robot.urdf").write_bytes(data)
    options = SynthesisOptions(train_views=1, test_views=0, resolution=8, samples=1)
    if one_sentence(synthesize, folder / "robot.urdf", folder / "capture", options) is not None:
        assert len(load_capture(folder / "capture").states) == 2
        shutil.rmtree(folder / "capture")
    assert {file.name for file in folder.iterdir()} <= {"robot.urdf", "box.obj", "material.mtl", "material_0.png"}


def meshes():
    box = trimesh.creation.box()
    yield from ((form, box.export(file_type=form)) for form in ("stl", "glb", "obj", "off", "ply", "dae"))
    yield "stl", box.export(file_type="stl_ascii")
    yield "ply", box.export(file_type="ply", encoding="ascii")
    yield "gltf", trimesh.Scene(box).export(file_type="gltf", merge_buffers=True)["model.gltf"]


MESHES = [(suffix, data.encode() if isinstance(data, str) else data) for suffix, data in meshes()]


@given(data=st.data())
@fuzzed
def test_any_mesh(tmp_path, data):
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    suffix, content = data.draw(st.sampled_from(MESHES))
    file = tmp_path / f"mesh.{suffix}"
    file.write_bytes(data.draw(damaged_bytes(content)))
    if (surface := one_sentence(load_mesh, file)) is not None:
        assert np.isfinite(surface.corners).all() and len(surface.corners) > 0
        assert all(np.isfinite(x).all() for x in (surface.normals, surface.uv, surface.colours))


@pytest.mark.parametrize("unit", ["", ".", "0", "-1", "nan", "1e999"])
def test_a_unit_that_is_no_length_is_refused(tmp_path, unit):
    text = dict(MESHES)["dae"].decode().replace("<asset>", f'<asset><unit meter="{unit}" name="x"/>', 1)
    (tmp_path / "a.dae").write_text(text)
    with pytest.raises(InputError, match="its unit is"):
        load_mesh(tmp_path / "a.dae")


def test_an_archive_is_not_unpacked(tmp_path):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.dae", b" " * (4 << 20))
    (tmp_path / "a.dae").write_bytes(data.getvalue())
    with pytest.raises(InputError, match="ZIP archive"):
        load_mesh(tmp_path / "a.dae")


@pytest.mark.parametrize("name", ["/etc/hostname", "../../../../secret.bin"])
def test_a_mesh_names_no_file_far_from_it(tmp_path, name):
    (tmp_path / "secret.bin").write_bytes(bytes(36))
    folder = tmp_path / "a/b/c/d"
    folder.mkdir(parents=True)
    buffer = f'"buffers": [{{"uri": "{name}", "byteLength": 36}}], "bufferViews": [{{"buffer": 0, "byteLength": 36}}]'
    accessor = '"accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}]'
    mesh = '"nodes": [{"mesh": 0}], "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}]'
    (folder / "a.gltf").write_text(
        f'{{"asset": {{"version": "2.0"}}, "scenes": [{{"nodes": [0]}}], {buffer}, {accessor}, {mesh}}}'
    )
    with pytest.raises(InputError, match="cannot be read"):
        load_mesh(folder / "a.gltf")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('size="1 1 1"', 'size="0 1 1"', "above 0"),
        ('<sphere radius="0.5"', '<sphere radius="-1"', "above 0"),
        ('joint="swing" mul', 'joint="follow" mul', "mimics itself"),
        ('xyz="0 0 2" rpy', 'xyz="0 0 1e300" rpy', "3 finite numbers"),
        ('upper="2"', 'upper="inf"', "1 finite numbers"),
        ("<robot", '<?xml version="1.0" encoding="none"?><robot', "XML"),
    ],
)
def test_values_of_a_urdf_that_make_no_sense_are_named(folder, old, new, words):
    assert old in URDF
    (folder / "robot.urdf").write_text(URDF.replace(old, new, 1))
    with pytest.raises(InputError, match=words):
        synthesize(folder / "robot.urdf", folder / "capture", SynthesisOptions(train_views=1, resolution=8))
    assert not (folder / "capture").exists()


def test_a_urdf_of_very_many_links_is_refused_at_once(tmp_path):
    links = "".join(f'<link name="l{i}"/>' for i in range(10_001))
    joint = '<joint name="j{}" type="fixed"><parent link="l{}"/><child link="l{}"/></joint>'
    joints = "".join(joint.format(i, i, i + 1) for i in range(10_000))
    (tmp_path / "robot.urdf").write_text(f"<robot>{links}{joints}</robot>")
    with pytest.raises(InputError, match="10001 links"):
        read_urdf(tmp_path / "robot.urdf")
