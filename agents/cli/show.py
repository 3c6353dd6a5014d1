"""Looking at scenes, episodes and scorers: ``ae-env view``, ``judge``, ``film``, ``scorers``."""

from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from agents.cli import console
from agents.cli.console import print_files, print_line, print_table, progress_bars
from agents.cli.simulate import make_simulator
from simulator.utils.checks import import_extra

#: What is shown where nothing is named; `ae-env warm-up` draws it.
DEFAULT_SCENES = "bundled:small"
Port = Annotated[int, Option(help="Port to serve at; 0 for any.", min=0, max=65535)]
Opens = Annotated[bool, Option("--open/--no-open", help="Open the page in the default browser.")]
#: Policies of a film where none is given.
POLICIES = ("average:tuned", "average:tuned?foresight=model", "regression:video?foresight=learnt")


@console.takes_source
def view(
    what: Annotated[
        str,
        Argument(
            metavar="[RAW|FOLDER|SCENE]",
            help="A raw or radiance map, a folder of them, scenes such as bundled or polyhaven, or "
            "the id of a bundled scene.",
        ),
    ] = DEFAULT_SCENES,
    port: Port = 0,
    open_browser: Opens = True,
    scorer: Annotated[str, Option(help="Scorer, as for `evaluate`.")] = "balanced",
    weights: console.Weights = "compact",
    depth: console.Depth = "far",
    tolerance: console.Tolerance = console.TOLERANCE,
    device: console.Device = "auto",
    cache: console.Cache = True,
    source: Any = None,
) -> None:
    """Look at a scene in the browser: any settings, all scores, episodes of two policies.

    The page is served to this machine alone, until Ctrl-C. Needs the extra `view`.

    Example: `ae-env view IMG_0001.CRW`
    """
    import_extra("nicegui", "view", "`ae-env view`")
    from ae_env.scorers import make_scorer
    from agents.viewer.page import Options, show_page
    from agents.viewer.server import free_port, serve
    from agents.viewer.viewed_scene import find_scenes
    from simulator.capture.limits import check_tolerance

    check_tolerance(tolerance)
    make_scorer(scorer)
    port = free_port(port)
    simulator = make_simulator(weights, device, cache, depth)
    with progress_bars() as progress, progress("scenes") as task:
        library = find_scenes(what, source)
        task(1, 1)
    how = {"depth": depth, "tolerance": tolerance, "scorer": scorer}
    options = Options(library, simulator, how)
    serve("ae-env view", partial(show_page, options), options.folder, port, open_browser)


def judge(
    choices: Annotated[
        list[Path] | None, Argument(metavar="[CSV]...", help="Of --fit: files of choices.")
    ] = None,
    fit: Annotated[bool, Option("--fit", help="Tell what the files say; ask nothing.")] = False,
    scenes: Annotated[str, Option(help="'bundled', 'polyhaven', raws or maps.")] = "bundled",
    split: Annotated[str, Option(help="train, validation, test or all.")] = "test",
    resolution: Annotated[int, Option(help="Packed pixels a side of a frame.", min=36)] = 256,
    pairs: Annotated[int, Option(help="Pairs to choose from.", min=1, max=10_000)] = 60,
    name: Annotated[str, Option("--judge", help="Name or id of who chooses.")] = "anonymous",
    out: Annotated[
        Path | None, Option(help="CSV of the choices (choices.csv); of --fit, a folder (judging).")
    ] = None,
    seed: console.Seed = 0,
    port: Port = 0,
    open_browser: Opens = True,
) -> None:
    """Choose the better of two frames, blind; with --fit, compare scorers with the choices.

    The page is served to this machine alone, until Ctrl-C, and needs the extra `view`.

    Example: `ae-env judge --judge ann --out ann.csv`, then `ae-env judge --fit ann.csv`
    """
    import tempfile

    from agents.report.judging import Judging, draw_pairs, judged_scenes, write_fit

    if fit != bool(choices):
        raise ValueError(f"`choices` (={list(map(str, choices or ()))}) must come with --fit")
    if choices:
        console.make_folder(out or Path("judging"))
        files = write_fit(choices, out or Path("judging"), console.command_line())
        print_line(files[1].read_text(encoding="utf-8"))
        print_files({file.name: file for file in files})
        return
    import_extra("nicegui", "view", "`ae-env judge`")
    from agents.viewer.judge_page import show_pairs
    from agents.viewer.page import PictureStore
    from agents.viewer.server import free_port, serve

    path, port = out or Path("choices.csv"), free_port(port)
    console.check_outputs(out=(path, ".csv"))
    source: dict[str, Any] = {"scenes": scenes, "split": split, "resolution": resolution}
    with progress_bars() as progress, progress("pairs") as task:
        found = judged_scenes(**source)
        draw = partial(draw_pairs, found, pairs, seed, task, **source)
        judging = Judging(path, name, found, draw)
    print_line(f"{judging.done} of {len(judging.pairs)} pairs of {path} are chosen from")
    show = partial(show_pairs, judging, found, PictureStore())
    serve("ae-env judge", show, tempfile.TemporaryDirectory(), port, open_browser)


@console.takes_source
def film(
    policy: console.Policies = None,
    light: Annotated[
        str, Option(help="Kind of moving light: tunnels, sines, shadows, clouds, pans...")
    ] = "tunnels",
    scenes: Annotated[str, Option(help="Scenes to draw from.")] = "bundled",
    scene: Annotated[str | None, Option(help="Id of the scene; drawn by default.")] = None,
    frames: Annotated[int, Option(help="Actions of the episode.", min=1, max=10_000)] = 64,
    seed: console.Seed = 0,
    out: Annotated[Path, Option(help="The animated GIF.")] = Path("film.gif"),
    source: Any = None,
) -> None:
    """Film one episode of AutoExposureVideo-v0: policies side by side, in the same moving light.

    Example: `ae-env film --policy average:tuned --policy ppo:video --light shadows`
    """
    import gymnasium as gym

    from ae_env.lighting.moving import KIND_SETS, MOVES
    from agents.evaluation.engine import fit_policies
    from agents.policy import PolicyContext
    from agents.policy_names import check_policy, make_policy
    from agents.report.film import record, write_film
    from agents.rollouts import scenes_of
    from simulator.utils.checks import check_word, did_you_mean

    console.check_outputs(out=(out, ".gif"))
    check_word("light", light, (*MOVES, *KIND_SETS))
    for name in policy or POLICIES:
        check_policy(name)
    options: dict[str, Any] = {"scenes": console.scene_files(scenes, "stop", source)}
    options |= {"split": "test", "max_episode_steps": frames + 1}
    options |= {"lighting": {"kind": "moving", "kinds": light}, "with_oracle": True}
    options |= {"with_subject": True, "render_mode": "rgb_array"}
    envs = gym.make_vec("ae_env/AutoExposureVideo-v0", num_envs=1, **options)
    with closing(envs), progress_bars() as progress:
        if scene is not None:
            known = [one.scene_id for one in scenes_of(envs)]
            if scene not in known:
                rule = f"must be an id of {scenes!r}, such as {known[0]!r}"
                raise ValueError(f"`scene` (={scene!r}) {rule}{did_you_mean(scene, known)}")
        context = PolicyContext.from_envs(envs)
        policies = {name: make_policy(name, context) for name in policy or POLICIES}
        with progress("fitting") as task:
            fit_policies(policies, {"scenes": "bundled", "grid": "video"}, progress=task, keep=True)
        with progress("film") as task:
            episodes = [record(n, p, envs, frames, seed, scene) for n, p in policies.items()]
            write_film(out, episodes, task)
    print_files({"film": out})


def scorers() -> None:
    """List all known scorers, those of installed packages included.

    Example: `ae-env scorers` lists them; docs/plug-in-a-scorer.md says how to add one.
    """
    from ae_env.scorers.registry import describe_scorers

    rows = []
    for row in describe_scorers():
        what = f"broken: {row.error}" if row.error else row.summary
        what += f" Needs {row.needs}." if row.needs else ""
        what += f" From {row.package}." if row.package != "ae-env" else ""
        rows.append((row.name, row.domain, row.depends_on, what))
    title = "scorers: all in [0, 1], higher is better"
    print_table(title, rows, "name", "sees", "depends on", "what it is")
    print_line("and by name: my_file.py:MyScore, package.module:MyScore, pyiqa:METRIC")


def policies() -> None:
    """List the built-in policies and their options.

    Example: `ae-env policies` lists them; docs/policies.md says more.
    """
    from agents.policy_names import ABOUT, default_options

    print_table("policies", ABOUT.items(), "name", "what it is")
    for name in ("average", "rpi_agc", "regression", "bracket:fixed"):
        named = default_options(name).items()
        options = ", ".join(key if value is None else f"{key}={value}" for key, value in named)
        print_line(f"options of {name if name != 'average' else 'METER:PROGRAM'}: {options}")
    print_line("for example: matrix:tuned?foresight=learnt&compensation=-1")


def cameras() -> None:
    """List the built-in cameras.

    Example: `ae-env cameras` lists them.
    """
    from simulator import get_camera, list_cameras

    rows = []
    for camera in map(get_camera, list_cameras()):
        isos = sorted(camera.nlf_by_iso)
        calibrated = f"ISO {isos[0]:g} to {isos[-1]:g}" if isos else "-"
        model = f"{camera.make} {camera.model.removeprefix(camera.make).strip()}"
        rows.append((camera.name, model, calibrated, camera.source.partition(";")[0]))
    print_table("cameras", rows, "name", "make and model", "noise calibrated", "by")
    print_line("options: NAME?prnu=0.005&dark_current=30")
    print_line("others by a file: ctt:FILE, darktable:MAKER MODEL, emva:FILE (docs/cameras.md)")


def lightings() -> None:
    """List the kinds of light that changes, with their options.

    Example: `ae-env lightings` lists them; `ae-env evaluate --lighting` takes each.
    """
    from dataclasses import fields

    from ae_env.lighting.base import KINDS

    rows = []
    for name, kind in KINDS.items():
        options = ", ".join(f"{option.name}={option.default}" for option in fields(kind))
        rows.append((name, options, str(kind.__doc__).partition("\n")[0]))
    print_table("lightings", rows, "name", "options", "what it is")
