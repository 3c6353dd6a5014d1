"""Source groups, and the train/test split by source group.

A group is the unit of splitting and of resampling: two photographs of one subject in different
splits, or counted as two independent ones, would make results look better and surer than they are.
"""

from __future__ import annotations

import csv
import hashlib
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
import torch

from ae_env.scenes.scene import Scene
from simulator.raw.image import RawImage

logger = logging.getLogger(__name__)

#: With fewer source groups than this nothing is held out for training: all of them are for test.
FEWEST_GROUPS_TO_SPLIT = 15
#: Share of the groups that the hash puts into the training split.
TRAIN_SHARE = 0.7
#: Shots this close in time [s] are of one subject, whatever they show.
BURST_SECONDS = 30.0
#: Shots up to this far apart [s] are of one subject if they look alike.
SESSION_SECONDS = 300.0
#: From this similarity on, two shots look alike (see `similarity`).
ALIKE = 0.5


@dataclass(frozen=True)
class Shot:
    """The facts about a raw that decide its source group.

    Args:
        camera: Make and model.
        time: When it was taken; None if the file does not say.
        histogram: Joint histogram of colour and relative brightness, summing to 1.
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


def similarity(first: Shot, second: Shot) -> float:
    """Bhattacharyya coefficient of two shots' histograms: 1 if equal, 0 if nothing is shared."""
    return float(np.sqrt(first.histogram * second.histogram).sum())


def group_shots(names: Sequence[str], shots: Sequence[Shot]) -> list[str]:
    """Source group of each raw, found from its time and its colours.

    Shots of one camera are put in the order in which they were taken (by time where every file
    states it, else as given). A shot joins its predecessor's group

    - if at most 30 s lie between them, or
    - if at most 300 s lie between them, or the times are unknown, and the two look alike:
      similarity of their colour and brightness histograms at least 0.5.

    Anything else starts a new group, named after its first shot.

    Args:
        names: Name of each shot.
        shots: Time and colours of each.

    Returns:
        The group of each, in the order given.
    """
    timed = all(shot.time is not None for shot in shots)

    def order(i: int) -> tuple[str, datetime, int]:
        taken = shots[i].time if timed else None
        return shots[i].camera, taken or datetime.min, i

    groups = [""] * len(shots)
    previous: int | None = None
    for i in sorted(range(len(shots)), key=order):
        same = previous is not None and _same_subject(shots[previous], shots[i])
        groups[i] = groups[previous] if same and previous is not None else names[i]
        previous = i
    return groups


def _same_subject(first: Shot, second: Shot) -> bool:
    if first.camera != second.camera:
        return False
    if first.time is None or second.time is None:
        pause = math.nan
    else:
        pause = abs((second.time - first.time).total_seconds())
    if pause <= BURST_SECONDS:
        return True
    return not pause > SESSION_SECONDS and similarity(first, second) >= ALIKE


def named_groups(folders: Sequence[Path]) -> dict[Path, str]:
    """Groups that ``groups.csv`` files name: columns ``file`` (relative to it) and ``group``.

    Raises:
        ValueError: If such a file lacks a column, leaves one empty or names a missing file.
    """
    groups: dict[Path, str] = {}
    for folder in folders:
        table = folder / "groups.csv"
        if not table.is_file():
            continue
        try:
            with table.open(newline="", encoding="utf-8-sig") as stream:
                reader = csv.DictReader(stream)
                rows, columns = list(reader), reader.fieldnames
        except (csv.Error, OSError, UnicodeError) as error:
            raise ValueError(f"{str(table)!r} must be a CSV file in UTF-8: {error}") from error
        if not {"file", "group"} <= set(columns or ()):
            raise ValueError(
                f"{str(table)!r} (columns {columns}) must have the columns `file` and `group`"
            )
        for number, row in enumerate(rows, start=2):
            name, group = (row["file"] or "").strip(), (row["group"] or "").strip()
            if not group or not name or not (folder / name).is_file():
                raise ValueError(
                    f"{str(table)!r}, line {number} (={name!r}, {group!r}): `file` must exist "
                    "beside it and `group` must not be empty"
                )
            groups[(folder / name).resolve()] = group
    return groups


def split_groups(groups: Sequence[str]) -> dict[str, str]:
    """``"train"`` or ``"test"`` for each group.

    Below 15 groups all are ``"test"``: too few to hold out. From 15 on a hash of the group's name
    decides, 70 % to training, so that adding a file moves no other. Should the hash leave one side
    empty, the group nearest to the threshold changes sides.

    >>> set(split_groups(["a", "b"]).values())
    {'test'}
    """
    names = sorted(set(groups))
    if len(names) < FEWEST_GROUPS_TO_SPLIT:
        return dict.fromkeys(names, "test")
    draws = {
        n: int.from_bytes(hashlib.sha256(n.encode()).digest()[:8], "big") / 2**64 for n in names
    }
    split = {n: "train" if draws[n] < TRAIN_SHARE else "test" for n in names}
    if len(set(split.values())) == 1:
        nearest = min(names, key=lambda n: abs(draws[n] - TRAIN_SHARE))
        split[nearest] = "test" if split[nearest] == "train" else "train"
    return split


def scenes_of_split(spec: str | Path, scenes: list[Scene], split: str) -> list[Scene]:
    """The scenes whose source group is in `split`.

    Args:
        spec: Name of the scenes, for the error.
        scenes: Scenes of all splits.
        split: ``"train"``, ``"test"`` or ``"all"``.

    Raises:
        ValueError: If `split` is ``"train"`` and there are too few groups.
    """
    if split == "all":
        return scenes
    parts = split_groups([scene.group for scene in scenes])
    if split == "train" and "train" not in parts.values():
        raise too_few_groups(spec, str(len(parts)))
    left_out = sum(part != split for part in parts.values())
    if left_out:
        logger.warning(
            f"{spec}: split {split!r} leaves out {left_out} of {len(parts)} source groups, those "
            "of the other split; split='all' (--split all) takes every one"
        )
    return [scene for scene in scenes if parts[scene.group] == split]


def too_few_groups(spec: str | Path, number: str) -> ValueError:
    """The error where `spec` has only `number` source groups, too few to train on."""
    return ValueError(
        f"`split` (='train') needs at least {FEWEST_GROUPS_TO_SPLIT} source groups, so that some "
        f"can be held out; {str(spec)!r} has {number}. Train on scenes='bundled' and use these "
        "with split='test' (zero-shot) or split='all'; if files are grouped wrongly, name the "
        "groups in a groups.csv (columns file, group) beside them"
    )


def log_groups(where: str, scenes: Sequence[Scene]) -> None:
    """Logs the scenes of each source group."""
    members: dict[str, list[str]] = {}
    for scene in scenes:
        members.setdefault(scene.group, []).append(scene.scene_id)
    text = "; ".join(f"{group}: {', '.join(ids)}" for group, ids in members.items())
    logger.info("%s: %d source groups (%s)", where, len(members), text)
