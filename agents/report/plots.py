"""The pictures of a report: figures of an evaluation, and contact sheets."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from ae_env.rendering import PATH_COLOURS
from agents.evaluation import metrics
from agents.evaluation.result import EvaluationResult
from agents.evaluation.stability import DELAYS, LEAD, STEPS, Stability
from simulator.utils.files import write_picture

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Dash patterns, the next one after each five colours: some of ten look alike to the colour-blind.
_DASHES = ("-", "--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)))
#: Shape and vertical offset of each part's marks.
_PARTS = {"all": ("o", 0.0), "hard": ("v", 0.2), "rest": ("^", -0.2), "all conditions": ("s", 0.38)}
#: Panels in a row of the plot of EV errors: as many as stay legible on a page.
_COLUMNS = 3
#: Paths on one contact sheet, and frames of a path.
_PATHS, _PATH_FRAMES = 5, 8
#: Most sheets, and the quality of their compression.
_SHEETS, _QUALITY = 2, 75
#: The kinds of scene whose contact sheet is shown where there are any: pictures, not drawings.
_KINDS = ("photograph", "backlit")


def plot_scores(path: Path, rows: pd.DataFrame, order: Sequence[str]) -> Path:
    """Draw the normalised score of each policy, a mark per part, and write it as PNG.

    `rows` are those of `result_rows`, and of ``"all conditions"``, where there are several; those
    of a single other condition are left out. `order` are the policies from the top.
    """
    parts = {name: own for name, own in rows.groupby("condition") if name in _PARTS}
    names = [name for name in reversed(order) if name != "oracle"]
    axes = (figure := _figure(7.5, 1.6 + 0.42 * len(names))).add_subplot()
    shown = [part for part in _PARTS if part in parts]
    for part in shown:
        marker, offset = _PARTS[part]
        own = parts[part][parts[part].policy.isin(names)]
        for name, interval, score in zip(own.policy, own.ci95, own.normalised_score, strict=True):
            height = names.index(name) + offset * (len(shown) > 1)
            colour = line_style(order.index(name))["color"]
            if interval is not None:
                axes.plot(interval, [height] * 2, color=colour, lw=1.6, alpha=0.6)
            axes.plot(score, height, marker, color=colour, markersize=6)
        label = f"{part} ({parts[part].num_groups.iloc[0]} groups)"
        axes.plot([], [], marker, color="0.35", label=label)
    axes.axvline(1.0, color="0.35", lw=1.0)
    axes.text(1.01, 0.02, "oracle", rotation=90, transform=axes.get_xaxis_transform())
    axes.axvline(0.0, color="0.75", lw=1.0, ls=":")
    axes.set_yticks(range(len(names)), [_text(name) for name in names])
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.set_xlabel("normalised score (random 0, oracle 1); bars: 95 % interval")
    _tidy(axes, axis="x", color="0.92")
    where: Any = {"loc": "lower center", "bbox_to_anchor": (0.4, 1.0), "frameon": False}
    axes.legend(ncols=2 if len(shown) > 3 else 3, **where)
    return write_figure(path, figure)


def plot_convergence(
    path: Path, results: Mapping[str, EvaluationResult], order: Sequence[str]
) -> Path:
    """Draw the mean EV error of every frame, a panel per condition, and write it as PNG."""
    rows = -(-len(results) // _COLUMNS)
    columns = -(-len(results) // rows)
    width = max(2.5 * columns + 0.5, 6.0)
    wide = max(1, min(len(order), int(width / (0.5 + 0.065 * max(map(len, order))))))  # legend
    figure = _figure(width, 2.1 * rows + 0.8 + 0.2 * -(-len(order) // wide))
    panels = figure.subplots(rows, columns, sharey=True, sharex=True, squeeze=False)
    for panel, (name, result) in zip(panels.flat, results.items(), strict=False):
        for i, policy in enumerate(order):
            errors = result.episode_metrics(policy)["ev_error"].mean(axis=0)  # (E, T)
            means = metrics.group_means(errors.T, result.groups).mean(axis=-1)
            panel.plot(np.arange(1, len(means) + 1), means, lw=1.3, **line_style(i))
        panel.set_title(name, fontsize=9)
        panel.set_yscale("symlog", linthresh=1.0, linscale=1.0)
        panel.set_yticks([0, 1, 2, 4, 8, 16], ["0", "1", "2", "4", "8", "16"], fontsize=8)
        panel.set_ylim(0, None)
        panel.xaxis.get_major_locator().set_params(integer=True)
        _tidy(panel, labelsize=8)
    for empty in panels.flat[len(results) :]:
        empty.set_visible(False)
    for lowest in panels.flat[max(len(results) - columns, 0) : len(results)]:
        lowest.tick_params(labelbottom=True)
        lowest.set_xlabel("frame", fontsize=9)
    for left in panels[:, 0]:
        left.set_ylabel("mean EV error [EV]", fontsize=9)
    shown = panel.get_lines(), [_text(policy) for policy in order]
    figure.legend(*shown, loc="outside lower center", ncols=wide, fontsize=8)
    return write_figure(path, figure)


def plot_learning(path: Path, curves: Mapping[str, Mapping[str, Sequence[float]]]) -> Path:
    """Draw learning curves, a panel per reported value, and write them as PNG.

    `curves` are, by training, ``frames`` and each value it reported after so many.
    """
    values = [name for name in next(iter(curves.values())) if name != "frames"]
    figure = _figure(max(7.5, 3.2 * len(values)), 3.2)
    panels = figure.subplots(1, len(values), squeeze=False)[0]
    for panel, value in zip(panels, values, strict=True):
        for i, (training, curve) in enumerate(curves.items()):
            panel.plot(curve["frames"], curve[value], lw=1.3, label=training, **line_style(i))
        panel.set(xlabel="frames", ylabel=f"{value} in training")
        panel.ticklabel_format(axis="x", style="sci", scilimits=(3, 3))
        if value != "reward":  # an error, which falls
            panel.set_yscale("log")
        _tidy(panel, labelsize=8)
    if len(curves) > 1:
        lines = panels[0].get_lines()
        figure.legend(lines, list(curves), loc="outside lower center", ncols=4, fontsize=8)
    return write_figure(path, figure)


def plot_stability(path: Path, found: Stability, rows: pd.DataFrame) -> Path:
    """Draw frames to settle, margins of the loop gain and three answers to steps, as PNG.

    `rows` are the `stability_rows` of what was `found`.
    """
    figure, cases = _figure(12.0, 3.6), found.cases
    heat, margins, traces = figure.subplots(1, 3, width_ratios=(4, 4, 5))
    sound = cases[(cases.fault == "none") & (cases.gain == 0.0)]
    image = heat.imshow(sound.settling.to_numpy().reshape(len(DELAYS), -1), origin="lower")
    heat.set_facecolor("0.85")  # of those that do not settle
    cycling = sound[sound.amplitude > 0.0]
    places = cycling.step.map(STEPS.index), cycling.delay
    heat.plot(*places, "x", color="#D55E00", label="limit cycle")
    heat.set_xticks(range(len(STEPS)), [f"{step:+g}" for step in STEPS])
    heat.set(xlabel="step of the light [EV]", ylabel="delay [frames]", title="no fault")
    figure.colorbar(image, ax=heat, label="frames to settle (grey: does not)")
    for i, (fault, own) in enumerate(rows.groupby("fault", sort=False)):
        (line,) = margins.plot(own.delay, own.gain_margin, ".-", label=fault)
        line.set(**line_style(i))
    margins.plot(rows.delay, rows.analytic, "k:", lw=2.5, label="theory, no fault")
    margins.set_ylim(-0.1, cases.gain.max() + 0.1)
    margins.set(xlabel="delay [frames]", ylabel="loop gain up to which it settles [stops]")
    margins.legend(fontsize=7)
    plain = (cases.gain == 0.0) & cases.settling.notna()
    pulse = int(cases.amplitude.where(plain, 0.0).argmax())
    # Delay 2 and the last step but one, delay 6 and the first step; the largest pulse.
    first, wide = sound.index.to_numpy(), len(STEPS)
    for i, row in enumerate((first[3 * wide - 2], first[6 * wide], pulse)):
        case, style = cases.loc[row], line_style(i)
        style["label"] = f"{case.step:+g} EV, delay {case.delay}, {case.fault}"
        evs = found.evs[row] - found.evs[row, LEAD - 1]
        traces.plot(np.arange(len(evs)) - LEAD, evs, lw=1.2, **style)
    traces.set(xlabel="frames after the step", ylabel="exposure from the last light's [EV100]")
    traces.legend(fontsize=7)
    for panel in (margins, traces):
        _tidy(panel, labelsize=8)
    figure.suptitle(_text(found.name), fontsize=11)
    return write_figure(path, figure)


def line_style(index: int) -> dict[str, Any]:
    """Colour and dashes of a policy by its position in the ranking; no two are equal below 50."""
    colour, dashes = PATH_COLOURS[index % len(PATH_COLOURS)], _DASHES[index // 5 % len(_DASHES)]
    return {"color": colour, "linestyle": dashes}


def pareto_front(
    costs: Mapping[str, float], scores: Mapping[str, float], same: float = 0.0
) -> list[str]:
    """Names that no other beats in both cost and score, the cheapest first.

    Scores that differ by `same` or less are the same.

    >>> pareto_front({"a": 1.0, "b": 2.0, "c": 3.0}, {"a": 0.5, "b": 0.4, "c": 0.9})
    ['a', 'c']
    """
    front, best = list[str](), -np.inf
    for name in sorted(scores, key=lambda n: (costs[n], -scores[n])):
        if scores[name] > best + same:
            front.append(name)
        best = max(best, scores[name])
    return front


def plot_cost(
    path: Path, costs: Mapping[str, float], scores: Mapping[str, float], order: Sequence[str]
) -> Path:
    """Draw normalised score against the time of one decision [ms] and write it as PNG.

    `order` are the policies in the order of the colours.
    """
    from matplotlib.ticker import LogLocator

    figure = _figure(7.5, 4.0 + 0.1 * len(scores))
    axes = figure.add_subplot()
    points = {name: (costs[name], scores[name]) for name in scores}
    steps = np.transpose([points[name] for name in pareto_front(costs, scores)])
    label = "nothing else is both faster and better"
    axes.step(*steps, where="post", color="0.6", lw=1.0, label=label)
    colours = [line_style(order.index(name))["color"] for name in scores]
    axes.scatter([costs[name] for name in scores], [*scores.values()], c=colours, zorder=2)
    axes.set_xscale("log", subs=[])
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.margins(x=0.18, y=0.12)
    axes.set_xlabel("time of a decision for one camera alone [ms]")
    axes.set_ylabel("normalised score (random 0, oracle 1)")
    _tidy(axes)
    figure.legend(frameon=False, fontsize=8, loc="outside lower center")
    _label(axes, points, colours)
    return write_figure(path, figure)


def _label(axes: Axes, points: Mapping[str, tuple[float, float]], colours: Sequence[str]) -> None:
    """Write names at points, apart from each other, each nearest to its own point if possible."""
    from matplotlib.text import Text

    figure: Any = axes.figure
    figure.draw_without_rendering()  # settles where the points lie
    spots = axes.transData.transform(list(points.values()))
    boxes = [*np.hstack([spots - 5, spots + 5])]  # of the marks: left, bottom, right, top
    for line in axes.get_lines():  # whose path is steps
        ends = axes.transData.transform(line.get_path().vertices)
        boxes += [*np.hstack([np.minimum(ends[1:], ends[:-1]), np.maximum(ends[1:], ends[:-1])])]
    frame = axes.get_window_extent().extents
    around = [np.array([np.cos(a), np.sin(a)]) for a in np.arange(16) * np.pi / 8]
    for name, spot, colour in zip(points, spots, colours, strict=True):
        arrow = {"arrowstyle": "-", "lw": 0.6, "color": colour, "shrinkA": 0, "shrinkB": 3}
        how: Any = {"textcoords": "offset points", "arrowprops": arrow, "in_layout": False}
        how |= {"fontsize": 8, "color": colour, "va": "bottom"}
        text = axes.annotate(_text(name), points[name], (0, 0), **how)
        size = np.array(Text.get_window_extent(text).size)  # without the line
        steps = [d * (r + size / 2) - size / 2 for r in (7, 12, 20, 30, 45, 65) for d in around]
        tried = [np.concatenate([spot + step, spot + step + size]) for step in steps]
        best = min(tried, key=lambda box: _label_cost(box, spot, spots, boxes, frame))
        boxes.append(best)
        text.xyann = tuple((best[:2] - spot) * 72.0 / figure.dpi)


def _label_cost(box: Any, spot: Any, spots: Any, boxes: Sequence[Any], frame: Any) -> Any:
    """What is wrong with a label's place: what it covers, leaves, is nearer to; its distance."""
    covered = sum(((box[:2] < other[2:]) & (other[:2] < box[2:])).all() for other in boxes)
    outside = (box[:2] < frame[:2]).any() or (box[2:] > frame[2:]).any()
    far = np.hypot(*np.maximum(np.maximum(box[:2] - spots, spots - box[2:]), 0).T)
    own = far[(spots == spot).all(axis=1)][0]
    return covered, outside, own > far.min(), own


def path_sheets(
    folder: Path, results: Mapping[str, EvaluationResult], order: Sequence[str]
) -> dict[str, Path]:
    """Write contact sheets of one scene's states with the paths of the best policies.

    They are ``contact_sheet.webp``, and ``contact_sheet_2.webp`` for more policies; none where the
    light changes at once, the scenes are not known, or the grid has too many states for a sheet.
    """
    from ae_env.rendering import MAX_SHEET_STATES, contact_sheet

    steady = [r for r in results.values() if not np.ptp(r.scores[:, :_PATH_FRAMES], axis=1).any()]
    if not steady or not steady[0].scenes or len(steady[0].grid) > MAX_SHEET_STATES:
        return {}
    result, last = steady[0], min(_PATH_FRAMES, steady[0].scores.shape[1]) - 1
    ends = np.array([result.tracks[name].states[0, :, last] for name in order[:_PATHS]])
    spread = np.std([result.scores[np.arange(len(own)), last, own] for own in ends], axis=0)
    differing = [len(set(own)) for own in ends.T.tolist()]  # states that policies end in
    episode = int(np.argmax(_PATHS * np.isin(result.kinds, _KINDS) + differing + spread))
    options, start = result.plan.options(), int(result.start_states[episode])
    files = {}
    for k, first in enumerate(range(0, min(len(order), _SHEETS * _PATHS), _PATHS)):
        shown = order[first : first + _PATHS]
        states = {name: result.tracks[name].states[0, episode, :_PATH_FRAMES] for name in shown}
        picture = contact_sheet(
            result.scenes[episode],
            camera=options.make_camera(),
            grid=result.grid,
            scorer=options.make_scorer(),
            path={name: [start, *own.tolist()] for name, own in states.items()},
            colours=[line_style(first + i)["color"] for i in range(len(shown))],
            **result.moves(episode),
        )
        name = "contact_sheet.webp" if k == 0 else f"contact_sheet_{k + 1}.webp"
        files[name] = write_picture(folder / name, picture, quality=_QUALITY)
    return files


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _tidy(axes: Axes, labelsize: int | None = None, color: str = "0.93", **grid: Any) -> None:
    """A grid below the marks, no frame, and small labels of the ticks where there are panels."""
    axes.grid(color=color, **grid)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if labelsize is not None:
        axes.tick_params(which="both", labelsize=labelsize)


def _text(name: str) -> str:
    """A name as Matplotlib shows it: without formulas."""
    return name.replace("$", r"\$")


def write_figure(path: Path, figure: Figure) -> Path:
    """Write a figure: photographs as WebP, plots as PNG of 256 colours at 200 dots per inch."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=100 if path.suffix == ".webp" else 200)
    picture = Image.open(stream).convert("RGB")
    if path.suffix == ".webp":
        return write_picture(path, picture, quality=80, method=6)
    return write_picture(path, picture.quantize(256, dither=Image.Dither.NONE), optimize=True)
