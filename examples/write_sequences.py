"""Raws of your own in the layout of the paper's dataset, for `ae-env bench paper FOLDER`.

    python examples/write_sequences.py out scene_001 IMG_0001.NEF IMG_0002.NEF ...

writes the captures of one scene to ``out/scene_001``, beside a ``camera_params.csv`` with the
columns that the authors' script for the camera writes. The raws must be of a Nikon Z6 or a Canon
70D, the cameras of the dataset: its files do not state levels.
"""

import io
import sys
from operator import attrgetter
from pathlib import Path

import numpy as np
import pandas as pd

from simulator import read_raw
from simulator.training.paper_dataset import PARAMETERS, packed_camera
from simulator.utils.files import write_atomically

#: What the files do not state of a camera.
LAYOUT = attrgetter("name", "cfa", "black_level", "white_level")


def write_packed_sequence(folder, raws):
    """Write `raws` as ``capture_000.npy`` and on, beside the table, in a new folder.

    The table records an exposure time as a camera does: one within 3 % of a nominal stop is read
    back as that stop. A `ValueError` if `folder` holds something already, or `raws` is empty or of
    another camera than one `packed_camera`.
    """
    folder = Path(folder).expanduser()
    if folder.exists() and any(folder.iterdir()):
        raise ValueError(f"`folder` (={str(folder)!r}) must be new or empty")
    layouts = {LAYOUT(raw.camera) for raw in raws}
    if len(layouts) != 1 or layouts != {LAYOUT(packed_camera(raws[0].camera.name))}:
        raise ValueError(f"`raws` (of {layouts or None}) must be captures of one `packed_camera`")
    nikon = raws[0].camera.name == "nikon_z6"
    # The Nikon's noise profile has its greens averaged, the Canon's all planes.
    groups = [(0,), (1, 2), (3,)] if nikon else [(0, 1, 2, 3)]
    rows = []
    for index, raw in enumerate(raws):
        stem, settings, content = f"capture_{index:03d}", raw.settings, io.BytesIO()
        np.save(content, raw.data.detach().cpu().numpy()[[0, 1, 3, 2]], allow_pickle=False)
        write_atomically(folder / f"{stem}.npy", content.getvalue())
        row = {"path": f"{folder.name}/{stem}.jpg", "time": settings.exposure_time}
        row |= {"iso": settings.iso, "aperture": settings.f_number}
        if nikon:
            row["wb"] = [*raw.white_balance, 0.0]
        means = [
            sum(values[i] for i in planes) / len(planes)
            for planes in groups
            for values in (raw.noise.shot, raw.noise.read)
        ]
        rows.append(row | {"noiseprofile": " ".join(map(repr, means))})
    table = pd.DataFrame(rows).to_csv(index=False, lineterminator="\r\n")
    write_atomically(folder / PARAMETERS, table)


if __name__ == "__main__":
    out, name, *files = sys.argv[1:]
    camera = packed_camera(read_raw(files[0]).camera.name)
    write_packed_sequence(Path(out) / name, [read_raw(file, camera=camera) for file in files])
