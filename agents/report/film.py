"""Films: episodes of policies side by side, each over a chart of its exposure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from ae_env.rendering import fitting_font
from agents.policy import Policy, VectorEnv
from agents.rollouts import choose, errors_of
from simulator.utils.files import write_picture

#: Size of a picture, height of the chart below it and of the title above [pixel].
PICTURE, CHART, TITLE, GAP = 192, 64, 34, 8
#: Pictures per second; half of the camera's, so that one can follow.
FRAME_RATE = 15
#: Colours of the picture file.
COLOURS = 64
_INK, _PAPER, _ORACLE, _CHOSEN = "#202020", "#ffffff", "#b0b0b0", "#c0392b"


@dataclass
class Recording:
    """One policy's episode: lists with a value for every frame."""

    name: str
    pictures: list[np.ndarray] = field(default_factory=list)  # (H, W, 3) uint8
    ev100: list[float] = field(default_factory=list)
    best: list[float] = field(default_factory=list)  # EV100 of the best state
    scores: list[float] = field(default_factory=list)
    states: list[int] = field(default_factory=list)
    regrets: list[float] = field(default_factory=list)


def record(
    name: str, policy: Policy, envs: VectorEnv, frames: int, seed: int, scene: str | None = None
) -> Recording:
    """Runs `policy`, which is fitted, through one episode of so many actions.

    `envs` is one environment, made with ``with_oracle=True`` and ``render_mode="rgb_array"``;
    `seed` decides the light and the start, and the scene where its id is not given.
    """
    base: Any = envs.unwrapped
    observations, info = envs.reset(seed=seed, options=None if scene is None else {"scene": scene})
    with errors_of(name, "reset"):
        policy.reset(1, seed=seed)
    found = Recording(name)
    for frame in range(frames + 1):
        if frame:
            actions = choose(name, policy, observations, base.action_masks(), info)
            observations, _, _, _, info = envs.step(actions)
        found.pictures.append(base.render()[0])
        found.ev100.append(float(info["ev100"][0]))
        found.best.append(float(base.grid.ev100[info["oracle_state"][0]]))
        found.scores.append(float(info["rewards.score"][0]))
        found.states.append(int(info["state"][0]))
        found.regrets.append(float(info["regret"][0]))
    return found


def write_film(
    path: Path, recordings: Sequence[Recording], progress: Callable[[int, int], None] | None = None
) -> Path:
    """Writes the recordings side by side as an animated GIF, each over a chart of its exposure.

    The chart has the EV100 of the best state in grey, that of the policy in colour up to now.
    """
    images = []
    total = len(recordings[0].pictures)
    for frame in range(total):
        panels = [_panel(recording, frame) for recording in recordings]
        width = (PICTURE + GAP) * len(panels) - GAP
        image = Image.new("RGB", (width, panels[0].height), _PAPER)
        for i, panel in enumerate(panels):
            image.paste(panel, (i * (PICTURE + GAP), 0))
        images.append(image.quantize(COLOURS, dither=Image.Dither.NONE))
        if progress is not None:
            progress(frame + 1, total)
    timing = {"loop": 0, "duration": 1000 // FRAME_RATE}
    animation = {"save_all": True, "append_images": images[1:], "optimize": True}
    return write_picture(path, images[0], **animation, **timing)


def _panel(recording: Recording, frame: int) -> Image.Image:
    panel = Image.new("RGB", (PICTURE, TITLE + PICTURE + CHART), _PAPER)
    draw = ImageDraw.Draw(panel)
    score = float(np.mean(recording.scores[1 : frame + 1])) if frame else recording.scores[0]
    for i, text in enumerate((recording.name, f"mean score so far {score:.2f}")):
        draw.text((0, 2 + 15 * i), text, _INK, fitting_font(draw, text, 12, PICTURE, least=7))
    panel.paste(Image.fromarray(recording.pictures[frame]).resize((PICTURE, PICTURE)), (0, TITLE))
    bottom, height = TITLE + PICTURE + CHART - 4, CHART - 8
    low, high = min(recording.best + recording.ev100), max(recording.best + recording.ev100)
    step, scale = PICTURE / max(len(recording.best) - 1, 1), max(high - low, 1.0)

    def points(values: Sequence[float]) -> list[tuple[float, float]]:
        return [(i * step, bottom - (v - low) / scale * height) for i, v in enumerate(values)]

    draw.line(points(recording.best), fill=_ORACLE, width=3)
    if frame:
        draw.line(points(recording.ev100[: frame + 1]), fill=_CHOSEN, width=2)
    return panel
