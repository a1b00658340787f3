"""Which captures a batch is of."""

import json

import pytest

from splatart_ns.batch.entry import check_apart, read_entries
from splatart_ns.batch.storage import open_storage
from splatart_ns.errors import InputError

SETTINGS = {"quality": "standard", "root": None, "seed": 0, "downscale": None, "joints": []}


@pytest.fixture
def make(tmp_path):
    def make(path, text="{}"):
        file = tmp_path / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)

    return make


def names(source):
    return [entry.name for entry in read_entries(str(source), SETTINGS)]


def test_captures_of_all_layouts_are_found(make, tmp_path):
    for state in ("state_00", "state_01", "eval/novel_00"):
        make(f"kitchen/drawer/{state}/transforms.json", '{"frames": []}')
    make("one_file/transforms.json", '{"frames": [{"state": 0}]}')
    make("one_file/eval/novel_00/transforms.json", "{}")
    for state in ("start", "end"):
        make(f"paris/{state}/camera_train.json")
    for state in ("start", "end"):
        make(f"artgs/transforms_train_{state}.json")
    make("dta/init_keyframes.yml")
    make("dta/cam_K.txt")
    make("notes/readme.json")
    make(".hidden/transforms.json", '{"frames": [{"state": 0}]}')
    entries = read_entries(str(tmp_path), SETTINGS)
    assert [entry.name for entry in entries] == ["artgs", "dta", "kitchen/drawer", "one_file", "paris"]
    assert entries[2].capture == str(tmp_path / "kitchen/drawer") and entries[0].settings == SETTINGS


def test_a_broken_file_among_captures_is_one_of_them(make, tmp_path):
    for name in ("a", "b"):
        make(f"{name}/transforms.json", '{"frames": [{"state": 0}]}')
    make("broken/transforms.json", '{"fra')
    assert names(tmp_path) == ["a", "b", "broken"]


def test_the_folder_may_be_a_capture_itself(make, tmp_path):
    make("scissors/state_00/transforms.json")
    assert names(tmp_path / "scissors") == ["scissors"]


def test_links_to_captures_are_not_followed_but_can_be_named(make, tmp_path):
    make("elsewhere/scissors/state_00/transforms.json")
    (tmp_path / "captures").mkdir()
    (tmp_path / "captures/a").symlink_to(tmp_path / "elsewhere/scissors")
    with pytest.raises(InputError, match="links to folders are not followed"):
        names(tmp_path / "captures")
    make("list.csv", "path\ncaptures/a\n")
    assert names(tmp_path / "list.csv") == ["a"]


def test_no_capture_at_all_is_a_mistake(make, tmp_path):
    with pytest.raises(InputError, match="notes: there is no such folder; give a folder above captures"):
        names(tmp_path / "notes")
    make("notes/readme.txt")
    with pytest.raises(InputError, match="no capture"):
        names(tmp_path / "notes")
    with pytest.raises(InputError, match="readme.txt: is no folder; give a folder above captures"):
        names(tmp_path / "notes/readme.txt")


@pytest.mark.parametrize("out", ["captures", "captures/a", "captures/a/state_00/new", "link"])
def test_bundles_among_the_captures_files_are_refused(make, tmp_path, out):
    make("captures/a/state_00/transforms.json")
    make("captures/kitchen/b/state_00/transforms.json")
    (tmp_path / "link").symlink_to(tmp_path / "captures")
    entries = read_entries(str(tmp_path / "captures"), SETTINGS)
    check_apart(entries, open_storage(str(tmp_path / "captures/new")))
    with pytest.raises(InputError, match="choose another --output-dir"):
        check_apart(entries, open_storage(str(tmp_path / out)))


def test_a_bundle_around_a_capture_is_refused(make, tmp_path):
    make("kitchen/deep/state_00/transforms.json")
    make("list.csv", "path,name\nkitchen/deep,kitchen\n")
    with pytest.raises(InputError, match=f"{tmp_path}/kitchen/deep: a bundle would lie"):
        check_apart(read_entries(str(tmp_path / "list.csv"), SETTINGS), open_storage(str(tmp_path)))


def test_captures_in_an_object_store_are_found(object_store):
    import fsspec

    store = fsspec.filesystem("s3")
    for name in ("a/state_00", "a/state_01", "deep/b/state_00"):
        store.pipe_file(f"bucket/found/{name}/transforms.json", b"{}")
    entries = read_entries(f"{object_store}/found", SETTINGS)
    assert [(entry.name, entry.capture) for entry in entries] == [
        ("a", "s3://bucket/found/a"),
        ("deep/b", "s3://bucket/found/deep/b"),
    ]


def test_a_csv_says_what_is_special_about_an_object(make, tmp_path):
    make(
        "list.csv",
        "path,name,quality,root,seed,downscale,joints,,\ncaps/a,,,,,,,,\n"
        "/b,bee,draft,base,7,3,lid:base=revolute; knob:lid;,,\n",
    )
    first, second = read_entries(str(tmp_path / "list.csv"), SETTINGS)
    assert (first.name, first.capture, first.settings) == ("a", f"{tmp_path}/caps/a", SETTINGS)
    assert (second.name, second.capture) == ("bee", "/b")
    joints = ["lid:base=revolute", "knob:lid"]
    assert second.settings == {"quality": "draft", "root": "base", "seed": 7, "downscale": 3, "joints": joints}


def test_json_lines_do_so_too(make, tmp_path):
    rows = [{"path": "s3://bucket/a"}, {"path": "b", "name": "x/y", "joints": ["lid:base"]}]
    make("list.jsonl", "\n".join(map(json.dumps, rows)) + "\n\n")
    first, second = read_entries(str(tmp_path / "list.jsonl"), SETTINGS)
    assert (first.name, first.capture) == ("a", "s3://bucket/a")
    assert (second.name, second.settings["joints"]) == ("x/y", ["lid:base"])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("path\n", "no capture"),
        ("name\na\n", "line 2: 'path' is missing"),
        ("path,colour\na,red\n", "line 2: 'colour' is unknown"),
        ("path,seed\na,-1\n", "line 2: 'seed' is '-1'"),
        ("path,downscale\na,0\n", "line 2: 'downscale' is 0; give 1 or more"),
        ("path,downscale\na,half\n", "line 2: 'downscale' is 'half'"),
        ("path,quality\na,best\n", "'best'; give one of draft, standard, high"),
        ("path,name\na\n", "line 2: has not as many fields"),
        ('path\n"a\n', "is no CSV"),
        ("path,seed, path\na,1,b\n", "line 1: has the column 'path' twice"),
        ("path\nx/a\ny/a\n", "both 'a' and 'a'"),
        ("path,name\na,A\nb,a\n", "both 'A' and 'a'"),
        ("path,name\na,../a\n", "'../a'"),
        ("path,name\na,/etc\n", "'/etc'"),
        ("path,name\na,.batch\n", "'.batch'"),
        ("path,name\na,x\nb,x/runs\n", "'x/runs'"),
        ("path,name\na,x\nb,x/y\n", "'x/y' would lie in the bundle 'x'"),
    ],
)
def test_a_manifest_with_a_mistake_names_the_line_and_the_mend(make, tmp_path, text, told):
    make("list.csv", text)
    with pytest.raises(InputError) as raised:
        names(tmp_path / "list.csv")
    assert told in str(raised.value) and str(raised.value).startswith(str(tmp_path / "list.csv"))


@pytest.mark.parametrize(
    "line",
    [
        "[1]",
        "{",
        '{"path": 3}',
        r'{"path": "a\u0000b", "name": "a"}',
        r'{"path": "a\ud800", "name": "a"}',
        '{"path": "a", "joints": "lid"}',
        '{"path": "a", "seed": true}',
        '{"path": "a", "path": "b"}',
    ],
)
def test_a_line_that_is_no_object_or_has_a_wrong_value_is_named(make, tmp_path, line):
    make("list.jsonl", '{"path": "fine"}\n' + line)
    with pytest.raises(InputError, match="line 2"):
        names(tmp_path / "list.jsonl")
