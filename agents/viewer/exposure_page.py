"""The tab of single captures: sliders, the picture, the scores of all states and the readouts."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from nicegui import run, ui

from ae_env.grid import ExposureGrid
from agents.policy_names import METERS, PROGRAMS
from agents.viewer.episode_page import SETTLED, settled
from agents.viewer.tab import Stage, Tab, curves, loading
from agents.viewer.viewed_scene import Picture, Readout, View, ViewedScene
from simulator import CameraSettings
from simulator.settings import format_exposure_time
from simulator.utils.checks import parse_number

_GRID = ExposureGrid.default()
#: Values of the sliders, in third stops as cameras mark them; the default grid's are among them.
ISOS = (
    *(100, 125, 160, 200, 250, 320, 400, 500, 640, 800, 1000, 1250, 1600, 2000),
    *(2500, 3200, 4000, 5000, 6400),
)
TIMES = (
    *(1 / n for n in (1000, 800, 640, 500, 400, 320, 250, 200, 160, 125, 100, 80, 60, 50, 40)),
    *(1 / n for n in (30, 25, 20, 15, 13, 10, 8, 6, 5, 4)),
    *(0.3, 0.4, 0.5),
)
F_NUMBERS = (4.0, 4.5, 5.0, 5.6, 6.3, 7.1, 8.0, 9.0, 10.0, 11.0)
#: Policies whose states can be marked; others are typed.
POLICIES = (*METERS, *(f"matrix:{name}" for name in PROGRAMS), "rpi_agc", "regression", "ppo")
_LETTERS = "ABCDEFGH"
#: Colours of the planes R, G1, G2, B in a histogram.
_PLANES = ("#ff5c5c", "#4fd36b", "#b6f0a0", "#6aa5ff")


class ExposurePage(Tab):
    """The tab, see `Tab`; `on_view` is called when it shows another view."""

    def __init__(
        self, address: Callable[[bytes], str], folder: Path, on_view: Callable[[], None]
    ) -> None:
        super().__init__(address, folder)
        self._on_view = on_view
        self._refreshing = asyncio.Lock()
        self._shown: tuple[ViewedScene, View] | None = None
        self._centre: tuple[float, float] | None = None
        self._marks: dict[str, int] = {}
        self._rows: dict[str, ui.element] = {}
        self._states: dict[int, tuple[ui.element, ui.label]] = {}
        self._facts: dict[str, ui.label] = {}
        with ui.element("div").classes("columns waiting") as self._columns:
            with ui.element("div").classes("column looked-at"):
                self._build_picture()
            with ui.element("div").classes("column controls"):
                self._iso = self._stops("ISO", ISOS, "{:g}".format)
                self._time = self._stops("Shutter", TIMES, format_exposure_time)
                self._f_number = self._stops("Aperture", F_NUMBERS, "f/{:g}".format)
                self._build_map()
                self._speed = self._slider("Motion", 2.0, 0.05, "{:.2f} H/s".format)
                self._defocus = self._slider("Defocus", 8.0, 0.25, "{:.2f} px".format)
                ui.label(
                    "Motion of the image in frame heights a second; defocus at f/4, in pixels of a "
                    "frame 64 pixels high."
                ).classes("note")
            with ui.element("div").classes("column"):
                self._histogram = ui.html(sanitize=False)
                self._histogram.props('role=img aria-label="histogram of the raw planes"')
                ui.label(
                    "Raw histogram of R, G1, G2 and B, black to white level (height: square root "
                    "of the pixel share)."
                ).classes("note")
                with ui.element("div").classes("facts"):
                    for name in ("Score", "Noise", "Blur", "Clipped", "Time"):
                        ui.label(name).classes("name")
                        self._facts[name] = ui.label()
                self._plan = ui.label().classes("plan")
        ui.keyboard(on_key=self._on_key)

    def _build_picture(self) -> None:
        self._stage = Stage(self, "simulated capture", "divider between the two states")
        for image in self._stage.images:
            image.on(
                "click",
                self._on_click,
                js_handler="(e) => emit(e.offsetY / e.target.clientHeight, "
                "e.offsetX / e.target.clientWidth)",
            )
        with ui.element("div").classes("bar"):
            self._clipping = ui.switch("Clipping (C)", on_change=self._refresh)
            self._pixels = ui.switch("Raw pixels (Z)", on_change=self._zoom)
            self._compare = ui.switch("Compare with this (P)", on_change=self._pin)
            self._spinner = ui.spinner(size="sm")
            self._spinner.visible = False
        self._across = self._slider("Across", 1.0, 0.01, "{:.0%}".format, self._move)
        self._down = self._slider("Down", 1.0, 0.01, "{:.0%}".format, self._move)
        self._pinned = ui.label().classes("note")
        self._show_window()

    def _stops(self, name: str, values: Sequence[float], text: Callable[[float], str]) -> ui.slider:
        return self._slider(name, len(values) - 1, 1, lambda i: text(values[int(i)]))

    def _slider(
        self,
        name: str,
        most: float,
        step: float,
        text: Callable[[float], str],
        on_change: Callable[[], Any] | None = None,
    ) -> ui.slider:
        with ui.element("div").classes("setting") as self._rows[name]:
            ui.label(name)
            change = on_change or self._refresh
            slider = ui.slider(min=0, max=most, step=step, value=0, on_change=change)
            slider.props(f'aria-label="{name}" dense')
            ui.label().classes("value").bind_text_from(slider, "value", text)
        return slider

    def _build_map(self) -> None:
        with ui.element("div").classes("maps"):
            for n, f_number in enumerate(_GRID.f_numbers):
                with ui.element("div").classes("map"):
                    ui.label(f"f/{f_number:g}: ISO down, shutter across").classes("head")
                    for i, t in np.ndindex(len(_GRID.isos), len(_GRID.exposure_times)):
                        state = _GRID.index(i, t, n)
                        button = ui.element("button").classes("state")
                        button.on("click", partial(self.set, _GRID[state]))
                        with button:
                            self._states[state] = (button, ui.label())
        with ui.element("div").classes("bar"):
            self._names = ui.select(
                list(POLICIES),
                label=f"Mark where policies stand after {SETTLED} frames",
                multiple=True,
                with_input=True,
                new_value_mode="add-unique",
                on_change=self._mark,
            )
            self._names.props("dense use-chips").classes("w-full")
        self._legend = ui.label().classes("note legend")

    # -- what is shown ----------------------------------------------------------------------------

    @property
    def view(self) -> View:
        """State and marks of the picture that the page shows."""
        iso, time = ISOS[int(self._iso.value)], TIMES[int(self._time.value)]
        return View(
            CameraSettings(iso, time, F_NUMBERS[int(self._f_number.value)]),
            speed=float(self._speed.value),
            defocus=float(self._defocus.value),
            clipping=bool(self._clipping.value),
            centre=self._centre,
        )

    @property
    def asked(self) -> dict[str, str]:
        """Entries of an address that `asked_settings` reads as the settings of `view`."""
        settings = self.view.settings
        time = format_exposure_time(settings.exposure_time).removesuffix(" s")
        return {"iso": f"{settings.iso:g}", "t": time, "n": f"{settings.f_number:g}"}

    async def show_scene(
        self, viewed: ViewedScene, before: CameraSettings, settings: CameraSettings | None
    ) -> None:
        """Shows another scene at `settings`, its best state, or what was chosen meanwhile.

        `before` are the settings on the page when it was asked for.
        """
        self.viewed, self._marks, self._centre = viewed, {}, None
        self._names.value = []
        self._pixels.value = self._compare.value = False
        self._speed.value = self._defocus.value = 0.0
        self._legend.text = ""
        self._show_compared(None)
        self._show_window()
        best = settings or await self.work(viewed.best)
        if best is not None:
            await (self.set(best) if self.view.settings == before else self._refresh())

    async def set(self, settings: CameraSettings) -> None:
        """Shows the scene at `settings`, which the sliders have."""
        self._iso.value = ISOS.index(round(settings.iso))
        self._time.value = TIMES.index(settings.exposure_time)
        self._f_number.value = F_NUMBERS.index(settings.f_number)
        await self._refresh()

    async def _refresh(self) -> None:
        """Shows the view that the page asks for; a view asked for meanwhile comes next, alone."""
        if self._refreshing.locked():
            return
        async with self._refreshing:
            with loading(self._spinner):
                while self.viewed is not None and (self.viewed, self.view) != self._shown:
                    await self._show_view(self.viewed, self.view)

    async def _show_view(self, viewed: ViewedScene, view: View) -> None:
        picture = await run.io_bound(viewed.picture, view)
        self._shown = viewed, view
        if picture is None:  # the program ends
            return
        self._columns.classes(remove="waiting")
        self._on_view()
        self._stage.show(picture.jpeg, picture.aspect, "pixels" if view.centre else "whole")
        if self.view != view:
            return
        readout = await run.io_bound(viewed.readout, view, picture.capture)
        if self.view == view and readout is not None:
            self._show_readout(readout, picture)
            await self._show_scores(viewed, view)

    def _show_readout(self, readout: Readout, picture: Picture) -> None:
        self._histogram.content = histogram(readout.histogram)
        plan, facts = readout.plan, self._facts
        facts["Score"].text = f"{readout.score:.3f}"
        facts["Noise"].text = f"SNR at mid grey: {readout.snr:.1f} dB per photosite"
        if plan.excess_noise:
            facts["Noise"].text += f", {plan.excess_noise:.0%} more variance than the camera's"
        facts["Blur"].text = f"motion {readout.motion:.1f} px, defocus {readout.defocus:.1f} px"
        facts["Clipped"].text = f"{readout.white:.2%} at white, {readout.black:.2%} at black"
        capture, developing = picture.milliseconds
        facts["Time"].text = (
            f"{capture:.0f} ms to simulate, {developing:.0f} ms to develop; error "
            f"{plan.predicted_error:.2f} of the noise"
        )
        self._plan.text = plan.explain()

    async def _show_scores(self, viewed: ViewedScene, view: View) -> None:
        table = await run.io_bound(viewed.table, view)
        if table is None:
            return
        best = table.oracle
        for state, (button, label) in self._states.items():
            letters = [_LETTERS[i] for i, s in enumerate(self._marks.values()) if s == state]
            score = float(table.mean[state])
            background, ink = score_colour(score)
            text = f"{'★' * (state == best)}{''.join(letters)} {score:.2f}"
            label.text = text.replace(" 0.", " .").strip()
            size = 12 if len(label.text) <= 6 else 9
            button.style(f"background:{background};color:{ink};font-size:{size}px")
            button.props["aria-label"] = f"{_GRID[state]}: score {score:.2f}"
            button.classes(replace="state shown" if _GRID[state] == view.settings else "state")
            button.update()

    # -- events -----------------------------------------------------------------------------------

    async def _on_key(self, event: Any) -> None:
        if not event.action.keydown or event.action.repeat or event.modifiers.ctrl:
            return
        switches = {"c": self._clipping, "z": self._pixels, "p": self._compare}
        switch = switches.get(str(event.key.name).lower())
        if switch is not None:
            switch.value = not switch.value

    async def _on_click(self, event: Any) -> None:
        down, right = event.args
        if not self._pixels.value:
            self._centre = (min(max(down, 0.0), 1.0), min(max(right, 0.0), 1.0))
        self._pixels.value = not self._pixels.value

    async def _zoom(self) -> None:
        if not self._pixels.value:
            self._centre = None
        elif self._centre is None:
            self._centre = (0.5, 0.5)
        self._compare.value = False
        self._show_window()
        await self._refresh()

    async def _move(self) -> None:
        if self._pixels.value:
            self._centre = (self._down.value, self._across.value)
            await self._refresh()

    def _show_window(self) -> None:
        for slider, name, place in ((self._down, "Down", 0), (self._across, "Across", 1)):
            self._rows[name].set_visibility(self._centre is not None)
            if self._centre is not None:
                slider.value = round(self._centre[place], 2)

    async def _pin(self) -> None:
        if not self._compare.value or self.viewed is None:
            self._show_compared(None)
            return
        view = replace(self.view, clipping=False)
        picture = await self.work(self.viewed.picture, view)
        if picture is not None:
            self._show_compared(picture, f"right of the divider: {view.settings}")

    def _show_compared(self, picture: Picture | None, text: str = "") -> None:
        self._stage.compare(None if picture is None else picture.jpeg)
        self._pinned.text = text

    async def _mark(self) -> None:
        if self.viewed is None:
            return
        viewed, names = self.viewed, self._marked[: len(_LETTERS)]
        missing = [name for name in names if name not in self._marks]
        if missing:
            with loading(self._spinner, Exception):  # whatever a policy of the user's raises
                self._marks |= await self.work(settled, missing, viewed.scored) or {}
        if viewed is not self.viewed:
            return
        if not self._marks.keys() >= set(names):
            self._names.value = [name for name in names if name not in missing]
            return
        self._marks = {name: self._marks[name] for name in self._marked if name in self._marks}
        self._legend.text = "\n".join(
            f"{letter} {name}: {_GRID[state]}"
            for letter, (name, state) in zip(_LETTERS, self._marks.items(), strict=False)
        )
        await self._show_scores(viewed, self.view)

    @property
    def _marked(self) -> list[str]:
        return [str(name) for name in self._names.value or []]


def asked_settings(asked: Mapping[str, str]) -> CameraSettings | None:
    """Settings of the sliders nearest to those of an address; None if it lacks one or is wrong."""
    try:
        wanted = [parse_number(asked.get(name, "")) for name in ("iso", "t", "n")]
    except ValueError:
        return None
    sliders = zip((ISOS, TIMES, F_NUMBERS), wanted, strict=True)
    return CameraSettings(
        *(values[np.abs(np.subtract(values, v)).argmin()] for values, v in sliders)
    )


def score_colour(score: float) -> tuple[str, str]:
    """Background and ink of a score in [0, 1]."""
    red, green, blue, _ = matplotlib.colormaps["viridis"](min(max(score, 0.0), 1.0))
    ink = "#000" if 0.3 * red + 0.59 * green + 0.11 * blue > 0.45 else "#fff"
    return matplotlib.colors.to_hex((red, green, blue)), ink


def histogram(shares: np.ndarray) -> str:
    """Histogram of the raw planes, an SVG: black level on the left, white level on the right."""
    tallest = float(np.sqrt(shares[:, 1:-1].max())) or 1.0  # clipped samples would hide the rest
    heights = np.minimum(np.sqrt(shares) / tallest, 1.0)
    return curves(zip(_PLANES, heights, strict=True), 0.0, 1.0, 96)
