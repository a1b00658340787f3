from __future__ import annotations

from pathlib import Path

import pytest
from stub_recipe import StubRecipe

from splatart_ns.batch.batch import run_batch
from splatart_ns.batch.entry import Entry
from splatart_ns.batch.pool import ProcessPool


class Recorder:
    """Keeps all that it is told."""

    def __init__(self):
        self.rows, self.stages, self.on_stage = {}, [], None

    def started(self, entry, stage):
        pass

    def ended(self, entry, stage, marker):
        self.stages.append((entry.name, stage))
        if self.on_stage is not None:
            self.on_stage(entry, stage, marker)

    def finished(self, index, row):
        assert row["name"] not in self.rows
        self.rows[row["name"]] = row

    def status(self):
        return {name: row["status"] for name, row in self.rows.items()}


@pytest.fixture
def recorder():
    return Recorder


@pytest.fixture
def captures(tmp_path):
    """Folders of two texts each; makes as many as it is told to."""

    def make(*names: str, **settings) -> list[Entry]:
        for name in names:
            folder = tmp_path / "captures" / name
            folder.mkdir(parents=True)
            (folder / "one").write_text(f"one of {name}")
            (folder / "two").write_text(f"two of {name}")
        return [Entry(name, str(tmp_path / "captures" / name), settings) for name in names]

    return make


@pytest.fixture
def run(tmp_path):
    """Runs a batch of stub stages in two processes; returns what it told."""

    def run(entries, out=None, recipe=None, engine=None, **options) -> Recorder:
        told = Recorder()
        recipe = StubRecipe(str(tmp_path / "log")) if recipe is None else recipe
        run_batch(entries, str(out or tmp_path / "out"), recipe, engine or ProcessPool(2, 4000, {}), told, **options)
        return told

    return run


@pytest.fixture
def log(tmp_path):
    """The stages that have run so far, in order."""
    path = Path(tmp_path / "log")
    return lambda: path.read_text().splitlines() if path.exists() else []


@pytest.fixture(scope="session")
def object_store():
    """A bucket of a local S3 server."""
    pytest.importorskip("s3fs", reason="s3fs is not installed: extra 'dev'")
    pytest.importorskip("flask_cors", reason="flask-cors is not installed: extra 'dev'")
    server_module = pytest.importorskip("moto.server", reason="moto's server is not installed: extra 'dev'")
    server = server_module.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", "http://{}:{}".format(*server.get_host_and_port()))
        patch.setenv("AWS_ACCESS_KEY_ID", "test")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "test")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        import fsspec

        fsspec.filesystem("s3").mkdir("bucket")
        yield "s3://bucket"
    server.stop()
