"""WebDataset shards of many bundles."""

import io
import json
import shutil
import tarfile
from dataclasses import replace

import numpy as np
import pytest
from bundle_of_two import save_box
from PIL import Image
from rich.console import Console

from splatart_ns.batch import shards
from splatart_ns.batch.batch import run_batch
from splatart_ns.batch.command import write_shards
from splatart_ns.batch.entry import Entry
from splatart_ns.batch.pool import ProcessPool
from splatart_ns.batch.shards import Sharding, ShardOptions, Shards, check_no_others, find_bundles
from splatart_ns.batch.stage import Work
from splatart_ns.batch.storage import open_storage
from splatart_ns.errors import InputError

OPTIONS = ShardOptions(images=10, shard_size=4, states=3, resolution=24)


@pytest.fixture(scope="module")
def bundles(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bundles")
    for number, name in enumerate(("a", "deep/b", "c")):
        save_box(folder / name, seed=number)
    (folder / ".batch").mkdir()
    return folder


@pytest.fixture
def make(recorder):
    def make(bundles, out, options=OPTIONS):
        told = recorder()
        entries = Shards(str(bundles), find_bundles(str(bundles)), options)
        run_batch(entries, str(out), Sharding(options, "torch"), ProcessPool(1, 8000, {}), told)
        return told

    return make


@pytest.fixture(scope="module")
def out(bundles, tmp_path_factory):
    return tmp_path_factory.mktemp("shards")


def members(path):
    with tarfile.open(path) as tar:
        return {member.name: tar.extractfile(member).read() for member in tar}


def test_bundles_are_found_in_order(bundles, tmp_path):
    assert find_bundles(str(bundles)) == ["a", "c", "deep/b"]
    (tmp_path / "links").mkdir()
    (tmp_path / "links/a").symlink_to(bundles / "a")
    with pytest.raises(InputError, match=r"no bundle in it \(links to folders are not followed\)"):
        find_bundles(str(tmp_path / "links"))
    assert find_bundles(str(tmp_path / "links/a")) == [""]
    with pytest.raises(InputError, match="gone: there is no such folder; give the --output-dir"):
        find_bundles(str(tmp_path / "gone"))


def test_every_image_is_in_one_shard_and_bundles_take_turns(bundles):
    entries = list(Shards(str(bundles), ["a", "c", "deep/b"], OPTIONS))
    assert [entry.name for entry in entries] == ["shard-000000", "shard-000001", "shard-000002"]
    assert [(entry.settings["first"], entry.settings["count"]) for entry in entries] == [(0, 4), (4, 4), (8, 2)]
    assert [entry.settings["bundles"] for entry in entries] == [
        ["a", "c", "deep/b"],
        ["c", "deep/b", "a"],
        ["deep/b", "a"],
    ]


def test_shards_hold_labelled_images_and_one_can_be_made_again_alone(bundles, make, out):
    told = make(bundles, out)
    assert set(told.status().values()) == {"done"}
    first = members(out / "shard-000000/images.tar")
    assert list(first)[:4] == [f"000000000.{suffix}" for suffix in ("rgb.png", "parts.png", "depth.png", "json")]
    about = [json.loads(first[f"{image:09d}.json"]) for image in range(4)]
    assert [one["object"] for one in about] == ["a", "c", "deep/b", "a"]
    assert [one["state"] for one in about] == [0, 0, 0, 1] and about[0]["q"] != about[1]["q"]
    pixels = {name: np.asarray(Image.open(io.BytesIO(data))) for name, data in first.items() if name.endswith("png")}
    assert pixels["000000000.rgb.png"].shape == (24, 24, 4)
    assert set(np.unique(pixels["000000000.parts.png"])) <= {0, *map(int, about[0]["parts"])}
    seen = pixels["000000000.parts.png"] > 0
    assert seen.any() and (pixels["000000000.depth.png"][seen] > 0).mean() > 0.9

    before = (out / "shard-000001/images.tar").read_bytes()
    other = (out / "shard-000000/images.tar").stat().st_mtime_ns
    shutil.rmtree(out / "shard-000001")
    again = make(bundles, out)
    assert {name for name, _ in again.stages} == {"shard-000001"}
    assert (out / "shard-000001/images.tar").read_bytes() == before
    assert (out / "shard-000000/images.tar").stat().st_mtime_ns == other


class Counted(bytes):
    """Of which it is known how many there were at once."""

    now = most = 0

    def __new__(cls, data):
        cls.now += 1
        cls.most = max(cls.now, cls.most)
        return super().__new__(cls, data)

    def __del__(self):
        Counted.now -= 1


def test_samples_of_a_shard_are_not_all_in_memory_at_once(bundles, tmp_path, monkeypatch):
    encode = shards._encode
    monkeypatch.setattr(shards, "_encode", lambda *given: {k: Counted(v) for k, v in encode(*given).items()})
    options = replace(OPTIONS, images=30, shard_size=30, resolution=8)
    (tmp_path / "bundle").mkdir()
    (entry,) = Shards(str(bundles), ["a", "c"], options)
    Sharding(options, "auto").run("images", Work(entry, open_storage(str(tmp_path / "out")), tmp_path / "bundle"))
    assert list(members(tmp_path / "bundle/images.tar"))[::4] == [f"{image:09d}.rgb.png" for image in range(30)]
    assert Counted.most <= 8  # files of two samples


def test_larger_images_need_more_memory():
    small, large = (
        Sharding(ShardOptions(images=10, resolution=side)).stages(Entry("a", "", {}), "files", {"digest": ""})[1]
        for side in (256, 8192)
    )
    assert small.needs.memory_mb < 2000 and large.needs.memory_mb > 5000


def test_one_bundle_is_enough(bundles, make, tmp_path):
    told = make(bundles / "a", tmp_path, ShardOptions(images=2, states=2, resolution=24))
    assert set(told.status().values()) == {"done"}
    assert json.loads(members(tmp_path / "shard-000000/images.tar")["000000000.json"])["object"] == "a"


def test_a_part_that_a_bundle_lacks_is_not_taken_from_the_bundle_before(bundles, make, tmp_path):
    root = shutil.copytree(bundles, tmp_path / "bundles")
    next((root / "c/parts").iterdir()).unlink()
    assert set(make(root, tmp_path / "out", replace(OPTIONS, images=2)).status().values()) == {"failed"}


def test_shards_that_fewer_images_would_leave_behind_are_refused(bundles, tmp_path):
    for name in ("shard-000002", "shard-000003-mine", "notes"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "images.tar").touch()
    (tmp_path / "shard-000004").mkdir()  # without images
    check_no_others(Shards(str(bundles), ["a"], OPTIONS), open_storage(str(tmp_path)))
    with pytest.raises(InputError, match=f"{tmp_path}: holds shard-000002, .* these 2; remove it, or give another"):
        write_shards(str(bundles), str(tmp_path), replace(OPTIONS, images=8), "torch", None, Console())
    assert (tmp_path / "shard-000002/images.tar").exists()


@pytest.mark.parametrize("options", [{"images": 0}, {"shard_size": 0}, {"states": 0}, {"states": 10**6}])
def test_options_without_sense_are_mistakes(bundles, options):
    with pytest.raises(InputError, match=f"--{next(iter(options)).replace('_', '-')}"):
        Shards(str(bundles), ["a"], ShardOptions(**({"images": 10} | options)))
