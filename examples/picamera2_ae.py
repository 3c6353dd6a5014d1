"""An exported agent on a Raspberry Pi camera: `python3 examples/picamera2_ae.py policy.onnx`.

First, on any machine: ae-env export regression -o policy.onnx
The camera needs picamera2, numpy and onnxruntime, no torch. `run` takes anything with Picamera2's
`set_controls` and `capture_request`; `examples/simulated_camera.py` has one to try it on.
"""

import sys

import numpy as np

from agents.onboard.controller import Controller, ExposureState

#: Of the imx477 in the HQ camera: black and white of its 12 bits, and ISO at gain 1.
BLACK, WHITE, BASE_ISO = 256.0, 4095.0, 100.0


def planes_of(mosaic, black=BLACK, white=WHITE):
    """Signal (4, H/2, W/2) of R, G1, G2, B of an RGGB mosaic (H, W)."""
    places = ((0, 0), (0, 1), (1, 0), (1, 1))
    planes = np.stack([mosaic[y::2, x::2] for y, x in places]).astype(np.float64)
    return np.clip((planes - black) / (white - black), -1.0, 1.0)


def run(camera, controller, frames, f_number, black=BLACK, white=WHITE, base_iso=BASE_ISO):
    """Exposes `frames` frames; yields what each was taken with, and what is asked for next.

    Settings take a few frames to arrive, come back rounded, and frames are dropped: what a frame
    was taken with is known from its own metadata alone.
    """
    asked = None
    for _ in range(frames):
        request = camera.capture_request()
        try:
            metadata = request.get_metadata()
            planes = planes_of(request.make_array("raw"), black, white)
        finally:
            request.release()
        time, gain = metadata["ExposureTime"] / 1e6, metadata["AnalogueGain"]
        taken = ExposureState(base_iso * gain, time, f_number)
        wanted = controller.decide(planes, taken, fixed_aperture=True)
        if wanted != asked:
            camera.set_controls(
                {
                    "ExposureTime": round(wanted.exposure_time * 1e6),
                    "AnalogueGain": wanted.iso / base_iso,
                }
            )
            asked = wanted
        yield taken, wanted


def main(path):
    """Drives the first camera until Ctrl-C."""
    from picamera2 import Picamera2

    with Picamera2() as camera:
        camera.configure(camera.create_still_configuration(raw={"format": "SRGGB12"}))
        camera.set_controls({"AeEnable": False})
        camera.start()
        for taken, wanted in run(camera, Controller(path), frames=10**9, f_number=2.8):
            print(taken, "->", wanted)


if __name__ == "__main__":
    main(sys.argv[1])
