import datetime
import json
import subprocess
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import torch

from simulator.utils.files import result_meta, write_results


def test_meta_says_where_a_number_comes_from():
    meta = result_meta("ae-env bench throughput", seed=3)
    assert set(meta) == {"command", "commit", "seed", "date", "machine", "versions"}
    assert (meta["command"], meta["seed"]) == ("ae-env bench throughput", 3)
    assert meta["machine"]["threads"] == torch.get_num_threads()
    assert meta["versions"]["torch"] == version("torch")
    age = datetime.datetime.now(datetime.UTC) - datetime.datetime.fromisoformat(meta["date"])
    assert abs(age.total_seconds()) < 60
    json.dumps(meta)


def test_commit_is_that_of_this_checkout():
    def git(*arguments):
        command = ["git", "-C", Path(__file__).parent, *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    head = git("rev-parse", "--verify", "--quiet", "HEAD")
    changed = git("diff", "--quiet", "HEAD").returncode
    expected = None if head.returncode else head.stdout.strip() + "+changes" * changed
    assert result_meta("x", seed=None)["commit"] == expected


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), object(), np.float32("nan")])
def test_files_read_back_and_bad_values_leave_them(tmp_path, bad):
    path = tmp_path / "new" / "results.json"
    rows = [{"value": np.float32(0.5), "count": np.int64(3), "tensor": torch.tensor([1.0, 2.0])}]
    assert write_results(path, rows, {"command": "x"}) == path
    before = path.read_text()
    expected = {"meta": {"command": "x"}, "rows": [{"value": 0.5, "count": 3, "tensor": [1, 2]}]}
    assert json.loads(before) == expected
    with pytest.raises(ValueError, match="finite JSON"):
        write_results(path, [{"a": bad}], {})
    assert path.read_text() == before
    assert len(list(path.parent.iterdir())) == 1
