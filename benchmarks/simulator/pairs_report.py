"""The section of the report that holds the paper's table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from benchmarks.simulator.cases import PARTITION

#: PSNR and SSIM that the paper publishes (table 1), on its own photographs.
PUBLISHED = {
    "nikon_z6": {
        "PC": (18.78, 0.542),
        "DL": (34.34, 0.879),
        "EXP": (35.31, 0.903),
        "NS": (35.36, 0.911),
        "Full": (36.10, 0.923),
    },
    "canon_70d": {
        "PC": (18.96, 0.413),
        "DL": (24.86, 0.429),
        "EXP": (33.53, 0.831),
        "NS": (33.49, 0.837),
        "Full": (34.28, 0.846),
    },
}
_CAMERAS = {"nikon_z6": "Nikon Z6, trained body", "canon_70d": "Canon 70D, unseen"}
Row = dict[str, Any]


def section(rows: list[Row]) -> str:
    """Markdown: the table, its breakdown by direction, and what was asked for."""
    counts = {(r["camera"], r["mix"]): r for r in reversed(rows) if r["method"] == "ceiling"}
    mixes = "; ".join(
        f"{_CAMERAS[camera]}, {mix}: {r['pairs']} of {r['source_groups']} source groups"
        for (camera, mix), r in reversed(counts.items())
    )
    size = rows[0]["size"]
    lines = [
        "Pairs of captures as the paper took them (any two of a sequence of 20 to 25), "
        "photographed by the reference camera. *Noisy*: against the target, before output noise is "
        "added to the estimate, as the paper measures; its ceiling is the noise-free mean. *Mean*: "
        "against that mean. PSNR is the mean over pairs of each pair's, as in the paper; images "
        "that agree to 80 dB or better count as 80. All images are clipped to [-pedestal, 1]. "
        "EXP, NS and Full use the w and b learnt on the Z6's body unless `w = 1, b = 0` is said. "
        "*No depth known*: photographs, radiance maps and flat procedural scenes, which the "
        "reference camera takes as in focus throughout: opening adds no blur to them, however "
        "soft they were recorded; an aperture module that reads softness as defocus is wrong.",
        "",
        f"Pairs: {mixes}. Milliseconds are for one raw of 4 x {size} x {size}.",
        "",
        *_main_table(rows),
        "",
        "The published figures are of other photographs; only their order and differences compare.",
        "",
        "### What was asked",
        "",
        *_verdicts(rows),
        "",
        "Ranges are standard errors over source groups.",
        "",
        "### Where Full's margin over EXP comes from",
        "",
        *_margin(rows),
    ]
    for camera, name in _CAMERAS.items():
        for field, reference in (("mean", "the noise-free mean"), ("noisy", "the noisy target")):
            lines += ["", f"### {name}: PSNR [dB] against {reference}", ""]
            lines += _breakdown(rows, camera, field)
    return "\n".join(lines)


def _find(rows: list[Row], **wanted: Any) -> Row | None:
    return next((r for r in rows if all(r[k] == v for k, v in wanted.items())), None)


def _label(row: Row) -> str:
    if not row["preset"]:
        return row["method"]
    return f"{row['method']} `{row['preset']}`" + ", w = 1, b = 0" * (not row["body_correction"])


def _methods(rows: list[Row]) -> list[tuple[str, str, bool]]:
    keys = ((r["method"], r["preset"], r["body_correction"]) for r in rows)
    return list(dict.fromkeys(keys))


def _main_table(rows: list[Row]) -> list[str]:
    head = "".join(f" | {name}: noisy | mean | published" for name in _CAMERAS.values())
    lines = [f"| PSNR [dB] / SSIM{head} | ms |", "|---" + "|--:" * 7 + "|"]
    for method, preset, corrected in _methods(rows):
        cells, times, label = [], [], ""
        for camera in _CAMERAS:
            key = {"method": method, "preset": preset, "body_correction": corrected}
            row = _find(rows, camera=camera, mix="all", group="all", **key)
            if row is None:
                cells += ["", "", ""]
                continue
            label = _label(row)
            cells += [f"{row[f'{r}_db']:.2f} / {row[f'{r}_ssim']:.3f}" for r in ("noisy", "mean")]
            if method == "ceiling":
                cells[-1] = ""  # the mean against itself
            known = PUBLISHED[camera].get(method)
            shown = known is not None and (corrected or not preset)
            cells.append(f"{known[0]:.2f} / {known[1]:.3f}" if known and shown else "")
            times += [row["milliseconds"]] if row["milliseconds"] is not None else []
        spent = f"{min(times):.1f}" if times else ""
        lines.append(f"| {label} | {' | '.join(cells)} | {spent} |")
    return lines


def _margin(rows: list[Row]) -> list[str]:
    """The margin on the paper's mix as a sum over groups that share no pair."""
    lines = [
        "Share of the pairs, Full `compact` over EXP against the noisy target, and contribution "
        "to the average margin (share times gain) [dB].",
        "",
        "| pairs |"
        + "".join(f" {name}: share | gain | contribution |" for name in _CAMERAS.values()),
        "|---" + "|--:" * (3 * len(_CAMERAS)) + "|",
    ]
    for group in (*PARTITION, "all"):
        cells = []
        for camera in _CAMERAS:
            key = {"method": "Full", "preset": "compact", "body_correction": True, "mix": "all"}
            row = _find(rows, camera=camera, group=group, **key)
            every = _find(rows, camera=camera, group="all", **key)
            if row is None or every is None:
                cells += ["0 %", "", ""]
                continue
            share, gain = row["pairs"] / every["pairs"], row["over_exp_noisy_db"]
            cells += [f"{share:.0%}", f"{gain:+.2f}", f"{share * gain:+.2f}"]
        lines.append(f"| {group} | {' | '.join(cells)} |")
    return lines


def _breakdown(rows: list[Row], camera: str, field: str) -> list[str]:
    own = [r for r in rows if r["camera"] == camera]
    shown = [m for m in _methods(own) if m[2] or not m[1]]
    if field == "mean":
        shown.remove(("ceiling", "", False))
    labels = [_label(next(r for r in own if _key(r) == m)) for m in shown]
    lines = [
        f"| mix: pairs | n | {' | '.join(labels)} |",
        "|---" + "|--:" * (len(labels) + 1) + "|",
    ]
    for mix, group in dict.fromkeys((r["mix"], r["group"]) for r in own):
        found = [r for r in own if (r["mix"], r["group"]) == (mix, group)]
        by_method = {_key(r): r for r in found}
        cells = [f"{by_method[m][f'{field}_db']:.2f}" for m in shown]
        lines.append(f"| {mix}: {group} | {found[0]['pairs']} | {' | '.join(cells)} |")
    return lines


def _key(row: Row) -> tuple[str, str, bool]:
    return row["method"], row["preset"], row["body_correction"]


# -- what was asked -------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Asked:
    """A gain of a stage over another, on a group of the training camera's pairs."""

    method: str
    over: str
    target: str
    group: str
    mix: str = "all"

    @property
    def name(self) -> str:
        return f"{self.method} over {self.over}, {self.mix}: {self.group} [dB]"


_ASKED = (
    _Asked("NS", "EXP", "> 0", "target cleaner than the source"),
    _Asked("Full", "EXP", "paper: 0.79", "all"),
    _Asked("Full", "NS", "> 0", "opens, blur >= 1.5 px", "opening"),
    _Asked("Full", "NS", "> 0", "opens, blur >= 1.5 px", "f/11 to f/4"),
    _Asked("Full", "NS", ">= -0.05", "opens, blur < 1.5 px", "opening"),
    _Asked("Full", "NS", ">= -0.05", "opens, blur < 1.5 px", "f/11 to f/4"),
    _Asked("Full", "NS", ">= -0.05", "opens, no depth known"),
    _Asked("Full", "NS", "0", "same aperture"),
    _Asked("Full", "NS", "0", "aperture closes"),
)


def _verdicts(rows: list[Row]) -> list[str]:
    lines = ["| | asked | against | `compact` | `paper` |", "|---|---|---|--:|--:|"]
    for asked in _ASKED:
        gain = "over_exp" if asked.over == "EXP" else "over_stage_before"
        where = {"camera": "nikon_z6", "mix": asked.mix, "group": asked.group}
        for field in ("noisy", "mean"):
            cells = []
            for preset in ("compact", "paper"):
                key = {"method": asked.method, "preset": preset, "body_correction": True}
                row = _find(rows, **key, **where)
                cells.append("" if row is None else _with_error(row, f"{gain}_{field}_db"))
            lines.append(f"| {asked.name} | {asked.target} | {field} | {' | '.join(cells)} |")
    return lines + _gaps(rows) + _baselines(rows)


def _with_error(row: Row, field: str) -> str:
    error = row[f"{field}_error"]
    return f"{row[field]:+.2f}" + ("" if error is None else f" ± {error:.2f}")


def _gaps(rows: list[Row]) -> list[str]:
    """How far below the ceiling Full is on the unseen camera, beyond the training camera's gap."""
    lines = []
    for corrected, name in ((True, "with w, b"), (False, "w = 1, b = 0")):
        cells = []
        for preset in ("compact", "paper"):
            gaps = []
            for camera in _CAMERAS:
                where = {"camera": camera, "mix": "all", "group": "all"}
                top = _find(rows, method="ceiling", **where)
                full = _find(rows, method="Full", preset=preset, body_correction=corrected, **where)
                if top is not None and full is not None:
                    gaps.append(top["noisy_db"] - full["noisy_db"])
            known = len(gaps) == len(_CAMERAS)
            text = f"{gaps[0]:.2f} to {gaps[1]:.2f}: {gaps[1] - gaps[0]:+.2f}" if known else ""
            cells.append(text)
        text = "Full's gap to the ceiling [dB], training to unseen camera"
        lines.append(f"| {text}, {name} | grows <= 0.5 | noisy | {' | '.join(cells)} |")
    return lines


def _baselines(rows: list[Row]) -> list[str]:
    lines = []
    for camera, name in _CAMERAS.items():
        for method in ("PC", "DL"):
            row = _find(rows, camera=camera, mix="all", group="all", method=method)
            if row is None:
                continue
            for field in ("noisy", "mean"):
                value = _with_error(row, f"over_exp_{field}_db")
                lines.append(f"| {method} over EXP, {name} [dB] | < 0 | {field} | {value} | |")
    return lines
