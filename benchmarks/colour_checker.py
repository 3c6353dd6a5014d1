"""Colour accuracy of `simulator.develop` on real raws of a ColorChecker.

    ae-env bench colour_checker

Every patch is averaged on the packed raw, brought to the chart's exposure by one scale, developed
(linear tone) and compared with the chart's published colour: CIE dE2000, D50, 2 degree observer.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from skimage.color import deltaE_ciede2000, lab2xyz, xyz2lab

from benchmarks.data import data_folder
from simulator import RawImage, develop, read_raw
from simulator.raw.develop import TONES, XYZ_FROM_SRGB, srgb_from_camera
from simulator.utils.results import result_meta, write_results

#: X-Rite, "New color specifications for ColorChecker SG and Classic charts" (2016): CIE L*a*b*,
#: D50, 2 degree, charts made after November 2014.
XRITE_2014 = {
    "dark skin": (37.54, 14.37, 14.92),
    "light skin": (64.66, 19.27, 17.50),
    "blue sky": (49.32, -3.82, -22.54),
    "foliage": (43.46, -12.74, 22.72),
    "blue flower": (54.94, 9.61, -24.79),
    "bluish green": (70.48, -32.26, -0.37),
    "orange": (62.73, 35.83, 56.50),
    "purplish blue": (39.43, 10.75, -45.17),
    "moderate red": (50.57, 48.64, 16.67),
    "purple": (30.10, 22.54, -20.87),
    "yellow green": (71.77, -24.13, 58.19),
    "orange yellow": (71.51, 18.24, 67.37),
    "blue": (28.37, 15.42, -49.80),
    "green": (54.38, -39.72, 32.27),
    "red": (42.43, 51.05, 28.62),
    "yellow": (81.80, 2.67, 80.41),
    "magenta": (50.63, 51.28, -14.12),
    "cyan": (49.57, -29.71, -28.32),
    "white 9.5": (95.19, -1.03, 2.93),
    "neutral 8": (81.29, -0.57, 0.44),
    "neutral 6.5": (66.89, -0.75, -0.06),
    "neutral 5": (50.76, -0.13, 0.14),
    "neutral 3.5": (35.63, -0.46, -0.48),
    "black 2": (20.64, 0.07, -0.46),
}
#: D. Pascale, "RGB coordinates of the Macbeth ColorChecker" (BabelColor), average of 30 charts,
#: mostly made before November 2014, on the same scale and in the same order.
BABELCOLOR_AVERAGE = (
    (38.446, 13.602, 14.526), (65.943, 17.883, 17.864), (50.061, -4.510, -22.278),
    (43.286, -13.232, 21.933), (55.319, 8.831, -24.617), (70.691, -33.032, -0.133),
    (62.651, 35.354, 57.838), (40.246, 9.759, -44.384), (51.599, 47.798, 16.877),
    (30.496, 21.062, -20.041), (72.462, -23.286, 56.992), (71.947, 19.478, 68.130),
    (28.876, 14.797, -50.153), (55.144, -37.811, 31.630), (42.277, 54.104, 28.670),
    (82.276, 4.028, 80.007), (51.916, 49.801, -13.846), (50.722, -28.103, -27.962),
    (96.529, -0.468, 2.379), (81.209, -0.656, 0.252), (66.482, -0.531, -0.042),
    (50.827, -0.626, -0.161), (35.849, -0.541, -0.514), (20.828, 0.025, -0.395),
)  # fmt: skip
CHARTS = {
    "x-rite after 2014": np.array(list(XRITE_2014.values())),
    "babelcolor average": np.array(BABELCOLOR_AVERAGE),
}
NAMES = tuple(XRITE_2014)
GREY = NAMES.index("neutral 5")

D50 = np.array([0.9642, 1.0, 0.8249])  # ICC profile connection space
BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


@dataclass(frozen=True)
class Chart:
    """Where the patches lie: centres of 4 corner patches on the packed visible area, (x, y).

    Args:
        top_left: Centre of the patch in row `rows[0]`, column `columns[0]`; then clockwise.
        top_right: Row `rows[0]`, column `columns[1]`.
        bottom_right: Row `rows[1]`, column `columns[1]`.
        bottom_left: Row `rows[1]`, column `columns[0]`.
        rows: First and last row of the chart (0 to 3) that is wholly in the picture.
        columns: First and last column (0 to 5); dark skin is row 0, column 0.
    """

    top_left: tuple[float, float]
    top_right: tuple[float, float]
    bottom_right: tuple[float, float]
    bottom_left: tuple[float, float]
    rows: tuple[int, int] = (0, 3)
    columns: tuple[int, int] = (0, 5)

    def patches(self) -> dict[int, tuple[float, float, float]]:
        """Index of each patch to (x, y, half side of the square that is averaged)."""
        down, across = self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]
        corners = np.array([self.top_left, self.top_right, self.bottom_right, self.bottom_left])
        half = 0.22 * np.linalg.norm(corners[1] - corners[0]) / across
        found = {}
        for i in range(down + 1):
            for j in range(across + 1):
                v, u = i / down, j / across
                weights = np.array([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v])
                x, y = weights @ corners
                found[6 * (self.rows[0] + i) + self.columns[0] + j] = (x, y, half)
        return found


#: All three show the chart upright; two are close-ups that cut it off.
FILES = {
    "CRW_0101.CRW": Chart((177, 165), (955, 161), (957, 622), (184, 626)),
    "CRW_0104.CRW": Chart((188, 165), (981, 161), (982, 553), (190, 558), (1, 3), (1, 5)),
    "CRW_0105.CRW": Chart((355, 269), (923, 270), (923, 550), (356, 552), (2, 3), (3, 5)),
}


def bradford(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Matrix that adapts XYZ from white `source` to white `target`."""
    gains = (BRADFORD @ target) / (BRADFORD @ source)
    return np.linalg.inv(BRADFORD) @ np.diag(gains) @ BRADFORD


def linear_srgb_to_lab(linear: np.ndarray) -> np.ndarray:
    """Linear sRGB (N, 3) to CIE L*a*b* under D50, Bradford-adapted from sRGB's D65."""
    matrix = np.array(XYZ_FROM_SRGB)
    to_d50 = bradford(matrix.sum(axis=1), D50) @ matrix
    # scikit-image's own white, so that white is L* 100, a* 0, b* 0 to the last digit.
    white = lab2xyz(np.array([100.0, 0.0, 0.0]), illuminant="D50")
    return xyz2lab(linear @ to_d50.T / D50 * white, illuminant="D50")


def lab_to_luminance(lab: np.ndarray) -> np.ndarray:
    """CIE Y of L*, 1 for L* = 100."""
    lightness = (lab[..., 0] + 16) / 116
    return np.where(lab[..., 0] > 8, lightness**3, lab[..., 0] / 903.2963)


def decode_srgb(encoded: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, sRGB values to linear light."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def patch_means(raw: RawImage, chart: Chart) -> dict[int, np.ndarray]:
    """Mean of each patch on the packed raw: index to (4,) R, G1, G2, B."""
    means = {}
    for index, (x, y, half) in chart.patches().items():
        rows = slice(round(y - half), round(y + half) + 1)
        columns = slice(round(x - half), round(x + half) + 1)
        square = raw.data[:, rows, columns].double()
        # A patch, not its frame: the spread inside is noise and shading.
        spread = float((square.std(dim=(1, 2)) / square.mean(dim=(1, 2)).clamp(min=0.01)).max())
        if spread > 0.35:
            raise ValueError(f"patch {NAMES[index]!r} is not flat (spread {spread:.2f})")
        means[index] = square.mean(dim=(1, 2)).numpy()
    return means


def measure(raw: RawImage, chart: Chart, white_balance: str, reference: str) -> list[dict]:
    """One row per patch, for one file, white balance (``"camera"`` or ``"chart"``) and table."""
    means = patch_means(raw, chart)
    order = sorted(means)
    planes = np.stack([means[i] for i in order])  # (N, 4)
    lab = CHARTS[reference][order]
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
    published = lab_to_luminance(lab[neutral])
    scale = float(published @ measured / (measured @ measured))

    packed = torch.from_numpy(planes * scale).float().T.reshape(1, 4, -1, 1)
    encoded = develop(packed, tuple(gains), raw.camera.colour_matrix, tone="linear")
    developed = decode_srgb(encoded[0, :, :, 0].T.double().numpy())
    shown = linear_srgb_to_lab(developed)
    unclipped = linear_srgb_to_lab(linear * scale)
    error = deltaE_ciede2000(shown, lab)
    error_unclipped = deltaE_ciede2000(unclipped, lab)
    even = unclipped_at_published_luminance(linear, lab)
    error_even = deltaE_ciede2000(even, lab)
    return [
        {
            "file": raw.metadata["path"],
            "white_balance": white_balance,
            "reference": reference,
            "patch": NAMES[i],
            "delta_e_2000": round(float(error[k]), 3),
            "delta_e_2000_without_gamut_clip": round(float(error_unclipped[k]), 3),
            "delta_e_2000_at_published_luminance": round(float(error_even[k]), 3),
            "lab_measured": [round(float(v), 2) for v in shown[k]],
            "lab_published": [round(float(v), 2) for v in lab[k]],
            "linear_srgb": [round(float(v), 5) for v in linear[k] * scale],
            "exposure_scale": round(scale, 4),
        }
        for k, i in enumerate(order)
    ]


def unclipped_at_published_luminance(linear: np.ndarray, lab: np.ndarray) -> np.ndarray:
    """Lab of `linear` with each patch scaled to its published Y: leaves hue and chroma errors only.

    Uneven light, vignetting and the camera's linearity drop out; veiling glare does not.
    """
    luminance = lab_to_luminance(linear_srgb_to_lab(linear))
    return linear_srgb_to_lab(linear * (lab_to_luminance(lab) / luminance)[:, None])


def paper_range(raw: RawImage) -> dict:
    """Darkest and brightest block of green along the picture's edge: white paper, evenly meant."""
    green = raw.data[1:3].mean(dim=0)
    blocks = green.unfold(0, 20, 20).unfold(1, 20, 20).mean(dim=(2, 3))
    edge = torch.cat([blocks[0], blocks[-1], blocks[:, 0], blocks[:, -1]])
    return {"darkest": round(float(edge.min()), 3), "brightest": round(float(edge.max()), 3)}


def linearity(raw: RawImage, chart: Chart, reference: str) -> list[dict]:
    """Per channel: how straight the neutral row's raw values lie over the published luminance."""
    means = patch_means(raw, chart)
    order = [i for i in sorted(means) if i >= 18]
    published = lab_to_luminance(CHARTS[reference][order])
    rows = []
    for name, planes in (("R", [0]), ("G", [1, 2]), ("B", [3])):
        values = np.array([means[i][planes].mean() for i in order])
        slope, offset = np.polyfit(published, values, 1)
        residual = values - (slope * published + offset)
        r2 = 1 - residual @ residual / ((values - values.mean()) ** 2).sum()
        rows.append(
            {
                "file": raw.metadata["path"],
                "channel": name,
                "patches": len(order),
                "slope": round(float(slope), 5),
                "offset_percent_of_white": round(100 * float(offset / slope), 3),
                "r_squared": round(float(r2), 6),
                "largest_residual_percent_of_white": round(
                    100 * float(np.abs(residual).max() / slope), 3
                ),
            }
        )
    return rows


def develop_times(matrix: np.ndarray, repeats: int = 25) -> list[dict]:
    """Median time of `develop` on the reward's batches, beside one power over its output."""
    generator = torch.Generator().manual_seed(0)
    rows = []
    for size in (64, 128):
        images = torch.rand(64, 4, size, size, generator=generator)
        gains = 1 + torch.rand(64, 3, generator=generator)
        colours = images[:, :3].contiguous()
        power = timed(lambda x=colours: x ** (1 / 2.4), repeats)
        for name, chosen in (("none", None), ("camera's", matrix)):
            for tone in TONES:

                def run(x=images, g=gains, m=chosen, t=tone):
                    return develop(x, g, m, tone=t)

                times = timed(run, repeats)
                row = {"batch": f"64 x 4 x {size} x {size}", "matrix": name, "tone": tone}
                row["ms"] = round(float(np.median(times)), 2)
                row["ms_quartiles"] = [round(float(v), 2) for v in np.percentile(times, (25, 75))]
                row["ratio_to_power"] = round(float(np.median(times) / np.median(power)), 2)
                rows.append(row)
    return rows


def timed(call: Callable[[], object], repeats: int) -> list[float]:
    """Times of `repeats` runs after two to warm up [ms]."""
    times = []
    for _ in range(repeats + 2):
        start = time.perf_counter()
        call()
        times.append(1000 * (time.perf_counter() - start))
    return times[2:]


def summary(rows: list[dict]) -> dict:
    """Mean, median and maximum of dE2000 over `rows`."""
    errors = np.array([row["delta_e_2000"] for row in rows])
    unclipped = np.array([row["delta_e_2000_without_gamut_clip"] for row in rows])
    even = np.array([row["delta_e_2000_at_published_luminance"] for row in rows])
    return {
        "patches": len(rows),
        "mean": round(float(errors.mean()), 2),
        "median": round(float(np.median(errors)), 2),
        "max": round(float(errors.max()), 2),
        "worst": rows[int(errors.argmax())]["patch"],
        "mean_without_gamut_clip": round(float(unclipped.mean()), 2),
        "mean_at_published_luminance": round(float(even.mean()), 2),
    }


def print_tables(rows: list[dict], summaries: list[dict], lines: list[dict]) -> None:
    keys = ("white_balance", "reference", "patches", "mean", "median", "max", "worst")
    keys = ("file", *keys, "mean_without_gamut_clip", "mean_at_published_luminance")
    print("| " + " | ".join(keys) + " |\n|" + "---|" * len(keys))
    for row in summaries:
        print("| " + " | ".join(str(row[k]) for k in keys) + " |")
    print("\n| patch | published L* a* b* | camera balance | dE2000 | chart balance | dE2000 |")
    print("|---|---|---|---|---|---|")
    first = [r for r in rows if r["file"] == next(iter(FILES))]
    first = [r for r in first if r["reference"] == next(iter(CHARTS))]
    for name in NAMES:
        camera, chart = (r for r in first if r["patch"] == name)
        cells = [name, camera["lab_published"], camera["lab_measured"], camera["delta_e_2000"]]
        cells += [chart["lab_measured"], chart["delta_e_2000"]]
        print("| " + " | ".join(str(c).strip("[]") for c in cells) + " |")
    print_table(lines)


def print_table(rows: list[dict]) -> None:
    print("\n| " + " | ".join(rows[0]) + " |\n|" + "---|" * len(rows[0]))
    for row in rows:
        print("| " + " | ".join(map(str, row.values())) + " |")


def run(out: Path, *, seed: int = 0, quick: bool = False) -> None:
    """Measures, prints the tables and writes ``colour_checker.json`` into `out`.

    Args:
        out: Folder of results.
        seed: Nothing here is random; only noted in the file.
        quick: Only the first raw.
    """
    folder = data_folder("canon_crw_cc0")
    rows, summaries, lines, paper = [], [], [], {}
    for file, chart in list(FILES.items())[: 1 if quick else None]:
        raw = read_raw(folder / file)
        for reference in CHARTS:
            for white_balance in ("camera", "chart"):
                part = measure(raw, chart, white_balance, reference)
                rows += part
                case = {"file": file, "white_balance": white_balance, "reference": reference}
                summaries.append(case | summary(part))
        lines += linearity(raw, chart, next(iter(CHARTS)))
        if chart.rows == (0, 3) and chart.columns == (0, 5):
            paper[file] = paper_range(raw)  # the close-ups show little paper
    print_tables(rows, summaries, lines)
    print(f"\nwhite paper around the chart, share of sensor white: {paper}")
    times = develop_times(np.array(raw.camera.colour_matrix))
    print_table(times)
    meta = result_meta("ae-env bench colour_checker" + (" --quick" if quick else ""), seed) | {
        "summary": summaries,
        "linearity": lines,
        "paper": paper,
        "develop_ms": times,
    }
    print(f"\nwrote {write_results(out / 'colour_checker.json', rows, meta)}")
