"""A bundle's parts and joints in words."""

from __future__ import annotations

import math

from splatart_ns.bundle.bundle import Bundle, Joint
from splatart_ns.bundle.joint_axis import direction_deviation
from splatart_ns.bundle.sliders import bundle_sliders

_UNKNOWN = 1.0
"""Standard deviation of an axis, radians, from which on it says nothing: lines of any direction are as far apart."""


def part_depths(bundle: Bundle) -> list[tuple[str, int]]:
    """All parts, each followed by those that hang on it, with the number of joints between it and the root."""
    children: dict[str, list[str]] = {}
    for joint in bundle.tree_joints:
        children.setdefault(joint.parent, []).append(joint.child)
    found, left = [], [(bundle.root, 0)]
    while left:
        name, depth = left.pop()
        found.append((name, depth))
        left += [(child, depth + 1) for child in reversed(children.get(name, []))]
    hung = {name for name, _ in found}
    return found + [(name, 0) for name in bundle.part_names if name not in hung]


def describe_joint(joint: Joint) -> str:
    """Type, parent, and how certain they and the axis are."""
    text = " or ".join([f"{joint.type} on {joint.parent}", *joint.other_parents])
    if joint.ambiguous:
        text += ", ambiguous"
    deviation = direction_deviation(joint)
    if deviation is None:
        return text
    return f"{text}, axis " + (f"± {math.degrees(deviation):.2g} degree" if deviation < _UNKNOWN else "unknown")


def describe_part(bundle: Bundle, name: str) -> str:
    """The joint that moves a part, or that there is none."""
    joint = next((joint for joint in bundle.tree_joints if joint.child == name), None)
    if joint is not None:
        return describe_joint(joint)
    return "the root" if name == bundle.root else "hangs on nothing"


def describe(bundle: Bundle) -> list[str]:
    """A line a part, indented under what it hangs on, with its joint and range; then the joints that close loops."""
    ranges: dict[str, list[str]] = {}
    for slider in bundle_sliders(bundle):
        ranges.setdefault(slider.joint, []).append(slider.note)
    joints = {joint.child: joint.name for joint in bundle.tree_joints}
    lines = [
        f"{'  ' * depth}{name}: {'; '.join([describe_part(bundle, name), *ranges.get(joints.get(name, ''), [])])}"
        for name, depth in part_depths(bundle)
    ]
    loops = [joint for joint in bundle.joints if not joint.in_tree]
    return lines + [f"{joint.child}: {describe_joint(joint)}; closes a loop" for joint in loops]
