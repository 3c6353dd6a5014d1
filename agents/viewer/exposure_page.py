"""The tab of single captures: sliders, the picture, the scores of all states and the readouts."""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from html import escape
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from nicegui import run, ui
from nicegui.elements.mixins.text_element import TextElement

from ae_env.grid import ExposureGrid
from ae_env.rendering import PATH_COLOURS
from agents.policy_names import CLASSIC_METERS, METERS, PROGRAMS
from agents.viewer.episode_page import SETTLED, settled
from agents.viewer.tab import Address, Stage, Tab, draw_lines, labelled_slider, line_chart, loading
from agents.viewer.viewed_scene import BINS, PLANES, STOPS, Picture, Readout, View, ViewedScene
from simulator import CameraSettings
from simulator.reference.sequences import ISO_SPEEDS
from simulator.settings import NOMINAL_TIMES, format_exposure_time
from simulator.utils.checks import parse_number

_GRID = ExposureGrid.default()
#: Values of the sliders, in third stops as cameras mark them; the default grid's are among them.
ISOS = ISO_SPEEDS[:19]
TIMES = tuple(time for time in NOMINAL_TIMES if 1 / 1000 <= time <= 0.5)
F_NUMBERS = (4.0, 4.5, 5.0, 5.6, 6.3, 7.1, 8.0, 9.0, 10.0, 11.0)
#: The sliders, their values, how these are read, and whether a step brightens or darkens.
_NAMES = ("ISO", "Shutter", "Aperture")
_SCALES = (ISOS, TIMES, F_NUMBERS)
_TEXTS = "{:g}".format, format_exposure_time, "f/{:g}".format
_SIGNS = (1, 1, -1)
#: Policies whose states can be marked; others are typed.
POLICIES = (*METERS, *(f"matrix:{name}" for name in PROGRAMS), "rpi_agc", "regression", "ppo")
#: What can be drawn over the picture: where meters look; regions are typed.
_DRAWN = ["nothing", *CLASSIC_METERS]
#: Options of a choice that also takes what is typed.
_TYPED: dict[str, Any] = {"with_input": True, "new_value_mode": "add-unique"}
#: Colours of the planes R, G1, G2, B in a histogram.
_PLANES = ("#ff5c5c", "#4fd36b", "#b6f0a0", "#6aa5ff")


class ExposurePage(Tab):
    """The tab, see `Tab`; `on_view` is called when it shows another view."""

    def __init__(self, address: Address, folder: Path, on_view: Callable[[], None]) -> None:
        super().__init__(address, folder)
        self._on_view = on_view
        self._refreshing = asyncio.Lock()
        self._shown: tuple[ViewedScene, View, CameraSettings | None] | None = None
        self._compared: View | None = None  # what is on the right of the divider
        self._kept: CameraSettings | None = None  # its settings
        self._picture: Picture | None = None
        self._centre: tuple[float, float] | None = None
        self._marks: dict[str, int] = {}
        self._states: dict[int, TextElement] = {}
        self._facts: dict[str, ui.label] = {}
        with ui.element("div").classes("columns three waiting") as self._columns:
            with ui.element("div").classes("column looked-at"):
                self._build_picture()
            with ui.element("div").classes("column controls"):
                self._settings = list(map(self._stops, _NAMES, _SCALES, _TEXTS))
                self._levels = [0, 0, 0]
                self._lock = ui.switch("Lock the exposure (L)")
                self._build_map()
                self._speed = labelled_slider("Motion", 2.0, 0.05, "{:.2f} H/s".format)
                self._defocus = labelled_slider("Defocus", 8.0, 0.25, "{:.2f} px".format)
                for slider in (self._speed, self._defocus):
                    slider.on_value_change(self._refresh)
                ui.label("Motion: heights a second. Defocus: at f/4, of 64 pixels.").classes("note")
            with ui.element("div").classes("column readouts"):
                with ui.element("div").classes("facts"):
                    for name in ("Score", "Exposure", "Noise", "Blur", "Clipped", "Photosite"):
                        ui.label(name).classes("name")
                        self._facts[name] = ui.label("point at the picture" * (name == "Photosite"))
                        if name == "Score":
                            self._parts = ui.html(sanitize=False).classes("parts")
                self._histogram = line_chart("stops below white", "samples (%)", 190)
                self._histogram.options["xAxis"] |= {"min": -STOPS, "max": 0}
                with ui.expansion("How it was simulated").props("dense").classes("w-full"):
                    self._plan = ui.label().classes("plan")
        ui.keyboard(on_key=self._on_key)

    def _build_picture(self) -> None:
        self._stage = Stage(self, "simulated capture", ("A", "B"))
        self._stage.on("click", self._on_click)
        self._stage.on("mousemove", self._point)
        with ui.element("div").classes("bar"):
            self._clipping = ui.switch("Clipping (C)", on_change=self._refresh)
            self._pixels = ui.switch("Raw pixels (Z)", on_change=self._zoom)
            self._compare = ui.switch("Keep this as B (P)", on_change=self._keep)
            self._equal = ui.switch("Equal brightness (E)", on_change=self._refresh)
            about = "Draw metering weights, or a region: left,top,width,height"
            choice = {"value": "nothing", "label": about, "on_change": self._draw, **_TYPED}
            self._drawn = ui.select(_DRAWN, **choice).props("dense").classes("flex-1")
            self._spinner = ui.spinner(size="sm")
            self._spinner.visible = False
        self._across = labelled_slider("Across", 1.0, 0.01, "{:.0%}".format)
        self._down = labelled_slider("Down", 1.0, 0.01, "{:.0%}".format)
        for slider in (self._across, self._down):
            slider.on_value_change(self._move)
            next(slider.ancestors()).bind_visibility_from(self._pixels, "value")

    def _stops(self, name: str, values: Sequence[float], text: Callable[[float], str]) -> ui.slider:
        slider = labelled_slider(name, len(values) - 1, 1, lambda i: text(values[int(i)]))
        return slider.on_value_change(partial(self._step, slider))

    def _build_map(self) -> None:
        """The states as on a contact sheet: a panel per ISO, shutter across, aperture down."""
        about = "scores of the 64 states; arrow keys choose"
        with ui.element("div").classes("maps").props(f'role=radiogroup aria-label="{about}"'):
            for i, iso in enumerate(_GRID.isos):
                with ui.element("div").classes("map"):
                    times = (format_exposure_time(t)[:-2] for t in _GRID.exposure_times)
                    for text in (f"ISO {iso:g}", *times):
                        ui.label(text).classes("head")
                    for n, f_number in enumerate(_GRID.f_numbers):
                        ui.label(f"f/{f_number:g}").classes("head")
                        for t in range(len(_GRID.exposure_times)):
                            state = _GRID.index(i, t, n)
                            button = TextElement(tag="button", text="").props("role=radio")
                            button.on("click", partial(self.set, _GRID[state])).classes("state")
                            self._states[state] = button
        ui.label("Star: the best state. Dashed: as bright as the state shown.").classes("note")
        about = f"Mark where policies stand after {SETTLED} frames"
        choice = {"multiple": True, "label": about, "on_change": self._mark, **_TYPED}
        self._names = ui.select(list(POLICIES), **choice).props("dense use-chips")
        self._legend = ui.html(sanitize=False).classes("note legend")

    # -- what is shown ----------------------------------------------------------------------------

    @property
    def view(self) -> View:
        """State and marks of the picture that the page shows."""
        scales = zip(_SCALES, self._settings, strict=True)
        return View(
            CameraSettings(*(values[int(slider.value)] for values, slider in scales)),
            speed=float(self._speed.value),
            defocus=float(self._defocus.value),
            clipping=bool(self._clipping.value),
            equal_brightness=bool(self._equal.value),
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
        self._legend.content, self._drawn.value = "", "nothing"
        best = settings or await self.work(viewed.best)
        if best is not None:
            await (self.set(best) if self.view.settings == before else self._refresh())

    async def set(self, settings: CameraSettings) -> None:
        """Shows the scene at `settings`, which the sliders have."""
        values = round(settings.iso), settings.exposure_time, settings.f_number
        await self._set_levels([s.index(v) for s, v in zip(_SCALES, values, strict=True)])

    async def _set_levels(self, levels: list[int]) -> None:
        self._levels = levels
        for slider, level in zip(self._settings, levels, strict=True):
            slider.value = level
        await self._refresh()

    async def _step(self, moved: ui.slider) -> None:
        """Shows what a slider asks for; under the lock the others move against it.

        All three have third stops. What the others cannot take up, the slider moves back.
        """
        levels = [int(slider.value) for slider in self._settings]
        if self._lock.value:
            changes = zip(_SIGNS, levels, self._levels, strict=True)
            excess = sum(sign * (level - before) for sign, level, before in changes)
            for k in sorted((1, 0, 2), key=lambda k: self._settings[k] is moved):  # itself last
                level = min(max(levels[k] - _SIGNS[k] * excess, 0), len(_SCALES[k]) - 1)
                excess += _SIGNS[k] * (level - levels[k])
                levels[k] = level
        await self._set_levels(levels)

    async def _refresh(self) -> None:
        """Shows the view that the page asks for; a view asked for meanwhile comes next, alone."""
        if self._refreshing.locked():
            return
        async with self._refreshing:
            with loading(self._spinner):
                while (asked := (self.viewed, self.view, self._kept)) != self._shown and asked[0]:
                    await self._show(asked[0], asked[1], asked[2])

    async def _show(self, viewed: ViewedScene, view: View, kept: CameraSettings | None) -> None:
        picture = await run.io_bound(viewed.picture, view)
        self._shown, self._picture = (viewed, view, kept), picture
        if picture is None:  # the program ends
            return
        self._columns.classes(remove="waiting")
        self._on_view()
        kind = "pixels" if view.centre else "whole"
        self._stage.show(picture.jpeg, picture.aspect, kind, picture.photosites)
        other = replace(view, settings=kept, clipping=False) if kept else None
        if other != self._compared:
            beside = await run.io_bound(viewed.picture, other) if other else None
            self._stage.compare(beside.jpeg if beside else None)
            self._compared = other
        if kept:
            left, right = self._stage.tags
            left.text, right.text = f"A: {view.settings}", f"B: {kept}"
        if self.view != view:
            return
        readout = await run.io_bound(viewed.readout, view, picture.capture)
        if self.view == view and readout is not None:
            self._show_readout(readout, picture, view)
            await self._show_scores(viewed, view)

    def _show_readout(self, readout: Readout, picture: Picture, view: View) -> None:
        stops = np.linspace(-STOPS, 0, 2 * BINS + 1)[1::2].tolist()  # middles of the bins
        planes = zip(PLANES, _PLANES, 100 * readout.histogram, strict=True)
        lines = [(n, c, zip(stops, v.tolist(), strict=True)) for n, c, v in planes]
        ends = ((0, readout.white, "right", "#ff5ce0"), (-STOPS, readout.black, "left", "#62b0ff"))
        marks = [
            {"xAxis": x, "lineStyle": {"color": c}, "label": {"formatter": f"{v:.1%}", "align": a}}
            for x, v, a, c in ends
        ]
        draw_lines(self._histogram, lines, marks)
        plan, facts, ev100 = readout.plan, self._facts, -view.settings.log2_exposure
        facts["Score"].text = f"{readout.score:.3f}"
        self._parts.content = "".join(
            f"<span>{name}</span><meter value={part:.3f} aria-label={name}></meter>"
            f"<span>{part:.2f}</span><span>{f'costs {cost:.2f}' if cost >= 0.005 else ''}</span>"
            for name, (part, cost) in readout.parts.items()
        )
        facts["Exposure"].text = f"EV100 {ev100:.1f}, {readout.ev:+.1f} EV from right"
        facts["Noise"].text = f"SNR at mid grey: {readout.snr:.1f} dB per photosite"
        if plan.excess_noise:
            facts["Noise"].text += f", {plan.excess_noise:.0%} more variance than the camera's"
        facts["Blur"].text = f"motion {readout.motion:.1f} px, defocus {readout.defocus:.1f} px"
        facts["Clipped"].text = f"{readout.white:.2%} at white, {readout.black:.2%} at black"
        capture, developing = picture.milliseconds
        times = f"{capture:.0f} ms to simulate, {developing:.0f} ms to develop"
        self._plan.text = f"{plan.explain()}\n{times}"

    async def _show_scores(self, viewed: ViewedScene, view: View) -> None:
        table = await run.io_bound(viewed.table, view)
        if table is None:
            return
        best, exposure = table.oracle, view.settings.log2_exposure
        shown = next((s for s in self._states if _GRID[s] == view.settings), None)
        for state, button in self._states.items():
            score, settings = float(table.mean[state]), _GRID[state]
            background, ink = score_colour(round(score, 3))
            names = [name for name, s in self._marks.items() if s == state]
            for k, colour in enumerate(map(self._colour, names)):
                dot = f"{colour} 4px, #000 4px 5px, #0000 5px"
                background = f"radial-gradient(circle at {6 + 11 * k}px 5px, {dot}), {background}"
            button.text = f"{'★' * (state == best)}{score:.2f}".replace("0.", ".")
            button.style(f"background:{background};color:{ink}")
            even = " even" * (abs(settings.log2_exposure - exposure) < 0.1)
            button.classes(replace="state shown" if state == shown else f"state{even}")
            told = ", ".join([f"{settings}: score {score:.2f}, EV100 {settings.ev100:.1f}", *names])
            stop = state == (best if shown is None else shown)  # the one that Tab leads to
            props = {"aria-label": told, "title": told, "tabindex": 0 if stop else -1}
            props["aria-checked"] = str(state == shown).lower()
            if not props.items() <= button.props.items():  # most stay as they are
                button.props.update(props)

    def _colour(self, name: str) -> str:
        return PATH_COLOURS[list(self._marks).index(name)]

    # -- events -----------------------------------------------------------------------------------

    async def _on_key(self, event: Any) -> None:
        if not event.action.keydown or event.action.repeat or event.modifiers.ctrl:
            return
        switches = {"c": self._clipping, "z": self._pixels, "p": self._compare}
        switches |= {"e": self._equal, "l": self._lock}
        switch = switches.get(str(event.key.name).lower())
        if switch is not None:
            switch.value = not switch.value

    async def _on_click(self, event: Any) -> None:
        self._centre = event.args[0], event.args[1]
        self._pixels.value = not self._pixels.value

    async def _zoom(self) -> None:
        self._centre = (self._centre or (0.5, 0.5)) if self._pixels.value else None
        if self._centre is not None:
            self._down.value, self._across.value = (round(share, 2) for share in self._centre)
        await self._refresh()
        await self._draw()

    async def _move(self) -> None:
        if self._pixels.value:
            self._centre = (self._down.value, self._across.value)
            await self._refresh()

    async def _keep(self) -> None:
        self._kept = self.view.settings if self._compare.value else None
        await self._refresh()

    async def _point(self, event: Any) -> None:
        if self._shown is not None and self._picture is not None:
            viewed, view, _ = self._shown
            text = viewed.photosite(view, self._picture.capture, *event.args)
            self._facts["Photosite"].text = text

    async def _draw(self) -> None:
        """Draws where a meter looks, over the whole picture."""
        name, png = str(self._drawn.value or "nothing"), None
        with loading(self._spinner):
            if self.viewed and self._centre is None and name != "nothing":
                png = self.viewed.weights_over(name)
        self._stage.draw_over(png)

    async def _mark(self) -> None:
        if self.viewed is None:
            return
        viewed, names = self.viewed, self._marked[: len(PATH_COLOURS)]
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
        dot = '<i style="background:{}"></i> '.format
        lines = (f"{dot(self._colour(n))}{escape(n)}: {_GRID[s]}" for n, s in self._marks.items())
        self._legend.content = "<br>".join(lines)
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
    sliders = zip(_SCALES, wanted, strict=True)
    return CameraSettings(
        *(values[np.abs(np.subtract(values, v)).argmin()] for values, v in sliders)
    )


@cache
def score_colour(score: float) -> tuple[str, str]:
    """Background and ink of a score in [0, 1]."""
    red, green, blue, _ = matplotlib.colormaps["viridis"](min(max(score, 0.0), 1.0))
    ink = "#000" if score > 0.433 else "#fff"  # either has a contrast of 4.5 at least
    return matplotlib.colors.to_hex((red, green, blue)), ink
