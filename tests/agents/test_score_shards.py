"""Score tables of many files: what a shard holds, and what is lost when something goes wrong."""

import os
import signal

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from agents.score_shards import ShardPlan, ShardWriter, _on_ray, run
from simulator import CameraSettings, RawImage, get_camera, write_dng

pq = pytest.importorskip("pyarrow.parquet")
FILES = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Raws of ever more light, one of which is none."""
    path = tmp_path_factory.mktemp("raws")
    camera, noise = get_camera("nikon_z6"), torch.Generator().manual_seed(0)
    for i in range(FILES):
        light = torch.rand(4, 48, 64, generator=noise) * 0.02 * 2**i
        raw = RawImage(light.clamp(max=1.0), CameraSettings(100, 1 / 64, 4), camera)
        write_dng(path / f"night-{i}.dng", raw)
    (path / "night-3.dng").write_bytes(b"no raw")
    (path / "night-5.dng").rename(path / os.fsdecode(b"night-5\xff.dng"))
    return path


def make(folder, out, **options):
    out.mkdir(exist_ok=True)
    given = {"per_shard": 2, "resolution": 36, "weights": "none", "captures": True}
    return ShardPlan.of(str(folder), out, **(given | options))


def contents(out):
    return {path.name: path.read_bytes() for path in sorted(out.glob("*-0*"))}


@pytest.fixture(scope="module")
def done(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("local")
    run(make(folder, out), "local", lambda *_: None)
    return out


def test_every_state_of_every_scene_is_in_the_tables(done):
    table = pq.read_table(done / "tables-00000.parquet").to_pydict()
    assert table["file"] == ["night-0.dng"] * 64 + ["night-1.dng"] * 64
    assert table["state"] == [*range(64), *range(64)]
    assert (table["iso"][20], table["f_number"][20]) == (400, 4.0)  # (1 * 4 + 1) * 4 + 0
    assert sum(table["best"]) == 2
    score, best, ev100 = (np.reshape(table[n], (2, 64)) for n in ("score", "best", "ev100"))
    assert (score[best] == score.max(axis=1)).all()
    assert np.diff(ev100[best]) >= 0.0  # more light, less exposure
    # Captures are the digital numbers of the states.
    frames = load_file(done / "captures-00002.safetensors")
    name = next(name for name in frames if name.startswith("night-4.dng"))
    numbers, camera = frames[name].double(), get_camera("nikon_z6")
    assert numbers.shape == (64, 4, 36, 36)
    mean = (numbers[0].mean() - camera.black_level[0]) / camera.span[0]
    # ISO 100, 1/1000 s, f/4: 64/1000 of the light of the file, half of 0.32 in the mean
    assert float(mean) == pytest.approx(0.16 * 64 / 1000, rel=0.03)


def test_a_file_that_cannot_be_read_is_on_the_side(folder, done, tmp_path):
    (bad,) = done.glob("bad-*")
    assert (bad.name, "night-3.dng" in bad.read_text()) == ("bad-00001.jsonl", True)
    assert set(pq.read_table(done / "tables-00001.parquet")["file"].to_pylist()) == {"night-2.dng"}
    plan = make(folder, tmp_path, per_shard=1)
    told = ShardWriter(plan).write(3)  # a shard without any other file
    assert (told["scenes"], told["bad"]) == (0, 1)
    assert pq.read_table(plan.table(3)).num_rows == 0


def test_a_run_continues_with_the_shards_that_are_missing(folder, done):
    plan = make(folder, done)
    whole = contents(done)
    plan.table(1).unlink()
    seen: list[tuple[int, int]] = []
    made = run(plan, "local", lambda done, total: seen.append((done, total)))
    assert ([one["shard"] for one in made], seen) == ([1], [(2, 3), (3, 3)])
    assert contents(done) == whole
    assert run(plan, "local", lambda *_: None) == []
    with pytest.raises(ValueError, match="`out`"):
        run(make(folder, done, scorer="mertens"), "local", lambda *_: None)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Ray, of its own settings
def test_a_cluster_of_two_nodes_loses_nothing_with_a_worker(folder, done, tmp_path, monkeypatch):
    pytest.importorskip("ray", reason="needs the extra ray, in an environment of its own")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    import ray
    from ray.cluster_utils import Cluster

    options = {"num_cpus": 2, "object_store_memory": 2**27}
    cluster = Cluster(initialize_head=True, head_node_args=options)
    try:
        cluster.add_node(**options)
        ray.init(address=cluster.address)
        plan = make(folder, tmp_path / "ray", per_shard=1)
        plan.begin()
        nodes = set()
        for told in _on_ray(plan, plan.missing(), "auto", 2):
            if not nodes:  # whoever has made the first shard
                os.kill(int(told["process"]), signal.SIGKILL)
            nodes.add(told["node"])
        assert len(nodes) == 2
        assert plan.missing() == []
    finally:
        ray.shutdown()
        cluster.shutdown()
    alone = make(folder, tmp_path / "alone", per_shard=1)
    run(alone, "local", lambda *_: None)
    assert contents(tmp_path / "ray") == contents(tmp_path / "alone")
