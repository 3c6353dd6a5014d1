"""Ladders of machine-readable codes or tags, drawn into scenes that know where each of them is.

``scenes="NAME?codes"`` draws Data Matrix symbols (``"NAME?tags"`` AprilTags) on planar boards into
every scene: one board in the sun, one in the shade, or one in each. Every board has one code of
each rung of `RUNGS`: its modules become smaller, and its two greys come nearer to each other. Light
greys are the first to clip, dark ones the first to drown in noise, so the share of readable codes
falls a few codes at a time as the exposure leaves the best one.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.random import Generator

from simulator.capture.blurred_frames import Layout
from simulator.radiance.light import WHITE_SIGNAL
from simulator.utils.checks import check_integer, import_extra

if TYPE_CHECKING:
    from ae_env.scenes.scene import Scene

Array = np.ndarray
#: Rungs from the easiest to the hardest: side of a module [frame heights], reflectances of the dark
#: and of the light modules.
RUNGS = (
    (0.0180, 0.020, 0.90),
    (0.0180, 0.450, 0.55),
    (0.0155, 0.250, 0.60),
    (0.0155, 0.040, 0.06),
    (0.0140, 0.130, 0.18),
    (0.0140, 0.450, 0.65),
    (0.0125, 0.080, 0.12),
    (0.0125, 0.700, 0.75),
)
#: Smallest frame [packed pixel]: the largest modules are nearly two pixels wide there.
MIN_SIZE = 96
#: Modules of a side of a code, and of its cell, which has the quiet zone as well.
MODULES, CELL = 10, 12
#: Light on a board, relative to the incident light [EV], uniform: a room seen from a sunlit street
#: has eight stops less.
LIGHT_EV = {"sun": (-0.5, 1.5), "shade": (-8.0, -3.0)}
#: Boards that a scene may get, each entry with the same chance.
_BOARDS = (("sun",), ("sun",), ("shade",), ("shade",), ("sun", "shade"))
#: Reflectance of a board between its codes.
_GREY = 0.35
#: Largest turn of a board [rad], and what its far side lacks at most of the near one's length.
_TURN, _FAR = math.radians(5.0), 0.15
#: Sets of places that are tried; samples per pixel's side; raised when the drawing changes.
_TRIES, _SAMPLES, _VERSION = 8, 4, 1


@dataclass(frozen=True, eq=False)
class Ladder:
    """What the N codes of a scene say, and where they are."""

    kind: str  # one of `KINDS`
    texts: tuple[str, ...]
    rungs: tuple[int, ...]  # indices into `RUNGS`
    boards: tuple[str, ...]  # "sun" or "shade"
    #: (N, 4, 2) float64 x and y of the corners of the cells [pixel of the frame, from its upper
    #: left corner], clockwise from the upper left one of the code.
    corners: Array

    def within(self, top: int, left: int, k: int) -> Ladder:
        """The codes in a frame that begins at this row and column, k x k pixels in one."""
        return replace(self, corners=(self.corners - (left, top)) / k)

    @property
    def facts(self) -> tuple[Any, ...]:
        """All of it in plain values."""
        return self.kind, self.texts, self.rungs, self.boards, self.corners.tolist()


def zxing() -> Any:
    """The module zxingcpp, or an `ImportError` that names the extra."""
    return import_extra("zxingcpp", "tasks", "a ladder of codes")


def tag_dictionary() -> Any:
    """OpenCV's AprilTags 36h11, or an `ImportError` that names the extra."""
    aruco = import_extra("cv2", "cv", "a ladder of tags").aruco
    return aruco.getPredefinedDictionary(aruco.DICT_APRILTAG_36h11)


def _code(rng: Generator) -> tuple[str, Array]:
    text = f"{rng.integers(10**6):06d}"
    made = zxing().create_barcode(text, zxing().BarcodeFormat.DataMatrix)
    return text, np.asarray(made.to_image(scale=1, add_quiet_zones=False)) > 0


def _tag(rng: Generator) -> tuple[str, Array]:
    tags = tag_dictionary()
    number = int(rng.integers(len(tags.bytesList)))
    return str(number), np.pad(tags.generateImageMarker(number, 8) > 0, 1, constant_values=True)


#: What draws a code of each kind: its text, and its modules (10, 10) bool, True is light.
KINDS: dict[str, Callable[[Generator], tuple[str, Array]]] = {"codes": _code, "tags": _tag}


def check_size(resolution: object) -> None:
    """A `ValueError` unless scenes of so many pixels a side can have codes drawn into them."""
    check_integer("resolution", resolution, MIN_SIZE, 4096, more=" to draw codes into scenes")


def with_ladder(scene: Scene, kind: str = "codes", seed: int = 0) -> Scene:
    """`scene` with boards of codes, which its name and `seed` decide, and with `Scene.ladder`.

    Where a scene has a layout, one board is its subject: in focus, and free to move by itself.

    A `ValueError` if the scene has noise of its own, is recorded or smaller than `MIN_SIZE`.
    """
    height = scene.light.shape[1]
    check_size(min(scene.light.shape[1:]))
    if not scene.noise_free or scene.recorded is not None:
        raise ValueError(
            f"`scenes` ({scene.scene_id!r}) must be light without noise to have codes drawn into "
            "it, such as 'bundled' or 'polyhaven'"
        )
    rng = np.random.default_rng([zlib.crc32(f"{kind} {scene.scene_id}".encode()), seed, _VERSION])
    sorts = _BOARDS[rng.integers(len(_BOARDS))]
    light = scene.light.numpy().copy()
    white = WHITE_SIGNAL * 2.0 ** (scene.reference.log2_exposure + scene.ev100)
    masks, rows = [], []
    for sort, quad in zip(sorts, _places(rng, sorts, light[1]), strict=True):
        ev = rng.uniform(*LIGHT_EV[sort])
        drawn = [KINDS[kind](rng) for _ in RUNGS]
        board = _matrix(_rectangle(*_board_size(height)), quad)
        masks.append(_paint(light, scene, board, white * 2.0**ev, [bits for _, bits in drawn]))
        for rung, ((text, _), cell) in enumerate(zip(drawn, _cells(height), strict=True)):
            rows.append((text, rung, sort, _mapped(board, _rectangle(cell[2], cell[2], *cell[:2]))))
    texts, rungs, boards, corners = zip(*rows, strict=True)
    layout, own = scene.layout, int(rng.integers(len(sorts)))
    if layout is not None:
        defocus = layout.defocus.clone()
        for index, mask in enumerate(map(torch.from_numpy, masks)):
            defocus[mask] = 0.0 if index == own else defocus[mask].mean()
        layout = Layout(defocus, torch.from_numpy(masks[own]))
    ladder = Ladder(kind, texts, rungs, boards, np.stack(corners))
    return replace(scene, light=torch.from_numpy(light), layout=layout, ladder=ladder)


def _cells(height: int) -> list[tuple[float, float, float]]:
    """Left, top and side of the cell of each rung on a board, two in a column [pixel]."""
    cells, left = [], 0.0
    for first, second in zip(RUNGS[::2], RUNGS[1::2], strict=True):
        sides = [rung[0] * height * CELL for rung in (first, second)]
        cells += [(left, 0.0, sides[0]), (left, sides[0], sides[1])]
        left += max(sides)
    return cells


def _board_size(height: int) -> tuple[float, float]:
    """Width and height of a board in a frame of so many rows [pixel]."""
    cells = np.array(_cells(height))
    return (cells[:, 0] + cells[:, 2]).max(), (cells[:, 1] + cells[:, 2]).max()


def _rectangle(width: float, height: float, left: float = 0.0, top: float = 0.0) -> Array:
    """Corners (4, 2), clockwise from the upper left one."""
    right, bottom = left + width, top + height
    return np.array([(left, top), (right, top), (right, bottom), (left, bottom)])


def _places(rng: Generator, sorts: tuple[str, ...], green: Array) -> list[Array]:
    """Corners (4, 2) of the boards in the frame, none before another.

    The sun's board goes to where the scene is bright, that of the shade to where it is dark.
    """
    found = []
    for _ in range(_TRIES):
        quads, spare = [_view(rng, green.shape[0]) for _ in sorts], float(green.shape[0])
        spare -= sum(np.ptp(quad[:, 1]) for quad in quads)
        top, merit = 0.0, 0.0
        for index in rng.permutation(len(sorts)):
            step = rng.uniform(0.0, spare)
            left = rng.uniform(0.0, green.shape[1] - np.ptp(quads[index][:, 0]))
            quads[index] = quads[index] + (left, top + step)
            (x0, y0), (x1, y1) = quads[index].min(axis=0), quads[index].max(axis=0)
            top, spare = float(y1), spare - step
            mean = float(green[int(y0) : int(y1) + 1, int(x0) : int(x1) + 1].mean())
            merit += math.log2(mean + 1e-12) * (1.0 if sorts[index] == "sun" else -1.0)
        found.append((merit, quads))
    return max(found, key=lambda one: one[0])[1]


def _view(rng: Generator, height: int) -> Array:
    """Corners (4, 2) of a board in perspective, from the upper left of their bounding box."""
    quad = _rectangle(*_board_size(height))
    quad, side = quad - quad.mean(axis=0), int(rng.integers(4))
    quad[[side, (side + 1) % 4]] *= rng.uniform(1.0 - _FAR, 1.0)
    turn = rng.uniform(-_TURN, _TURN)
    quad = quad @ np.array([(math.cos(turn), math.sin(turn)), (-math.sin(turn), math.cos(turn))])
    return np.asarray(quad - quad.min(axis=0))


def _matrix(source: Array, target: Array) -> Array:
    """The homography (3, 3) that takes four points to four others."""
    rows, right = [], []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows += [(x, y, 1, 0, 0, 0, -u * x, -u * y), (0, 0, 0, x, y, 1, -v * x, -v * y)]
        right += [u, v]
    return np.append(np.linalg.solve(np.array(rows, np.float64), right), 1.0).reshape(3, 3)


def _mapped(matrix: Array, points: Array) -> Array:
    """Points (..., 2) through a homography."""
    found = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(found[..., :2] / found[..., 2:])


def _paint(light: Array, scene: Scene, board: Array, white: float, codes: list[Array]) -> Array:
    """Paints a board into `light` (4, H, W), where white is `white`; its pixels (H, W) bool.

    Every pixel is a mean over its samples. The planes of a scene that is `Scene.sampled` lie half a
    photosite from the middle of the pixel.
    """
    width, height = _board_size(light.shape[1])
    corners = _mapped(board, _rectangle(width, height))
    (x0, y0) = np.floor(corners.min(axis=0)).astype(int)
    (x1, y1) = np.minimum(np.ceil(corners.max(axis=0)).astype(int), light.shape[:0:-1])
    fine = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    xs, ys = ((np.arange(a, b)[:, None] + fine).ravel() for a, b in ((x0, x1), (y0, y1)))
    points = np.stack(np.meshgrid(xs, ys), axis=-1)
    inverse, mask = np.linalg.inv(board), np.zeros(light.shape[1:], bool)
    gains, region = scene.white_balance, (slice(y0, y1), slice(x0, x1))
    offsets = scene.camera.cfa.offsets if scene.sampled else ((0.5, 0.5),) * 4
    painted: dict[tuple[float, float], tuple[Array, Array]] = {}
    for plane, (row, column) in enumerate(offsets):
        shift = (column - 0.5) / (2.0 * scene.box_factor), (row - 0.5) / (2.0 * scene.box_factor)
        if shift not in painted:
            painted[shift] = _reflected(_mapped(inverse, points + shift), codes, (width, height))
        covered, reflected = painted[shift]
        own = light[plane][region]
        own *= 1.0 - covered
        own += (white * gains[1] / gains[(0, 1, 1, 2)[plane]] * reflected).astype(np.float32)
        mask[region] |= covered > 0.5
    return mask


def _reflected(
    points: Array, codes: list[Array], board: tuple[float, float]
) -> tuple[Array, Array]:
    """Share of each pixel (h, w) that the board covers, and its mean reflectance times that.

    `points` (h samples, w samples, 2) are on the board, which has this width and height.
    """
    x, y = points[..., 0], points[..., 1]
    inside = (x >= 0.0) & (y >= 0.0) & (x < board[0]) & (y < board[1])
    values = np.where(inside, _GREY, 0.0)
    scale = board[1] / _board_size(1)[1]  # rows of the frame
    for bits, (_, dark, white), cell in zip(codes, RUNGS, _cells(1), strict=True):
        left, top, side = (scale * value for value in cell)
        own = np.nonzero((x >= left) & (y >= top) & (x < left + side) & (y < top + side))
        column, row = (((v[own] - v0) * (CELL / side)) for v, v0 in ((x, left), (y, top)))
        modules = np.pad(bits, (CELL - MODULES) // 2, constant_values=True)
        values[own] = np.where(modules[row.astype(int), column.astype(int)], white, dark)
    shape = points.shape[0] // _SAMPLES, _SAMPLES, points.shape[1] // _SAMPLES, _SAMPLES
    covered, reflected = (a.reshape(shape).mean(axis=(1, 3)) for a in (inside * 1.0, values))
    return covered, reflected
