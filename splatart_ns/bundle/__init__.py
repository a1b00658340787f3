"""The result of a fit: on disk, in memory, and in any configuration."""

from splatart_ns.bundle.articulated_splat import ArticulatedSplat, Picture, load
from splatart_ns.bundle.bundle import JOINT_DOFS, Bundle, Joint, Part
from splatart_ns.bundle.camera import Camera, capture_camera, orbit_camera
from splatart_ns.bundle.configuration_fit import ConfigurationFit, fit_configuration
from splatart_ns.bundle.folder import load_bundle, save_bundle
from splatart_ns.bundle.posing import (
    configured_motions,
    joint_motion,
    moved_splat,
    normalized,
    observed_motions,
    observed_values,
    part_features,
    posed_splat,
)

__all__ = [
    "JOINT_DOFS",
    "ArticulatedSplat",
    "Bundle",
    "Camera",
    "ConfigurationFit",
    "Joint",
    "Part",
    "Picture",
    "capture_camera",
    "configured_motions",
    "fit_configuration",
    "joint_motion",
    "load",
    "load_bundle",
    "moved_splat",
    "normalized",
    "observed_motions",
    "observed_values",
    "orbit_camera",
    "part_features",
    "posed_splat",
    "save_bundle",
]
