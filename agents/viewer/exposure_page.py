"""The tab of single captures: sliders, the picture, the scores of all states and the readouts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from nicegui import run, ui

from ae_env.grid import ExposureGrid
from agents.policy_names import METERS, PROGRAMS
from agents.viewer.drawings import histogram, score_colour
from agents.viewer.playing import SETTLED, settled
from agents.viewer.stage import Stage
from agents.viewer.viewed_scene import Picture, Readout, View, ViewedScene
from simulator import CameraSettings
from simulator.settings import format_exposure_time

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


class ExposurePage:
    """The tab.

    Args:
        address: Gives a picture an address that the browser can fetch it from.
    """

    def __init__(self, address: Callable[[bytes], str]) -> None:
        self._address = address
        self._viewed: ViewedScene | None = None
        self._done: Any = None
        self._busy = self._silent = False
        self._centre: tuple[float, float] | None = None
        self._marks: dict[str, int] = {}
        self._rows: dict[str, ui.element] = {}
        self._states: dict[int, tuple[ui.element, ui.label]] = {}
        self._facts: dict[str, ui.label] = {}

    # -- the page ---------------------------------------------------------------------------------

    def build(self) -> None:
        """Puts the tab together."""
        with ui.element("div").classes("columns"):
            with ui.element("div").classes("column looked-at"):
                self._build_picture()
            with ui.element("div").classes("column controls"):
                self._iso = self._setting("ISO", ISOS, lambda v: f"{v:g}")
                self._time = self._setting("Shutter", TIMES, format_exposure_time)
                self._f_number = self._setting("Aperture", F_NUMBERS, lambda v: f"f/{v:g}")
                self._build_map()
                self._speed = self._amount("Motion", 2.0, 0.05, "{:.2f} H/s")
                self._defocus = self._amount("Defocus", 8.0, 0.25, "{:.2f} px")
                ui.label(
                    "Motion of the image in frame heights a second; defocus at f/4, in pixels of a "
                    "frame 64 pixels high."
                ).classes("note")
            with ui.element("div").classes("column"):
                self._build_readouts()
        ui.keyboard(on_key=self._on_key)

    def _build_picture(self) -> None:
        self._stage = Stage(self._address, "simulated capture", "divider between the two states")
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
        self._across = self._amount("Across", 1.0, 0.01, "{:.0%}", self._move)
        self._down = self._amount("Down", 1.0, 0.01, "{:.0%}", self._move)
        self._pinned = ui.label().classes("note")
        self._show_window()

    def _build_readouts(self) -> None:
        self._histogram = ui.html(sanitize=False).props(
            'role=img aria-label="histogram of the raw planes"'
        )
        ui.label("Raw planes R, G1, G2, B from black to white; root of the share.").classes("note")
        with ui.element("div").classes("facts"):
            for name in ("Score", "Noise", "Blur", "Clipped", "Time"):
                ui.label(name).classes("name")
                self._facts[name] = ui.label()
        self._plan = ui.label().classes("plan")

    def _setting(self, name: str, values: Any, show: Callable[[Any], str]) -> Any:
        with ui.element("div").classes("setting"):
            ui.label(name)
            slider = ui.slider(min=0, max=len(values) - 1, step=1, value=0, on_change=self._refresh)
            slider.props(f'aria-label="{name}" dense')
            ui.label().classes("value").bind_text_from(
                slider, "value", lambda i: show(values[int(i)])
            )
        return slider

    def _amount(
        self,
        name: str,
        most: float,
        step: float,
        text: str,
        on_change: Callable[[], Any] | None = None,
    ) -> Any:
        with ui.element("div").classes("setting") as row:
            ui.label(name)
            slider = ui.slider(
                min=0, max=most, step=step, value=0, on_change=on_change or self._refresh
            )
            slider.props(f'aria-label="{name}" dense')
            ui.label().classes("value").bind_text_from(slider, "value", lambda v: text.format(v))
        self._rows[name] = row
        return slider

    def _build_map(self) -> None:
        with ui.element("div").classes("maps"):
            for n, f_number in enumerate(_GRID.f_numbers):
                with ui.element("div").classes("map"):
                    ui.label(f"f/{f_number:g}: ISO down, shutter across").classes("head")
                    for i in range(len(_GRID.isos)):
                        for t in range(len(_GRID.exposure_times)):
                            self._build_state(_GRID.index(i, t, n))
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

    def _build_state(self, state: int) -> None:
        button = ui.element("button").classes("state")
        button.on("click", lambda: self._set(_GRID[state]))
        with button:
            self._states[state] = (button, ui.label())

    # -- what is shown ----------------------------------------------------------------------------

    @property
    def view(self) -> View:
        """What the page shows now."""
        return View(
            CameraSettings(
                ISOS[int(self._iso.value)],
                TIMES[int(self._time.value)],
                F_NUMBERS[int(self._f_number.value)],
            ),
            speed=float(self._speed.value),
            defocus=float(self._defocus.value),
            clipping=bool(self._clipping.value),
            centre=self._centre,
        )

    async def show_scene(self, viewed: ViewedScene, before: CameraSettings) -> None:
        """Shows another scene, at its best state or at what was chosen since it was asked for.

        Args:
            viewed: The scene.
            before: Settings on the page when it was asked for.
        """
        self._viewed, self._marks, self._centre = viewed, {}, None
        self._silent = True
        try:
            self._names.value = []
            self._pixels.value = self._compare.value = False
            self._speed.value = self._defocus.value = 0.0
        finally:
            self._silent = False
        self._legend.text = ""
        self._show_compared(None)
        self._show_window()
        best = await run.io_bound(viewed.best)
        if best is None or viewed is not self._viewed:
            return
        if self.view.settings == before:
            await self._set(best)
        else:
            await self._refresh()

    async def _set(self, settings: CameraSettings) -> None:
        self._silent = True
        try:
            self._iso.value = ISOS.index(round(settings.iso))
            self._time.value = TIMES.index(settings.exposure_time)
            self._f_number.value = F_NUMBERS.index(settings.f_number)
        finally:
            self._silent = False
        await self._refresh()

    async def _refresh(self) -> None:
        """Shows what the page asks for; what was asked for meanwhile comes next, alone."""
        if self._silent or self._busy or self._viewed is None:
            return
        self._busy = True
        self._spinner.visible = True
        try:
            while self._viewed is not None and (self._viewed, self.view) != self._done:
                viewed, view = self._viewed, self.view
                picture = await run.io_bound(viewed.picture, view)
                if picture is None:  # the program ends
                    return
                self._stage.show(picture.jpeg, picture.aspect, "pixels" if view.centre else "whole")
                self._done = viewed, view
                if self.view != view:
                    continue
                readout = await run.io_bound(viewed.readout, view, picture.capture)
                if self.view == view and readout is not None:
                    self._show_readout(readout, picture)
                    await self._show_scores(viewed, view)
        except (ValueError, OSError, RuntimeError) as error:
            ui.notify(" ".join(str(error).split()), type="negative", multi_line=True)
        finally:
            self._busy = False
            self._spinner.visible = False

    def _show_readout(self, readout: Readout, picture: Picture) -> None:
        self._histogram.content = histogram(readout.histogram)
        plan = readout.plan
        facts = self._facts
        facts["Score"].text = f"{readout.score:.3f}"
        excess = (
            f", {plan.excess_noise:.0%} more variance than the camera's"
            if plan.excess_noise
            else ""
        )
        facts["Noise"].text = f"mid grey {readout.snr:.1f} dB above its noise, a photosite{excess}"
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
            label.text = f"{'★' * (state == best)}{''.join(letters)} {score:.2f}".replace(
                " 0.", " ."
            ).strip()
            size = 12 if len(label.text) <= 6 else 9
            button.style(f"background:{background};color:{ink};font-size:{size}px")
            button.props["aria-label"] = f"{_GRID[state]}: score {score:.2f}"
            if _GRID[state] == view.settings:
                button.classes(add="shown")
            else:
                button.classes(remove="shown")
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
        if self._silent:
            return
        if not self._pixels.value:
            self._centre = None
        elif self._centre is None:
            self._centre = (0.5, 0.5)
        self._compare.value = False
        self._show_window()
        await self._refresh()

    async def _move(self) -> None:
        if not self._silent and self._pixels.value:
            self._centre = (self._down.value, self._across.value)
            await self._refresh()

    def _show_window(self) -> None:
        self._silent = True
        try:
            for slider, name, place in ((self._down, "Down", 0), (self._across, "Across", 1)):
                self._rows[name].set_visibility(self._centre is not None)
                if self._centre is not None:
                    slider.value = round(self._centre[place], 2)
        finally:
            self._silent = False

    async def _pin(self) -> None:
        if self._silent:
            return
        if not self._compare.value or self._viewed is None:
            self._show_compared(None)
            return
        view = replace(self.view, clipping=False)
        picture = await run.io_bound(self._viewed.picture, view)
        if picture is not None:
            self._show_compared(picture, f"right of the divider: {view.settings}")

    def _show_compared(self, picture: Picture | None, text: str = "") -> None:
        self._stage.compare(None if picture is None else picture.jpeg)
        self._pinned.text = text

    async def _mark(self) -> None:
        if self._silent or self._viewed is None:
            return
        names = [str(name) for name in self._names.value or []][: len(_LETTERS)]
        missing = [name for name in names if name not in self._marks]
        viewed = self._viewed
        self._spinner.visible = True
        try:
            if missing:
                found = await run.io_bound(settled, missing, viewed.scored)
                self._marks |= found or {}
        except Exception as error:  # whatever a policy of the user's raises
            ui.notify(" ".join(str(error).split()), type="negative", multi_line=True)
            self._names.value = [name for name in names if name not in missing]
            return
        finally:
            self._spinner.visible = False
        if viewed is not self._viewed:
            return
        chosen = [str(name) for name in self._names.value or []]  # more may have come meanwhile
        self._marks = {name: self._marks[name] for name in chosen if name in self._marks}
        self._legend.text = "\n".join(
            f"{letter} {name}: {_GRID[state]}"
            for letter, (name, state) in zip(_LETTERS, self._marks.items(), strict=False)
        )
        await self._show_scores(viewed, self.view)
