"""A filmed episode: what each policy records of the same scene in the same moving light."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from agents.policy import Policy
from agents.rollouts import errors_of
from simulator.utils.files import write_atomically

#: Size of a picture, height of the chart below it and of the title above [pixel].
PICTURE, CHART, TITLE, GAP = 192, 64, 34, 8
#: Pictures per second; half of the camera's, so that one can follow.
FRAME_RATE = 15
#: Colours of the picture file.
COLOURS = 64
_INK, _PAPER, _ORACLE, _CHOSEN = "#202020", "#ffffff", "#b0b0b0", "#c0392b"


@dataclass
class Recording:
    """One policy's episode.

    Args:
        name: Of the policy.
        pictures: (H, W, 3) uint8 of every frame.
        ev100: EV100 of the settings of every frame.
        best: EV100 of the best state of every frame.
        scores: Score of every frame.
        states: Index of the state of every frame.
        regrets: Best state's expected score less that of the frame's state, of every frame.
    """

    name: str
    pictures: list[np.ndarray] = field(default_factory=list)
    ev100: list[float] = field(default_factory=list)
    best: list[float] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    states: list[int] = field(default_factory=list)
    regrets: list[float] = field(default_factory=list)


def record(
    name: str,
    policy: Policy,
    envs: gym.vector.VectorEnv[Any, Any, Any],
    frames: int,
    seed: int,
    scene: str | None = None,
) -> Recording:
    """Runs `policy` through one episode.

    Args:
        name: Of the policy, in the film.
        policy: Fitted.
        envs: One environment, made with ``with_oracle=True`` and ``render_mode="rgb_array"``.
        frames: Actions.
        seed: Decides the scene, its light and the start.
        scene: Id of the scene; drawn by default.
    """
    base: Any = envs.unwrapped
    options = None if scene is None else {"scene": scene}
    observations, info = envs.reset(seed=seed, options=options)
    with errors_of(name, "reset"):
        policy.reset(1, seed=seed)
    found = Recording(name)
    for frame in range(frames + 1):
        if frame:
            with errors_of(name, "act"):
                extra = {"info": info} if policy.privileged else {}
                actions = policy.act(observations, base.action_masks(), **extra)
            observations, _, _, _, info = envs.step(actions)
        pictures: Any = envs.render()
        found.pictures.append(pictures[0])
        found.ev100.append(float(info["ev100"][0]))
        found.best.append(float(base.grid.ev100[info["oracle_state"][0]]))
        found.scores.append(float(info["rewards"]["score"][0]))
        found.states.append(int(info["state"][0]))
        found.regrets.append(float(info["regret"][0]))
    return found


def write_film(
    path: Path,
    recordings: Sequence[Recording],
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Writes the recordings side by side as an animated GIF, each over a chart of its exposure.

    The chart has the EV100 of the best state in grey, that of the policy in colour up to now.
    """
    images = []
    total = len(recordings[0].pictures)
    for frame in range(total):
        panels = [_panel(recording, frame) for recording in recordings]
        width = sum(panel.width for panel in panels) + GAP * (len(panels) - 1)
        image = Image.new("RGB", (width, panels[0].height), _PAPER)
        for i, panel in enumerate(panels):
            image.paste(panel, (i * (PICTURE + GAP), 0))
        images.append(image.quantize(COLOURS, dither=Image.Dither.NONE))
        if progress is not None:
            progress(frame + 1, total)
    content = io.BytesIO()
    more: dict[str, Any] = {"append_images": images[1:], "duration": 1000 // FRAME_RATE}
    images[0].save(content, format="GIF", save_all=True, loop=0, optimize=True, **more)
    return write_atomically(path, content.getvalue())


def _panel(recording: Recording, frame: int) -> Image.Image:
    panel = Image.new("RGB", (PICTURE, TITLE + PICTURE + CHART), _PAPER)
    draw = ImageDraw.Draw(panel)
    score = float(np.mean(recording.scores[1 : frame + 1])) if frame else recording.scores[0]
    for i, text in enumerate((recording.name, f"mean score so far {score:.2f}")):
        font: Any = ImageFont.load_default(12)
        while draw.textlength(text, font) > PICTURE and font.size > 7:
            font = ImageFont.load_default(int(font.size) - 1)
        draw.text((0, 2 + 15 * i), text, _INK, font)
    picture = Image.fromarray(recording.pictures[frame]).resize((PICTURE, PICTURE))
    panel.paste(picture, (0, TITLE))
    top, bottom = TITLE + PICTURE + 4, TITLE + PICTURE + CHART - 4
    low, high = min(recording.best + recording.ev100), max(recording.best + recording.ev100)

    def points(values: Sequence[float]) -> list[tuple[float, float]]:
        step, scale = PICTURE / max(len(recording.best) - 1, 1), max(high - low, 1.0)
        return [
            (i * step, bottom - (v - low) / scale * (bottom - top)) for i, v in enumerate(values)
        ]

    draw.line(points(recording.best), fill=_ORACLE, width=3)
    if frame:
        draw.line(points(recording.ev100[: frame + 1]), fill=_CHOSEN, width=2)
    return panel


def film(
    policies: Mapping[str, Policy],
    envs: gym.vector.VectorEnv[Any, Any, Any],
    path: Path,
    *,
    frames: int,
    seed: int = 0,
    scene: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Films one episode by each of `policies`; see `record` and `write_film`."""
    found = [record(name, p, envs, frames, seed, scene) for name, p in policies.items()]
    return write_film(path, found, progress)
