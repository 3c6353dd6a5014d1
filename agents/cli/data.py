"""Data: ``ae-env scenes``, ``record``, ``score-tables``, ``cache`` and ``warm-up``."""

import logging
import tempfile
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer
from typer import Argument, Option

from agents.cli import console
from agents.cli.console import print_files, print_line, progress_bars

_EXAMPLE = "Sets of real scenes.\n\nExample: `ae-env scenes download`"
scenes = typer.Typer(no_args_is_help=True, callback=lambda: None, help=_EXAMPLE)

#: Environments whose first frames need the compiled code of all environments between them.
_CASES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("AutoExposure-v0", {}),
    ("AutoExposure-v0", {"device": "cpu"}),
    ("AutoExposure-v0", {"observation": "statistics"}),
    ("AutoExposure-v0", {"observation": "linear", "lighting": "flicker"}),
    ("AutoExposure-v0", {"observation": "dn", "noise": "exact"}),
    ("AutoExposure-v0", {"noise": "sensor", "camera": "canon_5d4", "scenes": "bundled:small"}),
    ("AutoExposure-v0", {"split": "test", "source": "raw"}),
    ("AutoExposureVideo-v0", {}),
    ("ExposureBracket-v0", {}),
)


@scenes.command()
def download(
    url: Annotated[
        str | None, Option(help="Another server's folder that holds NAME_1k.hdr.")
    ] = None,
) -> None:
    """Fetch Poly Haven's panoramas (CC0) for `--scenes polyhaven`; a second run resumes the first.

    They go to the cache folder (`ae-env cache` names it). Those that AE_ENV_DATA holds are not
    fetched. A proxy is taken from the environment.

    Example: `ae-env scenes download`
    """
    from ae_env.scenes.polyhaven import URL, download, list_assets

    with progress_bars() as progress, progress("maps") as task:
        fetched = download(url=url or URL, progress=task)
    print_line(f"{len(fetched)} of {len(list_assets())} maps were fetched, all are there")
    print_line("try next: ae-env quickstart --scenes polyhaven --out real_scenes")


@console.takes_source
def record(
    policy: Annotated[str, Option(help="The policy that acts.")],
    out: Annotated[str, Option("--out", "-o", help="Name, such as ae_env/matrix-v0.")],
    task: Annotated[
        str, Option(help="AutoExposure-v0 or AutoExposureVideo-v0.")
    ] = "AutoExposure-v0",
    env: Annotated[str | None, Option(help="Preset of the environment, or a YAML file.")] = None,
    scenes: Annotated[str | None, Option(help="Scenes to draw from.")] = None,
    split: Annotated[str | None, Option(help="train (default), validation, test or all.")] = None,
    episodes: Annotated[int, Option(help="How many.", min=1, max=1_000_000)] = 200,
    seed: console.Seed = 0,
    trust: console.Trust = False,
    source: Any = None,
) -> None:
    """Record episodes of a policy as a Minari dataset.

    It lies in Minari's folder, or in that of MINARI_DATASETS_PATH; `minari list local` shows it.

    Example: `ae-env record --policy matrix:tuned -o ae_env/matrix-v0`
    """
    import gymnasium as gym

    from ae_env.utils.user_files import load_preset
    from agents.evaluation.engine import fit_policies
    from agents.policy import PolicyContext
    from agents.policy_names import check_policy, make_policy
    from agents.recording import check_dataset_id, record_dataset
    from agents.rollouts import fitting_arguments
    from simulator.utils.checks import check_word

    console.trust_configuration(trust)
    check_word("task", task, ("AutoExposure-v0", "AutoExposureVideo-v0"))
    check_dataset_id(out)
    check_policy(policy)
    options: dict[str, Any] = {"split": "train"} | ({} if env is None else load_preset(env))
    given = {"split": split, "scenes": console.scene_files(scenes, "stop", source)}
    options |= {name: value for name, value in given.items() if value is not None}
    task = f"ae_env/{task}"
    with closing(gym.make_vec(f"ae_env:{task}", num_envs=1, **options)) as envs:
        acting = make_policy(policy, PolicyContext.from_envs(envs))
        arguments = {k: v for k, v in options.items() if k != "max_episode_steps"}
        arguments |= {"grid": "video"} if "Video" in task and "grid" not in arguments else {}
        arguments = fitting_arguments(arguments, options.get("resolution", 64))
    with progress_bars() as progress:
        with progress("fitting") as bar:
            fit_policies({policy: acting}, arguments, seed=seed, progress=bar)
        with progress("episodes") as bar:
            dataset = record_dataset(
                acting, policy, task, options, out, episodes=episodes, seed=seed, progress=bar
            )
    mean = sum(one.rewards.sum() for one in dataset.iterate_episodes()) / dataset.total_steps
    console.terminal.print(f"{dataset.total_steps:,} steps, mean reward {mean:.3f}")
    print_line(f'read it with: minari.load_dataset("{out}")')


@console.takes_source
def score_tables(
    what: Annotated[
        str, Argument(help="A folder or glob of raws and radiance maps, or one of them.")
    ],
    out: Annotated[Path, Option("--out", "-o", help="Folder for the shards.")] = Path(
        "score_tables"
    ),
    on: Annotated[
        str,
        Option(
            help="local: this process; ray: a Ray on this machine; or a cluster's address, such as "
            "ray://head:10001 or auto."
        ),
    ] = "local",
    workers: Annotated[int, Option(help="Processes on Ray.", min=1)] = 2,
    per_shard: Annotated[int, Option(help="Files of a shard.", min=1)] = 16,
    resolution: Annotated[int, Option(help="Packed pixels a side.", min=1)] = 64,
    grid: Annotated[
        str, Option(help="Exposure grid: default, third_stop, video, bracket.")
    ] = "default",
    scorer: Annotated[str, Option(help="Scorer, as for `evaluate`.")] = "balanced",
    camera: Annotated[str, Option(help="Camera for radiance maps.")] = "nikon_z6",
    weights: Annotated[str, Option(help="Networks that denoise the raws, or none.")] = "compact",
    captures: Annotated[bool, Option(help="Also write the captures.")] = False,
    seed: console.Seed = 0,
    source: Any = None,
) -> None:
    """Score every exposure state of many raws or radiance maps; writes Parquet, shard by shard.

    Run it again to continue. Needs the extra `tables`; a cluster the extra `ray`.

    Example: `ae-env score-tables path/to/raws -o tables`
    """
    from ae_env.grid import ExposureGrid
    from ae_env.scenes.load import check_weights
    from ae_env.scorers import make_scorer
    from agents.score_shards import ShardPlan, check_engine, run
    from simulator import get_camera
    from simulator.utils.checks import import_extra

    import_extra("pyarrow", "tables", "`ae-env score-tables`")
    check_engine(on)
    ExposureGrid.from_spec(grid), make_scorer(scorer), get_camera(camera)
    if weights != "none":
        check_weights(weights)
    options: dict[str, Any] = {"resolution": resolution, "camera": camera, "grid": grid}
    options |= {"per_shard": per_shard, "scorer": scorer, "weights": weights, "settings": source}
    plan = ShardPlan.of(what, out, **options, captures=captures, seed=seed)
    console.make_folder(out)
    begun = perf_counter()
    with progress_bars() as progress, progress("shards") as task:
        made = run(plan, on, task, workers)
    if not made:
        print_line("every shard was there already")
        return
    scenes, bad = (sum(int(one[name]) for one in made) for name in ("scenes", "bad"))
    seconds = perf_counter() - begun
    print_line(f"{scenes} scenes in {seconds:.1f} s, {bad} files that could not be read")
    if bad:
        reason = next(one["reason"] for one in made if one["bad"])
        print_line(f"which and why: {out}/bad-*.jsonl; the first is {reason}")
    if not scenes:
        raise ValueError(f"`what` (={what!r}): none of its files could be made a scene")
    print_files({"score tables": out / "tables-*.parquet"})


def latitude(
    detector: Annotated[
        str, Argument(help="codes, tags, text, faces, tracks, model.onnx or my_file.py:Name.")
    ],
    pictures: Annotated[str, Argument(help="A picture, raw or radiance map, a folder, or a glob.")],
    out: Annotated[Path, Option("--out", "-o", help="Folder for results.")] = Path("latitude"),
    size: Annotated[int, Option(help="Longer side of pictures [pixel].", min=36, max=4096)] = 512,
    camera: Annotated[str, Option(help="Camera whose noise counts.")] = "nikon_z6",
) -> None:
    """Measure over which exposures, ISO speeds and blurs a detector works; a plot and a CSV.

    It is called with (H, W, 3) uint8 and returns a truth value, a label, or a list of them.

    Example: `ae-env latitude my_file.py:MyDetector path/to/pictures`
    """
    from agents.applications.latitude import load_detector, measure_latitude, picture_scenes
    from simulator import get_camera
    from simulator.utils.files import write_atomically

    found, scenes = load_detector(detector), picture_scenes(pictures, get_camera(camera), size)
    console.make_folder(out)
    with progress_bars() as progress, progress("pictures") as task:
        result = measure_latitude(found, scenes, task)
    files = {"shares": out / "latitude.csv", "plot": out / "latitude.png"}
    write_atomically(files["shares"], result.rows.to_csv(index=False, float_format="%.6g"))
    result.plot(files["plot"])
    for line in result.lines():
        print_line(line)
    print_files(files)


def cache(clear: Annotated[bool, Option("--clear", help="Remove all of it.")] = False) -> None:
    """Show what is cached between runs (scenes, networks' outputs), or clear it.

    Example: `ae-env cache --clear`; the folder is another one where AE_ENV_CACHE names it.
    """
    from simulator.utils.cache import DISK_BYTES, disk_cache

    disk = disk_cache()
    usage = disk.usage()
    if clear:
        disk.clear()
    rows = [(kind.replace("_", " "), *(f"{n:,}" for n in own)) for kind, own in usage.items()]
    title = "removed" if clear else f"cached, at most {DISK_BYTES >> 30} GiB"
    console.print_table(title, rows, "kind", "files", "bytes", numbers=True)
    print_line(f"folder: {disk.folder}")


def warm_up() -> None:
    """Compile the simulator and draw the bundled scenes, as a container's build would.

    Both are kept: the code beside the sources or in NUMBA_CACHE_DIR, the scenes in AE_ENV_CACHE.
    So that all processors of a cluster have code, run it on one of each model.

    Example: `ae-env warm-up`
    """
    import gymnasium as gym
    import numpy as np

    from agents.rollouts import scenes_of

    logging.getLogger("simulator.utils.compute").setLevel(logging.ERROR)  # it proposes this command
    with progress_bars() as progress, progress("warming up") as task:
        for done, (name, arguments) in enumerate(_CASES):
            task(done, len(_CASES) + 1, ", ".join([name, *map(str, arguments.values())]))
            with closing(gym.make_vec(f"ae_env:ae_env/{name}", num_envs=16, **arguments)) as envs:
                scenes_of(envs)  # draws every one
                envs.reset(seed=0)
                for _ in range(4):
                    envs.step(np.arange(16))
        task(len(_CASES), len(_CASES) + 1, "raw files and the viewer")
        _use_rest()
        task(len(_CASES) + 1, len(_CASES) + 1)
    console.terminal.print("try next: ae-env quickstart")


def _use_rest() -> None:
    """Compiles what those environments do not use: raw files, the viewer, blur along rows."""
    import numpy as np
    import torch

    from agents.cli.show import DEFAULT_SCENES
    from agents.viewer.viewed_scene import View, ViewedScene, find_scenes
    from simulator import CameraSimulator, RawImage, estimate_nlf, read_raw
    from simulator.capture.blurred_frames import BLUR, BlurredFrames
    from simulator.capture.blurred_light import MapApertureBlur
    from simulator.capture.prepared_scene import PreparedScene
    from simulator.capture.statistics import DenoisedLight, Residual
    from simulator.noise.generator import frame_normals
    from simulator.optics.discs import disc_blur
    from simulator.optics.motion import motion_blur
    from simulator.radiance.procedural import draw

    library = find_scenes(DEFAULT_SCENES)
    viewed = ViewedScene(library.open(library.first), CameraSimulator(device="cpu"))
    view = View(viewed.best(), speed=5.0, defocus=4.0)
    viewed.readout(view, viewed.picture(view).capture)
    with tempfile.TemporaryDirectory() as folder:
        raw = read_raw(viewed.write_dng(Path(folder, "any.dng"), view))
    estimate_nlf(raw.data)
    numbers = raw.to_mosaic().astype(np.float64)  # files hold integers
    light = RawImage.from_mosaic(numbers, raw.settings, raw.camera).data
    disc_blur(motion_blur(light, 2.5), 2.5)
    frame_normals(0, (1, 1, 1))
    noise = raw.camera.nlf(raw.settings.iso)
    scene = PreparedScene(light, raw.settings, raw.camera, noise)
    scene.expose([raw.settings] * 2)
    opens = MapApertureBlur(light, torch.ones(light.shape[1:]), 32.0)
    networks = (DenoisedLight(light, residual=Residual.alike(0.1)),)
    whole = replace(scene, aperture_blur=opens, denoised_lights=networks, tolerance=0.0)
    whole.plan(replace(raw.settings, iso=raw.settings.iso / 8.0, exposure_time=1.0))
    vignetting = np.ones(light.shape[1:], np.float32)
    blurs = np.array([(0.0, 2.5, True, *[0] * 10, vignetting.ctypes.data)], BLUR)
    first = np.zeros(1, np.int64)
    frames = BlurredFrames(1, 1, 0)
    frames.run(frames.plan(first, first, blurs, frames.places([light]), first)[1])
    draw("dead_leaves", np.random.default_rng(0))  # the scenes may all have been in the cache
