"""The tab of what else one raw gives: a shallower depth of field, and an HDR picture."""

from __future__ import annotations

import asyncio
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from typing import Any

from nicegui import run, ui

from agents.viewer.from_one_raw import Made, fused, opened, recorded, wider_f_numbers
from agents.viewer.stage import Stage
from agents.viewer.viewed_scene import ViewedScene
from simulator import CameraSimulator, RawImage

_NO_RAW = "Only a raw can be opened or fused: this scene is no photograph. Open a raw."


class OneRawPage:
    """The tab.

    Args:
        address: Gives a picture an address that the browser can fetch it from.
        simulator: Reduces noise, and estimates the blur.
        folder: For downloads.
    """

    def __init__(
        self, address: Callable[[bytes], str], simulator: CameraSimulator, folder: Path
    ) -> None:
        self._address, self._simulator, self._folder = address, simulator, folder
        self._viewed: ViewedScene | None = None
        self._f_numbers: tuple[float, ...] = ()
        self._busy = self._shown = False
        self._begun, self._doing = 0.0, ""
        self._made: dict[str, Made] = {}
        self._saves: dict[str, ui.button] = {}

    # -- the page ---------------------------------------------------------------------------------

    def build(self) -> None:
        """Puts the tab together."""
        with ui.element("div").classes("columns"):
            with ui.element("div").classes("column looked-at"):
                self._stage = Stage(
                    self._address, "the raw", "divider between the raw and what was made of it"
                )
                self._raw_text = ui.label().classes("note")
                with ui.element("div").classes("bar"):
                    self._spinner = ui.spinner(size="sm")
                    self._told = ui.label().props("role=status")
            with ui.element("div").classes("column controls"):
                ui.label("Shallow depth of field").classes("title")
                with ui.element("div").classes("setting"):
                    ui.label("Aperture")
                    self._slider = ui.slider(min=0, max=1, step=1, value=0)
                    self._slider.props('aria-label="Wider aperture" dense')
                    ui.label().classes("value").bind_text_from(
                        self._slider, "value", lambda i: self._marked(int(i or 0))
                    )
                with ui.element("div").classes("bar"):
                    self._open = ui.button("Open the aperture", icon="camera", on_click=self._opens)
                    self._save_button(".dng")
                ui.label(
                    "Wider than the lens of the raw. What is soft is taken to lie behind what is "
                    "sharp; a raw that is sharp throughout stays as it is. A depth map does more: "
                    "ae-env refocus --depth."
                ).classes("note")
                ui.label("HDR").classes("title")
                with ui.element("div").classes("bar"):
                    self._fuse = ui.button("Fuse a bracket", icon="hdr_on", on_click=self._fuses)
                    self._save_button(".png")
                    self._save_button(".exr")
                ui.label(
                    "A bracket is simulated from the raw with its noise reduced, and fused: PNG. "
                    "The EXR holds the light, 1 at the raw's white."
                ).classes("note")
        self._clock = ui.timer(1.0, self._tick, active=False)
        self._update()

    def _save_button(self, ending: str) -> None:
        button = ui.button(ending[1:].upper(), icon="download", on_click=lambda: self._save(ending))
        button.props(f'dense aria-label="save {ending[1:].upper()}"')
        self._saves[ending] = button

    def _marked(self, place: int) -> str:
        return f"f/{self._f_numbers[place]:g}" if place < len(self._f_numbers) else ""

    @property
    def _raw(self) -> RawImage | None:
        return None if self._viewed is None else self._viewed.photograph

    def _update(self) -> None:
        """What can be done now is enabled."""
        ready = self._raw is not None and not self._busy
        self._open.set_enabled(ready and bool(self._f_numbers))
        self._slider.set_enabled(ready and bool(self._f_numbers))
        self._fuse.set_enabled(ready)
        for ending, button in self._saves.items():
            button.set_enabled(ending in self._made and not self._busy)
        self._spinner.visible = self._busy
        self._clock.active = self._busy

    def take_scene(self, viewed: ViewedScene) -> None:
        """Takes another scene; `show_raw` shows it."""
        self._viewed, self._made = viewed, {}
        self._f_numbers = () if viewed.photograph is None else wider_f_numbers(viewed.photograph)
        self._slider.props(f"max={max(len(self._f_numbers) - 1, 1)}")
        self._slider.value = max(len(self._f_numbers) - 1, 0)  # the widest
        self._stage.clear()
        self._raw_text.text = ""
        self._shown = viewed.photograph is None
        if not self._busy:
            open_already = "" if self._f_numbers else "The aperture of this raw is open already."
            self._told.text = _NO_RAW if viewed.photograph is None else open_already
        self._update()

    async def show_raw(self) -> None:
        """Shows the raw of the scene, once: a large one takes seconds."""
        viewed, raw = self._viewed, self._raw
        if self._shown or raw is None:
            return
        self._shown = True
        made = await run.io_bound(recorded, raw)
        if made is not None and viewed is self._viewed:
            self._stage.show(made.jpeg, made.aspect)
            self._raw_text.text = f"left of the divider: the raw, {made.told}"

    # -- events -----------------------------------------------------------------------------------

    async def _opens(self) -> None:
        await self._make("opening the aperture", opened, self._f_numbers[int(self._slider.value)])

    async def _fuses(self) -> None:
        await self._make("fusing", fused)

    async def _make(self, doing: str, function: Callable[..., Made], *options: Any) -> None:
        """Shows what `function` makes of the raw; it may take minutes, and the page lives."""
        viewed, raw = self._viewed, self._raw
        if raw is None or self._busy:
            return
        self._busy, self._begun = True, perf_counter()
        self._doing = f"{doing}, {4e-6 * raw.data[0].numel():.1f} megapixels"
        self._tick()
        self._update()
        told = ""
        try:
            made = await _in_background(function, raw, *options, self._simulator)
            if viewed is self._viewed:
                self._made |= dict.fromkeys(made.files, made)
                self._stage.compare(made.jpeg)
                told = f"right: {made.told}, in {perf_counter() - self._begun:.0f} s"
        except (ValueError, OSError, RuntimeError, MemoryError) as error:
            told = f"{doing} failed: {' '.join(str(error).split())}"
            ui.notify(told, type="negative", multi_line=True, timeout=10_000)
        finally:
            self._busy = False
            self._told.text = told
            self._update()

    def _tick(self) -> None:
        self._told.text = f"{self._doing} ... {perf_counter() - self._begun:.0f} s"

    async def _save(self, ending: str) -> None:
        if self._viewed is None or ending not in self._made:
            return
        what = "opened" if ending == ".dng" else "hdr"
        name = f"{Path(self._viewed.scene.scene_id).stem}-{what}{ending}"
        path = Path(tempfile.mkdtemp(dir=self._folder), name)
        self._saves[ending].props("loading")
        try:
            await run.io_bound(self._made[ending].files[ending], path)
            ui.download.file(path)
        except (ValueError, OSError, ImportError) as error:
            ui.notify(" ".join(str(error).split()), type="negative", multi_line=True)
        finally:
            self._saves[ending].props(remove="loading")


async def _in_background(function: Callable[..., Made], *arguments: Any) -> Made:
    """The result of `function`, made in a thread that the end of the program does not wait for."""
    loop = asyncio.get_running_loop()
    result: asyncio.Future[Made] = loop.create_future()

    def tell(how: Callable[[Any], None], what: Any) -> None:
        with suppress(RuntimeError):  # the program has ended
            loop.call_soon_threadsafe(lambda: None if result.done() else how(what))

    def work() -> None:
        try:
            made = function(*arguments)
        except Exception as error:  # raised where it is awaited
            tell(result.set_exception, error)
        else:
            tell(result.set_result, made)

    threading.Thread(target=work, daemon=True).start()
    return await result
