"""The result as files that robot simulators, viewers and 3D programs open, checked by those programs."""

from splatart_ns.bundle.export.describe import DENSITY, LIMIT_MARGIN, check_numbers, describe
from splatart_ns.bundle.export.folder import check_folder
from splatart_ns.bundle.export.formats import WITHOUT_MESHES, export, format_notes, require
from splatart_ns.bundle.export.robot import Robot
from splatart_ns.bundle.export.shapes import PartShape, part_shapes
from splatart_ns.bundle.export.validation import Check, format_checks, validate
from splatart_ns.choices import Format

__all__ = [
    "DENSITY",
    "LIMIT_MARGIN",
    "WITHOUT_MESHES",
    "Check",
    "Format",
    "PartShape",
    "Robot",
    "check_folder",
    "check_numbers",
    "describe",
    "export",
    "format_checks",
    "format_notes",
    "part_shapes",
    "require",
    "validate",
]
