import math

import numpy as np
import pytest
import torch
import trimesh
from solid_splat import splat_on

from splatart_ns.bundle.depth_view import look_around
from splatart_ns.bundle.surface import part_surface
from splatart_ns.errors import InputError
from splatart_ns.splats.splat import Splat

VOXELS = 60_000


def few(means: list[list[float]], scales=(0.1, 0.1, 0.1), opacity_logit: float = 3.0) -> Splat:
    n = len(means)
    return Splat(
        means=torch.tensor(means),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        log_scales=torch.tensor(scales).log().repeat(n, 1),
        opacity_logits=torch.full((n,), opacity_logit),
        sh=torch.zeros(n, 1, 3),
    )


def assert_solid(mesh: trimesh.Trimesh) -> None:
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume > 0
    assert np.isfinite(mesh.vertices).all()
    assert mesh.visual.vertex_colors.shape == (len(mesh.vertices), 4)


def distances(mesh: trimesh.Trimesh, true: trimesh.Trimesh) -> np.ndarray:
    """From points on either surface to the other."""
    a, b = (trimesh.sample.sample_surface(m, 1000, seed=1)[0] for m in (mesh, true))
    to = trimesh.proximity.closest_point
    return np.concatenate([to(true, a)[1], to(mesh, b)[1]])


@pytest.mark.parametrize(
    "true",
    [
        trimesh.creation.box((1, 0.6, 0.4)),
        trimesh.creation.icosphere(3, 0.5),
        trimesh.creation.torus(0.5, 0.15),
        trimesh.creation.box((1, 0.3, 0.03)),
    ],
    ids=["box", "sphere", "torus", "plate"],
)
def test_a_closed_shape_is_found_again(true):
    mesh = part_surface(splat_on(true), voxels=VOXELS)
    assert_solid(mesh)
    assert mesh.euler_number == true.euler_number
    assert mesh.volume == pytest.approx(true.volume, rel=0.05)
    assert np.sqrt((distances(mesh, true) ** 2).mean()) < 0.01


def test_an_outer_face_lies_before_the_middles_of_its_gaussians():
    box = trimesh.creation.box((1, 0.6, 0.4))
    mesh = part_surface(splat_on(box, thickness=0.02), voxels=VOXELS)
    assert_solid(mesh)
    assert mesh.volume == pytest.approx(box.volume, rel=0.05)  # between the middles there is 0.64 of it
    assert np.quantile(distances(mesh, box), 0.9) < 0.025


def test_the_floor_of_a_hollow_lies_in_the_middle_of_its_gaussians():
    mesh = part_surface(open_box(thickness=0.02, inwards=0.0), voxels=VOXELS)
    x, y, z = mesh.vertices.T
    assert z[(np.abs(x) < 0.3) & (np.abs(y) < 0.15)].max() == pytest.approx(-0.2, abs=0.02)


def test_a_sheet_gets_a_thickness_and_stays_open():
    box = trimesh.creation.box((1, 0.6, 0.4))
    box.update_faces(box.face_normals[:, 2] < 0.5)
    mesh = part_surface(splat_on(box, 5000), voxels=VOXELS)
    assert_solid(mesh)
    assert np.quantile(distances(mesh, box), 0.95) < 0.03
    assert mesh.volume < 0.3 * 0.24


def test_colours_lie_where_they_were():
    mesh = part_surface(splat_on(trimesh.creation.box((1, 0.6, 0.4))), voxels=VOXELS)
    red, green = mesh.visual.vertex_colors[:, 0].astype(int), mesh.visual.vertex_colors[:, 1].astype(int)
    right = mesh.vertices[:, 0] > 0.1
    left = mesh.vertices[:, 0] < -0.1
    assert (green[right] > 200).mean() > 0.95 and (red[right] < 50).mean() > 0.95
    assert (red[left] > 200).mean() > 0.95


def test_the_budget_of_triangles_holds():
    mesh = part_surface(splat_on(trimesh.creation.torus(0.5, 0.15)), triangles=800, voxels=VOXELS)
    assert_solid(mesh)
    assert 200 < len(mesh.faces) <= 800


def test_place_and_size_do_not_matter():
    box = trimesh.creation.box((1, 0.6, 0.4))
    near = part_surface(splat_on(box), voxels=VOXELS)
    splat = splat_on(box)
    splat.means = 0.01 * splat.means + torch.tensor([3.0, -2, 1])
    splat.log_scales = splat.log_scales + math.log(0.01)
    far = part_surface(splat, voxels=VOXELS)
    assert far.volume == pytest.approx(1e-6 * near.volume, rel=0.02)
    np.testing.assert_allclose(far.bounds, 0.01 * near.bounds + [3.0, -2, 1], atol=1e-4)


def test_the_same_every_time():
    splat = splat_on(trimesh.creation.box((1, 0.6, 0.4)), 500)
    first, second = (part_surface(splat, voxels=VOXELS) for _ in range(2))
    assert np.array_equal(first.vertices, second.vertices) and np.array_equal(first.faces, second.faces)


def test_a_faint_far_gaussian_changes_nothing():
    box = trimesh.creation.box((1, 0.6, 0.4))
    faint = few([[8.0, 0, 0]], (3.0, 3.0, 3.0), opacity_logit=-2.0)
    mesh = part_surface(Splat.cat([splat_on(box), faint]), voxels=VOXELS)
    assert mesh.volume == pytest.approx(0.24, rel=0.15)


@pytest.mark.parametrize("far", [3.0, 1000.0])
def test_an_opaque_gaussian_far_away_changes_nothing(far):
    box = splat_on(trimesh.creation.box((1, 0.6, 0.4)))
    stray = few([[far, far, far]], (0.02, 0.02, 0.02))
    mesh, alone = part_surface(Splat.cat([box, stray]), voxels=VOXELS), part_surface(box, voxels=VOXELS)
    assert np.array_equal(mesh.vertices, alone.vertices)


def test_pieces_of_a_part_apart_from_each_other_all_stay():
    pieces = [trimesh.creation.box((0.2, 0.2, 0.2)).apply_translation((x, 0, 0)) for x in (0.0, 5.0)]
    mesh = part_surface(Splat.cat([splat_on(piece) for piece in pieces]))
    assert mesh.bounds[1, 0] > 5


def test_haze_in_a_hollow_does_not_fill_it():
    box = trimesh.creation.box((1, 0.6, 0.4))
    box.update_faces(box.face_normals[:, 2] < 0.5)
    x = 2 * torch.rand(600, 3, generator=torch.Generator().manual_seed(0)) - 1
    haze = few((x * torch.tensor([0.4, 0.2, 0.15])).tolist(), (0.08, 0.08, 0.08), opacity_logit=math.log(0.09 / 0.91))
    shell = splat_on(box, 5000)
    clear, hazy = (part_surface(s, voxels=VOXELS) for s in (shell, Splat.cat([shell, haze])))
    assert hazy.volume == pytest.approx(clear.volume, rel=0.02)


def test_a_part_of_haze_alone_still_makes_a_solid():
    haze = splat_on(trimesh.creation.box((1, 0.6, 0.4)), opacity=0.05)
    assert_solid(part_surface(haze, voxels=VOXELS))


def test_what_no_camera_looked_at_is_told():
    """A box that was seen from above only: from there one sees the top and, from the sides, most of the sides."""
    splat = splat_on(trimesh.creation.box((1, 0.6, 0.4)), 5000)
    ring = torch.tensor([[math.cos(a), math.sin(a), 0.0] for a in torch.arange(0, 2 * math.pi, 0.3)])
    above = torch.cat([5 * ring + torch.tensor([0, 0, z]) for z in (0.3, 2.0, 8.0)])
    unseen = {
        name: part_surface(splat, cameras, voxels=VOXELS).metadata["unseen_share"]
        for name, cameras in {"not said": None, "around": torch.cat([above, -above]), "above": above}.items()
    }
    bottom = 0.6 / (2 * (0.6 + 0.4 + 0.24))
    assert unseen["not said"] < 0.01 and unseen["around"] < 0.01
    assert unseen["above"] == pytest.approx(bottom, abs=0.05)


def test_the_back_of_a_thin_plate_is_not_seen_through_its_front():
    splat = splat_on(trimesh.creation.box((1, 0.6, 0.01)), 5000)
    ring = torch.tensor([[math.cos(a), math.sin(a), 0.0] for a in torch.arange(0, 2 * math.pi, 0.3)])
    above = torch.cat([5 * ring + torch.tensor([0, 0, z]) for z in (2.0, 4.0, 8.0)])
    mesh = part_surface(splat, above, voxels=VOXELS)
    assert mesh.metadata["unseen_share"] == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(
    "splat",
    [
        few([[1.0, 2, 3]]),
        few([[1.0, 2, 3]], opacity_logit=-1.0),
        few([[1.0, 2, 3]], (0.1, 1e-12, 1e-12)),
        few([[1e4, 0, 0]], (1e-3, 1e-3, 1e-3)),
        few([[0.0, 0, 0], [0.0, 0, 0]]),
        few([[0.1 * k, 0, 0] for k in range(9)], (0.05, 1e-6, 1e-6)),
        few([[0.1 * k, 0.1 * j, 0] for k in range(5) for j in range(5)], (0.1, 0.1, 0.0)),
        few([[0.0, 0, 0], [100.0, 0, 0]]),
    ],
    ids=["one", "faint", "needle", "far", "twice", "line", "plane", "apart"],
)
def test_few_gaussians_still_make_a_solid(splat):
    mesh = part_surface(splat, voxels=VOXELS)
    assert_solid(mesh)
    low, high = splat.means.amin(0).numpy() - 1, splat.means.amax(0).numpy() + 1
    assert (mesh.vertices > low).all() and (mesh.vertices < high).all()


@pytest.mark.parametrize(
    "splat", [few([[0.0, 0, 0]]).select(torch.tensor([], dtype=torch.long)), few([[0.0, 0, 0]], opacity_logit=-9)]
)
def test_nothing_visible_is_an_error(splat):
    with pytest.raises(InputError, match="no visible Gaussians"):
        part_surface(splat)


def test_no_extent_is_an_error():
    with pytest.raises(InputError, match="no extent"):
        part_surface(few([[0.0, 0, 0]], (0.0, 0.0, 0.0)))


def open_box(**gaussians):
    """Without its upper face, at 0.2."""
    box = trimesh.creation.box((1, 0.6, 0.4))
    box.update_faces(box.face_normals[:, 2] < 0.5)
    return splat_on(box, 5000, **gaussians)


def lying_on(box_at):
    """A box as wide as the open one, its lower face at a height, without Gaussians there."""
    box = trimesh.creation.box((1.02, 0.62, 0.2))
    box.update_faces(box.face_normals[:, 2] > -0.5)
    box.apply_translation([0, 0, box_at + 0.1])
    return splat_on(box, 5000)


def test_the_face_that_another_part_lies_on_in_all_states_is_closed():
    alone = part_surface(open_box(), voxels=VOXELS)
    under = part_surface(open_box(), around=[lying_on(0.2), lying_on(0.2)], voxels=VOXELS)
    assert_solid(under)
    assert alone.volume < 0.5 * 1 * 0.6 * 0.4
    assert under.volume == pytest.approx(1 * 0.6 * 0.4, rel=0.15)
    assert under.bounds[1, 2] == pytest.approx(0.2, abs=0.03)


def test_the_underside_at_which_no_camera_looked_is_closed():
    """The open side of a box is its underside, or it is not."""
    above = torch.tensor([[0, 0, 9.0], [5, 0, 3], [-5, 0, 3], [0, 5, 3], [0, -5, 3]], dtype=torch.float64)
    from_above, from_below = (part_surface(open_box(), cameras, voxels=VOXELS) for cameras in (above, -above))
    assert_solid(from_below)
    assert from_above.volume < 0.5 * 1 * 0.6 * 0.4
    assert from_below.volume == pytest.approx(1 * 0.6 * 0.4, rel=0.15)
    assert from_below.bounds[1, 2] == pytest.approx(0.2, abs=0.03)


def test_a_deep_hollow_is_open_as_far_as_cameras_looked_into_it():
    """Of the directions all around hardly any leads to its floor."""
    box = trimesh.creation.box((0.8, 0.6, 2.0))
    box.update_faces(box.face_normals[:, 2] < 0.5)
    angle = torch.arange(12, dtype=torch.float64) * (math.pi / 6)
    rings = [(r * angle.cos(), r * angle.sin(), torch.full_like(angle, 6.0)) for r in (0.5, 1.2, 2.5, 6.0)]
    cameras = torch.cat([torch.stack(ring, -1) for ring in rings])
    mesh = part_surface(splat_on(box, 8000), cameras, voxels=VOXELS)
    assert_solid(mesh)
    assert mesh.volume < 0.35 * 0.8 * 0.6 * 2.0
    x, y, z = mesh.vertices.T
    assert z[(np.abs(x) < 0.25) & (np.abs(y) < 0.18)].max() == pytest.approx(-1.0, abs=0.1)


def test_a_camera_in_the_very_middle_looks_from_no_side():
    box, centre = splat_on(trimesh.creation.box((1, 0.6, 0.4)), 500), torch.zeros(3, dtype=torch.float64)
    towards = torch.tensor([[0, 0, 0], [0, 0.6, 0.8]], dtype=torch.float64)
    views = [look_around(box, centre, 1.0, 32, towards=some) for some in (None, towards[:1], towards)]
    assert [len(some) - len(views[0]) for some in views] == [0, 0, 1]
    assert all(view.image.isfinite().all() for view in views[2])


def test_a_hollow_stays_that_another_part_uncovers_in_some_state():
    alone = part_surface(open_box(), voxels=VOXELS)
    uncovered = part_surface(open_box(), around=[lying_on(0.2), lying_on(3.0)], voxels=VOXELS)
    assert uncovered.volume == pytest.approx(alone.volume, rel=0.05)


def test_what_another_part_hides_beside_a_part_is_none_of_it():
    box = trimesh.creation.box((1, 0.6, 0.4))
    alone = part_surface(splat_on(box), voxels=VOXELS)
    beside = part_surface(splat_on(box), around=[lying_on(0.2)] * 2, voxels=VOXELS)
    assert beside.volume == pytest.approx(alone.volume, rel=0.02)
