import math

import pytest
import viser
from viewer_client import free_port

from splatart_ns.viewer.panel import Panel, tree_text


@pytest.fixture
def panel(bundle):
    server = viser.ViserServer("127.0.0.1", free_port(), verbose=False)
    yield Panel(server, bundle)
    server.stop()


def test_sliders_are_degrees_and_lengths_and_configurations_are_not(panel):
    hinge, runner = panel.sliders
    assert panel.q == {"hinge": 0.0, "runner": 0.0}
    hinge.value, runner.value = -45.0, 0.25
    assert panel.q == pytest.approx({"hinge": -math.pi / 4, "runner": 0.25})


def test_a_configuration_moves_the_sliders_as_far_as_they_go(panel):
    panel.q = {"hinge": -math.pi / 6, "runner": 100.0}
    assert panel.sliders[0].value == -30
    assert 0.6 <= panel.sliders[1].value < 0.61
    panel.q = {}
    assert panel.q == {"hinge": 0.0, "runner": 0.0}


def test_switched_off_parts_are_hidden(panel):
    assert panel.hidden == set()
    panel.parts["lid"].value = False
    assert panel.hidden == {"lid"}


def test_the_tree_is_indented_and_fits_the_panel(bundle):
    bundle.joints[1].parent = "lid"
    assert tree_text(bundle) == "base\n└ lid\n └ drawer"
    bundle.parts[2].name = bundle.joints[1].child = 100 * "x"
    assert tree_text(bundle).splitlines()[2] == " └ " + 32 * "x" + "…"


def test_a_name_cannot_become_code_of_the_page(bundle):
    bundle.root = bundle.parts[0].name = bundle.joints[0].parent = bundle.joints[1].parent = (
        "a\n```\n{alert(1)}<b>![](x)"
    )
    text = tree_text(bundle)
    assert text.count("\n") == 2 and not set("`{}<>![]()") & set(text.splitlines()[0])


def test_the_selected_part_is_told_with_its_joint(panel):
    assert panel.selected is None and "Click" in panel._selection.content
    panel.selected = "lid"
    assert panel._selection.content.startswith("**lid**: revolute on base, axis ± ")
    panel.selected = "base"
    assert panel._selection.content == "**base**: the root"
    panel.selected = None
    assert "Click" in panel._selection.content
