"""The controls beside the scene."""

from __future__ import annotations

import math
import re

import viser

from splatart_ns.bundle.bundle import Bundle, Joint
from splatart_ns.bundle.configurations import Configuration
from splatart_ns.bundle.joint_axis import direction_deviation
from splatart_ns.bundle.sliders import bundle_sliders, configuration, positions

_LINE = 36
"""Characters of a line of the tree, at most."""
_HOW_TO_SELECT = "Click at a part to select it."


class Panel:
    """Sliders for the joints, switches for the parts, and buttons; what they do is attached by who owns the panel."""

    def __init__(self, server: viser.ViserServer, bundle: Bundle):
        gui = server.gui
        # It keeps its share button, without which viser 0.2.7 shows an empty page.
        gui.configure_theme(control_layout="collapsible", show_logo=False)
        joints = {joint.child: joint for joint in bundle.tree_joints}
        hints = {joint.name: describe_joint(joint) for joint in bundle.tree_joints}
        self._freedoms = bundle_sliders(bundle)
        self.sliders: list[viser.GuiInputHandle[float]] = []
        with gui.add_folder("Joints"):
            for freedom in self._freedoms:
                hint = f"{hints[freedom.joint]}; {freedom.note}"
                marks = tuple((x, f"{x:.3g}") for x in sorted(set(freedom.ends)))
                ends = (freedom.low, freedom.high, freedom.step)
                label = _breakable(freedom.label)
                self.sliders.append(gui.add_slider(label, *ends, initial_value=0.0, marks=marks, hint=hint))
            self.reset = gui.add_button("Reset", hint="All joints as in state 0")
            self.sweep = gui.add_checkbox("Sweep", False, hint="One joint after the other over its range")
        self.parts: dict[str, viser.GuiInputHandle[bool]] = {}
        self._told = {name: "hangs on nothing" for name in bundle.part_names} | {bundle.root: "the root"}
        self._told |= {name: describe_joint(joint) for name, joint in joints.items()}
        self._selected: str | None = None
        with gui.add_folder("Parts"):
            gui.add_markdown(f"```\n{tree_text(bundle)}\n```")
            self._selection = gui.add_markdown(_HOW_TO_SELECT)
            for name, _ in part_depths(bundle):
                self.parts[name] = gui.add_checkbox(_breakable(name), True, hint=self._told[name])
        with gui.add_folder("Show"):
            self.by_part = gui.add_checkbox("Part colours", False)
            self.axes = gui.add_checkbox("Joint axes", True, hint="Thicker by two standard deviations")
        with gui.add_folder("Save"):
            self.save_configuration = gui.add_button(
                "Configuration (JSON)", hint="Joint names and values, radians and lengths"
            )
            self.save_picture = gui.add_button("Picture (PNG)")

    @property
    def q(self) -> Configuration:
        """What the sliders say; setting it moves them."""
        return configuration(self._freedoms, [slider.value for slider in self.sliders])

    @q.setter
    def q(self, q: Configuration) -> None:
        for slider, freedom, position in zip(self.sliders, self._freedoms, positions(self._freedoms, q), strict=True):
            position = round(min(max(position, freedom.low), freedom.high), 9)  # 30, and not 29.999999999999996
            if abs(position - slider.value) > 1e-3 * freedom.step:
                slider.value = position

    @property
    def selected(self) -> str | None:
        """The part that stands out, whose joint is told; None for none."""
        return self._selected

    @selected.setter
    def selected(self, name: str | None) -> None:
        self._selected = name
        text = _HOW_TO_SELECT if name is None else f"**{_plain(name)}**: {_plain(self._told[name])}"
        self._selection.content = text

    @property
    def hidden(self) -> set[str]:
        """Names of the parts that are switched off."""
        return {name for name, switch in self.parts.items() if not switch.value}


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


def tree_text(bundle: Bundle) -> str:
    """A line a part, indented under what it hangs on. Nothing in a name can end a block of code."""
    lines = [max(depth - 1, 0) * " " + ("└ " if depth else "") + _plain(name) for name, depth in part_depths(bundle)]
    # A longer line would make the panel wider than the browser shows it.
    return "\n".join(line if len(line) <= _LINE else line[: _LINE - 1] + "…" for line in lines)


def describe_joint(joint: Joint) -> str:
    """Type, parent, and how certain they and the axis are."""
    text = " or ".join([f"{joint.type} on {joint.parent}", *joint.other_parents])
    if joint.ambiguous:
        text += ", ambiguous"
    deviation = direction_deviation(joint)
    return text if deviation is None else f"{text}, axis ± {math.degrees(deviation):.2g} degree"


def _plain(text: str) -> str:
    """Without what has a meaning in Markdown or HTML, but for underscores, which have none within words."""
    return re.sub(r"[^\w .,:+±-]", "?", text)


def _breakable(label: str) -> str:
    """With places to break the line, of which a long name has none that browsers know."""
    return re.sub(r"([_.:-])", "\\1\u200b", label)
