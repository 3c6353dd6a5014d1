"""Score tables and captures of many files, shard by shard, in one process or on a Ray cluster.

A shard is a few files. Its results are written when it is whole, so that a run that was stopped
continues with the shards that are missing, and a worker that is lost costs one shard's work.
"""

import importlib.util
import json
import os
import socket
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, Self

import numpy as np
import torch
from filelock import FileLock
from safetensors.torch import save

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.folder import find_files, is_raw
from ae_env.scenes.load import SceneNetworks
from ae_env.scorers import make_scorer
from ae_env.scorers.captures import prepare_scene
from ae_env.scorers.score_table import ScoreTables
from simulator import get_camera
from simulator.utils.files import printable, write_atomically

#: What is known of a run besides its shards.
PLAN = "plan.json"
_LOCAL, _RAY = "local", "ray"


@dataclass(frozen=True)
class ShardPlan:
    """The work of a run; every shard is made from it and its own number alone.

    `files` are raws and radiance maps as the workers find them, `names` those in the tables; `out`
    is a folder that all workers reach. Scenes are averaged to `resolution` packed pixels a side;
    `camera` photographs radiance maps, a raw has its own, and its own settings but for `settings`;
    `seed` is that of the captures' noise.
    """

    files: tuple[str, ...]
    names: tuple[str, ...]
    out: str
    per_shard: int = 16
    resolution: int = 64
    camera: str = "nikon_z6"
    grid: str = "default"
    scorer: str = "balanced"
    weights: str = "compact"
    captures: bool = False
    seed: int = 0
    settings: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, what: str, out: Path, **options: Any) -> Self:
        """The plan for a file, folder or glob of raws and radiance maps."""
        base, files = find_files(what)
        names = [printable(str(f.relative_to(base)) if f != base else f.name) for f in files]
        paths = tuple(str(file.resolve()) for file in files)
        return cls(paths, tuple(names), str(out.resolve()), **options)

    @property
    def shards(self) -> range:
        """Numbers of the shards."""
        return range(-(-len(self.files) // self.per_shard))

    def table(self, shard: int) -> Path:
        """Where a shard's score tables are; the file is written last."""
        return Path(self.out, f"tables-{shard:05d}.parquet")

    def missing(self) -> list[int]:
        """Shards that are still to be made."""
        return [shard for shard in self.shards if not self.table(shard).exists()]

    def begin(self) -> None:
        """Writes the plan, or raises a `ValueError` where the folder's is another."""
        path, text = Path(self.out, PLAN), json.dumps(asdict(self), indent=1).encode()
        with FileLock(path.with_name(f".{PLAN}.lock")):
            if path.exists() and path.read_bytes() != text:
                raise ValueError(
                    f"`out` (={self.out!r}) holds the tables of other files or options, see {PLAN}:"
                    " give another folder, or delete that one"
                )
            write_atomically(path, text)


class ShardWriter:
    """Makes shards; what does not depend on the shard is loaded once."""

    def __init__(self, plan: ShardPlan) -> None:
        self.plan = plan
        self._grid = ExposureGrid.from_spec(plan.grid)
        self._camera = get_camera(plan.camera)
        self._scorer = make_scorer(plan.scorer)
        self._tables: dict[str, ScoreTables] = {}
        self._networks = None if plan.weights == "none" else SceneNetworks(plan.weights)

    def write(self, shard: int) -> dict[str, Any]:
        """Writes a shard; tells how many scenes and bad files it has, seconds and process."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        begun, plan = perf_counter(), self.plan
        columns: dict[str, list[Any]] = {}
        bad: list[dict[str, str]] = []
        frames: dict[str, torch.Tensor] = {}
        scenes = 0
        own = slice(shard * plan.per_shard, (shard + 1) * plan.per_shard)
        for path, name in zip(plan.files[own], plan.names[own], strict=True):
            try:
                spec = {"path": path, "settings": plan.settings} if is_raw(path) else path
                found = load_scenes(spec, "all", camera=self._camera, resolution=plan.resolution)
                if self._networks is not None:
                    found = [self._networks.denoised(scene) for scene in found]
            except (ValueError, OSError) as error:
                bad.append({"file": name, "error": " ".join(str(error).split())})
                continue
            for scene in found:
                for column, values in self._rows(name, scene).items():
                    columns.setdefault(column, []).extend(values)
                if plan.captures:
                    frames[f"{name}:{scene.scene_id}"] = self._captures(scene)
                scenes += 1
        stem = f"{shard:05d}"
        if frames:
            write_atomically(Path(plan.out, f"captures-{stem}.safetensors"), save(frames))
        if bad:
            text = "".join(json.dumps(line) + "\n" for line in bad)
            write_atomically(Path(plan.out, f"bad-{stem}.jsonl"), text)
        sink = pa.BufferOutputStream()
        pq.write_table(pa.table(columns), sink)
        write_atomically(plan.table(shard), sink.getvalue().to_pybytes())
        return {
            "shard": shard,
            "scenes": scenes,
            "bad": len(bad),
            "reason": f"{bad[0]['file']}: {bad[0]['error']}" if bad else "",
            "seconds": perf_counter() - begun,
            "node": socket.gethostname(),
            "process": os.getpid(),
        }

    def _rows(self, name: str, scene: Scene) -> dict[str, list[Any]]:
        """Columns of a scene's states."""
        key = repr(scene.camera)
        if key not in self._tables:
            self._tables = {key: ScoreTables(self._grid, scene.camera, self._scorer)}
        table = self._tables[key].table(scene)
        count, states = len(self._grid), self._grid.states
        return {
            "file": [name] * count,
            "scene": [scene.scene_id] * count,
            "state": list(range(count)),
            "iso": [s.iso for s in states],
            "exposure_time": [s.exposure_time for s in states],
            "f_number": [s.f_number for s in states],
            "ev100": self._grid.ev100.tolist(),
            "score": table.mean.tolist(),
            **{f"score_{part}": values.tolist() for part, values in table.parts.items()},
            "best": (np.arange(count) == table.oracle).tolist(),
        }

    def _captures(self, scene: Scene) -> torch.Tensor:
        """(S, 4, R, R) uint16 digital numbers of every state's capture."""
        camera = scene.camera
        frames = prepare_scene(scene, camera).expose(self._grid.states, seed=self.plan.seed)
        black, span = (torch.tensor(v).reshape(4, 1, 1) for v in (camera.black_level, camera.span))
        return (frames * span + black).round().to(torch.uint16)


def run(
    plan: ShardPlan, on: str, progress: Callable[[int, int], None], workers: int = 1
) -> list[dict[str, Any]]:
    """Makes the shards that are missing; what `ShardWriter.write` tells of each.

    `on` is ``"local"``: in this process; ``"ray"``: on a Ray of this machine alone; or an address
    such as ``"ray://head:10001"`` or ``"auto"``: on that cluster, in so many `workers`.
    """
    check_engine(on)
    plan.begin()
    todo, total = plan.missing(), len(plan.shards)
    progress(total - len(todo), total)
    if not todo:
        return []
    local = on == _LOCAL
    shards = map(ShardWriter(plan).write, todo) if local else _on_ray(plan, todo, on, workers)
    made = []
    for shard in shards:
        made.append(shard)
        progress(total - len(todo) + len(made), total)
    return made


def check_engine(on: str) -> None:
    """Checks `on`, see `run`; an `ImportError` names the extra where Ray is not there."""
    if on not in (_LOCAL, _RAY, "auto") and ":" not in on:
        raise ValueError(f"`on` (={on!r}) must be local, ray, auto or the address of a cluster")
    if on != _LOCAL and importlib.util.find_spec("ray") is None:
        raise ImportError(
            "a cluster needs the extra ray, in an environment of its own: pip install 'ae-env[ray]'"
        )


class _RayWorker:
    """A `ShardWriter` in a process of the cluster, one thread each."""

    def __init__(self, plan: ShardPlan) -> None:
        torch.set_num_threads(1)
        self._writer = ShardWriter(plan)

    def __call__(self, batch: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        import ray

        node = ray.get_runtime_context().get_node_id()
        made = [self._writer.write(int(shard)) | {"node": node} for shard in batch["shard"]]
        return {name: np.array([one[name] for one in made]) for name in made[0]}


def _on_ray(
    plan: ShardPlan, todo: list[int], address: str, workers: int
) -> Iterator[dict[str, Any]]:
    import ray

    if not ray.is_initialized():
        own = {"num_cpus": workers, "include_dashboard": False, "object_store_memory": 2**28}
        ray.init(**(own if address == _RAY else {"address": address}))
    # Few workers for the whole run, each with its networks and its compiled code: one cache of
    # numba's per node, beside the installed package. Ray starts a lost one anew and gives its
    # shard to another.
    shards = [{"shard": shard} for shard in todo]
    done = ray.data.from_items(shards, override_num_blocks=len(todo)).map_batches(
        _RayWorker,
        fn_constructor_args=(plan,),
        batch_size=1,
        compute=ray.data.ActorPoolStrategy(size=workers),
        num_cpus=1,
        scheduling_strategy="SPREAD",
    )
    yield from map(dict, done.iter_rows())
