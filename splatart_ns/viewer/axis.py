"""What joints look like: meshes along their axes, thicker where an axis is less certain."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import trimesh
import viser
from torch import Tensor

from splatart_ns.bundle.animation import bundle_colours
from splatart_ns.bundle.bundle import Bundle, Joint
from splatart_ns.bundle.joint_axis import axis_deviation, axis_line
from splatart_ns.capture.capture import Normalization
from splatart_ns.geometry.se3 import quat_from_matrix

_RADIUS = 0.008
"""Of the rod, in radii of the object."""
_SECTIONS = 24
_OPACITY = 0.6


def joint_mesh(joint: Joint, points: np.ndarray, radius: float) -> trimesh.Trimesh | None:
    """An arrow along the axis, or a ball at a spherical joint's centre, in the canonical frame; None for other types.

    The arrow shows the positive direction, passes the child's `points` [N, 3], and is two standard deviations of where
    the axis lies wider than a thin rod. `radius` is the object's, length.
    """
    if joint.type == "spherical":
        ball = trimesh.creation.icosphere(subdivisions=3, radius=3 * _RADIUS * radius)
        return ball.apply_translation(joint.origin.numpy())
    line = axis_line(joint, points, radius)
    if line is None:
        return None
    along = np.linspace(line.low, line.high, _SECTIONS)
    around = _RADIUS * radius + 2 * axis_deviation(joint, along)
    tip = 4 * _RADIUS * radius
    profile = [
        (0.0, line.low),
        *zip(around, along, strict=True),
        (around[-1] + tip / 2, line.high),
        (0.0, line.high + 2 * tip),
    ]
    arrow = trimesh.creation.revolve(np.array(profile), sections=16)
    arrow.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], line.axis))
    return arrow.apply_translation(line.origin)


class Axes:
    """The joints of a bundle in a viser scene; the browser draws them, over the image of the parts."""

    def __init__(self, server: viser.ViserServer, bundle: Bundle, normalization: Normalization):
        colours = dict(zip(bundle.part_names, bundle_colours(bundle).tolist(), strict=True))
        scale = normalization.scale
        self._nodes: list[tuple[str, viser.MeshHandle]] = []
        """The part that carries the joint, and the joint's node."""
        for index, joint in enumerate(bundle.tree_joints):
            mesh = joint_mesh(joint, bundle.part(joint.child).splat.means.double().numpy(), 1 / scale)
            if mesh is not None:
                vertices, colour = scale * (mesh.vertices - normalization.centre), tuple(colours[joint.child])
                node = server.scene.add_mesh_simple(f"/joints/{index}", vertices, mesh.faces, colour, opacity=_OPACITY)
                self._nodes.append((joint.parent, node))

    def move(self, motions: Mapping[str, Tensor]) -> None:
        """Put the joints where the parts that carry them are; T[part] [4, 4] of the normalised world."""
        for part, node in self._nodes:
            T = motions[part]
            node.wxyz, node.position = quat_from_matrix(T[:3, :3]).numpy(), T[:3, 3].numpy()

    def show(self, visible: bool) -> None:
        for _, node in self._nodes:
            node.visible = visible
