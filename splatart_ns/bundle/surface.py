"""A closed mesh of a part from its Gaussians alone: depth seen from all around, fused in a signed distance field."""

from __future__ import annotations

import math
from collections.abc import Sequence

import manifold3d
import numpy as np
import torch
import torch.nn.functional as F
import trimesh
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes
from torch import Tensor

from splatart_ns.bundle.depth_view import FAINT, DepthView, look_around
from splatart_ns.bundle.hull import Hull, Outside
from splatart_ns.bundle.occlusion import Extent
from splatart_ns.errors import InputError
from splatart_ns.geometry.se3 import matrix_from_quat
from splatart_ns.splats.splat import Splat

_MIN_OPACITY = 0.02
_COARSE_PIXELS = 64
"""Size of the images that find the part's extent."""
_AGREEING = 3
"""So many views must see through a place for it to be empty: fewer may be wrong."""
_HARDLY, _SHARE = 4.0, 0.5
"""And so large a share of those that see less than so many voxels past it: a flat face would sag to where the few that
see deepest into its Gaussians have it, and there are many views of it; into a hollow few can look."""
_SAME_SIDE = math.cos(math.radians(20))
"""A view whose direction differs by less than this from a camera's shows what the camera saw: those all around are 25
degrees apart."""
_GRAZING = math.sin(math.radians(10))
"""What a camera sees at a smaller angle than this, it hardly sees."""
_BAND = 3.0
"""Truncation of the signed distance, voxels."""
_THICKEN = 0.75
"""What surfaces lie further out by in the field, voxels: a sheet that both sides see at one depth would have holes."""
_LEFT_THICK = 0.25
"""What of this the mesh keeps, voxels."""
_AT_ONCE = 2**16
"""So many places are looked at together: it takes about a kilobyte of memory for each."""
_COARSE = 4
"""Voxels between the places where the field is looked at far from any surface."""
_MIN_COMPONENT = 0.01
"""Components of less than this share of the largest one's area, or opacity, are floaters."""


@torch.no_grad()
def part_surface(
    splat: Splat,
    cameras: Tensor | None = None,
    around: Sequence[Splat] = (),
    *,
    triangles: int = 20_000,
    voxels: int = 1_000_000,
) -> trimesh.Trimesh:
    """A watertight mesh around the Gaussians of one part, in their frame and unit, with a colour per vertex.

    The part alone is rendered from all around, and from where cameras were. Space that several views see through is
    empty; all else is solid: what no view can look into is closed, and a sheet that both sides are seen of has some
    thickness. Where the part has no Gaussians because others always stood before it, as on the face that one lies on,
    or because no camera looked there, as at an underside, views do not see through a convex body about it. A part too
    small or too transparent to hide what is behind it becomes the convex hull of its Gaussians. Deterministic.

    Args:
        splat: The Gaussians [N].
        cameras: Where the capture's cameras were [M, 3], M > 0, in the Gaussians' frame, if that is known.
        around: What stands around the part at each state, in the Gaussians' frame: `surroundings`.
        triangles: Most triangles of the mesh, 100 or more; flat shapes take fewer.
        voxels: Number of voxels of the part's box. What is thinner than a voxel is not resolved.

    Returns:
        The mesh, wound outwards. `metadata["unseen_share"]` is the share of its area that no view looks at, or none
        from the side of a camera: where it was closed, or follows the inside of Gaussians that were seen from the
        other side alone.

    Raises:
        InputError: No Gaussian is visible, or they have no extent.
    """
    if triangles < 100:
        raise InputError(f"a surface cannot be made of {triangles} triangles: ask for 100 or more")
    splat = splat.detach().to("cpu", torch.float32)
    splat = splat.select(splat.opacities > _MIN_OPACITY)
    if len(splat) == 0:
        raise InputError("a part has no visible Gaussians, and so no surface: fit the object again")
    clear = splat.opacities > FAINT
    splat = _without_strays(splat.select(clear) if clear.any() else splat)
    ends = _ellipsoid_ends(splat)
    centre, half = _box(ends)
    radius = float(half.norm())
    if not (0 < radius < math.inf):
        raise InputError("a part's Gaussians have no extent, and so it has no surface: fit the object again")

    # Large faint Gaussians reach far beyond what can be seen: looks at less and less find the true box.
    shrunk = True
    while shrunk:
        seen = torch.cat([view.surface(0.5) for view in look_around(splat, centre, radius, _COARSE_PIXELS)])
        if len(seen) == 0:
            return _hull(splat, ends)
        centre, half = _box(seen.double() * radius + centre)
        half = half + 3 * radius / _COARSE_PIXELS
        shrunk = float(half.norm()) < 0.5 * radius
        radius = float(half.norm())
    half = half.numpy() / radius
    towards = None if cameras is None else F.normalize(cameras.to(centre) - centre, dim=-1)
    extent = Extent.of((splat.means.double() - centre) / radius) if around or towards is not None else None

    while True:
        voxel = float((8 * half.prod() / voxels) ** (1 / 3))
        views = look_around(
            splat, centre, radius, math.ceil(2 / voxel), around, towards, torch.from_numpy(half) * radius
        )
        level = _zero_level(views, half, voxel, extent)
        if level is None:
            return _hull(splat, ends)
        solid = _simplified(_without_floaters(*level), triangles, voxel)
        if solid is not None:
            break
        voxels //= 4
    mesh = _thinned(solid, (_THICKEN - _LEFT_THICK) * voxel)
    if len(mesh.faces) == 0:
        return _hull(splat, ends)
    colours, vertex_seen = _vertex_colours(views, torch.from_numpy(np.array(mesh.vertices)).float(), 2 * voxel)
    seen = vertex_seen[mesh.faces].any(1)
    if towards is not None:
        seen &= _looked_at(views, towards, mesh, 2 * voxel)
    mesh.visual.vertex_colors = colours
    mesh.metadata["unseen_share"] = float(mesh.area_faces[~seen].sum() / mesh.area)
    mesh.vertices = mesh.vertices * radius + centre.numpy()
    return mesh


def _without_strays(splat: Splat) -> Splat:
    """A splat without Gaussians far from all others: few, apart by as much as most lie from the middle.

    One of them would make the part's box large and its voxels coarse.
    """
    x = splat.means.double()
    middle = x.median(0).values
    apart = float((x - middle).norm(dim=1).median())
    if apart == 0:
        return splat
    cells, cell_of = np.unique(np.floor((x - middle).numpy() / apart), axis=0, return_inverse=True)
    touching = cKDTree(cells).query_pairs(math.sqrt(3) + 1e-6, output_type="ndarray")
    graph = coo_matrix((np.ones(len(touching)), touching.T), (len(cells), len(cells)))
    cluster = torch.from_numpy(connected_components(graph, directed=False)[1][cell_of.ravel()]).long()
    weight = torch.zeros(int(cluster.max()) + 1).index_add(0, cluster, splat.opacities)
    return splat.select((weight >= _MIN_COMPONENT * weight.max())[cluster])


def _box(points: Tensor) -> tuple[Tensor, Tensor]:
    """Centre and half sides [3] of the box around points [N, 3]."""
    low, high = points.amin(0), points.amax(0)
    return (low + high) / 2, (high - low) / 2


def _ellipsoid_ends(splat: Splat) -> Tensor:
    """Both ends of the Gaussians' axes at two standard deviations [6 N, 3], float64."""
    axes = 2 * (matrix_from_quat(splat.quats.double()) * splat.scales.double()[:, None]).mT
    means = splat.means.double()[:, None]
    return torch.cat([means + axes, means - axes], 1).flatten(0, 1)


def _hull(splat: Splat, ends: Tensor) -> trimesh.Trimesh:
    """The convex hull of the Gaussians, with a thickness where they have none, in their mean colour."""
    centre, half = _box(ends)
    least = 1e-3 * float(half.max())
    corners = torch.cartesian_prod(*[torch.tensor([-least, least], dtype=torch.float64)] * 3)
    x = ((ends - centre)[:, None] + corners).flatten(0, 1).numpy()
    mesh = trimesh.convex.convex_hull(np.unique(x, axis=0))
    mesh.vertices = mesh.vertices + centre.numpy()
    weights = splat.opacities[:, None]
    colour = (weights * splat.base_colours).sum(0) / weights.sum()
    mesh.visual.vertex_colors = _bytes(colour.expand(len(mesh.vertices), 3))
    mesh.metadata["unseen_share"] = 1.0
    return mesh


def _zero_level(
    views: list[DepthView], half: np.ndarray, voxel: float, extent: Extent | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices and faces of the border between empty and solid in a box of half sides [3]; None where all is empty."""
    # Whole coarse cells, with an empty margin.
    cells = np.ceil(2 * half / (voxel * _COARSE)).astype(int) + 2
    origin = -voxel * _COARSE * cells / 2
    axes = [torch.from_numpy(origin[k] + voxel * np.arange(_COARSE * cells[k] + 1)).float() for k in range(3)]

    every_second = torch.cartesian_prod(*[axis[::2] for axis in axes])
    beside = sum((view.sample(every_second)[0] < 0.5).int() for view in views)
    inside = (beside < _AGREEING).numpy().reshape([len(axis[::2]) for axis in axes])
    hull = Hull.of(inside, origin, 2 * voxel)

    def field_at(nodes: Tensor) -> np.ndarray:
        found = []
        for some in nodes.split(_AT_ONCE):
            points = torch.stack([axis[i] for axis, i in zip(axes, some.unbind(-1), strict=True)], -1)
            found.append(_field(views, points, voxel, extent, hull.outside(points)))
        return torch.cat(found).numpy()

    coarse_nodes = torch.cartesian_prod(*[torch.arange(0, len(axis), _COARSE) for axis in axes])
    coarse = field_at(coarse_nodes).reshape(cells + 1)
    near = np.zeros([len(axis) for axis in axes], bool)
    for view in views:
        nodes = np.round((view.surface(0.1).numpy() - origin) / voxel).astype(int)
        near[tuple(nodes[((nodes >= 0) & (nodes < near.shape)).all(1)].T)] = True
    near = ndimage.binary_dilation(near, iterations=3)
    near |= _upsampled(ndimage.maximum_filter(coarse, 3) * ndimage.minimum_filter(coarse, 3) <= 0)
    field = _upsampled(coarse)
    field[near] = field_at(torch.from_numpy(np.argwhere(near)))
    for axis in range(3):
        np.moveaxis(field, axis, 0)[[0, -1]] = 1.0
    if field.min() >= 0:
        return None
    # A node on the surface would make faces without area.
    field[np.abs(field) < 1e-3] = 1e-3
    vertices, faces, _, _ = marching_cubes(field, 0.0)
    return origin + voxel * vertices, faces


def _upsampled(values: np.ndarray) -> np.ndarray:
    """Values at coarse nodes [I, J, K] for all nodes: each takes that of the nearest coarse one."""
    for axis, size in enumerate(values.shape):
        values = values.take((np.arange((size - 1) * _COARSE + 1) + _COARSE // 2) // _COARSE, axis)
    return values


def _field(views: list[DepthView], points: Tensor, voxel: float, extent: Extent | None, outside: Outside) -> Tensor:
    """Truncated signed distance [N] at `points` [N, 3], positive where empty: what _AGREEING views at least find, and a
    _SHARE of those that see hardly past a point.

    The mean over views, the common choice, makes two-sided sheets as thick as the truncation, or loses them. Views find
    nothing within the part's `extent` where others hid it from them in all states, or they are blind; None, where
    neither could be.
    """
    within = torch.zeros(0, dtype=torch.long) if extent is None else extent.holds(points).nonzero()[:, 0]
    outer = outside.nearness.nonzero()[:, 0]
    outside = Outside(outside.nearness[outer], outside.direction[outer])
    found, hardly = torch.empty(len(views), len(points)), torch.zeros(len(points))
    for k, view in enumerate(views):
        accumulation, past, nearer = view.sample(points)
        past[outer] -= nearer[outer] * outside.share(view.towards(points[outer]))
        past /= voxel
        value = torch.maximum(((past - _THICKEN) / _BAND).clamp(-1, 1), 1 - 2 * accumulation)
        by_little = (accumulation > 0.5) & (past > 0) & (past < _HARDLY)
        hidden = within[view.hidden(points[within], voxel)]
        value[hidden], by_little[hidden] = -1.0, False
        found[k] = value
        hardly += by_little
    takes = (_SHARE * hardly).ceil().clamp_min(_AGREEING).long()
    ordered = torch.from_numpy(np.sort(np.ascontiguousarray(found.T.numpy()), axis=1))  # 10 times as fast as torch's
    return ordered.gather(1, len(views) - takes[:, None])[:, 0]


def _without_floaters(vertices: np.ndarray, faces: np.ndarray) -> manifold3d.Manifold:
    """The large components of the solid, with the cavities filled that nothing leads into."""
    solid = manifold3d.Manifold(manifold3d.Mesh(vertices.astype(np.float32), faces.astype(np.uint32)))
    pieces = [piece for piece in solid.decompose() if piece.volume() > 0]
    largest = max(piece.surface_area() for piece in pieces)
    return manifold3d.Manifold.compose([p for p in pieces if p.surface_area() >= _MIN_COMPONENT * largest])


def _simplified(solid: manifold3d.Manifold, triangles: int, voxel: float) -> manifold3d.Manifold | None:
    """The solid with no more than so many triangles, moved by no more than two voxels; None where that cannot be."""
    tolerance = 0.1 * voxel
    while tolerance <= 2 * voxel:
        simple = solid.simplify(tolerance)
        if simple.num_tri() <= triangles:
            return simple
        tolerance *= 1.5
    return None


def _thinned(solid: manifold3d.Manifold, depth: float) -> trimesh.Trimesh:
    """The solid's mesh with its surface moved inwards; as it is where all of it is sheets, which would turn over."""
    data = solid.to_mesh()
    mesh = trimesh.Trimesh(data.vert_properties[:, :3].astype(np.float64), data.tri_verts, process=False)
    thin = mesh.copy()
    thin.vertices -= depth * mesh.vertex_normals
    return thin if thin.volume > 0.5 * mesh.volume else mesh


def _looked_at(views: list[DepthView], towards: Tensor, mesh: trimesh.Trimesh, band: float) -> np.ndarray:
    """Which faces [N] some camera saw, of cameras in the directions `towards` [M, 3] from the centre."""
    cosines, nearest = (torch.stack([view.direction for view in views]) @ towards.mT).max(-1)
    points, normals = (torch.from_numpy(np.array(x)).float() for x in (mesh.triangles_center, mesh.face_normals))
    seen = torch.zeros(len(points), dtype=torch.bool)
    for view, cosine, side in zip(views, cosines, towards[nearest].float(), strict=True):
        if cosine > _SAME_SIDE:
            seen |= view.shows(points, band) & (normals @ side > _GRAZING)
    return seen.numpy()


def _vertex_colours(views: list[DepthView], points: Tensor, band: float) -> tuple[np.ndarray, np.ndarray]:
    """Colours [N, 4] uint8 that the views see within `band` of points [N, 3], and whether any view sees them [N]."""
    total = torch.zeros(len(points), 4)
    for view in views:
        shown = view.shows(points, band)[:, None]
        total += shown * torch.cat([view.colours(points), view.sample(points)[0][:, None]], -1)
    seen = total[:, 3] > 0
    # What nobody saw takes the mean colour.
    rgb = torch.where(
        seen[:, None], total[:, :3] / total[:, 3:].clamp_min(1e-6), total[:, :3].sum(0) / total[:, 3].sum()
    )
    return _bytes(rgb), seen.numpy()


def _bytes(rgb: Tensor) -> np.ndarray:
    """RGBA [N, 4] uint8, opaque, of colours in 0..1 [N, 3]."""
    return (255 * F.pad(rgb, (0, 1), value=1.0)).round().clamp(0, 255).to(torch.uint8).numpy()
