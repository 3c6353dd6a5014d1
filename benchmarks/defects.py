"""Do the analytic measures of photographic defects read the severity that was rendered?

The maps from what a defect leaves in the picture to its severity are fitted on training scenes and
tested on test scenes; the constants that `ae_env/scorers/defects.py` holds are printed.
"""

from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy.optimize import nnls

from ae_env.scenes import Scene, load_scenes, reference_settings
from ae_env.scorers.defects import DEFECTS, KNOTS, SIGNS, mapped
from ae_env.scorers.measures import luma_of
from agents.cli.console import print_line
from benchmarks.harness import Part, Report, Row, benchmark, correlation, interval, pivot, table
from simulator import develop, exposure_ratio, get_camera
from simulator.optics.discs import disc_blur
from simulator.raw.develop import GREY_CARD_SIGNAL

CAMERA = "nikon_z6"
#: Packed pixels a side of the renderings that the maps are fitted on, and of those tested on.
RESOLUTION, OTHER_RESOLUTION = 128, 64
#: Scenes of each kind at most; seven kinds are procedural, one is photographs.
TRAINING_SCENES, TEST_SCENES = 60, 24
UNSIGNED, SIGNED = np.linspace(0.0, 1.0, 11), np.linspace(-1.0, 1.0, 21)
NUM_KNOTS = 9
#: Severities (L,) at which each defect is rendered.
LEVELS = {name: SIGNED if name == "saturation" else UNSIGNED for name in DEFECTS}
#: What severity 1 is.
EXPOSURE_EV, CARD_NOISE, GAIN_STOPS, AIRLIGHT, DISC_PX = 4.0, 0.5, 1.0, 0.8, 8.0
_TINTS = ((1.0, -1.0), (-1.0, 1.0), (1.0, 1.0), (-1.0, -1.0))


def render(scene: Scene, defect: str, generator: torch.Generator) -> torch.Tensor:
    """sRGB (L, 3, H, W) of `scene` with `defect` at its `LEVELS`."""
    severities = torch.from_numpy(LEVELS[defect]).float()[:, None, None, None]
    proper = reference_settings(scene.ev100)
    light = scene.light * float(exposure_ratio(scene.reference, proper))
    gains = torch.tensor(scene.white_balance)
    frames = light.expand(len(severities), -1, -1, -1)
    if defect == "exposure":
        side = 1.0 if float(torch.rand((), generator=generator)) < 0.5 else -1.0
        frames = light * 2.0 ** (side * EXPOSURE_EV * severities)
    elif defect == "noise":
        shot = (CARD_NOISE * severities) ** 2 * GREY_CARD_SIGNAL
        normals = torch.randn(frames.shape, generator=generator)
        frames = light + normals * (shot * light.clamp(min=0.0)).sqrt()
    elif defect == "white_balance":
        red, blue = _TINTS[int(torch.randint(len(_TINTS), (), generator=generator))]
        gains = gains * 2.0 ** (GAIN_STOPS * severities[:, :, 0, 0] * torch.tensor([red, 0, blue]))
    elif defect == "haze":
        bright = float(light[1:3].mean(dim=0).quantile(0.9).clamp(0.12, 0.66))
        airlight = bright * (gains[1] / gains)[[0, 1, 1, 2]][:, None, None]
        frames = light + AIRLIGHT * severities * (airlight - light)
    elif defect == "blur":
        frames = torch.stack([disc_blur(light, DISC_PX * float(s)) for s in severities.flatten()])
    pictures = develop(frames.clamp(0.0, 1.0), gains, scene.camera.colour_matrix)
    if defect == "saturation":
        luma = luma_of(pictures)[:, None]
        pictures = (luma + (1.0 + severities) * (pictures - luma)).clamp_(0.0, 1.0)
    return pictures


def signs_of(
    scenes: list[Scene], defect: str, names: list[str], seed: int
) -> dict[str, np.ndarray]:
    pictures = []
    for number, scene in enumerate(scenes):  # each rendering has random numbers of its own
        entropy = np.random.SeedSequence([seed, number, DEFECTS.index(defect)])
        generator = torch.Generator().manual_seed(int(entropy.generate_state(1, np.uint64)[0]))
        pictures.append(render(scene, defect, generator))
    return {name: np.stack([SIGNS[name](own).numpy() for own in pictures]) for name in names}


def fit_map(sign: np.ndarray, severity: np.ndarray) -> list[list[float]]:
    """Knots [sign, severity] of the monotone, piecewise straight map of least squares."""
    x = np.unique(np.round(np.quantile(sign, np.linspace(0.0, 1.0, NUM_KNOTS)), 4))
    low = severity.min()
    steps = np.clip((sign[:, None] - x[:-1]) / np.diff(x), 0.0, 1.0)  # each adds what it rises by
    rises, _ = nnls(np.column_stack([np.ones(len(sign)), steps]), severity - low)
    y = np.clip(low + np.cumsum(rises), low, severity.max())
    return [[float(a), round(float(b), 4)] for a, b in zip(x, y, strict=True)]


def fit(scenes: list[Scene], seed: int) -> dict[str, list[list[float]]]:
    maps = {}
    for defect in DEFECTS:
        names = ["over_exposure", "under_exposure"] if defect == "exposure" else [defect]
        signs = signs_of(scenes, defect, names, seed)
        rendered = np.broadcast_to(LEVELS[defect], signs[names[0]].shape)
        if defect != "exposure":
            maps[defect] = fit_map(signs[defect].ravel(), rendered.ravel())
            continue
        # Each side is zero where the light is off to the other side: where the last rendering is
        # brighter than the first, and the other way round.
        more = signs["over_exposure"] - signs["under_exposure"]
        brighter = more[:, -1] > more[:, 0]
        for name, own in (("over_exposure", brighter), ("under_exposure", ~brighter)):
            target = np.where(own[:, None], rendered, 0.0)
            maps[name] = fit_map(signs[name].ravel(), target.ravel())
    return maps


def severities_of(scenes: list[Scene], defect: str, seed: int) -> dict[str, np.ndarray]:
    signs = signs_of(scenes, defect, list(SIGNS), seed)
    values = {
        name: mapped(name, torch.from_numpy(v.ravel())).numpy().reshape(v.shape)
        for name, v in signs.items()
    }
    sides = values.pop("over_exposure"), values.pop("under_exposure")
    return {"exposure": np.maximum(*sides)} | values


def own_row(defect: str, estimated: np.ndarray, scenes: list[Scene], which: str, seed: int) -> Row:
    """How well the severity of its own defect is read, over ``"all"`` scenes or a part of them."""
    chosen = [which == "all" or s.hard == (which == "hard") for s in scenes]
    rendered = np.broadcast_to(LEVELS[defect], estimated.shape)[chosen]
    values, groups = estimated[chosen], np.array([scene.group for scene in scenes])[chosen]
    errors = pd.Series(np.abs(values - rendered).mean(axis=1)).groupby(groups).mean().to_numpy()
    within = np.mean([correlation(v, r) for v, r in zip(values, rendered, strict=True)])
    row: Row = {"part": "own", "measure": f"analytic_{defect}", "scenes": which}
    row |= {"resolution": scenes[0].light.shape[-1], "num_scenes": len(values)}
    row |= {"num_groups": len(errors), "mae": float(errors.mean())}
    row |= {"spearman": correlation(values.ravel(), rendered.ravel())}
    row |= {"spearman_within_scene": float(within), "mae_ci95": interval(errors, seed)}
    constant = np.abs(rendered - np.median(LEVELS[defect])).mean()
    return row | {"mae_of_a_constant": float(constant)}


def cross_rows(defect: str, estimated: dict[str, np.ndarray]) -> list[Row]:
    """Mean |severity| that each measure gives with and without `defect` at its worst."""
    clean, rows = int(np.flatnonzero(LEVELS[defect] == 0.0)[0]), []
    for end, last in (("", -1), *([(" (too weak)", 0)] if defect == "saturation" else [])):
        for measure, values in estimated.items():
            means = np.abs(values).mean(axis=0)
            row: Row = {"part": "cross_talk", "defect": f"{defect}{end}"}
            row |= {"measure": f"analytic_{measure}", "clean": float(means[clean])}
            row |= {"at_severity_1": float(means[last])}
            rows.append(row | {"change": float(means[last] - means[clean])})
    return rows


def scenes_of(split: str, resolution: int, per_kind: int, quick: bool) -> list[Scene]:
    spec = "bundled:small" if quick else "bundled"
    found = load_scenes(spec, split, camera=get_camera(CAMERA), resolution=resolution)  # type: ignore[arg-type]
    kinds = dict.fromkeys(scene.kind for scene in found)
    return [s for kind in kinds for s in [s for s in found if s.kind == kind][:per_kind]]


def parts(seed: int, quick: bool) -> list[Part]:
    sizes = (RESOLUTION, OTHER_RESOLUTION)
    return [Part("maps", fitted), *(Part(f"test {n}", tested, {"resolution": n}) for n in sizes)]


def fitted(seed: int, quick: bool) -> dict[str, Any]:
    training = scenes_of("train", RESOLUTION, TRAINING_SCENES, quick)
    return {"maps": fit(training, seed), "scenes": len(training)}


def tested(resolution: int, seed: int, quick: bool) -> dict[str, Any]:
    scenes, rows = scenes_of("test", resolution, TEST_SCENES, quick), []
    for defect in DEFECTS:
        estimated = severities_of(scenes, defect, seed)
        both = len({scene.hard for scene in scenes}) == 2
        for which in ("all", "ordinary", "hard") if both else ("all",):
            rows.append(own_row(defect, estimated[defect], scenes, which, seed))
        if resolution == RESOLUTION:
            rows += cross_rows(defect, estimated)
    return {"rows": rows, "scenes": len(scenes)}


_FITTED = """training scenes = {training_scenes} | test scenes = {test_scenes} |
the constants in use are those of this run = {in_use_is_fitted}"""
_OWN = """measure = `{measure}` | pixels = {resolution} | scenes = {num_scenes} {scenes} |
rank correlation = {spearman:.2f} | within a scene = {spearman_within_scene:.2f} |
error = {mae:.3f} [{mae_ci95[0]:.3f}, {mae_ci95[1]:.3f}] | constant = {mae_of_a_constant:.3f}"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    maps = results["maps"]["maps"]
    tests = [results[f"test {size}"] for size in (RESOLUTION, OTHER_RESOLUTION)]
    for name, knots in maps.items():
        columns = ", ".join(repr(column) for column in zip(*knots, strict=True))
        print_line(f'"{name}": ({columns}),')
    rows = [row for test in tests for row in test["rows"]]
    fits = [{"part": "map", "name": n, "knots": m, "in_use": KNOTS[n]} for n, m in maps.items()]
    in_use = all(
        np.shape(knots) == np.shape(KNOTS[name]) and np.allclose(knots, KNOTS[name], atol=2e-3)
        for name, knots in maps.items()
    )
    more = {"training_scenes": results["maps"]["scenes"], "test_scenes": tests[0]["scenes"]}
    more |= {"in_use_is_fitted": in_use, "camera": CAMERA}
    own = [r for r in rows if r["part"] == "own"]
    own = [r for r in own if r["scenes"] == "all" or r["resolution"] == RESOLUTION]
    cross = [row for row in rows if row["part"] == "cross_talk"]
    first = [row for row in cross if row["defect"] == DEFECTS[0]]
    shown = [r | {"defect": "no defect", "shown": f"{r['clean']:.2f}"} for r in first]
    shown += [row | {"shown": f"{row['change']:+.2f}"} for row in cross]
    tables = {"fitted": table([more], _FITTED), "own": table(own, _OWN)}
    tables["cross_talk"] = pivot(shown, "defect = {defect}", "`{measure}`", "{shown}")
    return Report([*fits, *rows], tables, meta=more)


run = benchmark("defects", parts, report)
