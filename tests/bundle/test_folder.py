import copy
import json

import pytest
import torch

from splatart_ns.bundle import load_bundle, save_bundle
from splatart_ns.errors import InputError


@pytest.fixture
def folder(bundle, tmp_path):
    save_bundle(bundle, tmp_path)
    return tmp_path


def rewrite(folder, edit):
    path = folder / "articulation.json"
    value = json.loads(path.read_text())
    edit(value)
    path.write_text(json.dumps(value))


def assert_equal(a, b):
    if isinstance(a, torch.Tensor):
        assert torch.equal(torch.nan_to_num(a), torch.nan_to_num(b)) and torch.equal(a.isnan(), b.isnan())
    elif isinstance(a, list):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_equal(x, y)
    elif hasattr(a, "__dataclass_fields__"):
        for name in a.__dataclass_fields__:
            assert_equal(getattr(a, name), getattr(b, name))
    else:
        assert a == b


def test_a_bundle_survives_the_disk_exactly(bundle, folder):
    assert_equal(load_bundle(folder), bundle)


def test_the_file_follows_the_contract(folder):
    value = json.loads((folder / "articulation.json").read_text())
    assert list(value) == ["format", "units", "states", "root", "parts", "joints", "loops", "provenance"]
    assert value["units"] == {"length": "metre", "angle": "radian"}
    part = value["parts"][0]
    assert list(part) == ["id", "name", "splat", "num_gaussians", "motion", "motion_covariance"]
    assert part["splat"] == "parts/base.ply"
    assert part["motion_covariance"][1] is None
    assert list(value["joints"][0]) == (
        ["name", "type", "parent", "child", "in_tree", "axis", "origin", "pitch", "values", "limits", "residual"]
        + ["covariance", "ambiguous", "alternatives"]
    )
    assert "NaN" not in (folder / "articulation.json").read_text()


def test_saving_leaves_only_the_bundles_files(folder):
    files = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert files == {"articulation.json", "parts/base.ply", "parts/door.ply", "parts/latch.ply"}


@pytest.mark.parametrize("names", [["../../a", "__/__/A", "ü"], ["a_b_3", "a.b", "a_b"]])
def test_part_names_that_are_no_file_names_stay_inside_and_apart(bundle, tmp_path, names):
    for part, name in zip(bundle.parts, names, strict=True):
        for joint in bundle.joints:
            joint.parent = name if joint.parent == part.name else joint.parent
            joint.child = name if joint.child == part.name else joint.child
            for other in joint.alternatives:
                other.update({"parent": name} if other.get("parent") == part.name else {})
        part.name = name
    bundle.root = names[0]
    bundle.loops = []
    save_bundle(bundle, tmp_path / "out")
    assert {p.name for p in tmp_path.iterdir()} == {"out"}
    assert len(list((tmp_path / "out" / "parts").iterdir())) == 3
    assert load_bundle(tmp_path / "out").part_names == names


def set_(*path, value):
    def edit(top):
        for key in path[:-1]:
            top = top[key]
        top[path[-1]] = value

    edit.__name__ = "-".join(map(str, path))
    return edit


EYE = torch.eye(4).tolist()
SKEWED = [[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MIRRORED = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
PART, JOINT = ("parts", 1), ("joints", 1)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (set_("format", value="splatart-articulation-9"), "format"),
        (set_("states", value=["a", "a"]), "states"),
        (set_("states", value=[]), "states"),
        (set_("states", value=["a", 1]), "states"),
        (set_("root", value="nobody"), "root"),
        (set_("root", value="door"), "'door' 1 parents"),
        (set_("root", value="latch"), "'latch' 1 parents"),
        (set_("units", "angle", value="degree"), "radian"),
        (set_("units", value=None), "units"),
        (set_("parts", value=[]), "parts"),
        (set_("parts", value={}), "parts"),
        (set_("parts", 1, value="door"), r"parts\[1\]"),
        (set_(*PART, "id", value=1), "twice"),
        (set_(*PART, "id", value=0), "part ids"),
        (set_(*PART, "id", value=255), "part ids"),
        (set_(*PART, "id", value=True), "id"),
        (set_(*PART, "id", value=2.5), "id"),
        (set_(*PART, "name", value="base"), "twice"),
        (set_(*PART, "name", value=""), "empty"),
        (set_(*PART, "name", value="l\ud800"), "half a character"),
        (set_(*PART, "splat", value="../door.ply"), "inside the bundle"),
        (set_(*PART, "splat", value="/etc/passwd"), "inside the bundle"),
        (set_(*PART, "splat", value="parts/\0"), "inside the bundle"),
        (set_(*PART, "splat", value="parts/none.ply"), "none.ply"),
        (set_(*PART, "num_gaussians", value=3), "PLY holds 6"),
        (set_(*PART, "motion", value=[EYE]), "motion"),
        (set_(*PART, "motion", value=[EYE, SKEWED]), "no rigid motion"),
        (set_(*PART, "motion", value=[EYE, MIRRORED]), "no rigid motion"),
        (set_(*PART, "motion", 0, value=[[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "identity"),
        (set_(*PART, "motion", 1, 0, 3, value="1"), "motion"),
        (set_(*PART, "motion", 1, 0, 3, value=None), "null"),
        (set_(*PART, "motion", 1, 0, 3, value=float("nan")), "JSON"),
        (set_(*PART, "motion", 1, 0, 3, value=10**400), "motion"),
        (set_(*PART, "motion_covariance", value=[None]), "motion_covariance"),
        (set_(*PART, "motion_covariance", 0, value=[[1.0]]), "motion_covariance"),
        (set_(*JOINT, "type", value="ball"), "known are"),
        (set_(*JOINT, "name", value="slide"), "twice"),
        (set_(*JOINT, "name", value="latch"), "call joint 'latch' as the part that joint 'slide' moves"),
        (set_(*JOINT, "parent", value="nobody"), "parent"),
        (set_(*JOINT, "parent", value="door"), "joins two parts"),
        (set_(*JOINT, "parent", value="latch"), "way to the root"),
        (set_(*JOINT, "child", value="latch"), "2 parents"),
        (set_(*JOINT, "in_tree", value=1), "in_tree"),
        (set_(*JOINT, "in_tree", value=False), "way to the root"),
        (set_(*JOINT, "axis", value=[0, 0, 2]), "unit"),
        (set_(*JOINT, "axis", value=[0, 0]), "axis"),
        (set_(*JOINT, "origin", value=None), "origin"),
        (set_(*JOINT, "values", value=[0.0]), "values"),
        (set_(*JOINT, "values", value=[1.0, 2.0]), "first state is 0"),
        (set_(*JOINT, "limits", value=[1, 0]), "lower limit"),
        (set_(*JOINT, "limits", value=None), "limits"),
        (set_(*JOINT, "limits", value=[0.2, 1.5]), r"is \[0.2, 1.5\]; give a range that holds 0"),
        (set_(*JOINT, "limits", value=[-1.5, -0.2]), "holds 0"),
        (set_("joints", 2, "limits", value=[0.0, 1.0]), r"a spherical joint has 3 values; give null"),
        (set_(*JOINT, "residual", value=-1), "residual"),
        (set_(*JOINT, "residual", value="0"), "residual"),
        (set_(*JOINT, "covariance", value=[]), "covariance"),
        (set_(*JOINT, "covariance", "values", value=[[1.0]]), "values"),
        (set_(*JOINT, "covariance", "pitch", value=None), "pitch"),
        (set_(*JOINT, "alternatives", 0, "type", value="x"), "alternatives"),
        (set_(*JOINT, "alternatives", 1, "parent", value="nobody"), "known are base"),
        (set_("loops", 0, "joint", value="hinge"), "known are closure"),
        (set_("loops", 0, "parts", value=["base", "nobody"]), "nobody"),
        (set_("provenance", value=3), "provenance"),
        (set_("provenance", "cameras", value=[[[0.0, 1, 2]]]), "each of the 2 states"),
        (set_("provenance", "cameras", value=[[[0.0, 1, 2]], [[0.0, 1]]]), "cameras"),
        (set_("provenance", "cameras", value=[[], 3]), "cameras"),
    ],
    ids=lambda v: getattr(v, "__name__", None),
)
def test_what_is_wrong_in_the_file_is_named(folder, edit, message):
    rewrite(folder, edit)
    with pytest.raises(InputError, match=message) as error:
        load_bundle(folder)
    assert str(folder) in str(error.value)


def test_every_missing_key_is_named(folder):
    path = folder / "articulation.json"
    whole = json.loads(path.read_text())
    places = [(), ("units",), PART, JOINT, ("joints", 1, "alternatives", 0), ("loops", 0)]
    for place in places:
        inner = whole
        for key in place:
            inner = inner[key]
        for key in inner:
            value = copy.deepcopy(whole)
            target = value
            for step in place:
                target = target[step]
            del target[key]
            path.write_text(json.dumps(value))
            with pytest.raises(InputError, match=f"'{key}' of .* is missing"):
                load_bundle(folder)


def test_a_key_that_an_object_has_twice_is_named(folder):
    path = folder / "articulation.json"
    path.write_text(path.read_text().replace('"pitch"', '"limits": [0, 1], "pitch"', 1))
    with pytest.raises(InputError, match=r'articulation\.json: an object has the key "limits" twice; keep one of them'):
        load_bundle(folder)


def test_a_joint_may_have_the_name_of_the_part_that_it_moves(folder):
    rewrite(folder, set_(*JOINT, "name", value="door"))
    assert load_bundle(folder).tree_joint("door").child == "door"


def test_a_part_may_hang_on_nothing(folder):
    rewrite(folder, lambda top: top["joints"].pop(0))
    assert [joint.name for joint in load_bundle(folder).tree_joints] == ["hinge"]


@pytest.mark.parametrize("text", ["", "{", "[]", "3", "[" * 100000, '{"format": NaN}'])
def test_a_file_that_is_no_object_is_refused(folder, text):
    (folder / "articulation.json").write_text(text)
    with pytest.raises(InputError, match="articulation.json"):
        load_bundle(folder)


def test_a_cut_ply_is_refused(folder):
    path = folder / "parts" / "door.ply"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match="door.ply"):
        load_bundle(folder)


def test_a_link_out_of_the_folder_is_refused(folder, tmp_path_factory):
    outside = tmp_path_factory.mktemp("outside") / "door.ply"
    (folder / "parts" / "door.ply").rename(outside)
    (folder / "parts" / "door.ply").symlink_to(outside)
    with pytest.raises(InputError, match="inside the bundle"):
        load_bundle(folder)


def test_a_folder_without_a_bundle_is_named(tmp_path):
    with pytest.raises(InputError, match="articulation.json"):
        load_bundle(tmp_path)


def test_saving_over_another_bundle_leaves_only_its_own_parts(bundle, tmp_path):
    save_bundle(bundle, tmp_path)
    (tmp_path / "parts" / "of_an_earlier_bundle.ply").write_bytes(b"ply")
    save_bundle(bundle, tmp_path)
    assert len(list((tmp_path / "parts").glob("*.ply"))) == len(bundle.parts)
