"""An exported agent on a Raspberry Pi camera: `python3 examples/picamera2_ae.py policy.onnx`.

First, on any machine: ae-env export regression -o policy.onnx
The camera needs picamera2, numpy, onnxruntime, pydantic and lazy-loader, no torch. `run` takes
anything with Picamera2's `set_controls`, `camera_configuration` and `capture_request`;
`examples/simulated_camera.py` has one to try it on.
"""

import re
import sys

import numpy as np

from agents.onboard.controller import Controller, ExposureState

#: ISO at gain 1 of the imx477 in the HQ camera.
BASE_ISO = 100.0


def planes_of(array, configuration, black_levels):
    """Signal (4, H/2, W/2) of R, G1, G2, B of a raw as `make_array("raw")` gives it.

    That is (H, stride) bytes: rows of samples of 16 bits (8 where the format says so), padded.
    `configuration` is that of the raw stream, which says order and bits of the samples (a Raspberry
    Pi 5 moves them up to 16 bits); `black_levels` those of R, Gr, Gb, B in the metadata, on 16 bits
    whatever the sensor has.
    """
    known = re.fullmatch(r"S(RGGB|GRBG|GBRG|BGGR)(\d+)", configuration["format"])
    if known is None:
        raise ValueError(
            f"raw format {configuration['format']} is packed: configure an unpacked one"
        )
    order, white = known[1], 2.0 ** int(known[2]) - 1.0
    width, height = configuration["size"]
    kind = np.dtype(np.uint8 if white < 256.0 else np.uint16)
    samples = array[..., : array.shape[-1] // kind.itemsize * kind.itemsize].view(kind)
    mosaic = samples[:height, :width].astype(np.float64)
    if mosaic.shape != (height, width):
        raise ValueError(f"raw of {samples.shape} samples must hold {height} rows of {width}")
    red, blue = order.index("R"), order.index("B")
    places = (red, red ^ 1, blue ^ 1, blue)  # G1 is on red's rows, G2 on blue's
    planes = np.stack([mosaic[i // 2 :: 2, i % 2 :: 2] for i in places])
    black = np.array(black_levels)[:, None, None] * (white + 1.0) / 2.0**16
    return (planes - black) / (white - black)


def run(camera, controller, frames, f_number, base_iso=BASE_ISO):
    """Exposes `frames` frames; yields what each was taken with, and the decision for the next.

    Settings take a few frames to arrive, come back rounded, and frames are dropped: what a frame
    was taken with is known from its own metadata alone.
    """
    asked, configuration = None, camera.camera_configuration()["raw"]
    for _ in range(frames):
        request = camera.capture_request()
        try:
            metadata = request.get_metadata()
            array = request.make_array("raw")
            planes = planes_of(array, configuration, metadata["SensorBlackLevels"])
        finally:
            request.release()
        time, gain = metadata["ExposureTime"] / 1e6, metadata["AnalogueGain"]
        taken = ExposureState(base_iso * gain, time, f_number)
        decision = controller.decide(planes, taken, fixed_aperture=True)
        wanted = decision.state
        if wanted != asked:
            camera.set_controls(
                {
                    "ExposureTime": round(wanted.exposure_time * 1e6),
                    "AnalogueGain": wanted.iso / base_iso,
                }
            )
            asked = wanted
        yield taken, decision


def main(path):
    """Drives the first camera until Ctrl-C."""
    from picamera2 import Picamera2
    from picamera2.sensor_format import SensorFormat

    with Picamera2() as camera:
        raw = SensorFormat(camera.sensor_format)
        raw.packing = None
        camera.configure(camera.create_still_configuration(raw={"format": raw.format}))
        camera.set_controls({"AeEnable": False})
        camera.start()
        for taken, decision in run(camera, Controller(path), frames=10**9, f_number=2.8):
            print(taken, "->", decision.state, decision.reason)


if __name__ == "__main__":
    main(sys.argv[1])
