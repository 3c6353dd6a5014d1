"""Scenes from a user's own files: raws and radiance maps in a folder, by a glob, or one by one.

A source group is the unit of splitting and of resampling: two photographs of one subject in
different splits, or counted as two independent ones, would make results look better and surer than
they are. The group of a file is, in this order: the one that a ``groups.csv`` beside it names
(columns ``file`` and ``group``); its sub-folder; for a radiance map the file itself; for a raw the
one that `group_shots` finds from its time and colours. No other names are read.
"""

import glob
import logging
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch

from ae_env.scenes.scene import Scene, SceneRequest
from simulator.radiance.light import camera_from_srgb, mean_anchor
from simulator.radiance.maps import assumed_ev100, hash_fraction, map_views, near_one
from simulator.radiance.reading import RADIANCE_SUFFIXES, read_radiance
from simulator.raw.image import RawImage
from simulator.raw.read import check_settings, read_raw
from simulator.utils.checks import check_number, check_type, check_word
from simulator.utils.compute import progress_bar
from simulator.utils.files import PICTURE_SUFFIXES, RAW_SUFFIXES, printable, read_table

logger = logging.getLogger(__name__)

OnError = Literal["stop", "skip"]
#: With fewer source groups than this all are for test; of more, the hash trains with this share.
FEWEST_GROUPS_TO_SPLIT, TRAIN_SHARE = 15, 0.7
#: Shots this close in time [s] are of one subject; up to this far apart, if they look alike.
BURST_SECONDS, SESSION_SECONDS = 30.0, 300.0
#: From this Bhattacharyya coefficient of their histograms on (1 if equal), two shots look alike.
ALIKE = 0.5
#: Most file names in a log line about files that were skipped.
_MOST_NAMES = 5
_HOW_TO_SKIP = "; --on-error skip, or {'path': ..., 'on_error': 'skip'}, leaves it out"
_RAW_ENDINGS = f"{', '.join(RAW_SUFFIXES[:8])} ..."


@dataclass(frozen=True)
class FolderOptions:
    """Facts about the files that the caller knows, and the rule for files that cannot be read."""

    #: Light on the subject [lux] of every file, or by file name.
    illuminance: float | Mapping[str, float] | None = None
    kind: str | None = None  # kind of the scenes; ``"raw"`` or ``"radiance"`` by default
    hard: bool | None = None  # whether they count as hard
    median_speed: float | None = None  # median image speed of a moving episode [frame heights / s]
    ev100: float | None = None  # EV100 of the radiance maps, in place of the assumed one
    layer: str | None = None  # part or layer of the OpenEXR files, where several have R, G and B
    #: Of every raw, in place of the file's: any of ``iso``, ``exposure_time`` [s] and ``f_number``,
    #: as an adapted lens or some telephones do not state them.
    settings: Mapping[str, float] | None = None
    #: What happens where a file cannot be read, or is black without `illuminance`: ``"stop"``
    #: raises an error that names it, so that nothing goes missing unseen; ``"skip"``, not for
    #: sequences, leaves it out: a warning says how many were and why.
    on_error: OnError = "stop"

    def __post_init__(self) -> None:
        check_word("on_error", self.on_error, get_args(OnError))
        lux = self.illuminance
        for value in lux.values() if isinstance(lux, Mapping) else [lux]:
            if value is not None:
                check_number("illuminance", value, 1e-6, 1e9, more=" lux")
        check_type("kind", self.kind, str, None)
        check_type("layer", self.layer, str, None)
        check_type("hard", self.hard, bool, None)
        if self.median_speed is not None:
            check_number("median_speed", self.median_speed, 0.0, 1e6, more=" frame heights / s")
        if self.ev100 is not None:
            check_number("ev100", self.ev100, -20.0, 40.0)
        check_settings(self.settings)

    def fields(self, path: Path) -> dict[str, Any]:
        """Keyword arguments for the scenes of `path`, a raw or a radiance map."""
        lux = self.illuminance
        if isinstance(lux, Mapping):
            lux = lux.get(path.name)
        given = {"kind": self.kind, "hard": self.hard, "median_speed": self.median_speed}
        given |= {"illuminance": lux}
        if not is_raw(path):
            layer = self.layer if path.suffix.lower() == ".exr" else None
            given |= {"ev100": self.ev100, "layer": layer}
        return {name: value for name, value in given.items() if value is not None}


NOTHING_KNOWN = FolderOptions()


def folder_scenes(
    spec: str | Path, request: SceneRequest, options: FolderOptions = NOTHING_KNOWN
) -> list[Scene]:
    """The scenes of a split among the user's files; each is resized before the next file is read.

    `spec` is a file, a folder (searched with its sub-folders; hidden ones left out) or a glob. A
    `ValueError` if a file cannot be read, or there are too few groups to train on.
    """
    base, files = find_files(spec)
    named = _named_groups(sorted({base, *(p.parent for p in files)}))
    _check_training_groups(spec, request.split, len(files), "at most ")
    groups = {path: named.get(path.resolve()) for path in files}
    for path in files:
        if groups[path] is None and path.parent != base:
            groups[path] = printable(path.parent.relative_to(base).as_posix())
    return _read_files(spec, base, groups, options, request, hint=_HOW_TO_SKIP)


def sequence_scenes(
    spec: str | Path, request: SceneRequest, options: FolderOptions = NOTHING_KNOWN
) -> list[Scene]:
    """The frames of every sequence of a split, one sequence after the other.

    The raws of one folder, in the natural order of their names, are one sequence and one source
    group, called as the folder below `spec`. Each raw's light is known through its own settings: it
    may change from frame to frame. Raws in `spec` itself are named after it, or ``.`` where a
    folder below has that name.

    The arguments are those of `folder_scenes`; `on_error` must be ``"stop"``, and fewer than 15
    sequences are all for test. A `ValueError` if there are no raws, one cannot be read, or there
    are too few to train on.
    """
    if options.on_error == "skip":
        raise ValueError(
            "`on_error` (='skip') must be 'stop' for a sequence: without a raw all later ones "
            "would come a frame too early; cut the recording there, into two folders"
        )
    base, found = find_files(spec)
    raws = [path for path in found if is_raw(path)]
    folders = list(dict.fromkeys(path.parent for path in raws))
    if not folders:
        raise ValueError(
            f"`scenes` (={{'sequence': {str(spec)!r}}}) must hold raws ({_RAW_ENDINGS}): radiance "
            "maps have no settings of their own"
        )
    _check_training_groups(spec, request.split, len(folders))
    names = {folder: printable(folder.relative_to(base).as_posix()) for folder in folders}
    own = printable(base.resolve().name)
    if base in names and own and own not in names.values():
        names[base] = own  # else "."
    groups = {raw: names[raw.parent] for raw in sorted(raws, key=lambda p: folders.index(p.parent))}
    scenes = _read_files(spec, base, groups, options, request)
    return [replace(scene, sequence=scene.group) for scene in scenes]


def sequence_bounds(scenes: Sequence[Scene]) -> tuple[np.ndarray, np.ndarray]:
    """First and last frame, (F,) int64 each, of the sequence that each of F frames belongs to.

    Those of one sequence follow each other. A scene of none is one of its own.
    """
    names = [scene.sequence or scene.scene_id for scene in scenes]
    begins = [i for i, name in enumerate(names) if i == 0 or names[i - 1] != name]
    lengths = np.diff([*begins, len(names)])
    first = np.repeat(begins, lengths)
    return first, first + np.repeat(lengths, lengths) - 1


def find_files(spec: str | Path) -> tuple[Path, list[Path]]:
    """The folder, and the raws and radiance maps that `spec` names as of `folder_scenes`.

    They are in natural order. A `ValueError` if there is nothing by that name, or none in it.
    """
    try:
        base, found = _listed(spec)
    except (OSError, RuntimeError) as error:  # no permission, no such user, a folder removed ...
        raise ValueError(f"`scenes` (={str(spec)!r}) cannot be listed: {error}") from error
    files = visible_files(base, found, (*RAW_SUFFIXES, *RADIANCE_SUFFIXES))
    if not files:
        if len(found) == 1 and found[0].suffix.lower() in PICTURE_SUFFIXES:
            kind = found[0].suffix[1:].upper()
            raise ValueError(f"`path` (={str(spec)!r}) is a {kind}, not a raw or a radiance map")
        endings = ", ".join(sorted({p.suffix.lower() or "(none)" for p in found}))
        if any(p.suffix.lower() in PICTURE_SUFFIXES for p in found):
            endings += "; developed pictures of every state are 'recorded:FOLDER'"
        raise ValueError(
            f"`scenes` (={str(spec)!r}) must hold raws ({_RAW_ENDINGS}) or radiance maps "
            f"({', '.join(RADIANCE_SUFFIXES)}); "
            + (f"its files end in: {endings}" if endings else "it has no file that can be read")
        )
    return base, sorted(files, key=_natural)


def _listed(spec: str | Path) -> tuple[Path, list[Path]]:
    path = Path(spec).expanduser()
    if path.is_file():
        return path.parent, [path]
    if path.is_dir():
        return path, [p for p in path.rglob("*") if p.is_file()]
    matches = [Path(p) for p in glob.glob(str(path), recursive=True)]
    if not matches:
        raise ValueError(f"`scenes` (={str(spec)!r}) must name an existing file, folder or glob")
    first = next((i for i, p in enumerate(path.parts) if glob.has_magic(p)), -1)
    return Path(*path.parts[:first]), [p for p in matches if p.is_file()]


def visible_files(folder: Path, paths: Iterable[Path], suffixes: Sequence[str]) -> list[Path]:
    """Those of the `paths` that end in one of `suffixes`, and are not hidden in `folder`."""
    fitting = [path for path in paths if path.suffix.lower() in suffixes]
    return [p for p in fitting if not any(n.startswith(".") for n in p.relative_to(folder).parts)]


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sort key in which numbers count as numbers."""
    parts = re.split(r"(\d+)", path.as_posix().lower())
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts]


def is_raw(path: str | Path) -> bool:
    """Whether a file is a raw by the ending of its name."""
    return Path(path).suffix.lower() in RAW_SUFFIXES


def _read_files(
    spec: str | Path,
    base: Path,
    groups: Mapping[Path, str | None],
    options: FolderOptions,
    request: SceneRequest,
    *,
    hint: str = "",
) -> list[Scene]:
    """The scenes of a split in files below `base`, which messages call `spec`.

    `groups` has the source group of each; None for the file itself, or shots that belong to it.
    `hint` ends the error of a file that cannot be read, where there are others.
    """
    lux, names = options.illuminance, {path.name for path in groups}
    if isinstance(lux, Mapping) and (wrong := sorted(set(map(str, lux)) - names)):
        raise ValueError(f"`illuminance` names {wrong[0]!r}, which is no file of {str(spec)!r}")
    endings = {path.suffix.lower() for path in groups}
    kinds = {"settings": RAW_SUFFIXES, "layer": (".exr",), "ev100": RADIANCE_SUFFIXES}
    for name, known in kinds.items():
        value = getattr(options, name)
        if value not in (None, {}) and endings.isdisjoint(known):
            rule = f"is for files that end in {', '.join(known[:8])}: {str(spec)!r} has none"
            raise ValueError(f"`{name}` (={value!r}) {rule}")
    scenes: list[Scene] = []
    shots: dict[str, Shot] = {}  # of raws without a group
    skipped: list[str] = []
    # Scene ids: the path below `base` without its ending, with it where two would be equal.
    places = {path: path.relative_to(base) for path in groups}
    times = Counter(place.with_suffix("") for place in places.values())
    logger.info("reading %d scene files of %s", len(groups), spec)
    with progress_bar("reading scene files", len(groups)) as advance:
        for path, group in groups.items():
            place = places[path]
            unique = times[place.with_suffix("")] == 1
            name = printable((place.with_suffix("") if unique else place).as_posix())
            try:
                scenes += _read_file(path, name, group, options, request, shots)
            except (ValueError, OSError) as error:  # it may also have vanished since it was listed
                if options.on_error == "stop":
                    more = hint if len(groups) > 1 else ""
                    raise ValueError(f"scene file {str(path)!r}: {error}{more}") from error
                skipped.append(f"{path.name}: {error}")
            advance()
    if skipped:
        rest = [f"and {len(skipped) - _MOST_NAMES} more"] if len(skipped) > _MOST_NAMES else []
        text = "; ".join(skipped[:_MOST_NAMES] + rest)
        text = f"{len(skipped)} of {len(groups)} scene files skipped ({text})"
        if not scenes:
            raise ValueError(f"`scenes` (={str(spec)!r}) must hold a file that can be read: {text}")
        logger.warning("%s: %s", spec, text)
    found = dict(zip(shots, group_shots(list(shots), list(shots.values())), strict=True))
    scenes = [replace(s, group=found.get(s.scene_id, s.group)) for s in scenes]
    return scenes_of_split(spec, scenes, request.split)


def _read_file(
    path: Path,
    name: str,
    group: str | None,
    options: FolderOptions,
    request: SceneRequest,
    shots: "dict[str, Shot]",
) -> list[Scene]:
    """The scenes of a file; the `Shot` of a raw without a group goes into `shots`."""
    fields = options.fields(path)
    if is_raw(path):
        raw = read_raw(path, settings=options.settings)
        source = f"{printable(path.name)}; noise: {raw.metadata.get('nlf_source', 'unknown')}"
        scene = Scene.from_raw(raw, scene_id=name, group=group or name, source=source, **fields)
        scenes = [request.sized(scene)]
    else:
        scenes = list(radiance_scenes(path, request, name=name, group=group or name, **fields))
    for scene in scenes:
        _ = scene.ev100  # raises where a frame is black and its light unknown
    if is_raw(path) and group is None:
        shots[name] = describe(raw)
    return scenes


def radiance_scenes(
    path: str | Path,
    request: SceneRequest,
    *,
    name: str,
    group: str,
    ev100: float | None = None,
    layer: str | None = None,
    **fields: Any,
) -> Iterator[Scene]:
    """The scenes of one radiance map, all in one source group; see `map_views`.

    A radiance map is linear but relative: nothing in it says how many lux it shows. Unless that is
    known, its views are put at `ev100` or the `assumed_ev100` of the source group, as each scene's
    `source` says: the mean of the views is 0.12 there, on average over the views, which keep their
    relative brightness. `name` begins the scene ids; `layer` is as of `read_radiance`,
    `fields` are further arguments of `Scene.from_radiance`.
    """
    file = printable(Path(path).name)
    image = read_radiance(path, layer=layer)
    if "illuminance" not in fields:
        image = near_one(image)
        if ev100 is None:
            ev100 = assumed_ev100(group)
            fields.setdefault("source", f"{file}; light of unknown scale, EV100 assumed")
    fields.setdefault("source", file)
    views, sampled = map_views(image, request.resolution, native=request.crop == "native")
    if not sampled:
        logger.info(
            "radiance map %s: fewer pixels than photosites, so planes share their places", file
        )
    matrix, _ = camera_from_srgb(request.camera)
    greens = [torch.from_numpy(np.tensordot(matrix[1], v, axes=1)) for v in views.values()]
    levels = [-math.log2(mean_anchor(green)) for green in greens]
    for (ending, view), level in zip(views.items(), levels, strict=True):
        if ev100 is not None:  # one scale for the whole map: a darker view stays darker
            fields["ev100"] = ev100 + level - float(np.mean(levels))
        scene = Scene.from_radiance(
            view, request.camera, scene_id=name + ending, group=group, sampled=sampled, **fields
        )
        yield request.sized(scene)


@dataclass(frozen=True)
class Shot:
    """The facts about a raw that decide its source group.

    Its make and model, when it was taken if the file says so, and the joint histogram of colour and
    relative brightness, summing to 1.
    """

    camera: str
    time: datetime | None
    histogram: np.ndarray


def describe(raw: RawImage) -> Shot:
    """The `Shot` of a raw, with exposure and white balance divided out."""
    gains = torch.tensor(raw.white_balance, dtype=torch.float32)[:, None, None]
    planes = torch.stack([raw.data[0], raw.data[1:3].mean(dim=0), raw.data[3]])
    small = torch.nn.functional.adaptive_avg_pool2d(planes[None], (48, 64))[0]
    red, green, blue = (small.clamp(min=1e-3) * gains).flatten(1).double().numpy()
    brightness = (red + green + blue) / 3.0
    features = [np.log2(v / np.median(v)) for v in (red / green, blue / green, brightness)]
    edges = [np.linspace(-2, 2, 11), np.linspace(-2, 2, 11), np.linspace(-3, 3, 7)]
    clipped = [np.clip(f, e[0], e[-1]) for f, e in zip(features, edges, strict=True)]
    histogram, _ = np.histogramdd(np.stack(clipped, axis=1), bins=edges)
    taken = raw.metadata.get("datetime")
    return Shot(
        camera=f"{raw.camera.make} {raw.camera.model}",
        time=None if taken is None else datetime.fromisoformat(str(taken)).replace(tzinfo=None),
        histogram=histogram / histogram.sum(),
    )


def group_shots(names: Sequence[str], shots: Sequence[Shot]) -> list[str]:
    """Source group of each raw, found from its time and its colours.

    Shots of one camera are put in the order in which they were taken (by time where every file
    states it, else as given). A shot joins its predecessor's group

    - if at most 30 s lie between them, or
    - if at most 300 s lie between them, or the times are unknown, and the two look alike:
      similarity of their colour and brightness histograms at least 0.5.

    Anything else starts a new group, named after its first shot.
    """
    timed = all(shot.time is not None for shot in shots)

    def order(i: int) -> tuple[str, datetime, int]:
        taken = shots[i].time if timed else None
        return shots[i].camera, taken or datetime.min, i

    groups = list(names)
    for before, i in pairwise(sorted(range(len(shots)), key=order)):
        if _same_subject(shots[before], shots[i]):
            groups[i] = groups[before]
    return groups


def _same_subject(first: Shot, second: Shot) -> bool:
    if first.camera != second.camera:
        return False
    pause = math.nan  # unknown
    if first.time is not None and second.time is not None:
        pause = abs((second.time - first.time).total_seconds())
    if pause <= BURST_SECONDS or pause > SESSION_SECONDS:
        return pause <= BURST_SECONDS
    return float(np.sqrt(first.histogram * second.histogram).sum()) >= ALIKE


def _named_groups(folders: Sequence[Path]) -> dict[Path, str]:
    """Groups that ``groups.csv`` files name: columns ``file`` (relative to it) and ``group``."""
    groups: dict[Path, str] = {}
    for folder in folders:
        table = folder / "groups.csv"
        if not table.is_file():
            continue
        rows = read_table(table)
        if not {"file", "group"} <= set(rows):
            raise ValueError(f"{str(table)!r} (columns {[*rows]}) must have `file` and `group`")
        for number, (name, group) in enumerate(zip(rows.file, rows.group, strict=True), start=2):
            name, group = name.strip(), group.strip()
            if not group or not name or not (folder / name).is_file():
                given = f"{str(table)!r}, line {number} (={name!r}, {group!r})"
                raise ValueError(f"{given} must name a file beside it, and its group")
            groups[(folder / name).resolve()] = group
    return groups


def split_groups(groups: Sequence[str]) -> dict[str, str]:
    """``"train"`` or ``"test"`` for each group.

    Below 15 groups all are ``"test"``: too few to hold out. From 15 on a hash of the group's name
    decides, 70 % to training, so that adding a file moves no other. Should the hash leave one side
    empty, the group nearest to the threshold changes sides.
    """
    names = sorted(set(groups))
    if len(names) < FEWEST_GROUPS_TO_SPLIT:
        return dict.fromkeys(names, "test")
    draws = {name: hash_fraction(name) for name in names}
    split = {n: "train" if draws[n] < TRAIN_SHARE else "test" for n in names}
    if len(set(split.values())) == 1:
        nearest = min(names, key=lambda n: abs(draws[n] - TRAIN_SHARE))
        split[nearest] = "test" if split[nearest] == "train" else "train"
    return split


def scenes_of_split(spec: str | Path, scenes: list[Scene], split: str) -> list[Scene]:
    """The scenes whose source group is in `split`; the log tells the groups and how many are not.

    A `ValueError` if there are too few groups to train on.
    """
    members: dict[str, list[str]] = {}
    for scene in scenes:
        members.setdefault(scene.group, []).append(scene.scene_id)
    text = "; ".join(f"{group}: {', '.join(ids)}" for group, ids in members.items())
    logger.info("%s: %d source groups (%s)", spec, len(members), text)
    if split == "all":
        return scenes
    _check_training_groups(spec, split, len(members))
    parts = split_groups(list(members))
    left_out = sum(part != split for part in parts.values())
    if left_out:
        logger.warning(
            f"{spec}: split {split!r} leaves out {left_out} of {len(parts)} source groups, those "
            "of the other split; split='all' (--split all) takes every one"
        )
    return [scene for scene in scenes if parts[scene.group] == split]


def _check_training_groups(spec: str | Path, split: str, count: int, most: str = "") -> None:
    if split == "train" and count < FEWEST_GROUPS_TO_SPLIT:
        raise ValueError(
            f"`split` (='train') needs at least {FEWEST_GROUPS_TO_SPLIT} source groups, so that "
            f"some can be held out; {str(spec)!r} has {most}{count}. Train on scenes='bundled' and "
            "use these with split='test' (zero-shot) or split='all'; if files are grouped wrongly, "
            "name the groups in a groups.csv (columns file, group) beside them"
        )
