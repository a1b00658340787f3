"""Reading what stage 1 left."""

import pytest

from splatart_ns.errors import InputError
from splatart_ns.plugin.semantic_run import find_semantic_runs


def test_semantic_runs_that_are_not_there_are_named_by_state(capture_dir, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="--state 0"):
        find_semantic_runs(capture_dir, 2)
