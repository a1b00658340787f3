"""The page of `--format html`, without a browser."""

import json
import math
import re
import shutil
import subprocess
from dataclasses import replace
from importlib import resources

import numpy as np
import pytest
import torch

from splatart_ns.bundle import configured_motions
from splatart_ns.bundle.export import export, page, validate
from splatart_ns.bundle.export.page_model import PageModel
from splatart_ns.bundle.export.quantization import quantized, restored
from splatart_ns.bundle.sliders import bundle_sliders, configuration
from splatart_ns.rasterize.render import PIXEL_VARIANCE

NODE = shutil.which("node")
KINDS = ("revolute", "prismatic", "screw", "cylindrical", "spherical", "free", "fixed")
EVIL = '</script><img src=x onerror="alert(1)"><!--<script>{{scripts}}'


@pytest.fixture
def write(objects, tmp_path):
    def write(bundle):
        robot = objects.robot(bundle)
        return export(bundle, robot, "html", tmp_path / "out"), robot

    return write


def verdicts(checks):
    return {check.what: check.verdict for check in checks}


def test_a_page_is_one_file_that_loads_nothing(objects, write):
    path, _ = write(objects.chain(["revolute"]))
    assert {file.name for file in path.parent.iterdir()} == {"thing.html", "export.json"}
    text = path.read_text(encoding="utf-8")
    assert "default-src 'none'" in text and "{{" not in text
    assert re.findall(r"(?:src|href)\s*=\s*[\"'](?!data:)", text) == []
    assert "://" not in text and "fetch(" not in text and "import(" not in text


def test_its_gaussians_are_the_bundles_to_half_a_step(objects, write):
    bundle = objects.chain(["revolute", "prismatic"])
    g = torch.Generator().manual_seed(0)
    for part, coefficients in zip(bundle.parts, (1, 4, 16), strict=True):
        splat = part.splat
        splat.log_scales += torch.randn(6, 3, generator=g)
        splat.opacity_logits += torch.randn(6, generator=g)
        part.splat = replace(splat, sh=torch.randn(6, coefficients, 3, generator=g))
    bundle.parts[1].splat.quats[2] *= 1000  # the same turn
    model = PageModel(write(bundle)[0])
    for i, part in enumerate(bundle.parts):
        splat = part.splat
        wanted = {
            "means": (splat.means, 16),
            "quats": (torch.nn.functional.normalize(splat.quats), 16),
            "log_scales": (splat.log_scales, 8),
            "opacities": (splat.opacity_logits.sigmoid()[:, None], 8),
            "sh": (torch.cat(splat.sh.unbind(1), 1), 8),
        }
        assert set(model.object["parts"][i]["columns"]) == set(wanted)
        for name, (values, bits) in wanted.items():
            half_steps = np.ptp(values.numpy(), axis=0) / (2**bits - 1) / 2
            assert (np.abs(model.column(i, name) - values.numpy()) <= half_steps + 1e-6).all(), name


def test_its_joints_are_the_bundles(objects, write):
    bundle = objects.chain(list(KINDS))
    told = PageModel(write(bundle)[0]).object
    assert [part["name"] for part in told["parts"]] == bundle.part_names
    for i, (own, joint) in enumerate(zip(told["joints"], bundle.joints, strict=True)):
        assert (own["name"], own["type"], own["parent"], own["child"]) == (joint.name, joint.type, i, i + 1)
        assert (own["axis"], own["origin"]) == (joint.axis.tolist(), joint.origin.tolist())
        assert np.array_equal(np.squeeze(own["values"]), joint.values) and own["pitch"] == joint.pitch
        assert own["limits"] == (None if joint.limits is None else list(joint.limits))


@pytest.mark.skipif(NODE is None, reason="node is not installed")
def test_its_script_moves_parts_as_the_bundle_does(objects):
    bundle = objects.chain(list(KINDS))
    sliders, about = bundle_sliders(bundle), page.page_object(bundle)
    q = configuration(sliders, np.random.default_rng(0).uniform(-30, 30, len(sliders)))
    values = [np.ravel(q.get(joint["name"], 0.0)).tolist() for joint in about["joints"]]
    motion = (resources.files("splatart_ns.bundle.export") / "web/motion.js").read_text(encoding="utf-8")
    script = f"{motion}\nconsole.log(JSON.stringify(partMotions({json.dumps(about)}, {json.dumps(values)})))"
    told = json.loads(subprocess.run([NODE], input=script, capture_output=True, text=True, check=True).stdout)
    wanted = [T.numpy() for T in configured_motions(bundle, q).values()]
    np.testing.assert_allclose(np.reshape(told, (-1, 4, 4)), wanted, atol=1e-9)


def test_its_data_are_checked(objects, write):
    path, robot = write(objects.chain(list(KINDS)))

    def found(change=lambda bundle: None):
        bundle = objects.chain(list(KINDS))
        change(bundle)
        checked = verdicts(validate(path, "html", bundle, robot))
        return checked["Gaussians"], checked["part poses"]

    def lose(bundle):
        bundle.parts[2].splat = bundle.parts[2].splat.select(torch.arange(5))

    assert found() == ("passed", "passed")
    assert found(lambda bundle: bundle.parts[1].splat.means[3].add_(0.01)) == ("failed", "passed")
    assert found(lose) == ("failed", "passed")
    assert found(lambda bundle: bundle.joints[0].origin.add_(1e-3)) == ("passed", "failed")


def test_no_name_gets_out_of_the_data(objects, write):
    bundle = objects.chain(["revolute", "prismatic"])
    bundle.parts[1].name = bundle.joints[0].child = bundle.joints[1].parent = EVIL
    bundle.joints[0].name = EVIL + "\u2028"
    bundle.length_unit = EVIL
    bundle.provenance = {"version": EVIL}
    path, _ = write(bundle)
    text = path.read_text(encoding="utf-8")
    assert "<img" not in text and text.count("</script>") == len(page._SCRIPTS) + 3
    model = PageModel(path)
    assert model.part_names[1] == EVIL and model.object["joints"][0]["name"] == EVIL + "\u2028"


@pytest.mark.parametrize("bits", [8, 16])
def test_packed_numbers_are_off_by_half_a_step_at_most(bits):
    values = np.random.default_rng(0).normal(size=(200, 3)) * [1.0, 1e-3, 50.0]
    values[:, 1] = 7.0  # a column without a range
    column = quantized(values, bits)
    half_steps = np.ptp(values, axis=0) / (2**bits - 1) / 2
    assert (np.abs(restored(column) - values) <= half_steps * (1 + 1e-9)).all()
    assert restored(quantized(values[:0], bits)).shape == (0, 3)


def test_what_is_uncertain_or_undetermined_is_told(objects):
    bundle = objects.chain(["revolute", "prismatic"])
    joint = bundle.joints[0]
    joint.covariance = {
        "axis": (0.01**2 * np.eye(3)).tolist(),
        "values": np.diag([0, 4e-4, 1e-4]).tolist(),
        "origin": None,
    }
    joint.ambiguous = True
    joint.alternatives = [
        {"type": "fixed", "residual": 0.1, "score": 9.0},
        {"type": "revolute", "residual": 0.0, "score": 1.0, "parent": "p2"},
    ]
    about = page.page_object(bundle)["joints"][0]
    assert about["deviations"]["direction"] == pytest.approx(0.01) and about["deviations"]["place"] is None
    assert about["deviations"]["values"] == pytest.approx([0.02]) and about["ambiguous"]
    assert about["other_parents"] == [2]
    along = np.array(about["line"]["points"]) @ joint.axis.numpy()
    distances = np.abs(along - joint.origin.numpy() @ joint.axis.numpy())
    np.testing.assert_allclose(about["line"]["deviations"], 0.01 * distances, atol=1e-12)


def test_loops_are_listed_after_the_tree_and_empty_parts_are_written(objects, write):
    bundle = objects.chain(["revolute", "spherical"])
    loop = objects.joint("closure", "revolute", "p2", "p0", 1, in_tree=False)
    bundle.joints = [loop, *bundle.joints[::-1]]
    bundle.parts[1] = replace(bundle.parts[1], splat=bundle.parts[1].splat.select(torch.arange(0)))
    path, robot = write(bundle)
    joints = PageModel(path).object["joints"]
    assert [joint["name"] for joint in joints] == ["j1", "j2", "closure"]
    assert [joint["in_tree"] for joint in joints] == [True, True, False]
    assert set(verdicts(validate(path, "html", bundle, robot)).values()) == {"passed"}


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_needles_and_points_keep_their_size_where_it_can_be_seen(objects, unit):
    bundle = objects.chain(["revolute"])
    bundle.parts[0].splat.log_scales[0] = torch.tensor([-1.0, -4.0, -40.0])
    for part in bundle.parts:
        part.splat.means *= unit
        part.splat.log_scales += math.log(unit)
    bundle.joints[0].origin *= unit
    column = page.page_object(bundle)["parts"][0]["columns"]["log_scales"]
    sizes = np.exp(restored(column)[0]) / unit
    assert sizes[:2] == pytest.approx([math.exp(-1), math.exp(-4)], rel=0.02) and 1e-5 < sizes[2] < 1e-3


def test_the_page_blurs_gaussians_as_the_rasterizer_does(objects, write):
    path, _ = write(objects.chain(["revolute"]))
    over, under = re.search(r"BLUR = ([\d.]+) / ([\d.]+);", path.read_text(encoding="utf-8")).groups()
    assert float(over) / float(under) == pytest.approx(PIXEL_VARIANCE)
