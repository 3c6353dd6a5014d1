"""The page: the bar with the scene's name, the scene picker, files in and out, and its tabs."""

from __future__ import annotations

import asyncio
import shutil
import tempfile
import uuid
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any
from weakref import WeakMethod

from fastapi import Response
from nicegui import app, run, ui

from agents.viewer.episode_page import EpisodePage
from agents.viewer.exposure_page import ExposurePage
from agents.viewer.one_raw_page import OneRawPage
from agents.viewer.tab import complain, loading, new_file
from agents.viewer.viewed_scene import Library, ViewedScene
from simulator import CameraSimulator
from simulator.camera_simulator import Depth

#: Largest file that is taken [byte].
LARGEST_UPLOAD = 300_000_000
#: Pictures that wait to be fetched, at most.
_WAITING = 256
_TABS = ("Exposure", "Episode", "Refocus, HDR")
#: The looks of all pages.
STYLE = Path(__file__).with_name("page.css")


class PictureStore:
    """Pictures under addresses of their own, the latest `_WAITING` of them."""

    def __init__(self) -> None:
        self._kept: dict[str, bytes] = {}
        app.get("/frame/{key}")(self.fetch)

    def address(self, jpeg: bytes) -> str:
        """Address that `jpeg` can be fetched from."""
        key = uuid.uuid4().hex
        self._kept[key] = jpeg
        if len(self._kept) > _WAITING:
            del self._kept[next(iter(self._kept))]  # the oldest
        return f"/frame/{key}"

    def fetch(self, key: str) -> Response:
        """The answer to a browser that asks for a picture."""
        if key not in self._kept:
            return Response(status_code=404)
        headers = {"Cache-Control": "no-store"}
        return Response(self._kept[key], media_type="image/jpeg", headers=headers)


@dataclass
class Options:
    """The options of `ae-env view`, which all tabs of the browser share.

    `thumbnails` are JPEGs of scenes that were asked for; `folder` has one for each tab's files.
    """

    library: Library
    simulator: CameraSimulator
    depth: Depth
    tolerance: float
    scorer: str
    thumbnails: dict[str, bytes] = field(default_factory=dict)
    folder: tempfile.TemporaryDirectory[str] = field(
        default_factory=lambda: tempfile.TemporaryDirectory(prefix="ae-env-view-")
    )
    pictures: PictureStore = field(default_factory=PictureStore)

    def viewed(self, library: Library, name: str) -> ViewedScene:
        """The scene called `name`, to be shown."""
        how = {"depth": self.depth, "tolerance": self.tolerance, "scorer": self.scorer}
        return ViewedScene(library.open(name), self.simulator, **how)  # type: ignore[arg-type]


def _weakly(method: Callable[..., Any]) -> Callable[..., Any]:
    """`method`, whose object may go: FastAPI's caches hold the handlers of uploads for ever."""
    known = WeakMethod(method)

    async def call(event: Any) -> None:
        found = known()
        if found is not None:
            await found(event)

    return call


async def show_page(options: Options) -> None:
    """Puts the page together, for one tab of the browser, and opens the first scene."""
    ui.add_css(STYLE.read_text())
    client = ui.context.client
    await client.connected()
    if not client.is_deleted:  # a page that nobody looks at costs nothing
        await Page(options).open(options.library.first)


class Page:
    """One tab of the browser."""

    def __init__(self, options: Options) -> None:
        self._options = options
        # Uploads belong to their tab of the browser.
        self._library = Library(options.library.readers)
        self._folder = folder = Path(tempfile.mkdtemp(dir=options.folder.name))
        ui.context.client.on_delete(lambda: shutil.rmtree(folder, ignore_errors=True))
        with ui.element("header").classes("bar"):
            self._title = ui.label("ae-env view").classes("title")
            with ui.dialog() as self._picker, ui.card().classes("w-full"):
                ui.label("Scenes").classes("title")
                self._thumbs = ui.element("div").classes("thumbs w-full")
            self._listed: set[str] = set()
            ui.button("Scenes", icon="photo_library", on_click=self._open_picker).props("dense")
            most = f"a raw may have {LARGEST_UPLOAD // 10**6} MB at most"
            upload = ui.upload(
                auto_upload=True,
                max_file_size=LARGEST_UPLOAD,
                on_upload=_weakly(self._take_upload),
                on_rejected=lambda: ui.notify(most, type="negative"),
            ).classes("hidden")
            pick = partial(upload.run_method, "pickFiles")
            self._open = ui.button("Open raw", icon="upload", on_click=pick).props("dense")
            self._save = ui.button("DNG", icon="download", on_click=self._download).props("dense")
        with ui.tabs().props("dense align=left") as tabs:
            for name in _TABS:
                ui.tab(name)
        self._panels = ui.tab_panels(tabs, value=_TABS[0], animated=False, on_change=self._show_raw)
        shared = options.pictures.address, folder
        with self._panels.classes("w-full bg-transparent"):
            with ui.tab_panel(_TABS[0]).classes("p-0"):
                self._exposure = ExposurePage(*shared)
            with ui.tab_panel(_TABS[1]).classes("p-0"):
                self._episode = EpisodePage(*shared)
            with ui.tab_panel(_TABS[2]).classes("p-0"):
                self._one_raw = OneRawPage(*shared, options.simulator)

    async def _open_picker(self) -> None:
        self._picker.open()
        with self._thumbs:
            for name in self._library.readers:
                if name in self._listed:
                    continue
                self._listed.add(name)
                button = ui.element("button").classes("thumb")
                with button:
                    image = ui.element("img").props('alt=""')
                    ui.label(name)
                button.on("click", lambda name=name: self._pick(name))
                asyncio.get_running_loop().create_task(self._fill(image, name))

    async def _fill(self, image: ui.element, name: str) -> None:
        """Puts the thumbnail of the scene called `name` into `image`."""
        shared = name in self._options.library.readers
        known = self._options.thumbnails if shared else {}
        jpeg, viewed = known.get(name), self._options.viewed
        if jpeg is None:
            with suppress(ValueError, OSError):  # such a file says so when it is opened
                jpeg = await run.io_bound(lambda: viewed(self._library, name).thumbnail())
        if jpeg is not None:  # else the program ends
            known[name] = jpeg
            self._exposure.show(image, jpeg)

    async def _pick(self, name: str) -> None:
        self._picker.close()
        await self.open(name)

    async def open(self, name: str) -> None:
        """Shows the scene called `name` on all tabs."""
        title, self._title.text = self._title.text, f"{name} ..."
        before = self._exposure.view.settings
        try:
            viewed = await run.io_bound(self._options.viewed, self._library, name)
        except (ValueError, OSError) as error:
            self._title.text = title
            complain(error)
            return
        if viewed is None:  # the program ends
            return
        self._episode.show_scene(viewed)
        self._one_raw.take_scene(viewed)
        await self._exposure.show_scene(viewed, before)
        if viewed is self._exposure.viewed:  # no other was opened meanwhile
            self._title.text = name
        await self._show_raw()

    async def _show_raw(self) -> None:
        if self._panels.value == _TABS[2]:
            await self._one_raw.show_raw()

    async def _take_upload(self, event: Any) -> None:
        event.sender.reset()
        name = Path(event.file.name).name
        own = None
        with loading(self._open):
            path = new_file(self._folder, name)
            try:
                await event.file.save(path)
                own = await run.io_bound(self._library.add, path, name)
            finally:
                if own is None:
                    shutil.rmtree(path.parent, ignore_errors=True)
        if own is not None:
            await self.open(own)

    async def _download(self) -> None:
        viewed, view = self._exposure.viewed, self._exposure.view
        if viewed is not None:
            name = f"{Path(viewed.scene.scene_id).stem}-simulated.dng"
            write = partial(viewed.write_dng, view=view)
            await self._exposure.download(self._save, name, write)
