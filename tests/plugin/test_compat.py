import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from splatart_ns.errors import InputError
from splatart_ns.plugin.compat import StartView, finished_runs, read_checkpoint, read_run_config


def write_run(folder: Path, data: Path, *, saved_at: int | None = 9) -> Path:
    """A run's folder with as much of a config.yml as matters, of ten steps, and a checkpoint of one of them."""
    parts = "".join(f"\n      - {part}" for part in data.parts)
    (folder / "nerfstudio_models").mkdir(parents=True)
    (folder / "config.yml").write_text(
        "!!python/object:splatart_ns.plugin.joint.JointTrainerConfig\n"
        "max_num_iterations: 10\n"
        "pipeline: !!python/object:a.B\n  datamanager: !!python/object:c.D\n"
        f"    data: &id001 !!python/object/apply:pathlib.PosixPath{parts}\n"
        "    dataparser: !!python/object:e.F\n      data: *id001\n      state: 1\n"
    )
    if saved_at is not None:
        torch.save({"pipeline": {}}, folder / "nerfstudio_models" / f"step-{saved_at:09d}.ckpt")
    return folder / "config.yml"


def test_a_run_config_is_read_without_running_what_it_says(tmp_path: Path) -> None:
    witness = tmp_path / "witness"
    config = tmp_path / "config.yml"
    config.write_text(f"!!python/object:a.B\nx: !!python/object/apply:os.system\n- touch {witness}\ny: [1, {{z: 2}}]\n")
    assert read_run_config(config) == {"x": [f"touch {witness}"], "y": [1, {"z": 2}]}
    assert not witness.exists()


@pytest.mark.parametrize("content", ["", "- 1\n", "a: [1\n", "!!python/name:os.system ''\n"])
def test_what_is_no_run_config_is_refused(tmp_path: Path, content: str) -> None:
    config = tmp_path / "config.yml"
    config.write_text(content)
    with pytest.raises(InputError, match=r"config\.yml"):
        read_run_config(config)


def test_the_newest_checkpoint_is_read(tmp_path: Path) -> None:
    config = write_run(tmp_path / "run", tmp_path)
    # nerfstudio's schedulers leave NumPy scalars beside the tensors.
    state = {"pipeline": {"a": torch.ones(2)}, "schedulers": {"means": {"_last_lr": [np.float64(0.1)]}}}
    torch.save(state, config.parent / "nerfstudio_models" / "step-000000119.ckpt")
    assert torch.equal(read_checkpoint(config, {"a": (2,)})["a"], torch.ones(2))


def test_a_missing_or_cut_off_checkpoint_is_told(tmp_path: Path) -> None:
    config = write_run(tmp_path / "run", tmp_path, saved_at=None)
    with pytest.raises(InputError, match="no checkpoint"):
        read_checkpoint(config, {})
    (config.parent / "nerfstudio_models" / "step-000000001.ckpt").write_bytes(b"PK\x03\x04cut off")
    with pytest.raises(InputError, match="cannot be read"):
        read_checkpoint(config, {})


def test_finished_runs_are_found_by_their_data_and_in_the_order_of_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    method = Path("outputs/any name/splatart-pose")
    old = write_run(method / "b", Path("captures/door.v1"))
    new = write_run(method / "a", tmp_path / "captures" / "door.v1")
    write_run(method / "c", Path("captures/door.v2"))
    write_run(method / "d", Path("captures/door.v1"), saved_at=None)
    write_run(Path("outputs/door/splatart-joint/e"), Path("captures/door.v1"))
    os.utime(old, (1, 1))
    os.utime(new, (2, 2))
    assert finished_runs(Path("outputs"), Path("captures/door.v1"), "splatart-pose") == [old, new]


def test_a_run_that_was_killed_between_two_of_its_steps_is_not_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    method = Path("outputs/door/splatart-semantic")
    finished = write_run(method / "a", Path("door"))
    write_run(method / "b", Path("door"), saved_at=5)
    assert finished_runs(Path("outputs"), Path("door"), "splatart-semantic") == [finished]


def test_a_run_whose_checkpoint_was_cut_off_is_not_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    method = Path("outputs/door/splatart-semantic")
    finished, cut_off = write_run(method / "a", Path("door")), write_run(method / "b", Path("door"))
    (file,) = cut_off.parent.glob("nerfstudio_models/*")
    os.truncate(file, file.stat().st_size // 2)
    assert finished_runs(Path("outputs"), Path("door"), "splatart-semantic") == [finished]


def test_runs_are_looked_for_in_the_folder_that_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_run(Path("outputs/door/splatart-pose/a"), Path("door"))
    elsewhere = write_run(Path("elsewhere/door/splatart-pose/a"), Path("door"))
    assert finished_runs(Path("elsewhere"), Path("door"), "splatart-pose") == [elsewhere]


def test_a_run_that_cannot_be_read_stands_in_no_other_runs_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    good = write_run(Path("outputs/door/splatart-pose/a"), Path("door"))
    write_run(Path("outputs/other/splatart-pose/b"), Path("other")).write_text("")
    assert finished_runs(Path("outputs"), Path("door"), "splatart-pose") == [good]


def test_an_uncaught_input_error_ends_a_process_with_one_sentence() -> None:
    code = "from splatart_ns.errors import InputError\nimport splatart_ns.plugin.compat\nraise {}('Mend it.')"
    ended = subprocess.run([sys.executable, "-c", code.format("InputError")], capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (2, "error: Mend it.\n")


def test_other_exceptions_keep_their_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    try:
        raise ValueError("a bug")
    except ValueError:
        sys.excepthook(*sys.exc_info())
    assert "Traceback" in capsys.readouterr().err


def test_the_viewer_opens_on_the_whole_object() -> None:
    client = SimpleNamespace(atomic=nullcontext, camera=SimpleNamespace())
    server = SimpleNamespace(on_client_connect=lambda callback: callback(client))
    StartView(np.array([0.0, 0.0, 7.0]))._setup(SimpleNamespace(viser_server=server))
    # Viser's unit is a tenth of ours, and its camera sees 75 degrees.
    assert client.camera.position[2] / 10 > 1 / np.sin(np.radians(75 / 2))
    assert np.allclose(client.camera.position[:2], 0) and np.allclose(client.camera.look_at, 0)
