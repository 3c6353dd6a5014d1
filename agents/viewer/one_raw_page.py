"""The tab of what else one raw gives: a shallower depth of field, and an HDR picture."""

import asyncio
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, Self

from nicegui import ui
from PIL import Image

from agents.applications.hdr import hdr_picture, linear_rgb, write_exr
from agents.applications.refocus import NOTHING_FOUND, refocus
from agents.viewer.tab import Address, Stage, Tab, complain, heading, labelled_slider
from agents.viewer.viewed_scene import ViewedScene, encoded
from simulator import CameraSimulator, RawImage, render_srgb, write_dng
from simulator.raw.develop import upright_picture
from simulator.utils.files import write_atomically

#: F-numbers as cameras mark them, in third stops.
_MARKED = (
    *(1.4, 1.6, 1.8, 2.0, 2.2, 2.5, 2.8, 3.2, 3.5, 4.0, 4.5, 5.0, 5.6, 6.3, 7.1, 8.0, 9.0, 10.0),
    *(11.0, 13.0, 14.0, 16.0, 18.0, 20.0, 22.0),
)
#: Largest picture on the page, longer side [pixel of the sensor].
_LONGEST = 1536
_NO_RAW = "Only a raw can be opened or fused: this scene is no photograph. Open a raw."


@dataclass(frozen=True)
class RenderedImage:
    """A picture on the page of a raw or of a result from it, and functions that write its files."""

    jpeg: bytes
    aspect: float
    text: str
    files: Mapping[str, Callable[[Path], object]] = field(default_factory=dict)

    @classmethod
    def of(cls, image: Image.Image, text: str, **files: Callable[[Path], object]) -> Self:
        """`image`, averaged down for the page."""
        small = image.reduce(max(1, -(-max(image.size) // _LONGEST)))
        return cls(encoded(small), small.width / small.height, text, files)


def wider_f_numbers(raw: RawImage) -> tuple[float, ...]:
    """The marked f-numbers that are wider than the raw's, the nearest first; down to f/1.4."""
    own = raw.settings.effective_f_number  # what is marked 5.6 may be recorded as 5.66
    settings = (replace(raw.settings, f_number=n) for n in reversed(_MARKED))
    return tuple(s.f_number for s in settings if s.effective_f_number < own)


def recorded(raw: RawImage) -> RenderedImage:
    """The raw itself, developed."""
    image = upright_picture(raw, render_srgb(raw))
    return RenderedImage.of(image, f"{raw.camera.name}, {raw.settings}")


def opened(raw: RawImage, f_number: float, simulator: CameraSimulator) -> RenderedImage:
    """The raw as a wider aperture would have recorded it; the blur is estimated."""
    result = refocus(raw, f_number, simulator=simulator)
    largest = result.metadata["largest_disc_px"]
    text = f"f/{f_number:g}, blur estimated: the widest disc has {largest:.1f} packed pixels"
    if largest == 0.0:
        text = NOTHING_FOUND
    image = upright_picture(result, render_srgb(result))
    return RenderedImage.of(image, text, dng=lambda path: write_dng(path, result))


def fused(raw: RawImage, simulator: CameraSimulator) -> RenderedImage:
    """The simulated bracket of the raw, fused."""
    hdr = hdr_picture(raw, simulator=simulator)
    image = upright_picture(raw, (hdr.fused * 255.0).round().byte())
    darkest, brightest = hdr.exposures[0], hdr.exposures[-1]
    text = f"{len(hdr.exposures)} simulated pictures, {darkest:+g} to {brightest:+g} EV, fused"
    saturated = float(raw.saturated.float().mean())
    if saturated >= 5e-5:
        text += f"; {saturated:.2%} of the raw is saturated: its light is estimated"
    return RenderedImage.of(
        image,
        text,
        png=lambda path: write_atomically(path, encoded(image, "PNG")),
        exr=lambda path: write_exr(path, linear_rgb(raw, hdr.radiance)),
    )


class OneRawPage(Tab):
    """The tab, see `Tab`; `simulator` reduces noise, and estimates the blur."""

    def __init__(self, address: Address, folder: Path, simulator: CameraSimulator) -> None:
        super().__init__(address, folder)
        self._simulator = simulator
        self._f_numbers: tuple[float, ...] = ()
        self._begun, self._doing = 0.0, ""  # what is under way, if anything is
        self._results: dict[str, RenderedImage] = {}
        self._saves: dict[str, ui.button] = {}
        with ui.element("div").classes("columns"):
            with ui.element("div").classes("column looked-at"):
                self._stage = Stage(self, "the raw", ("raw", "result"))
                self._raw_text = ui.label().classes("note")
                with ui.element("div").classes("bar"):
                    self._spinner = ui.spinner(size="sm")
                    self._status = ui.label().props("role=status")
            with ui.element("div").classes("column controls"):
                heading("Shallow depth of field", 2)
                self._slider = labelled_slider("Wider aperture", 1, 1, self._marked)
                with ui.element("div").classes("bar"):
                    self._open = ui.button("Open the aperture", icon="camera", on_click=self._opens)
                    self._saves["dng"] = self.save_button("dng", self._save)
                ui.label(
                    "Wider than the lens of the raw. Blurred areas are assumed to be background; a "
                    "raw that is sharp throughout stays as it is. A depth map does more: ae-env "
                    "refocus --depth."
                ).classes("note")
                heading("HDR", 2)
                with ui.element("div").classes("bar"):
                    fuse = partial(self._render, "fusing", fused)
                    self._fuse = ui.button("Fuse a bracket", icon="hdr_on", on_click=fuse)
                    for ending in ("png", "exr"):
                        self._saves[ending] = self.save_button(ending, self._save)
                ui.label(
                    "A bracket is simulated from the raw with its noise reduced, and fused: PNG. "
                    "The EXR holds the light, 1 at the raw's white."
                ).classes("note")
        self._clock = ui.timer(1.0, self._tick, active=False)
        self._update()

    def _marked(self, place: float) -> str:
        return f"f/{self._f_numbers[int(place)]:g}" if place < len(self._f_numbers) else ""

    def _update(self) -> None:
        """Enables what can be done now."""
        busy = bool(self._doing)
        ready = self.viewed is not None and self.viewed.photograph is not None and not busy
        self._open.set_enabled(ready and bool(self._f_numbers))
        self._slider.set_enabled(ready and bool(self._f_numbers))
        self._fuse.set_enabled(ready)
        for ending, button in self._saves.items():
            button.set_enabled(ending in self._results and not busy)
        self._spinner.visible = self._clock.active = busy

    def take_scene(self, viewed: ViewedScene) -> None:
        """Takes another scene; `show_raw` shows it."""
        self.viewed, self._results = viewed, {}
        self._f_numbers = () if viewed.photograph is None else wider_f_numbers(viewed.photograph)
        self._slider.props(f"max={max(len(self._f_numbers) - 1, 1)}")
        self._slider.value = max(len(self._f_numbers) - 1, 0)  # the widest
        self._stage.clear()
        self._raw_text.text = ""
        if not self._doing:
            open_already = "" if self._f_numbers else "The aperture of this raw is open already."
            self._status.text = _NO_RAW if viewed.photograph is None else open_already
        self._update()

    async def show_raw(self) -> None:
        """Shows the raw of the scene, once: a large one takes seconds."""
        viewed = self.viewed
        if viewed is None or viewed.photograph is None or self._raw_text.text:
            return
        self._raw_text.text = "left of the divider: the raw ..."
        image = await self.work(recorded, viewed.photograph)
        if image is not None:
            self._stage.show(image.jpeg, image.aspect)
            self._raw_text.text = f"left of the divider: the raw, {image.text}"

    # -- events -----------------------------------------------------------------------------------

    async def _opens(self) -> None:
        await self._render("opening the aperture", opened, self._f_numbers[int(self._slider.value)])

    async def _render(
        self, doing: str, function: Callable[..., RenderedImage], *options: Any
    ) -> None:
        """Shows the result of `function` for the raw; it may take minutes, and the page lives."""
        viewed = self.viewed
        if viewed is None or viewed.photograph is None or self._doing:
            return
        raw, self._begun = viewed.photograph, perf_counter()
        self._doing = f"{doing}, {4e-6 * raw.data[0].numel():.1f} megapixels"
        self._tick()
        self._update()
        status = ""
        try:
            image = await _in_background(function, raw, *options, self._simulator)
            if viewed is self.viewed:
                self._results |= dict.fromkeys(image.files, image)
                self._stage.compare(image.jpeg)
                status = f"right: {image.text}, in {perf_counter() - self._begun:.0f} s"
        except (ValueError, OSError, RuntimeError, MemoryError) as error:
            status = f"{doing} failed: {' '.join(str(error).split())}"
            complain(status)
        finally:
            self._doing, self._status.text = "", status
            self._update()

    def _tick(self) -> None:
        self._status.text = f"{self._doing} ... {perf_counter() - self._begun:.0f} s"

    async def _save(self, ending: str) -> None:
        if self.viewed is not None and ending in self._results:
            result = "opened" if ending == "dng" else "hdr"
            name = f"{Path(self.viewed.scene.scene_id).stem}-{result}.{ending}"
            await self.download(self._saves[ending], name, self._results[ending].files[ending])


async def _in_background(function: Callable[..., RenderedImage], *arguments: Any) -> RenderedImage:
    """The result of `function`, in a thread that the end of the program does not wait for."""
    result: Future[RenderedImage] = Future()
    result.set_running_or_notify_cancel()  # from now on it cannot be cancelled

    def work() -> None:
        try:
            result.set_result(function(*arguments))
        except Exception as error:  # raised where it is awaited
            result.set_exception(error)

    threading.Thread(target=work, daemon=True).start()
    return await asyncio.wrap_future(result)
