"""The controls beside the scene."""

from __future__ import annotations

import re

import viser

from splatart_ns.bundle.bundle import Bundle
from splatart_ns.bundle.configurations import Configuration
from splatart_ns.bundle.description import describe_joint, describe_part, part_depths
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
        self._told = {name: describe_part(bundle, name) for name in bundle.part_names}
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


def tree_text(bundle: Bundle) -> str:
    """A line a part, indented under what it hangs on. Nothing in a name can end a block of code."""
    lines = [max(depth - 1, 0) * " " + ("└ " if depth else "") + _plain(name) for name, depth in part_depths(bundle)]
    # A longer line would make the panel wider than the browser shows it.
    return "\n".join(line if len(line) <= _LINE else line[: _LINE - 1] + "…" for line in lines)


def _plain(text: str) -> str:
    """Without what has a meaning in Markdown or HTML, but for underscores, which have none within words."""
    return re.sub(r"[^\w .,:+±-]", "?", text)


def _breakable(label: str) -> str:
    """With places to break the line, of which a long name has none that browsers know."""
    return re.sub(r"([_.:-])", "\\1\u200b", label)
