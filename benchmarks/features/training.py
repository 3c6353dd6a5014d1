"""A small detector of local features, the pictures that it learns from, and its training."""

import functools
import time
import zlib
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save
from torch import Tensor, nn

from ae_env.scorers.measures import srgb_decode
from benchmarks.harness import RUNS, real_files
from benchmarks.isolated import ROOT
from simulator import develop
from simulator.augment import ExposureAugmentation, sample_seeds
from simulator.radiance.reading import read_radiance
from simulator.raw.develop import GREY_CARD_SIGNAL, srgb_encode
from simulator.training.scenes import Split, photograph_pictures, radiance_files, recorded_mosaics
from simulator.utils.files import write_atomically

# -- pictures, and pairs of views of them with a known homography ---------------------------------

#: Brightest light of a map, in its medians.
_BRIGHTEST = 64.0
#: Corners that are labels: least contrast, and least distance [pixel].
_LEAST_CORNER, _CORNER_DISTANCE = 2e-5, 4


class Source(NamedTuple):
    """Light of one picture; `group` is the unit of splitting.

    (3, 2H, 2W) linear at the pitch of the photosites, or (4, H, W) planes of a raw; its median
    green is that of a metered exposure.
    """

    name: str
    group: str
    light: Tensor


class View(NamedTuple):
    """A source picture (H, W, 3) uint8 sRGB at its metered exposure, and its corners (N, 2)."""

    picture: np.ndarray
    corners: np.ndarray


def sources(split: Split, *, raws: bool, limit: int | None = None) -> list[Source]:
    data, found = real_files("photo_pool").parent, []
    for picture in islice(photograph_pictures(data, split), limit):
        found.append(Source(picture.name, picture.group, _metered(picture.light)))
    for path, group in islice(radiance_files(data, split), limit):
        light = read_radiance(path)
        light = np.minimum(light / max(float(np.median(light[1])), 1e-9), _BRIGHTEST)
        found.append(Source(path.stem, group, _metered(torch.from_numpy(light))))
    for belongs in ("train", "validation", "test") if raws else ():
        for raw in recorded_mosaics(data, belongs):
            found.append(Source(raw.name, raw.group, _metered(raw.light.clamp(min=0.0))))
    return found


def _metered(light: Tensor) -> Tensor:
    """`light` at an exposure at which its median green is that of a grey card."""
    return light.float() * (GREY_CARD_SIGNAL / max(float(light[1].median()), 1e-9))


def training_view(source: Source) -> View:
    """The picture of a source as files hold them, and Shi and Tomasi's corners of it."""
    packed = source.light[None]
    if packed.shape[1] == 3:
        packed = F.avg_pool2d(packed, 2)[:, [0, 1, 1, 2]]
    picture = develop(packed)[0].permute(1, 2, 0).numpy()
    grey = cv2.GaussianBlur(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
    strength = torch.from_numpy(cv2.cornerMinEigenVal(grey, 5))[None, None]
    largest = F.max_pool2d(strength, 2 * _CORNER_DISTANCE + 1, 1, _CORNER_DISTANCE)
    peaks = ((strength == largest) & (strength > _LEAST_CORNER))[0, 0].nonzero()
    corners = peaks.flip(1).numpy().astype(np.float32)
    return View(np.round(picture * 255.0).astype(np.uint8), corners)


# -- homographies ---------------------------------------------------------------------------------


def crop_homography(
    rng: np.random.Generator,
    centre: np.ndarray,
    size: int,
    scale: float,
    turn: float,
    jitter: float,
) -> np.ndarray:
    """(3, 3) from a picture to a crop of `size` pixels a side around `centre` (x, y).

    `scale` and `turn` [degrees] are the most either way, `jitter` of the corners in sides.
    """
    half = 0.5 * size * scale ** rng.uniform(-1.0, 1.0)
    angle = np.radians(rng.uniform(-turn, turn))
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = square + 2.0 * rng.uniform(-jitter, jitter, (4, 2))
    given = (centre + half * moved @ rotation.T).astype(np.float32)
    wanted = (0.5 * size * (square + 1.0) - 0.5).astype(np.float32)
    return cv2.getPerspectiveTransform(given, wanted).astype(np.float64)


def mapped(points: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Points (N, 2) mapped by a homography."""
    if not len(points):
        return points.reshape(0, 2)
    return cv2.perspectiveTransform(points.astype(np.float64)[None], homography)[0]


def inside(points: np.ndarray, size: int, border: float = 0.0) -> np.ndarray:
    """(N,) whether points lie in a crop."""
    return np.asarray(((points >= border) & (points <= size - 1 - border)).all(axis=1))


def two_crops(
    rng: np.random.Generator, height: int, width: int, size: int
) -> tuple[np.ndarray, np.ndarray]:
    reach = min(0.75 * size, 0.5 * min(height, width))
    centre = np.array([rng.uniform(reach, width - reach), rng.uniform(reach, height - reach)])
    first = crop_homography(rng, centre, size, 1.1, 0.0, 0.0)
    moved = centre + rng.uniform(-0.1, 0.1, 2) * size
    return first, crop_homography(rng, moved, size, 1.25, 25.0, 0.1)


def warped(image: np.ndarray, homography: np.ndarray, size: int) -> np.ndarray:
    flags, border = cv2.INTER_LINEAR, cv2.BORDER_REFLECT_101
    return cv2.warpPerspective(image, homography, (size, size), flags=flags, borderMode=border)


def finer(homography: np.ndarray) -> np.ndarray:
    """The same between pictures of twice the pixels a side."""
    # Pixel x of a picture is at 2 x + 1/2 of the finer one.
    up = np.array([[2.0, 0.0, 0.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]])
    return up @ homography @ np.linalg.inv(up)


def shuffled(count: int, seed: int) -> Iterator[int]:
    """Indices without end, each as often as any other."""
    rng = np.random.default_rng([seed, 1])
    while True:
        yield from rng.permutation(count).tolist()


# -- a small detector and descriptor of local features --------------------------------------------

#: Pixels a side of a cell that holds at most one keypoint.
CELL = 4
#: Keypoints closer than this to the border are left out, and to a stronger one [pixel].
BORDER, SPACING = 4, 3
DESCRIPTOR = 64


class Features(NamedTuple):
    """Keypoints of one picture, the strongest first: x and y [pixel] (N, 2), 0 at the middle of the
    first pixel, and descriptors (N, D) of length 1."""

    points: Tensor
    descriptors: Tensor


def _double(channels_in: int, channels: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for given in (channels_in, channels):
        layers += [nn.Conv2d(given, channels, 3, padding=1, bias=False)]
        layers += [nn.BatchNorm2d(channels), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class Detector(nn.Module):
    """Scores and dense descriptors of a picture: a small SuperPoint (DeTone et al. 2018)."""

    def __init__(self) -> None:
        super().__init__()
        widths = (16, 32, 64, 64)
        self.levels = nn.ModuleList(
            _double(given, width) for given, width in zip((1, *widths), widths, strict=False)
        )
        self.merged = nn.Sequential(nn.Conv2d(128, 64, 1, bias=False), nn.BatchNorm2d(64))
        self.score = nn.Sequential(
            nn.Conv2d(64, 32, 3, padding=1), nn.ReLU(), nn.Conv2d(32, CELL**2 + 1, 1)
        )
        self.descriptor = nn.Conv2d(64, DESCRIPTOR, 1)

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (B, 17, H/4, W/4), the last of "none", and descriptors (B, 64, H/4, W/4).

        `pictures` (B, 3, H, W) are sRGB in [0, 1], H and W multiples of 8.
        """
        grey = 0.299 * pictures[:, :1] + 0.587 * pictures[:, 1:2] + 0.114 * pictures[:, 2:]
        # Every picture to the same mean and contrast, so that a gap is not hopeless from the start.
        deviation, mean = torch.std_mean(grey, dim=(1, 2, 3), keepdim=True)
        x = (grey - mean) / (deviation + 1e-3)
        for index, level in enumerate(self.levels):
            x = level(x if index == 0 else F.max_pool2d(x, 2))
            if index == 2:
                fine = x
        x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
        x = F.relu(self.merged(torch.cat([fine, x], dim=1)))
        return self.score(x), self.descriptor(x)

    @torch.no_grad()
    def detect(self, pictures: Tensor, count: int) -> list[Features]:
        """The `count` strongest keypoints of each picture."""
        logits, dense = self(pictures.contiguous(memory_format=torch.channels_last))
        scores = F.pixel_shuffle(logits.softmax(dim=1)[:, :-1], CELL)
        largest = F.max_pool2d(scores, 2 * SPACING + 1, 1, SPACING)
        scores = torch.where(scores == largest, scores, 0.0)[:, 0]
        scores = F.pad(scores[:, BORDER:-BORDER, BORDER:-BORDER], (BORDER,) * 4)
        found = []
        for score, maps in zip(scores, dense, strict=True):
            values, index = score.flatten().topk(count)
            index = index[values > 0]
            points = torch.stack([index % score.shape[1], index // score.shape[1]], dim=1).float()
            found.append(Features(points, sample(maps[None], points[None])[0]))
        return found


def sample(dense: Tensor, points: Tensor) -> Tensor:
    """Descriptors (B, K, D) of length 1 at points (B, K, 2) of pictures, of a map of cells."""
    height, width = (CELL * n for n in dense.shape[-2:])
    size = torch.tensor([width, height], dtype=points.dtype)
    grid = (points + 0.5) / size * 2.0 - 1.0
    values = F.grid_sample(dense, grid[:, :, None], align_corners=False, padding_mode="border")
    return F.normalize(values[..., 0].transpose(1, 2), dim=-1)


# -- augmentations --------------------------------------------------------------------------------

#: Exposures that plain scaling and ours draw from [EV]; the tests lie within.
STOPS = (-6.0, 4.0)
#: The body whose pictures the detector is for: it lends ours its noise.
CAMERA = "canon_70d"
#: Side of a crop [pixel], pairs of a batch, points of a pair that are described.
SIZE, BATCH, POINTS = 80, 8, 48
STEPS, QUICK_STEPS = 3200, 20
#: Share of the crops that are augmented; the others stay as they are.
AUGMENTED = 0.15
_RATE, _TEMPERATURE, _SAME = 2e-3, 0.1, 6.0

Augmentation = Callable[[Tensor, list[int]], Tensor]


def jittered(pictures: Tensor, seeds: list[int]) -> Tensor:
    """Gamma from 1/3 to 3 and contrast from 0.5 to 1.5."""
    out = []
    for picture, seed in zip(pictures, seeds, strict=True):
        rng = np.random.default_rng(seed)
        gamma, contrast = 3.0 ** rng.uniform(-1.0, 1.0), rng.uniform(0.5, 1.5)
        changed = picture**gamma
        mean = changed.mean()
        out.append(((changed - mean) * contrast + mean).clamp(0.0, 1.0))
    return torch.stack(out)


def scaled(pictures: Tensor, seeds: list[int]) -> Tensor:
    ratios = [2.0 ** np.random.default_rng(seed).uniform(*STOPS) for seed in seeds]
    linear = srgb_decode(pictures) * torch.tensor(ratios)[:, None, None, None]
    return srgb_encode(linear.clamp(0.0, 1.0))


#: By name: none, jitter, plain scaling, ours with its exposure alone, ours in full.
AUGMENTATIONS: dict[str, Augmentation] = {
    "none": lambda pictures, seeds: pictures,
    "jitter": jittered,
    "scaling": scaled,
    "exposure": ExposureAugmentation(CAMERA, STOPS, modules=("exposure",)),
    "full": ExposureAugmentation(CAMERA, STOPS, defocus=(0.0, 0.5), motion=(0.0, 1.0)),
}


# -- training -------------------------------------------------------------------------------------


def train(arm: str, seed: int, steps: int, limit: int | None = None) -> tuple[Detector, float]:
    """The detector trained under an augmentation, or that of an earlier run; and its seconds.

    Random weights are trained without augmentation first, once for each seed, and go on under the
    augmentation for as many steps. All arms see the same crops in the same order.
    """
    files, checksum = (ROOT / "simulator" / "augment.py", Path(__file__)), 0
    for path in files:  # weights are those of one state of the code
        checksum = zlib.crc32(path.read_bytes(), checksum)
    begin, end = (
        RUNS.parent / "features" / f"{name}-{seed}-{steps}-{checksum:08x}.safetensors"
        for name in ("start", arm)
    )
    if not begin.is_file():
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            model = Detector()
        _fit(model, "none", seed, range(steps), _RATE, limit, begin)
    if not end.is_file():
        model = _stored(begin)[0]
        _fit(model, arm, seed, range(steps, 2 * steps), 0.5 * _RATE, limit, end)
    model, seconds = _stored(end)
    return model.eval(), seconds


def _stored(path: Path) -> tuple[Detector, float]:
    model, stored = Detector(), load_file(path)
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    seconds = float(stored.pop("seconds"))
    model.load_state_dict(stored)
    return model, seconds


def _fit(
    model: Detector, arm: str, seed: int, steps: range, rate: float, limit: int | None, path: Path
) -> None:
    views, begun = _views(limit), time.perf_counter()
    model.train().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimiser = torch.optim.AdamW(model.parameters(), lr=rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=max(len(steps), 2))
    indices = islice(shuffled(len(views), seed), BATCH * steps.start, None)
    for step in steps:
        drawn = (np.random.default_rng([seed, step, j]) for j in range(BATCH))
        batch = [_pair(views[next(indices)], rng) for rng in drawn]
        pictures = torch.from_numpy(np.stack([p for pair in batch for p in pair[0]]))
        pictures = pictures.permute(0, 3, 1, 2).float() / 255.0
        some = np.random.default_rng([seed, step]).random(len(pictures)) < AUGMENTED
        if some.any():
            seeds = sample_seeds(seed, step, np.flatnonzero(some).tolist())
            pictures[some] = AUGMENTATIONS[arm](pictures[some], seeds)
        loss = _loss(model, (pictures * 255.0).round() / 255.0, batch)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        schedule.step()
    state = {name: value.contiguous() for name, value in model.state_dict().items()}
    state["seconds"] = torch.tensor(time.perf_counter() - begun)
    write_atomically(path, save(state))


@functools.cache
def _views(limit: int | None) -> list[View]:
    return [training_view(source) for source in sources("train", raws=False, limit=limit)]


Pair = tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]


def _pair(view: View, rng: np.random.Generator) -> Pair:
    """Two crops, the corners of each, and points (POINTS, 2) of each that are the same places."""
    height, width, _ = view.picture.shape
    homographies = two_crops(rng, height, width, SIZE)
    crops = [warped(view.picture, h, SIZE) for h in homographies]
    if rng.random() < 0.5:  # both, mirrored
        mirror = np.array([[-1.0, 0.0, SIZE - 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        homographies = tuple(mirror @ h for h in homographies)
        crops = [np.ascontiguousarray(crop[:, ::-1]) for crop in crops]
    placed = [mapped(view.corners, h) for h in homographies]
    shown = [points[inside(points, SIZE)] for points in placed]
    both = np.flatnonzero(inside(placed[0], SIZE, 2.0) & inside(placed[1], SIZE, 2.0))
    both = rng.permutation(both)[:POINTS]
    first = placed[0][both]
    other = homographies[1] @ np.linalg.inv(homographies[0])
    while len(first) < POINTS:  # places that are no corners fill up
        places = rng.uniform(2.0, SIZE - 3.0, (4 * POINTS, 2))
        places = places[inside(mapped(places, other), SIZE, 2.0)]
        first = np.concatenate([first, places])[:POINTS]
    return crops, shown, [first, mapped(first, other)]


def _loss(model: Detector, pictures: Tensor, batch: list[Pair]) -> Tensor:
    with torch.autocast("cpu", torch.bfloat16):  # half the time
        logits, dense = model(pictures.contiguous(memory_format=torch.channels_last))
    logits, dense = logits.float(), dense.float()
    cells = SIZE // CELL
    labels = torch.full((len(pictures), cells, cells), CELL**2)
    for index, points in enumerate(shown for pair in batch for shown in pair[1]):
        x, y = np.round(points).astype(np.int64).T
        labels[index, y // CELL, x // CELL] = torch.from_numpy((y % CELL) * CELL + x % CELL)
    scored = F.cross_entropy(logits, labels)
    places = [np.stack([pair[2][side] for pair in batch]) for side in (0, 1)]
    first, second = (torch.from_numpy(p.astype(np.float32)) for p in places)
    a, b = sample(dense[0::2], first).flatten(0, 1), sample(dense[1::2], second).flatten(0, 1)
    similar = a @ b.T / _TEMPERATURE
    # Neighbours of a point are no negatives.
    near = torch.cdist(first, first) < _SAME
    near &= ~torch.eye(POINTS, dtype=torch.bool)
    blocks: Tensor = torch.block_diag(*near)  # type: ignore[no-untyped-call]
    similar = similar.masked_fill(blocks, -torch.inf)
    target = torch.arange(len(similar))
    described = F.cross_entropy(similar, target) + F.cross_entropy(similar.T, target)
    return scored + 0.5 * described
