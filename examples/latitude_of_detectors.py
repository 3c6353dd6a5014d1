"""Over which exposures, ISO speeds and blurs do the built-in detectors work?

`python examples/latitude_of_detectors.py` measures `ae-env latitude` of `codes`, `tags`, `text`,
`faces` and `tracks` on pictures that come with scikit-image, and on boards that it draws. It writes
``docs/results/latitude.json``, the table of its page and its picture, in two minutes on one core.
The detectors need the extras ``tasks``, ``cv`` and ``onnx`` and the packages that
``docs/latitude.md`` names.
"""

import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import skimage.data
import torch
import zxingcpp
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from ae_env.scenes.ladder import tag_dictionary
from agents.applications.latitude import AXES, load_detector, measure_latitude, picture_scenes
from benchmarks.harness import Report, Row, table, write_report
from benchmarks.isolated import ROOT
from simulator import get_camera
from simulator.utils.files import result_meta

SIZE, GREY = (512, 512), 118  # middle grey of sRGB: nothing else of a board is white or black
COLUMNS = """detector = {detector} | pictures = {shown} | found = {things} | darkest = {low} |
brightest = {high} | highest ISO = {iso} | longest blur = {blur} | CPU seconds = {seconds:.0f}"""
WORDS = ("shutter", "aperture", "ISO 800", "metering", "exposure", "raw file", "highlight", "noise")


def boards() -> dict[str, Image.Image]:
    """Pictures of codes, of tags and of words, of several sizes, dark grey on light grey."""
    names = ("codes", "tags", "words")
    found = {name: Image.new("L", SIZE, GREY + 60) for name in names}
    for i, side in enumerate(range(48, 144, 24)):
        for column in range(3):
            at, text = (20 + 160 * column, 20 + (0, 62, 148, 260)[i]), f"{i}{column}"
            code = zxingcpp.create_barcode(text, zxingcpp.BarcodeFormat.QRCode)
            tag = cv2.aruco.generateImageMarker(tag_dictionary(), 10 * i + column, side)
            for name, cells in (("codes", np.asarray(code.to_image(scale=4))), ("tags", tag)):
                drawn = Image.fromarray((cells > 0).astype(np.uint8) * 120 + GREY // 2)
                found[name].paste(drawn.resize((side, side), Image.Resampling.NEAREST), at)
    for i, word in enumerate(WORDS):
        font = ImageFont.load_default(16 + 4 * i)
        ImageDraw.Draw(found["words"]).text((24, 20 + 60 * i), word, GREY // 2, font)
    return found


def main() -> None:
    """Measures each detector, and writes what was found."""
    torch.set_num_threads(1)
    camera, drawn = get_camera("nikon_z6"), boards()
    names = ("astronaut", "coffee", "chelsea", "rocket")
    photographs = {name: Image.fromarray(getattr(skimage.data, name)()) for name in names}
    astronauts = Image.new("RGB", SIZE, 3 * (GREY + 60,))
    for side, at in ((240, (8, 8)), (160, (260, 8)), (120, (8, 260)), (90, (140, 260))):
        astronauts.paste(photographs["astronaut"].resize((side, side)), at)
    shown = {name: {name: drawn[name]} for name in ("codes", "tags")}
    shown |= {"text": {"words": drawn["words"]}, "tracks": photographs}
    shown |= {"faces": {"astronaut, four sizes": astronauts}}
    rows, figure = list[Row](), Figure(figsize=(9, 3.2), dpi=90, layout="constrained")
    plots = figure.subplots(1, 3, sharey=True)
    for name, pictures in shown.items():
        begun, detector = time.process_time(), load_detector(name)
        with tempfile.TemporaryDirectory() as folder:
            for title, picture in pictures.items():
                picture.convert("RGB").save(Path(folder) / f"{title}.png")
            found = measure_latitude(detector, picture_scenes(folder, camera, max(SIZE)))
        row: Row = {"detector": name, "shown": ", ".join(pictures)}
        row |= {"things": int(found.rows.trials.max()), "left_out": found.left_out}
        row["seconds"] = time.process_time() - begun
        units = {"EV": "{:+.1f} EV", "ISO": "{:.0f}", "blur": "{:.1f} %"}
        for axis, unit in units.items():
            for end in ("low", "high") if axis == "EV" else ("high",):
                value, cause = found.ends(axis).get(end, (None, "nine in ten are not reached"))
                key = end if axis == "EV" else axis.lower()
                text = "" if value is None else unit.format(value)
                row[key] = f"{text} ({cause or 'end of the axis'})".strip()
        rows.append(row | {"curves": found.rows.to_dict("records")})
        for axes, axis in zip(plots, AXES, strict=True):
            own = found.curve(axis)
            x = own.value if axis == "EV" else np.arange(len(own))
            axes.plot(x, own.share, marker=".", label=name)
            axes.fill_between(x, own.low, own.high, alpha=0.15)
            if axis != "EV":
                axes.set_xticks(x, [f"{value:g}" for value in own.value], rotation=45)
    for axes, label in zip(plots, ("exposure [EV]", "ISO", "blur [% of the height]"), strict=True):
        axes.set(xlabel=label, ylim=(-0.03, 1.03))
    plots[0].set(ylabel="share found, 95 %")
    plots[0].legend(fontsize=7)
    meta = result_meta("python examples/latitude_of_detectors.py", 0)
    report = Report(rows, {"detectors": table(rows, COLUMNS)}, figures={"latitude.png": figure})
    write_report(report, ROOT / "docs" / "results", "latitude", meta)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        sys.exit(__doc__)
    main()
