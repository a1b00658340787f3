"""Files that are whole or not there, in a folder and in an object store."""

import uuid
from concurrent.futures import ThreadPoolExecutor

import pytest

from splatart_ns.batch.storage import open_storage, publish
from splatart_ns.errors import InputError


@pytest.fixture(params=["folder", "object store"])
def storage(request, tmp_path):
    if request.param == "folder":
        return open_storage(str(tmp_path / "storage"))
    return open_storage(f"{request.getfixturevalue('object_store')}/{uuid.uuid4().hex}")


def test_what_is_written_is_read_and_listed(storage):
    assert (storage.read("a/b"), storage.files("a"), storage.children("a")) == (None, {}, ([], []))
    storage.write("a/b", b"one")
    storage.write("a/c/d", b"three")
    assert storage.read("a/b") == b"one"
    assert {name: info.size for name, info in storage.files("a").items()} == {"b": 3, "c/d": 5}
    assert storage.children("a") == (["c"], ["b"])
    storage.remove("a/b")
    storage.remove("a/b")
    assert storage.read("a/b") is None


def test_another_content_has_another_stamp(storage):
    storage.write("a", b"one")
    before = storage.files("")["a"].stamp
    storage.write("a", b"two")
    assert before and storage.files("")["a"].stamp != before


def test_of_several_that_create_a_file_one_does(storage):
    with ThreadPoolExecutor(6) as threads:
        created = list(threads.map(lambda number: storage.create("claims/1", b"%d" % number), range(6)))
    assert sum(created) == 1 and storage.read("claims/1") == b"%d" % created.index(True)
    storage.remove("claims/1")
    assert storage.create("claims/0", b"first")
    assert not storage.create("claims/0", b"second")
    assert storage.read("claims/0") == b"first"
    assert list(storage.files("claims")) == ["0"]


def test_folders_come_back_as_they_were(storage, tmp_path):
    storage.write("a/b", b"one")
    storage.write("a/c/d", b"two")
    storage.get("a", tmp_path / "copy")
    assert (tmp_path / "copy/c/d").read_bytes() == b"two" and (tmp_path / "copy/b").read_bytes() == b"one"


def test_publishing_replaces_what_an_earlier_run_left(storage, tmp_path):
    for name in ("new/x", "new/y/z", "last"):
        (tmp_path / "work" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "work" / name).write_text(name)
    for name in ("new/old", "newer", "last", "other"):
        storage.write(f"target/{name}", b"old")
    sizes = publish(storage, tmp_path / "work", ["new", "last"], "target")
    assert sizes == {"new/x": 5, "new/y/z": 7, "last": 4} and list(sizes)[-1] == "last"
    assert set(storage.files("target")) == {"new/x", "new/y/z", "newer", "last", "other"}
    assert storage.read("target/last") == b"last" and storage.read("target/newer") == b"old"


def test_half_written_files_are_not_listed(tmp_path):
    storage = open_storage(str(tmp_path))
    (tmp_path / ".a.123.tmp.json").write_text("{")
    assert storage.files("") == {}


def test_a_name_in_a_bucket_cannot_lead_out(object_store, tmp_path):
    import fsspec

    fsspec.filesystem("s3").pipe_file("bucket/evil/../../out", b"x")
    with pytest.raises(InputError, match="leads out"):
        open_storage(f"{object_store}/evil").get("", tmp_path / "copy")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("link", ["a/parts", "a/parts/x.ply"])
def test_a_link_in_a_folder_cannot_lead_out(tmp_path, link):
    secret = tmp_path / "elsewhere/x.ply"
    secret.parent.mkdir()
    secret.write_text("secret")
    source = tmp_path / "bundles" / link
    source.parent.mkdir(parents=True)
    source.symlink_to(secret.parent if link.endswith("parts") else secret)
    with pytest.raises(InputError, match="leads out"):
        open_storage(str(tmp_path / "bundles")).get("a/parts", tmp_path / "copy")
    assert not list(tmp_path.glob("copy/**/*.ply"))


def test_an_unknown_kind_of_url_is_a_mistake():
    with pytest.raises(InputError, match="nothing://"):
        open_storage("nothing://bucket").read("a")


def test_a_store_that_does_not_answer_is_a_mistake(object_store, tmp_path):
    (tmp_path / "file").write_text("one")
    nowhere = open_storage("s3://no-such-bucket/a")
    assert (nowhere.read("b"), nowhere.files(""), nowhere.children("")) == (None, {}, ([], []))
    for write in (
        lambda: nowhere.write("b", b"one"),
        lambda: nowhere.create("b", b"one"),
        lambda: nowhere.put(tmp_path / "file", "b"),
    ):
        with pytest.raises(InputError, match="s3://no-such-bucket/a: .*does not exist.*correct the URL"):
            write()
    misnamed = open_storage("s3://no!bucket/a")
    for read in (misnamed.read, misnamed.files, misnamed.children, misnamed.remove):
        with pytest.raises(InputError, match="s3://no!bucket/a: .*Invalid bucket name"):
            read("b")


def test_a_store_without_credentials_asks_for_them(object_store, monkeypatch, tmp_path):
    import fsspec

    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    for name in ("AWS_CONFIG_FILE", "AWS_SHARED_CREDENTIALS_FILE"):
        monkeypatch.setenv(name, str(tmp_path / "none"))
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setitem(fsspec.config.conf, "s3", {"skip_instance_cache": True})
    with pytest.raises(InputError, match="s3://bucket/a: .*Unable to locate credentials.*give this machine"):
        open_storage("s3://bucket/a").children("")
