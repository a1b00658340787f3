import numpy as np
import pytest
import torch

from splatart_ns.errors import InputError
from splatart_ns.splats import Splat, read_ply, write_ply

FIELDS = ["means", "quats", "log_scales", "opacity_logits", "sh"]


def random_splat(n: int, degree: int) -> Splat:
    g = torch.Generator().manual_seed(n + degree)
    return Splat(
        means=torch.randn(n, 3, generator=g),
        quats=torch.randn(n, 4, generator=g),
        log_scales=torch.randn(n, 3, generator=g),
        opacity_logits=torch.randn(n, generator=g),
        sh=torch.randn(n, (degree + 1) ** 2, 3, generator=g),
    )


def edited(path, old: bytes, new: bytes):
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))
    return path


@pytest.fixture
def ply(tmp_path):
    path = tmp_path / "part.ply"
    write_ply(random_splat(5, 1), path)
    return path


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 17])
def test_round_trip_is_exact(tmp_path, n, degree):
    splat = random_splat(n, degree)
    write_ply(splat, tmp_path / "a.ply")
    back = read_ply(tmp_path / "a.ply")
    assert back.part_logits is None
    for name in FIELDS:
        assert torch.equal(getattr(back, name), getattr(splat, name)), name


def test_the_file_has_the_layout_that_viewers_expect(tmp_path):
    splat = random_splat(3, 1)
    write_ply(splat, tmp_path / "a.ply")
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property float")]
    rest = [f"f_rest_{i}" for i in range(9)]
    assert names == (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity"]
        + ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    )
    table = np.frombuffer(body, "<f4").reshape(3, len(names))
    # All coefficients of red come first, then those of green.
    assert np.array_equal(table[:, names.index("f_rest_0")], splat.sh[:, 1, 0].numpy())
    assert np.array_equal(table[:, names.index("f_rest_2")], splat.sh[:, 3, 0].numpy())
    assert np.array_equal(table[:, names.index("f_rest_3")], splat.sh[:, 1, 1].numpy())
    assert np.array_equal(table[:, names.index("rot_0")], splat.quats[:, 0].numpy())


def test_part_ids_are_a_property_of_their_own(tmp_path):
    splat = random_splat(3, 0)
    write_ply(splat, tmp_path / "whole.ply", parts=torch.tensor([1, 254, 2]))
    data = (tmp_path / "whole.ply").read_bytes()
    assert b"property float rot_3\nproperty uchar part\nend_header\n" in data
    size = len(data.split(b"end_header\n", 1)[1]) // 3
    assert [data[-1 - 2 * size], data[-1 - size], data[-1]] == [1, 254, 2]
    torch.testing.assert_close(read_ply(tmp_path / "whole.ply").means, splat.means, atol=0, rtol=0)


def test_writing_leaves_no_other_file(tmp_path):
    write_ply(random_splat(2, 0), tmp_path / "a.ply")
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def test_a_splat_with_nan_is_not_written_and_the_last_file_stays(ply):
    before = ply.read_bytes()
    splat = random_splat(2, 0)
    splat.means[1, 2] = torch.nan
    with pytest.raises(ValueError, match="not finite"):
        write_ply(splat, ply)
    assert ply.read_bytes() == before


def test_other_properties_and_types_are_read_past(tmp_path):
    splat = random_splat(4, 0)
    write_ply(splat, tmp_path / "a.ply")
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    table = np.frombuffer(body, "<f4").reshape(4, -1)
    wider = b"".join(row.tobytes() + bytes([7]) for row in table)
    (tmp_path / "b.ply").write_bytes(header + b"property uchar label\nend_header\n" + wider)
    assert torch.equal(read_ply(tmp_path / "b.ply").quats, splat.quats)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"ply\n", b"plx\n", "begin with 'ply'"),
        (b"binary_little_endian", b"ascii", "format ascii 1.0"),
        (b"element vertex 5", b"element vertex 6", "promises 6 vertices"),
        (b"element vertex 5", b"element vertex 99999999999999", "promises 99999999999999"),
        (b"element vertex 5", b"element vertex -5", "element vertex -5"),
        (b"element vertex 5", b"element face 5", "element face 5"),
        (b"property float x\n", b"property list uchar int x\n", "property list uchar int x"),
        (b"property float nx\n", b"property float x\n", "named twice"),
        (b"property float opacity", b"property float transparency", "lack opacity"),
        (b"property float f_rest_4", b"property float f_rest_44", "9 f_rest properties"),
        (b"property float f_rest_4", b"property float other", "8 f_rest properties"),
        (b"end_header\n", b"", "header"),
    ],
)
def test_a_header_that_lies_is_refused(ply, old, new, message):
    with pytest.raises(InputError, match=message) as error:
        read_ply(edited(ply, old, new))
    assert str(ply) in str(error.value)


@pytest.mark.parametrize("size", [0, 3, 40, -1, -100])
def test_a_file_cut_anywhere_is_refused(ply, size):
    ply.write_bytes(ply.read_bytes()[:size])
    with pytest.raises(InputError, match="part.ply"):
        read_ply(ply)


def test_bytes_after_the_vertices_are_refused(ply):
    ply.write_bytes(ply.read_bytes() + b"\0")
    with pytest.raises(InputError, match="bytes follow"):
        read_ply(ply)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_value_that_is_not_finite_is_refused_by_name(ply, value):
    header, end, body = ply.read_bytes().partition(b"end_header\n")
    table = np.frombuffer(body, "<f4").reshape(5, -1).copy()
    table[3, 1] = value
    ply.write_bytes(header + end + table.tobytes())
    with pytest.raises(InputError, match="y of vertex 3"):
        read_ply(ply)


@pytest.mark.parametrize(
    ("columns", "value", "found"),
    [
        (slice(-4, None), 0.0, "rotation of vertex 2 is 0 0 0 0;"),
        (slice(-4, None), 1e-30, "rotation of vertex 2"),
        (slice(-4, None), 1e30, "rotation of vertex 2"),
        (-5, 31.0, "scale_2 of vertex 2 is 31"),
    ],
)
def test_a_gaussian_that_cannot_be_rendered_is_refused(ply, columns, value, found):
    header, end, body = ply.read_bytes().partition(b"end_header\n")
    table = np.frombuffer(body, "<f4").reshape(5, -1).copy()
    table[2, columns] = value
    ply.write_bytes(header + end + table.tobytes())
    with pytest.raises(InputError, match=found):
        read_ply(ply)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere.ply"):
        read_ply(tmp_path / "nowhere.ply")
