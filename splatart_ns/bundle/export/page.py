"""The object as one HTML file that needs no server and no network: the splat, posable, with a slider for each freedom.

What the page does is in the files of the folder `web`, which are put into it as they are. Gaussians are packed into 18
bytes each and 3 for each coefficient of spherical harmonics, 30 at degree 1; pictures then differ from those of our own
rasterizer by a PSNR of 52 to 64 dB (benchmarks/page.py), and by 34 dB without the harmonics. The page's policy
(Content-Security-Policy) lets it run its own scripts alone, and load nothing.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
import re
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from splatart_ns.bundle.animation import bundle_colours
from splatart_ns.bundle.bundle import Bundle, Joint, Part
from splatart_ns.bundle.camera import ELEVATION, FIELD_OF_VIEW, bounding_sphere, front_azimuth
from splatart_ns.bundle.configurations import movable_joints
from splatart_ns.bundle.export.quantization import quantized
from splatart_ns.bundle.joint_axis import (
    axis_deviation,
    axis_line,
    direction_deviation,
    place_deviation,
    value_deviations,
)
from splatart_ns.bundle.sliders import bundle_sliders, freedoms, unit_name

FORMAT = "splatart-page-1"
_SCRIPTS = (
    *("elements.js", "motion.js", "gaussians.js", "sorter.js", "renderer.js", "camera.js", "axes.js", "sweep.js"),
    *("panel.js", "table.js", "pace.js", "page.js"),
)
"""In the order in which they need each other; the last starts the page."""
_SMALLEST = math.log(1e-4)
"""Logarithm of the least standard deviation in radii of the object: less is a point on any screen."""
_SECTIONS = 12
"""Of a drawn axis."""


def write_page(bundle: Bundle, name: str, folder: Path) -> Path:
    """Write `<name>.html`, in the bundle's unit of length."""
    path = folder / f"{name}.html"
    path.write_text(_page(name, page_object(bundle), bundle.provenance.get("version")), encoding="utf-8")
    return path


def page_object(bundle: Bundle) -> dict[str, Any]:
    """All that the page knows of the object, as JSON has it: parts with packed Gaussians, joints, sliders, first view.

    Joints of the tree come first, parents before children, and name parts by their place in the list. A slider has its
    ends in its `unit`, and `units` is what a value of the bundle is multiplied by.
    """
    moves = movable_joints(bundle)
    ends = [{name: joint.values[state] for name, joint in moves.items()} for state in range(len(bundle.states))]
    centre, radius = bounding_sphere(bundle, [{}, *ends])
    joints = [*bundle.tree_joints, *(joint for joint in bundle.joints if not joint.in_tree)]
    places = {joint.name: i for i, joint in enumerate(joints)}
    colours = bundle_colours(bundle).tolist()
    return {
        "format": FORMAT,
        "parts": [_part(part, colour, radius) for part, colour in zip(bundle.parts, colours, strict=True)],
        "joints": [_joint(joint, bundle, radius) for joint in joints],
        "sliders": [
            {
                "joint": places[slider.joint],
                "freedom": slider.freedom,
                "name": slider.label.removesuffix(f" ({slider.unit})"),
                "unit": slider.unit,
                "units": slider.units,
                "low": slider.low,
                "high": slider.high,
                "step": slider.step,
                "ends": list(slider.ends),
                "note": slider.note,
            }
            for slider in bundle_sliders(bundle)
        ],
        "view": {
            "centre": centre.tolist(),
            "radius": radius,
            "azimuth": front_azimuth(bundle),
            "elevation": ELEVATION,
            "field_of_view": FIELD_OF_VIEW,
        },
    }


def _part(part: Part, colour: list[float], radius: float) -> dict[str, Any]:
    splat = part.splat.detach().to("cpu")
    quats = splat.quats / splat.quats.norm(dim=-1, keepdim=True)
    return {
        "name": part.name,
        "colour": colour,
        "count": len(splat),
        "coefficients": splat.sh.shape[1],
        "columns": {
            "means": quantized(splat.means.numpy(), 16),
            "quats": quantized(quats.numpy(), 16),
            "log_scales": quantized(splat.log_scales.numpy().clip(min=_SMALLEST + math.log(radius)), 8),
            "opacities": quantized(splat.opacities.numpy()[:, None], 8),
            "sh": quantized(splat.sh.numpy().reshape(len(splat), 3 * splat.sh.shape[1]), 8),
        },
    }


def _joint(joint: Joint, bundle: Bundle, radius: float) -> dict[str, Any]:
    return {
        "name": joint.name,
        "type": joint.type,
        "parent": bundle.part_names.index(joint.parent),
        "child": bundle.part_names.index(joint.child),
        "in_tree": joint.in_tree,
        "axis": joint.axis.tolist(),
        "origin": joint.origin.tolist(),
        "pitch": joint.pitch,
        "values": joint.values.reshape(len(joint.values), -1).tolist(),
        "limits": joint.limits,
        "freedoms": [
            {"name": suffix.strip(), "unit": unit_name(turns, bundle.length_unit)}
            for suffix, turns in freedoms(joint.type)
        ],
        "deviations": {
            "direction": direction_deviation(joint),
            "place": place_deviation(joint),
            "values": value_deviations(joint),
        },
        "length_unit": unit_name(False, bundle.length_unit),
        "ambiguous": joint.ambiguous,
        "other_parents": [bundle.part_names.index(name) for name in joint.other_parents],
        "line": _line(joint, bundle.part(joint.child).splat.means.double().numpy(), radius),
    }


def _line(joint: Joint, points: np.ndarray, radius: float) -> dict[str, Any] | None:
    """Where the axis is drawn, as points and the standard deviation at each; one point for a ball."""
    if joint.type == "spherical":
        return {"points": [joint.origin.tolist()], "deviations": axis_deviation(joint, np.zeros(1)).tolist()}
    line = axis_line(joint, points, radius)
    if line is None:
        return None
    along = np.linspace(line.low, line.high, _SECTIONS)
    return {"points": line.points(along).tolist(), "deviations": axis_deviation(joint, along).tolist()}


def _page(title: str, about: dict[str, Any], version: Any) -> str:
    """The template filled in one pass, so that what is put in is never looked at again."""
    files = resources.files("splatart_ns.bundle.export") / "web"
    style = (files / "page.css").read_text(encoding="utf-8")
    scripts = [(files / name).read_text(encoding="utf-8") for name in _SCRIPTS]
    texts = {
        "title": html.escape(title),
        "version": html.escape(str(version or "")),
        "style": style,
        "style hash": _hash(style),
        "script hashes": " ".join(_hash(script) for script in scripts),
        "vertex shader": (files / "splat.vert").read_text(encoding="utf-8"),
        "fragment shader": (files / "splat.frag").read_text(encoding="utf-8"),
        "object": _script_json(about),
        "scripts": "\n".join(f"<script>{script}</script>" for script in scripts),
    }
    template = (files / "page.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{([a-z ]+)\}\}", lambda place: texts[place[1]], template)


def _script_json(value: Any) -> str:
    """JSON in which no name can end the element that it stands in."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    """A source of a Content-Security-Policy that stands for this very text."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
