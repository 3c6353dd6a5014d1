"""Colour accuracy of `simulator.develop` on real raws of a ColorChecker.

Every patch is averaged on the packed raw, brought to the chart's exposure by one scale, developed
(linear tone) and compared with the chart's published colour: CIE dE2000, D50, 2 degree observer.
"""

from dataclasses import dataclass
from itertools import product
from typing import Any

import colour
import numpy as np
import pandas as pd
import torch

from ae_env.scorers.measures import srgb_decode
from benchmarks.harness import Part, Report, Row, benchmark, pivot, real_files, rounded, table
from simulator import RawImage, develop, read_raw
from simulator.camera_files import XYZ_FROM_SRGB
from simulator.raw.develop import srgb_from_camera

#: CIE L*a*b*, D50, 2 degree, of charts made after November 2014. X-Rite, "New color specifications
#: for ColorChecker SG and Classic charts" (2016).
_CHART = colour.CCS_COLOURCHECKERS["ColorChecker24 - After November 2014"]
D50, NAMES = _CHART.illuminant, tuple(name.partition(" (")[0] for name in _CHART.data)
_XYZ = np.array([colour.xyY_to_XYZ(value) for value in _CHART.data.values()])
PUBLISHED, GREY = colour.XYZ_to_Lab(_XYZ, D50), NAMES.index("neutral 5")


@dataclass(frozen=True)
class Chart:
    """Where the patches lie on the packed visible area."""

    corners: tuple[tuple[float, float], ...]
    rows: tuple[int, int] = (0, 3)
    columns: tuple[int, int] = (0, 5)

    def means(self, raw: RawImage) -> dict[int, np.ndarray]:
        """Means (4,) over a square of each patch, by its index."""
        down, across = self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]
        corners, found = np.array(self.corners, float), {}
        half = float(0.22 * np.linalg.norm(corners[1] - corners[0]) / across)
        for i, j in product(range(down + 1), range(across + 1)):
            v, u = i / down, j / across
            x, y = np.array([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v]) @ corners
            rows, columns = (slice(round(n - half), round(n + half) + 1) for n in (y, x))
            square = raw.data[:, rows, columns].double()
            index = 6 * (self.rows[0] + i) + self.columns[0] + j
            found[index] = square.mean(dim=(1, 2)).numpy()
        return found


#: All three show the chart upright; two are close-ups that cut it off.
FILES = {
    "CRW_0101.CRW": Chart(((177, 165), (955, 161), (957, 622), (184, 626))),
    "CRW_0104.CRW": Chart(((188, 165), (981, 161), (982, 553), (190, 558)), (1, 3), (1, 5)),
    "CRW_0105.CRW": Chart(((355, 269), (923, 270), (923, 550), (356, 552)), (2, 3), (3, 5)),
}


def linear_srgb_to_lab(linear: np.ndarray) -> np.ndarray:
    """Linear sRGB (N, 3) to CIE L*a*b* under D50, Bradford-adapted from sRGB's D65."""
    return colour.XYZ_to_Lab(colour.RGB_to_XYZ(linear, "sRGB", D50, "Bradford"), D50)


def measure(raw: RawImage, chart: Chart, white_balance: str) -> list[Row]:
    means = chart.means(raw)
    order = sorted(means)
    planes, lab = np.stack([means[i] for i in order]), PUBLISHED[order]  # (N, 4), (N, 3)
    gains = np.array(raw.white_balance)
    if white_balance == "chart":
        r, g1, g2, b = means[GREY]
        gains = np.array([(g1 + g2) / 2 / r, 1.0, (g1 + g2) / 2 / b])
    gains = gains / gains.min()
    camera_rgb = np.stack([planes[:, 0], planes[:, 1:3].mean(axis=1), planes[:, 3]], 1) * gains
    assert raw.camera.colour_matrix is not None
    linear = camera_rgb @ srgb_from_camera(raw.camera.colour_matrix).numpy().T

    neutral = [k for k, i in enumerate(order) if i >= 18]
    measured = (linear @ np.array(XYZ_FROM_SRGB)[1])[neutral]
    published = _XYZ[order, 1]
    scale = float(published[neutral] @ measured / (measured @ measured))

    packed = torch.from_numpy(planes * scale).float().T.reshape(1, 4, -1, 1)
    encoded = develop(packed, tuple(gains), raw.camera.colour_matrix, tone="linear")
    shown = linear_srgb_to_lab(srgb_decode(encoded[0, :, :, 0].T.double()).numpy())
    # Each patch scaled to its published Y, which leaves errors of hue and chroma only: uneven
    # light, vignetting and the camera's linearity drop out; veiling glare does not.
    luminance = colour.RGB_to_XYZ(linear, "sRGB", D50, "Bradford")[:, 1]
    even = linear * (published / luminance)[:, None]
    errors = {
        "delta_e_2000": colour.delta_E(shown, lab),
        "delta_e_2000_without_gamut_clip": colour.delta_E(linear_srgb_to_lab(linear * scale), lab),
        "delta_e_2000_at_published_luminance": colour.delta_E(linear_srgb_to_lab(even), lab),
    }
    rows = []
    for k, i in enumerate(order):
        row: Row = {"file": raw.metadata["path"], "white_balance": white_balance}
        row |= {"patch": NAMES[i]} | {name: error[k] for name, error in errors.items()}
        row |= {"lab_measured": shown[k].round(2), "lab_published": lab[k]}
        rows.append(rounded(row | {"linear_srgb": linear[k] * scale, "exposure_scale": scale}))
    return rows


def paper_range(raw: RawImage) -> Row:
    """Darkest and brightest block of green along the picture's edge: white paper, evenly meant."""
    green = raw.data[1:3].mean(dim=0)
    blocks = green.unfold(0, 20, 20).unfold(1, 20, 20).mean(dim=(2, 3))
    edge = torch.cat([blocks[0], blocks[-1], blocks[:, 0], blocks[:, -1]])
    return {"darkest": round(float(edge.min()), 3), "brightest": round(float(edge.max()), 3)}


def summary(rows: list[Row]) -> Row:
    frame = pd.DataFrame(rows).set_index("patch").filter(like="delta_e")
    errors, means = frame["delta_e_2000"], frame.mean()
    found: Row = {"patches": len(rows), "mean": errors.mean(), "median": errors.median()}
    found |= {"max": errors.max(), "worst": errors.idxmax()}
    found |= {f"mean{name.removeprefix('delta_e_2000')}": means[name] for name in frame.columns[1:]}
    return {k: round(float(v), 2) if isinstance(v, float) else v for k, v in found.items()}


def measure_file(file: str) -> dict[str, Any]:
    raw, chart = read_raw(real_files("canon_crw_cc0") / file), FILES[file]
    rows, summaries = [], []
    for white_balance in ("camera", "chart"):
        own = measure(raw, chart, white_balance)
        rows += own
        summaries.append({"file": file, "white_balance": white_balance} | summary(own))
    whole = chart.rows == (0, 3) and chart.columns == (0, 5)  # the close-ups show little paper
    paper = [{"file": file, **paper_range(raw)}] if whole else []
    return {"rows": rows, "summary": summaries, "paper": paper}


def parts(seed: int, quick: bool) -> list[Part]:
    real_files("canon_crw_cc0")  # raises before any work
    files = list(FILES)[: 1 if quick else None]
    return [Part(file, measure_file, {"file": file}) for file in files]


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    keys = ("rows", "summary", "paper")
    found: dict[str, list[Row]] = {k: [r for own in results.values() for r in own[k]] for k in keys}
    shown = [row for row in found["rows"] if row["file"] == next(iter(FILES))]
    for row, name in product(shown, ("published", "measured")):
        row[name] = " ".join(map(str, row[f"lab_{name}"]))
    contents = "published = {published} | measured = {measured} | dE2000 = {delta_e_2000:.2f}"
    tables = {"patches": pivot(shown, "patch = {patch}", "{white_balance}", contents)}
    for name, key in (("charts", "summary"), ("paper", "paper")):
        columns = {title.replace("_", " "): f"{{{title}}}" for title in found[key][0]}
        tables[name] = table(found[key], columns)
    return Report(found.pop("rows"), tables, meta=found)


run = benchmark("colour_checker", parts, report)
