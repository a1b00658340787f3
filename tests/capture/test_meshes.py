import numpy as np
import pytest
import trimesh
from PIL import Image

from splatart_ns.capture.meshes import load_mesh
from splatart_ns.errors import InputError

OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"


def write_obj(folder, texture="../images/wood.png"):
    (folder / "objs").mkdir()
    (folder / "images").mkdir()
    Image.new("RGB", (4, 4), (10, 200, 30)).save(folder / "images" / "wood.png")
    (folder / "objs" / "a.mtl").write_text(f"newmtl wood\nKd 0 0 0\nmap_Kd {texture}\nnewmtl blue\nKd 0 0 1\n")
    text = f"mtllib a.mtl\n{OBJ}usemtl wood\nf 1/1 2/2 3/3\nusemtl blue\nf 1/1 3/3 2/2\n"
    (folder / "objs" / "a.obj").write_text(text)
    return folder / "objs" / "a.obj"


def test_a_texture_outside_the_mesh_folder_is_found(tmp_path):
    surface = load_mesh(write_obj(tmp_path))
    wood = [i for i, t in enumerate(surface.textures) if t.shape == (4, 4, 3)]
    assert len(wood) == 1
    assert surface.textures[wood[0]][0, 0].tolist() == [10, 200, 30]
    textured = surface.texture == wood[0]
    assert textured.sum() == 1
    assert surface.colours[textured] == pytest.approx(1.0)
    assert surface.colours[~textured][0, 0] == pytest.approx([0.0, 0.0, 1.0])


def test_a_missing_texture_is_named_in_a_warning(tmp_path, caplog):
    load_mesh(write_obj(tmp_path, "../images/gone.png"))
    assert "gone.png" in caplog.text


def test_a_material_whose_triangles_all_lack_area_is_left_out(tmp_path):
    path = write_obj(tmp_path)
    path.write_text(path.read_text() + "usemtl grey\nf 1/1 2/2 2/2\n")
    assert len(load_mesh(path).corners) == 2


def test_a_mesh_whose_triangles_all_lack_area_is_refused(tmp_path):
    (tmp_path / "flat.obj").write_text(OBJ + "f 1 2 2\n")
    with pytest.raises(InputError, match="flat.obj: the mesh holds no triangles"):
        load_mesh(tmp_path / "flat.obj")


@pytest.mark.parametrize("texture_coordinates", [True, False])
def test_a_mesh_without_material_takes_the_given_colour(tmp_path, texture_coordinates):
    face = "f 1/1 2/2 3/3\n" if texture_coordinates else "f 1 2 3\n"
    (tmp_path / "plain.obj").write_text(OBJ + face)
    surface = load_mesh(tmp_path / "plain.obj", (0.2, 0.4, 0.6))
    assert surface.colours[0, 0] == pytest.approx([0.2, 0.4, 0.6])


@pytest.mark.parametrize("suffix", ["stl", "glb", "ply", "obj"])
def test_formats_give_the_same_shape(tmp_path, suffix):
    box = trimesh.creation.box(extents=(1.0, 2.0, 3.0))
    box.export(tmp_path / f"box.{suffix}")
    surface = load_mesh(tmp_path / f"box.{suffix}")
    assert len(surface.corners) == 12
    assert np.ptp(surface.corners.reshape(-1, 3), axis=0) == pytest.approx([1.0, 2.0, 3.0])


def test_a_collada_file_in_inches_is_read_in_metres(tmp_path):
    pytest.importorskip("collada")
    trimesh.creation.box(extents=(1.0, 1.0, 1.0)).export(tmp_path / "box.dae")
    text = (tmp_path / "box.dae").read_text()
    start = text.index("<asset>") + len("<asset>")
    assert "<unit" not in text
    (tmp_path / "box.dae").write_text(text[:start] + '<unit name="inch" meter="0.0254"/>' + text[start:])
    surface = load_mesh(tmp_path / "box.dae")
    assert np.ptp(surface.corners.reshape(-1, 3), axis=0) == pytest.approx(0.0254)


def test_vertex_and_face_colours_are_read(tmp_path):
    box = trimesh.creation.box()
    box.visual.vertex_colors = (255, 0, 51, 255)
    box.export(tmp_path / "box.ply")
    assert load_mesh(tmp_path / "box.ply").colours.reshape(-1, 3) == pytest.approx(
        np.broadcast_to([1.0, 0.0, 0.2], (36, 3))
    )


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("gone.obj", None, "not there"),
        ("mesh.blend", b"x", "'.blend'"),
        ("empty.obj", b"", "mesh"),
        ("points.obj", b"v 0 0 0\n", "mesh"),
        ("broken.stl", b"\x00" * 100, "mesh"),
        ("broken.dae", b"<not", "cannot be read"),
    ],
)
def test_a_file_that_is_no_mesh_is_refused_by_name(tmp_path, name, content, says):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=says) as refusal:
        load_mesh(tmp_path / name)
    assert name in str(refusal.value)
