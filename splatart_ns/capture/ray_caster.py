"""Images of surfaces by ray casting: colour, coverage, part ids and depth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from splatart_ns.capture.capture import Camera
from splatart_ns.capture.images import undistorted_points
from splatart_ns.capture.light import Light
from splatart_ns.capture.surface import Surface, join
from splatart_ns.errors import InputError

if TYPE_CHECKING:
    from embreex.rtcore_scene import EmbreeScene


@dataclass(frozen=True)
class Rendering:
    """What one camera sees."""

    rgba: np.ndarray
    """[H, W, 4] uint8, straight alpha; white where nothing is."""
    part_ids: np.ndarray
    """[H, W] uint8: what the ray through the pixel's centre meets, 0 where nothing."""
    depth: np.ndarray
    """[H, W] float32: distance along the optical axis at the pixel's centre, 0 where nothing is."""

    @property
    def silhouette(self) -> np.ndarray:
        """[H, W] bool."""
        return self.part_ids > 0


def embree_scene(triangles: np.ndarray) -> EmbreeScene:
    """Triangles [G, 3, 3] as what rays meet, in float32.

    Raises:
        InputError: embreex is not installed.
    """
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise InputError("Ray casting needs embreex; install it with `pip install embreex`.") from error
    scene = EmbreeScene()
    TriangleMesh(scene, triangles.astype(np.float32))
    return scene


class RayCaster:
    """Parts at rest in one configuration.

    Args:
        parts: part id (1..254) to its surface in the world.

    Raises:
        InputError: embreex is not installed.
    """

    def __init__(self, parts: Mapping[int, Surface]) -> None:
        self._surface = join(list(parts.values()))
        self._part = np.repeat(np.array(list(parts), dtype=np.uint8), [len(s.sides) for s in parts.values()])
        triangles = self._surface.triangles
        low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        # Rays are float32: about the object's centre they lose least.
        self._centre, self._size = 0.5 * (low + high), float(np.linalg.norm(high - low))
        self._scene = embree_scene(triangles - self._centre)
        self._atlas = _Atlas(self._surface)

    def render(self, camera: Camera, T_world_camera: np.ndarray, light: Light, samples: int = 2) -> Rendering:
        """One image.

        Args:
            camera: pinhole, with or without distortion.
            T_world_camera: [4, 4], OpenGL axes.
            light: what lights the scene.
            samples: rays per pixel along each side; coverage and colour are their mean.
        """
        grid = (np.arange(samples) + 0.5) / samples
        colour, _, _ = self._trace(camera, T_world_camera, grid, light)
        _, part, depth = self._trace(camera, T_world_camera, np.array([0.5]), None)

        h, w = camera.height, camera.width
        colour = colour.reshape(h, samples, w, samples, 4).transpose(0, 2, 1, 3, 4).reshape(h, w, -1, 4)
        alpha = colour[..., 3].mean(axis=-1)
        rgb = colour[..., :3].sum(axis=2) / np.maximum(colour[..., 3].sum(axis=2), 1.0)[..., None]
        rgb = np.where(alpha[..., None] > 0.0, rgb, 1.0)
        rgba = np.round(255.0 * np.concatenate([rgb, alpha[..., None]], axis=-1)).astype(np.uint8)
        return Rendering(rgba, part.reshape(h, w), depth.reshape(h, w))

    def _trace(
        self, camera: Camera, T_world_camera: np.ndarray, offsets: np.ndarray, light: Light | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colour [N, 4] (premultiplied; zeros without light), part id [N], depth [N] of the rays at these offsets."""
        u, v = ((np.arange(size)[:, None] + offsets).ravel() for size in (camera.width, camera.height))
        x, y = undistorted_points(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2), camera).T
        # OpenGL cameras look along -z and have y up.
        local = np.stack([x, -y, np.full_like(x, -1.0)], axis=-1)
        directions = local @ T_world_camera[:3, :3].T
        lengths = np.linalg.norm(directions, axis=-1, keepdims=True)
        directions /= lengths
        origin = T_world_camera[:3, 3] - self._centre
        hits = self._scene.run(
            np.broadcast_to(origin, directions.shape).astype(np.float32), directions.astype(np.float32), output=True
        )
        ray = np.flatnonzero(hits["primID"] >= 0)
        triangle, distance = hits["primID"][ray], hits["tfar"][ray].astype(np.float64)

        part = np.zeros(len(directions), dtype=np.uint8)
        part[ray] = self._part[triangle]
        depth = np.zeros(len(directions), dtype=np.float32)
        depth[ray] = distance / lengths[ray, 0]
        colour = np.zeros((len(directions), 4), dtype=np.float32)
        if light is not None and len(ray) > 0:
            footprint = distance / (camera.fx * len(offsets))
            points = origin + distance[:, None] * directions[ray]
            colour[ray, :3] = self._shade(triangle, points, directions[ray], footprint, light)
            colour[ray, 3] = 1.0
        return colour, part, depth

    def _shade(
        self, triangle: np.ndarray, points: np.ndarray, directions: np.ndarray, footprint: np.ndarray, light: Light
    ) -> np.ndarray:
        """Colours [N, 3] of points on triangles, seen along directions; `footprint` is the width of a ray there."""
        surface = self._surface
        corners = surface.corners[surface.sides[triangle, 0]] - self._centre
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat /= np.linalg.norm(flat, axis=-1, keepdims=True)
        behind = np.einsum("nk,nk->n", flat, directions) > 0.0
        flat = np.where(behind[:, None], -flat, flat)

        face = surface.sides[triangle, behind.astype(int)]
        weights = _barycentric(points, surface.corners[face] - self._centre)[..., None]
        albedo = (surface.colours[face] * weights).sum(axis=1)
        albedo = albedo * self._atlas.look_up(face, (surface.uv[face] * weights).sum(axis=1), footprint)

        normals = (surface.normals[face] * weights).sum(axis=1)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        normals = np.where(np.einsum("nk,nk->n", normals, flat)[:, None] < 0.0, -normals, normals)

        sun = np.asarray(light.direction) / np.linalg.norm(light.direction)
        lit = np.maximum(normals @ sun, 0.0) * (flat @ sun > 0.0)
        if light.shadows:
            facing = np.flatnonzero(lit > 0.0)
            start = (points[facing] + 1e-4 * self._size * flat[facing]).astype(np.float32)
            towards = np.broadcast_to(sun, start.shape).astype(np.float32)
            lit[facing[self._scene.run(start, towards, query="OCCLUDED") >= 0]] = 0.0
        # The ground below gives less light than the sky above.
        sky = 0.9 + 0.1 * normals[:, 2]
        return np.clip(albedo * (light.ambient * sky + (1.0 - light.ambient) * lit)[:, None], 0.0, 1.0)


class _Atlas:
    """The textures of a surface, each with its halvings (mipmaps), in one array of texels."""

    def __init__(self, surface: Surface) -> None:
        levels, texels, used = [], [], 0
        deepest = max(max(t.shape[:2]).bit_length() for t in surface.textures)
        for image in surface.textures:
            level, row = image.astype(np.float32) / 255.0, []
            for _ in range(deepest):
                row.append((used, level.shape[1], level.shape[0]))
                texels.append(level.reshape(-1, 3))
                used += level.shape[0] * level.shape[1]
                level = _halved(level)
            levels.append(row)
        self._texels = np.concatenate(texels)
        self._levels = np.array(levels)
        """[textures, levels, 3]: first texel, width, height."""
        self._texture = surface.texture

        # Texels per length on a face, to choose the level at which a ray is about a texel wide.
        size = self._levels[self._texture, 0, 1:]
        area = _doubled_area(surface.corners)
        with np.errstate(divide="ignore", invalid="ignore"):
            density = np.sqrt(_doubled_area(surface.uv * size[:, None]) / area)
        self._density = np.where(np.isfinite(density), density, 0.0)

    def look_up(self, face: np.ndarray, uv: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """Colours [N, 3] at texture coordinates [N, 2], bilinear, repeated beyond 0..1."""
        texture = self._texture[face]
        level = np.log2(np.maximum(self._density[face] * footprint, 1.0)).round().astype(int)
        first, width, height = self._levels[texture, np.minimum(level, self._levels.shape[1] - 1)].T
        x = uv[:, 0] % 1.0 * width - 0.5
        y = (1.0 - uv[:, 1]) % 1.0 * height - 0.5
        x0, y0 = np.floor(x), np.floor(y)
        fx, fy = (x - x0)[:, None], (y - y0)[:, None]
        x0, y0 = x0.astype(int), y0.astype(int)

        def texel(i: np.ndarray, j: np.ndarray) -> np.ndarray:
            return self._texels[first + (j % height) * width + i % width]

        top = (1.0 - fx) * texel(x0, y0) + fx * texel(x0 + 1, y0)
        bottom = (1.0 - fx) * texel(x0, y0 + 1) + fx * texel(x0 + 1, y0 + 1)
        return (1.0 - fy) * top + fy * bottom


def _halved(image: np.ndarray) -> np.ndarray:
    """The image [H, W, 3] at half its size, not below one texel; an odd last row or column is dropped."""
    if image.shape[0] > 1:
        image = 0.5 * (image[0:-1:2] + image[1::2])
    if image.shape[1] > 1:
        image = 0.5 * (image[:, 0:-1:2] + image[:, 1::2])
    return image


def _doubled_area(triangles: np.ndarray) -> np.ndarray:
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    if triangles.shape[-1] == 2:
        return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return np.linalg.norm(np.cross(a, b), axis=-1)


def _barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Weights [N, 3] of points [N, 3] in their triangles [N, 3, 3], clipped to the inside."""
    a, b, p = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    normal = np.cross(a, b)
    scale = np.maximum(np.einsum("nk,nk->n", normal, normal), 1e-300)
    s = np.einsum("nk,nk->n", np.cross(p, b), normal) / scale
    t = np.einsum("nk,nk->n", np.cross(a, p), normal) / scale
    weights = np.clip(np.stack([1.0 - s - t, s, t], axis=-1), 0.0, 1.0)
    return weights / weights.sum(axis=-1, keepdims=True)
