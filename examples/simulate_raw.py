"""One raw photograph at other settings: `python simulate_raw.py IMG_0001.dng`."""

import sys

from simulator import CameraSettings, CameraSimulator, read_raw, write_dng

raw = read_raw(sys.argv[1] if len(sys.argv) > 1 else "IMG_0001.dng")
settings = CameraSettings(iso=800, exposure_time=1 / 60, f_number=4.0)
simulator = CameraSimulator.from_pretrained()  # exposure, noise and aperture module
prepared = simulator.prepare(raw, depth="unknown")  # estimate what is out of focus
print(prepared.plan(settings))  # which modules run, which do not and why, and the error of that
write_dng("out.dng", simulator.simulate(prepared, settings, seed=0))
