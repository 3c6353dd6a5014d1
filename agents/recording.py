"""Episodes of a policy as a Minari dataset, for offline reinforcement learning and imitation."""

import os
import re
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from filelock import FileLock, Timeout

from agents.policy import Policy
from agents.rollouts import checked_states, choose, errors_of
from simulator.utils.checks import import_extra

_minari = partial(import_extra, "minari", "minari", "a dataset")
#: The variable that names Minari's folder.
_ROOT = "MINARI_DATASETS_PATH"
#: Minari's form of a name: namespaces (two letters or more), the dataset and its version.
_ID = re.compile(r"([\w-][\w/-]*[\w-]/)?[\w-]+-v\d+")


def check_dataset_id(dataset_id: str) -> None:
    """Checks that a dataset of this name can be written, and that the extra is installed."""
    if not _ID.fullmatch(dataset_id):
        rule = "must be a name of letters, digits, - and _, after a namespace of two or more or "
        rule += "none, and end in -vNUMBER, such as 'ae_env/matrix-v0'"
        raise ValueError(f"`out` (={dataset_id!r}) {rule}")
    with _writing(dataset_id), _reserved(dataset_id):
        pass


def record_dataset(
    policy: Policy,
    name: str,
    task: str,
    options: Mapping[str, Any],
    dataset_id: str,
    *,
    episodes: int,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Any:
    """Runs `policy` and writes what it saw, chose and got; returns the `minari.MinariDataset`.

    Observations are stored as they are, not as JPEG. Every episode has its ``seed`` and, as its
    reset option, its scene: ``env.reset(seed=seed, options=options)`` begins it again.

    Args:
        policy, name: The policy, for one environment, and its name, that of the algorithm.
        task, options: Id of the environment, such as ``"ae_env/AutoExposure-v0"``, and its
            arguments, JSON values.
        dataset_id: Name of the dataset in Minari's folder (MINARI_DATASETS_PATH names another). It
            appears there when all episodes are recorded.
        episodes: How many; episode i has the seed ``seed + i``.
        progress: Called with the episodes that are done, and all.

    Raises:
        UserCodeError: If the policy raises, or chooses what is no allowed state.
        ValueError: If there is a dataset of that name, or another process records one.
        OSError: If Minari's folder cannot be written, or the disk is full.
    """
    check_dataset_id(dataset_id)
    minari, report = _minari(), progress or (lambda *_: None)
    oracle = {"with_oracle": True} if getattr(policy, "privileged", False) else {}
    oracle |= {"with_subject": True} if getattr(policy, "needs_subject", False) else {}
    with ExitStack() as opened:
        with _writing(dataset_id):  # reserved while the environment loads, too
            folder = opened.enter_context(_reserved(dataset_id))
        env = opened.enter_context(closing(gym.make(f"ae_env:{task}", **{**options, **oracle})))

        def recorded() -> Iterator[Any]:
            for i in range(episodes):
                report(i, episodes)
                content = _record_episode(env, policy, name, seed + i)
                size = sum(np.asarray(value).nbytes for value in content["observations"].values())
                with tempfile.TemporaryFile(dir=folder) as file:  # HDF5 crashes on a full disk
                    file.write(bytes(2 * size + 2**20))  # chunks not full, and what describes them
                yield minari.data_collector.EpisodeBuffer(id=i, **content)
            report(episodes, episodes)

        with _writing(dataset_id), _datasets_in(folder):
            found = recorded()
            dataset = minari.create_dataset_from_buffers(
                dataset_id,
                [next(found)],
                env=env,
                algorithm_name=name,
                description=f"{episodes} episodes of {name} in {task}, seeds from {seed}",
                requirements=["ae-env"],
                data_format="hdf5",
                jpeg_encoding=False,
            )
            for one in found:  # each is on disk before there must be room for the next
                dataset.storage.update_episodes([one])
        with _writing(dataset_id):
            namespace = dataset_id.rpartition("/")[0]
            if namespace and namespace not in minari.namespace.list_local_namespaces():
                minari.namespace.create_namespace(namespace)
            (folder / dataset_id).rename(folder.parent / dataset_id)
    return minari.load_dataset(dataset_id)


@contextmanager
def _writing(dataset_id: str) -> Iterator[None]:
    """Errors within, of the disk or of another process, name the dataset."""
    try:
        yield
    except Timeout:
        rule = "is being recorded by another process: take another name, or wait"
        raise ValueError(f"`out` (={dataset_id!r}) {rule}") from None
    except OSError as error:
        named = os.environ.get(_ROOT)
        where = named or "Minari's folder" + f" ({_ROOT} is empty)" * (named is not None)
        reason = f"`out` (={dataset_id!r}) cannot be written to {where}: {error.strerror or error}"
        raise OSError(error.errno, reason) from error


@contextmanager
def _reserved(dataset_id: str) -> Iterator[Path]:
    """An empty folder in Minari's, for a dataset that nobody has recorded or may meanwhile.

    Folders that processes left which have died are removed.
    """
    minari = _minari()

    @contextmanager
    def emptied(folder: Path) -> Iterator[None]:
        with FileLock(f"{folder}.lock", timeout=0):
            try:
                shutil.rmtree(folder, ignore_errors=True)
                yield
            finally:
                shutil.rmtree(folder, ignore_errors=True)
                Path(f"{folder}.lock").unlink(missing_ok=True)

    root = minari.storage.get_dataset_path("").resolve()  # Minari fails in a relative one
    for left in filter(Path.is_dir, root.glob(".unfinished-*")):
        with suppress(Timeout), emptied(left):
            pass
    folder = root / f".unfinished-{dataset_id.replace('/', '.')}"  # a name holds no point
    with emptied(folder):
        if dataset_id in minari.list_local_datasets() or (root / dataset_id).exists():
            rule = f"take a higher version, or remove it with `minari delete {dataset_id}`"
            raise ValueError(f"`out` (={dataset_id!r}) is there already: {rule}")
        folder.mkdir()
        yield folder


@contextmanager
def _datasets_in(folder: Path) -> Iterator[None]:
    """Within, Minari writes to `folder`: a dataset is moved to its place when it is finished."""
    before = os.environ.get(_ROOT)
    os.environ[_ROOT] = str(folder)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that there is no author's address
            yield
    finally:
        os.environ.pop(_ROOT)
        if before is not None:
            os.environ[_ROOT] = before


def _record_episode(env: gym.Env[Any, Any], policy: Policy, name: str, seed: int) -> dict[str, Any]:
    """What an `EpisodeBuffer` of Minari holds of one episode."""
    observation, info = env.reset(seed=seed)
    seen, scene = {key: [value] for key, value in observation.items()}, info["scene_id"]
    steps: list[tuple[Any, ...]] = []
    with errors_of(name, "reset"):
        policy.reset(1, seed=seed)
    done = False
    while not done:
        shown = {key: np.asarray(value)[None] for key, value in observation.items()}
        masks = np.asarray(env.unwrapped.action_masks())[None]  # type: ignore[attr-defined]
        told = {name: np.array([info.get(name)]) for name in ("oracle_state", "subject")}
        state = checked_states(name, choose(name, policy, shown, masks, told), masks)[0]
        observation, reward, terminated, truncated, info = env.step(state)
        done = terminated or truncated
        steps.append((state, reward, terminated, truncated))
        for key, value in observation.items():
            seen[key].append(value)
    columns = ("actions", "rewards", "terminations", "truncations")
    own = dict(zip(columns, map(list, zip(*steps, strict=True)), strict=True))
    return {"seed": seed, "options": {"scene": scene}, "observations": seen, **own}
