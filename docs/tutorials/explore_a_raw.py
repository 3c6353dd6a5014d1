# %% [markdown]
# # Explore a raw
#
# What would this photograph have looked like at other settings, and how sure is that? The cells
# of this page are a script, `docs/tutorials/explore_a_raw.py`: run it as it is, or open it as a
# notebook in an editor that knows cells (VS Code, PyCharm, Spyder, Jupyter with jupytext).
#
# The raw here is made from a bundled scene, so that this runs anywhere. Put your own file in its
# place: any Bayer raw that LibRaw reads will do.

# %%
import matplotlib.pyplot as plt
import torch

from ae_env.scenes import load_scenes
from simulator import CameraSettings, CameraSimulator, get_camera, read_raw, render_srgb, write_dng

camera = get_camera("nikon_z6")
scene = load_scenes("bundled:back_light", "test", camera=camera, resolution=None)[0]
taken = CameraSettings(iso=400, exposure_time=1 / 125, f_number=5.6)
write_dng("scene.dng", CameraSimulator().simulate(scene, taken, seed=0))

raw = read_raw("scene.dng")  # read_raw("IMG_0001.NEF") for a file of your own
print(raw.settings, raw.camera.name, tuple(raw.data.shape))

# %% [markdown]
# `raw.data` is packed: four planes R, G1, G2, B, black subtracted, 1.0 at sensor white. The noise
# level function tells the variance of the noise at each level; a DNG states it, and raws of
# unknown cameras get an [estimate](../raw-files.md#noise-level-function-of-an-unknown-camera).

# %%
shot, read = raw.noise.shot[1], raw.noise.read[1]
for signal in (0.01, 0.12, 0.9):
    noise = (read + shot * signal) ** 0.5
    print(
        f"green at {signal:5.0%} of white: noise {noise:.4f}, signal to noise {signal / noise:.0f}"
    )

# %% [markdown]
# A plan says which steps a change of settings takes, which error that has in units of the target's
# noise, and what it costs, before anything is computed. From ISO 400 to a longer exposure at ISO 100
# the source is noisier than the target: a network takes its noise away, where the tolerance asks for
# that.

# %%
simulator = CameraSimulator.from_pretrained()
prepared = simulator.prepare(raw)
for settings in (
    CameraSettings(iso=3200, exposure_time=1 / 1000, f_number=5.6),
    CameraSettings(iso=100, exposure_time=1 / 30, f_number=5.6),
):
    print(prepared.plan(settings), end="\n\n")

# %% [markdown]
# The raw is prepared once; every capture is then a few element-wise steps. Here is the exposure
# series around the settings it was taken at:

# %%
times = [1 / 2000, 1 / 500, 1 / 125, 1 / 30]
states = [CameraSettings(iso=400, exposure_time=time, f_number=5.6) for time in times]
frames = prepared.expose(states, seed=0)  # (4, 4, H, W)

figure, axes = plt.subplots(2, 4, figsize=(11, 5), constrained_layout=True)
for state, frame, above, below in zip(states, frames, *axes, strict=True):
    picture = render_srgb(simulator.simulate(prepared, state, seed=0), "half")
    above.imshow(picture.permute(1, 2, 0))
    above.set_title(str(state), fontsize=9)
    above.axis("off")
    for plane, colour in zip(frame, ("tab:red", "tab:green", "limegreen", "tab:blue"), strict=True):
        below.plot(torch.linspace(0, 1, 64), torch.histc(plane, 64, 0, 1).sqrt(), color=colour)
    below.set(xlabel="share of sensor white", yticks=[])
figure.savefig("explore_a_raw.webp", dpi=80)

# %% [markdown]
# ![four exposures of a scene and the histograms of their raw planes](explore_a_raw.webp)
#
# Write any of them as a DNG that a raw developer opens, with noise, levels and settings in its tags:

# %%
write_dng("longer.dng", simulator.simulate(prepared, states[3], seed=0))

# %% [markdown]
# The same with sliders, in the browser: `ae-env view scene.dng` ([viewer](../viewer.md)). All 64 states
# as one picture: `ae-env sweep scene.dng`. What is exact and what is not: [simulator](../simulator.md).
