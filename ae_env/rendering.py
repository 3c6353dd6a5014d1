"""Pictures for people: one capture with its settings and score, and all states of a scene."""

import io
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageColor, ImageDraw, ImageFont

from ae_env.grid import ExposureGrid
from ae_env.observation import linear_signal
from ae_env.scenes.scene import Scene
from ae_env.scorers.captures import prepare_scene
from ae_env.scorers.registry import make_scorer
from ae_env.scorers.score_table import ScoreTable, ScoreTables
from ae_env.scorers.terms import CompositeScorer
from simulator.camera import CameraProfile
from simulator.optics.motion import ALONG_ROWS, Movement
from simulator.raw.develop import develop
from simulator.settings import CameraSettings, format_exposure_time
from simulator.utils.checks import check_type

#: Least side of a rendered frame [pixel].
FRAME_PIXELS = 256
#: A contact sheet of more states would be unreadable. Height of one picture on it [pixel], and that
#: which scenes are averaged to for it [packed pixel].
MAX_SHEET_STATES, THUMB_PIXELS, CAPTURE_PIXELS = 256, 104, 192
#: Colours for up to ten policies, most of them those of Okabe and Ito (2008).
PATH_COLOURS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C8C8C", "#B8A800"),
    *("#8C4B1F", "#8A6FE8"),
)
_font: Any = ImageFont.load_default
_BACKGROUND, _INK, _FAINT = (27, 27, 27), (235, 235, 235), (165, 165, 165)
_BORDER, _GAP, _MARGIN, _PANEL_GAP = 5, 4, 18, 22
_TITLE_HEIGHT, _LABEL_WIDTH, _LABEL_HEIGHT = 76, 48, 20
#: Of a sheet with paths: height of the strip below each picture, and width of the charts [pixel].
_STRIP, _CHARTS = 21, 400


def render_frame(
    raw: np.ndarray, scene: Scene, camera: CameraProfile, settings: CameraSettings, score: float
) -> np.ndarray:
    """A capture developed, with its settings and score written on it, (H, W, 3) uint8 sRGB.

    `raw` is (4, H, W) as it is observed: uint8 codes, uint16 digital numbers or float signals. It
    is enlarged by a whole factor to at least 256 pixels.
    """
    image = developed(torch.from_numpy(linear_signal(raw[None], camera)), scene)[0]
    factor = -(-FRAME_PIXELS // min(image.shape[:2]))
    picture = Image.fromarray(np.repeat(np.repeat(image, factor, 0), factor, 1))
    lines = (str(settings), f"EV100 {settings.ev100:.1f}   score {score:.3f}")
    size = max(12, picture.height // 20)
    height = int(1.35 * size * len(lines) + 0.5 * size)
    band = Image.new("RGBA", (picture.width, height), (0, 0, 0, 150))
    draw = ImageDraw.Draw(band)
    for i, line in enumerate(lines):
        font = fitting_font(draw, line, size, picture.width - size, least=6)
        draw.text((size // 2, size // 4 + int(1.35 * size * i)), line, _INK, font)
    picture.paste(band, (0, picture.height - height), band)
    return np.asarray(picture).copy()


def developed(signal: torch.Tensor, scene: Scene) -> np.ndarray:
    """Captures (B, 4, H, W) of `scene` as sRGB pictures (B, H, W, 3) uint8."""
    rgb = develop(signal, scene.white_balance, scene.camera.colour_matrix)
    return np.asarray(rgb.mul(255.0).round_().byte().permute(0, 2, 3, 1).numpy())


def contact_sheet(
    scene: Scene,
    *,
    camera: CameraProfile | None = None,
    grid: ExposureGrid | None = None,
    scorer: str | Mapping[str, float] | CompositeScorer = "balanced",
    speed: float = 0.0,
    defocus: float = 0.0,
    movement: Movement = ALONG_ROWS,
    path: Sequence[int] | Mapping[str, Sequence[int]] | None = None,
    colours: Sequence[str] = PATH_COLOURS,
    seed: int = 0,
) -> Image.Image:
    """All exposure states of a scene as one picture.

    One panel per ISO; in it the exposure time grows to the right and the f-number downwards. The
    frame of each capture shows its expected score, and a star marks the oracle. With paths, the
    strip below a capture names the frames in which each policy chose its state, and charts beside
    the sheet show score, EV100 and controls of each policy over the frames. A `ValueError` if the
    grid has more states, or a path leaves it, or `scene` is none.

    Args:
        scene: Of any size and shape; large ones are averaged down first.
        camera, grid: By default the scene's, and the default grid; at most 256 states.
        scorer: Scorer of the captures, as `make_scorer` takes it.
        speed, defocus, movement: See `ae_env.scorers.captures.prepare_scene`.
        path: States that a policy went through, the start state first; or several by name.
        colours: Of the paths, in turn.
        seed: Seed of the noise.
    """
    check_type("scene", scene, Scene)
    camera = scene.camera if camera is None else camera
    grid = ExposureGrid.default() if grid is None else grid
    if len(grid) > MAX_SHEET_STATES:
        raise ValueError(f"`grid` ({len(grid)} states) must have at most {MAX_SHEET_STATES} states")
    paths = _checked_paths(path, len(grid))
    colours = [*itertools.islice(itertools.cycle(colours), len(paths))]
    scene = scene.averaged(max(1, min(scene.light.shape[1:]) // CAPTURE_PIXELS))
    moves: Any = {"speed": speed, "defocus": defocus, "movement": movement}
    table = ScoreTables(grid, camera, make_scorer(scorer)).table(scene, **moves)
    frames: Iterable[torch.Tensor]
    if scene.recorded is None:
        frames = prepare_scene(scene, camera, **moves).stream(grid.states, seed=seed)
    else:  # black where there is none
        frames = scene.recorded[scene.frame_of_state]
        frames = (f * float(a) for f, a in zip(frames, np.asarray(scene.allowed), strict=True))
    pictures = [Image.fromarray(developed(frame[None], scene)[0]) for frame in frames]
    return _Sheet(grid, table, pictures, paths, colours).draw(_title(scene, moves, grid, table))


def _checked_paths(path: Any, count: int) -> dict[str, list[int]]:
    if path is None:
        return {}
    named = dict(path) if isinstance(path, Mapping) else {"policy": path}
    paths = {}
    for name, states in named.items():
        values = np.asarray(states)
        fits = values.ndim == 1 and values.size > 0 and values.dtype.kind in "iu"
        if not fits or values.min() < 0 or values.max() >= count:
            rule = f"must be a list of states in [0, {count})"
            raise ValueError(f"`path` of {name!r} (={states!r}) {rule}")
        paths[str(name)] = values.tolist()
    return paths


def _title(
    scene: Scene, moves: dict[str, Any], grid: ExposureGrid, table: ScoreTable
) -> tuple[str, str]:
    lux = scene.illuminance
    light = "light unknown" if lux is None else f"{float(f'{lux:.4g}'):,g} lux"
    parts = [scene.scene_id, f"{light} (EV100 {scene.ev100:.1f})"]
    expected = "score" if scene.recorded is not None else "expected score"
    best = f"best state: {grid[table.oracle]}, {expected} {table.mean[table.oracle]:.3f}"
    if scene.recorded is not None:
        return "   ·   ".join([*parts, "real captures"]), best
    speed, own = moves["speed"], moves["movement"].subject_speed
    if speed or not own:
        parts.append(f"moves {speed:.3g} frame heights/s" if speed else "nothing moves")
    if own and scene.layout is not None:
        parts.append(f"subject moves {own:.3g} frame heights/s")
    blur = scene.own_blur(4.0) * 64.0 / scene.light.shape[-2]
    focus = f"its own defocus, {blur:.3g} px of 64 at f/4" if blur else "all in focus"
    drawn = moves["defocus"]
    parts.append(f"defocus {drawn:.3g} px of 64 at f/4" if drawn else focus)
    return "   ·   ".join(parts), best


@dataclass(frozen=True)
class _Sheet:
    """Layout and drawing of a contact sheet."""

    grid: ExposureGrid
    table: ScoreTable
    pictures: list[Image.Image]
    paths: dict[str, list[int]]
    colours: Sequence[str] = ()  # of the paths

    @property
    def thumb(self) -> tuple[int, int]:
        """Width and height of one picture."""
        width, height = self.pictures[0].size
        return max(24, min(2 * THUMB_PIXELS, THUMB_PIXELS * width // height)), THUMB_PIXELS

    @property
    def pitch(self) -> int:
        """Height of one picture with its strip and the gap below it."""
        return THUMB_PIXELS + _GAP + (_STRIP if self.paths else 0)

    @property
    def panel(self) -> tuple[int, int]:
        """Width and height of the captures of one ISO, without labels."""
        _, times, apertures = self.grid.shape
        return times * (self.thumb[0] + _GAP) - _GAP, apertures * self.pitch - _GAP

    @property
    def labels(self) -> tuple[list[str], list[str], list[str]]:
        """Names of the values of the controls: ISO, exposure time, f-number."""
        times = [format_exposure_time(value) for value in self.grid.exposure_times]
        isos = [f"ISO {value:.5g}" for value in self.grid.isos]
        return isos, times, [f"f/{value:g}" for value in self.grid.f_numbers]

    @property
    def panel_columns(self) -> int:
        """Panels side by side, so that the sheet comes out about square."""
        columns, (width, height) = np.arange(1, self.grid.shape[0] + 1), self.panel
        ratios = columns * width / (-(-len(columns) // columns) * height)
        return int(np.abs(np.log(ratios)).argmin()) + 1

    def corner(self, state: int) -> tuple[int, int]:
        """Upper left corner of the picture of `state`."""
        iso, time, aperture = self.grid.controls(state)
        row, column = divmod(int(iso), self.panel_columns)
        x, y = self.panel_corner(row, column)
        return x + int(time) * (self.thumb[0] + _GAP), y + int(aperture) * self.pitch

    def panel_corner(self, row: int, column: int) -> tuple[int, int]:
        """Upper left corner of a panel's first picture."""
        width, height = self.panel
        x = _MARGIN + _LABEL_WIDTH + column * (width + _LABEL_WIDTH + _PANEL_GAP)
        y = _TITLE_HEIGHT + 2 * _LABEL_HEIGHT
        return x, y + row * (height + 2 * _LABEL_HEIGHT + _PANEL_GAP)

    def draw(self, title: tuple[str, str]) -> Image.Image:
        """The finished sheet."""
        rows = -(-self.grid.shape[0] // self.panel_columns)
        right, bottom = self.panel_corner(rows, self.panel_columns)
        width = max(right - _LABEL_WIDTH - _PANEL_GAP + _MARGIN, 560)
        room = (700 + 20 * len(self.paths)) * bool(self.paths)  # for the charts
        height = max(bottom - 2 * _LABEL_HEIGHT + 58, room)
        sheet = Image.new("RGB", (width + _CHARTS * bool(self.paths), height), _BACKGROUND)
        draw = ImageDraw.Draw(sheet)
        font = fitting_font(draw, title[0], 20, width - 2 * _MARGIN)
        draw.text((_MARGIN, 14), title[0], _INK, font)
        font = fitting_font(draw, title[1], int(font.size) - 2, width - 2 * _MARGIN)
        draw.text((_MARGIN, 44), title[1], _FAINT, font)
        self._draw_labels(draw)
        allowed = self.table.allowed
        for state, picture in enumerate(self.pictures):
            if allowed is None or allowed[state]:
                self._draw_picture(sheet, draw, state, picture)
        self._draw_legend(sheet, draw)
        overlay = Image.new("RGBA", (2 * width, 2 * height))  # at twice the size: smooth lines
        self._draw_visits(ImageDraw.Draw(overlay))
        self._draw_star(ImageDraw.Draw(overlay))
        sheet.paste(overlay.reduce(2).convert("RGB"), mask=overlay.reduce(2).getchannel("A"))
        if self.paths:
            sheet.paste(self._charts(height), (width, 0))
        return sheet

    def _colour(self, score: float) -> tuple[int, int, int]:
        from matplotlib import colormaps

        position = float(np.clip(score / max(float(self.table.mean.max()), 1e-9), 0.0, 1.0))
        red, green, blue, _ = colormaps["viridis"](position, bytes=True)
        return int(red), int(green), int(blue)

    def _draw_labels(self, draw: ImageDraw.ImageDraw) -> None:
        (width, _), (isos, times, f_numbers) = self.thumb, self.labels
        for i, iso in enumerate(isos):
            x, y = self.panel_corner(*divmod(i, self.panel_columns))
            draw.text((x, y - 2 * _LABEL_HEIGHT - 2), iso, _INK, _font(17))
            for j, time in enumerate(times):
                at = x + j * (width + _GAP) + width // 2
                draw.text((at, y - 5), time, _FAINT, _font(13), anchor="md")
            for k, f_number in enumerate(f_numbers):
                at = y + k * self.pitch + THUMB_PIXELS // 2
                draw.text((x - 6, at), f_number, _FAINT, _font(13), anchor="rm")

    def _draw_picture(
        self, sheet: Image.Image, draw: ImageDraw.ImageDraw, state: int, picture: Image.Image
    ) -> None:
        (x, y), (width, height) = self.corner(state), self.thumb
        score = float(self.table.mean[state])
        draw.rectangle((x, y, x + width - 1, y + height - 1), self._colour(score))
        inner = (width - 2 * _BORDER, height - 2 * _BORDER)
        sheet.paste(picture.resize(inner, Image.Resampling.BICUBIC), (x + _BORDER, y + _BORDER))
        corner = (x + _BORDER, y + height - _BORDER)
        where: Any = {"xy": (corner[0] + 4, corner[1] - 2), "text": f"{score:.2f}", "anchor": "lb"}
        where["font"] = _font(18 if state == self.table.oracle else 13)
        box = draw.textbbox(**where)
        draw.rectangle((corner[0], box[1] - 3, box[2] + 3, corner[1] - 1), (0, 0, 0))
        draw.text(**where, fill=_INK)

    def _draw_visits(self, draw: ImageDraw.ImageDraw) -> None:
        """Below a picture the first frame of each policy there, at a place of the policy's own."""
        for i, (colour, states) in enumerate(zip(self.colours, self.paths.values(), strict=True)):
            width = 2 * self.thumb[0] // len(self.paths)
            ink = "white" if np.dot(ImageColor.getrgb(colour)[:3], (3, 6, 1)) < 1000 else "black"
            for state in dict.fromkeys(states):
                x, y = self.corner(state)
                x, y = 2 * x + i * width, 2 * (y + THUMB_PIXELS) + 5
                draw.rounded_rectangle((x, y, x + width - 2, y + 34), 9, colour)
                label = f"{states.index(state)}{'+' * (states.count(state) > 1)}"
                draw.text((x + width // 2, y + 17), label, ink, _font(25), anchor="mm")

    def _charts(self, height: int) -> Image.Image:
        """Score, EV100 and controls of each policy over the frames; dotted: of the best state."""
        from matplotlib import style
        from matplotlib.figure import Figure

        names = [name if len(name) < 45 else f"…{name[-43:]}" for name in self.paths]
        values = self.table.mean, self.grid.ev100, *self.grid.controls(np.arange(len(self.grid))).T
        look: dict[str, Any] = dict.fromkeys(("figure.facecolor", "axes.facecolor"), "#1b1b1b")
        look |= {"text.parse_math": False, "axes.titlelocation": "left", "legend.frameon": False}
        look |= {"axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": "0.5"}
        with style.context(["dark_background", look]):
            figure = Figure((_CHARTS / 100, height / 100), dpi=100, layout="constrained")
            panels = figure.subplots(len(values), sharex=True)
            for panel, value, labels in zip(panels, values, ([], [], *self.labels), strict=True):
                widths = np.linspace(2.0 * len(names), 1.8, len(names))  # so that all are seen
                for states, *own in zip(self.paths.values(), self.colours, widths, strict=True):
                    panel.plot(value[states], color=own[0], lw=own[1])
                panel.axhline(value[self.table.oracle], color="white", ls=":", lw=1.5)
                if labels:
                    each = -(-len(labels) // 6)
                    panel.set_yticks(range(0, len(labels), each), labels[::each])
            panels[0].set_title("score on the sheet", fontsize=11)
            panels[1].set_title("EV100", fontsize=11)
            panel.set_xlabel("frame")
            panel.xaxis.get_major_locator().set_params(integer=True)
            figure.legend(panel.get_lines(), [*names, "best state"], loc="outside upper left")
            figure.savefig(stream := io.BytesIO(), format="png")
        return Image.open(stream)

    def _draw_star(self, draw: ImageDraw.ImageDraw) -> None:
        x, y = self.corner(self.table.oracle)
        width, height = self.thumb
        frame = (2 * x - 4, 2 * y - 4, 2 * (x + width) + 3, 2 * (y + height) + 3)
        draw.rectangle(frame, None, "white", 6)
        draw.polygon(_star(2 * (x + width - 18), 2 * (y + 18), 24), "white", "black")

    def _draw_legend(self, sheet: Image.Image, draw: ImageDraw.ImageDraw) -> None:
        best, y = float(self.table.mean.max()), sheet.height - 40
        for i in range(150):
            draw.line((_MARGIN + i, y, _MARGIN + i, y + 12), self._colour(best * i / 149))
        for x, text in ((0, "0"), (75, "expected score"), (150, f"{best:.2f}")):
            draw.text((_MARGIN + x, y + 15), text, _FAINT, _font(12), anchor="lmr"[x // 75] + "a")
        draw.polygon(_star(_MARGIN + 180, y + 7, 10), "white")
        draw.text((_MARGIN + 195, y + 7), "best state", _INK, _font(14), anchor="lm")


def _star(x: float, y: float, radius: float) -> list[tuple[float, float]]:
    angles = np.arange(10) * np.pi / 5
    radii = np.where(np.arange(10) % 2, 0.4 * radius, radius)
    corners = np.stack([x + radii * np.sin(angles), y - radii * np.cos(angles)], axis=1)
    return [(column, row) for column, row in corners.tolist()]


def fitting_font(
    draw: ImageDraw.ImageDraw, line: str, size: int, width: int, *, least: int = 9
) -> Any:
    """The font of at most `size` in which `line` is at most `width` wide, or that of `least`."""
    while size > least and draw.textlength(line, _font(size)) > width:
        size -= 1
    return _font(size)
