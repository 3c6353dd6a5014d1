"""The tab of episodes: two policies in the same light, frame by frame."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
from nicegui import run, ui
from PIL import Image

from ae_env.grid import ExposureGrid
from agents.report.plots import FRAME_RATE, Recording
from agents.viewer.drawings import BEST, POLICIES, chart
from agents.viewer.playing import LIGHTS, STILL, play
from agents.viewer.viewed_scene import ViewedScene

#: Policies that are offered; others are typed.
NAMES = (
    *("average:tuned", "average:tuned?foresight=model", "regression:video?foresight=learnt"),
    *("regression:video", "ppo:video", "rpi_agc", "average", "matrix", "regression", "ppo"),
)
_FRAMES = 64


class EpisodePage:
    """The tab.

    Args:
        address: Gives a picture an address that the browser can fetch it from.
    """

    def __init__(self, address: Callable[[bytes], str]) -> None:
        self._address = address
        self._viewed: ViewedScene | None = None
        self._recordings: list[Recording] = []
        self._grid = ExposureGrid.video()

    def build(self) -> None:
        """Puts the tab together."""
        with ui.element("div").classes("column w-full"):
            with ui.element("div").classes("bar"):
                choices = "".join(f'<option value="{name}">' for name in NAMES)
                ui.html(choices, sanitize=False, tag="datalist").props("id=policies")
                self._policies = [
                    ui.input(f"policy {letter}", value=name)
                    .props("dense list=policies")
                    .classes("w-72")
                    for letter, name in zip("AB", (NAMES[0], NAMES[2]), strict=True)
                ]
                self._light = ui.select(list(LIGHTS), label="light", value="shadows").props("dense")
                self._frames = ui.number("frames", value=_FRAMES, min=2, max=512, precision=0)
                self._seed = ui.number("seed", value=0, min=0, max=2**31, precision=0)
                for number in (self._frames, self._seed):
                    number.props("dense").classes("w-20")
                self._run = ui.button("Run", icon="play_circle", on_click=self._record)
            with ui.element("div").classes("column w-full") as self._shown:
                self._build_player()
        self._shown.set_visibility(False)
        self._timer = ui.timer(1.0 / FRAME_RATE, self._advance, active=False)

    def _build_player(self) -> None:
        with ui.element("div").classes("players"):
            self._images, self._facts = [], []
            for colour in POLICIES:
                with ui.element("div").classes("column"):
                    self._images.append(ui.element("img").props('alt="frame"'))
                    self._facts.append(ui.label().classes("note").style(f"color:{colour}"))
        with ui.element("div").classes("bar"):
            self._play = ui.button(icon="play_arrow", on_click=self._toggle)
            self._play.props('dense aria-label="play or pause"')
            self._frame = ui.slider(min=0, max=1, step=1, value=0, on_change=self._show_frame)
            self._frame.props('aria-label="frame"').classes("flex-1")
            self._number = ui.label().classes("note")
        self._charts = {}
        for name in ("EV100: the best state's (grey) and the policies'", "Score", "Regret"):
            ui.label(name).classes("note")
            with ui.element("div").classes("chart") as holder:
                content = ui.html(sanitize=False)
                ui.element("div").classes("now")
            self._charts[name.partition(":")[0]] = (holder, content)

    def show_scene(self, viewed: ViewedScene) -> None:
        """Takes another scene for the next episode."""
        self._viewed, self._recordings = viewed, []
        self._timer.active = False
        self._shown.set_visibility(False)

    async def _record(self) -> None:
        if self._viewed is None:
            return
        viewed, names = self._viewed, [str(field.value) for field in self._policies]
        names = list(dict.fromkeys(names))  # a policy beside itself is shown once
        light = str(self._light.value)
        self._run.props("loading")
        try:
            found = await run.io_bound(
                play,
                names,
                viewed.scored,
                light=light,
                frames=int(self._frames.value or _FRAMES),
                seed=int(self._seed.value or 0),
            )
        except Exception as error:  # whatever a policy of the user's raises
            ui.notify(" ".join(str(error).split()), type="negative", multi_line=True)
            return
        finally:
            self._run.props(remove="loading")
        if found is None or viewed is not self._viewed:
            return
        self._grid = ExposureGrid.default() if light == STILL else ExposureGrid.video()
        self._show(found)

    def _show(self, recordings: list[Recording]) -> None:
        self._recordings = recordings
        count = len(recordings[0].states)
        lines = dict(zip(POLICIES, recordings, strict=False))
        ev100 = {BEST: recordings[0].best} | {c: r.ev100 for c, r in lines.items()}
        values = np.concatenate([np.asarray(v) for v in ev100.values()])
        self._draw("EV100", ev100, float(values.min()) - 0.5, float(values.max()) + 0.5)
        self._draw("Score", {c: r.scores for c, r in lines.items()}, 0.0, 1.0)
        regrets = {c: r.regrets for c, r in lines.items()}
        self._draw("Regret", regrets, 0.0, max(0.1, *(max(v) for v in regrets.values())))
        self._frame.props(f"max={count - 1}")
        self._frame.value = 0
        self._show_frame()
        self._shown.set_visibility(True)
        self._timer.active = True
        self._play.props("icon=pause")

    def _draw(self, name: str, lines: Any, low: float, high: float) -> None:
        self._charts[name][1].content = chart(lines, low, high)

    def _show_frame(self) -> None:
        if not self._recordings:
            return
        frame, last = int(self._frame.value), len(self._recordings[0].states) - 1
        self._number.text = f"frame {frame} of {last}"
        for holder, _ in self._charts.values():
            holder.style(f"--now: {100.0 * frame / max(last, 1):.2f}%")
        for i, (image, facts) in enumerate(zip(self._images, self._facts, strict=True)):
            if i >= len(self._recordings):
                facts.text = ""
                image.set_visibility(False)
                continue
            one = self._recordings[i]
            image.set_visibility(True)
            image.props["src"] = self._address(_jpeg(one.pictures[frame]))
            image.update()
            facts.text = (
                f"{'AB'[i]} {one.name}: {self._grid[one.states[frame]]}, score "
                f"{one.scores[frame]:.3f}, regret {one.regrets[frame]:.3f}; mean score so far "
                f"{np.mean(one.scores[: frame + 1]):.3f}"
            )

    def _toggle(self) -> None:
        self._timer.active = not self._timer.active
        if self._timer.active and self._frame.value >= len(self._recordings[0].states) - 1:
            self._frame.value = 0
        self._play.props("icon=pause" if self._timer.active else "icon=play_arrow")

    def _advance(self) -> None:
        last = len(self._recordings[0].states) - 1 if self._recordings else 0
        if self._frame.value >= last:
            self._timer.active = False
            self._play.props("icon=play_arrow")
            return
        self._frame.value = int(self._frame.value) + 1


def _jpeg(picture: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="JPEG", quality=90)
    return buffer.getvalue()
