"""The page: the bar with the scene's name, the scene picker, files in and out, and its tabs."""

import json
import shutil
import tempfile
import threading
import uuid
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode
from weakref import WeakMethod

from fastapi import Request, Response
from nicegui import app, run, ui
from nicegui.elements.upload_files import create_file_upload

from agents.viewer.episode_page import EpisodePage
from agents.viewer.exposure_page import ExposurePage, asked_settings
from agents.viewer.one_raw_page import OneRawPage
from agents.viewer.tab import complain, heading, loading, new_file
from agents.viewer.viewed_scene import Library, ViewedScene
from simulator import CameraSettings, CameraSimulator
from simulator.utils.checks import did_you_mean

#: Largest file that is taken [byte].
LARGEST_UPLOAD = 300_000_000
_TOO_LARGE = "A raw may have 300 MB at most."
_NO_FILE = "No file arrived. Choose a DNG, CR2, NEF or another raw."
#: Pictures that wait to be fetched, at most.
_WAITING = 256
#: Tabs by their names in the page's address.
_TABS = {"exposure": "Exposure", "episode": "Episode", "raw": "Refocus, HDR"}
_RAW = _TABS["raw"]


class PictureStore:
    """Pictures under addresses of their own: the latest `_WAITING`, and thumbnails, made later."""

    def __init__(self) -> None:
        self._kept: dict[str, bytes] = {}
        self._thumbnails: dict[str, Callable[[], bytes]] = {}
        self._one = threading.Lock()  # more would keep several raws in memory
        app.get("/frame/{key:path}")(self.fetch)

    def address(self, jpeg: bytes) -> str:
        """Address that `jpeg` can be fetched from."""
        key = uuid.uuid4().hex
        self._kept[key] = jpeg
        if len(self._kept) > _WAITING:
            del self._kept[next(iter(self._kept))]  # the oldest
        return f"/frame/{key}"

    def thumbnail_address(self, key: str, make: Callable[[], bytes]) -> str:
        """Lasting address of the thumbnail that `make` returns, once a browser asks for it."""
        self._thumbnails.setdefault(key, cache(make))
        return f"/frame/{quote(key)}"

    def fetch(self, key: str) -> Response:
        """The answer to a browser that asks for a picture."""
        found, status = self._kept.get(key), 404
        if key in self._thumbnails:
            status = 204  # a file that cannot be read says so when it is opened
            with suppress(ValueError, OSError), self._one:
                found = self._thumbnails[key]()
        headers = {"Cache-Control": "no-store"}
        return Response(found, 200 if found else status, headers, media_type="image/jpeg")


@dataclass
class Options:
    """The options of `ae-env view`, which all tabs of the browser share.

    `folder` has one for each tab's files.
    """

    library: Library
    simulator: CameraSimulator
    how: Mapping[str, Any]  # other options of `ViewedScene`
    folder: tempfile.TemporaryDirectory[str] = field(
        default_factory=lambda: tempfile.TemporaryDirectory(prefix="ae-env-view-")
    )
    pictures: PictureStore = field(default_factory=PictureStore)

    def viewed(self, library: Library, name: str) -> ViewedScene:
        """The scene called `name`, to be shown."""
        return ViewedScene(library.open(name), self.simulator, **self.how)


def _weakly(method: Callable[..., Any]) -> Callable[..., Any]:
    """`method`, whose object may go: FastAPI's caches hold the handlers of uploads for ever."""
    known = WeakMethod(method)

    async def call(event: Any) -> None:
        if (found := known()) is not None:
            await found(event)

    return call


def _refuse_empty_forms(upload: ui.upload) -> None:
    """Answers a form without a file with 400 and a sentence: NiceGUI's own route fails at it."""
    url = upload.props["url"]
    app.remove_route(url)

    @app.post(url)
    async def take(request: Request) -> Response:
        async with request.form() as form:
            files: list[Any] = [f for f in form.values() if getattr(f, "filename", "")]
            await upload.handle_uploads([await create_file_upload(file) for file in files])
        return Response("" if files else _NO_FILE, 200 if files else 400, media_type="text/plain")


def style_page() -> None:
    """Gives a page its looks, and what its pictures and its map do in the browser itself."""
    ui.add_css(Path(__file__).with_name("page.css").read_text())
    ui.add_head_html(f"<script>{Path(__file__).with_name('page.js').read_text()}</script>")


async def show_page(options: Options) -> None:
    """Puts the page together, for one tab of the browser, and opens the first scene."""
    style_page()
    client = ui.context.client
    asked = dict(client.request.query_params)
    await client.connected()
    if not client.is_deleted:  # a page that nobody looks at costs nothing
        await Page(options).follow(asked)


class Page:
    """One tab of the browser."""

    def __init__(self, options: Options) -> None:
        self._options = options
        # Uploads belong to their tab of the browser.
        self._library = Library(options.library.readers)
        self._folder = folder = Path(tempfile.mkdtemp(dir=options.folder.name))
        ui.context.client.on_delete(lambda: shutil.rmtree(folder, ignore_errors=True))
        with ui.element("header").classes("bar"):
            self._title = heading("ae-env view", 1)
            with ui.dialog() as self._picker, ui.card().classes("w-full"):
                self._picker.props("aria-label=Scenes")
                heading("Scenes", 2)
                self._thumbs = ui.element("div").classes("thumbs w-full")
            self._listed: set[str] = set()
            ui.button("Scenes", icon="photo_library", on_click=self._open_picker).props("dense")
            upload = ui.upload(
                auto_upload=True,
                max_file_size=LARGEST_UPLOAD,
                on_upload=_weakly(self._take_upload),
                on_rejected=lambda: complain(_TOO_LARGE),
            ).classes("hidden")
            _refuse_empty_forms(upload)
            pick = partial(upload.run_method, "pickFiles")
            self._open = ui.button("Open raw", icon="upload", on_click=pick).props("dense")
            self._save = ui.button("DNG", icon="download", on_click=self._download).props("dense")
        with ui.tabs().props("dense align=left") as tabs:
            for name in _TABS.values():
                ui.tab(name)
        first, *_ = _TABS.values()
        self._panels = ui.tab_panels(tabs, value=first, animated=False, on_change=self._show_tab)
        shared = options.pictures.address, folder
        with self._panels.classes("w-full bg-transparent"):
            with ui.tab_panel(first).classes("p-0"):
                self._exposure = ExposurePage(*shared, self._show_address)
            with ui.tab_panel(_TABS["episode"]).classes("p-0"):
                self._episode = EpisodePage(*shared, self._show_address)
            with ui.tab_panel(_RAW).classes("p-0"):
                self._one_raw = OneRawPage(*shared, options.simulator)
        self._scene, self._address, self._following = "", "", False
        ui.on("went_back", lambda event: self.follow(dict(parse_qsl(event.args))))
        ui.run_javascript(
            "addEventListener('popstate', () => emitEvent('went_back', location.search.slice(1)))"
        )

    # -- the page's address -----------------------------------------------------------------------

    async def follow(self, asked: Mapping[str, str]) -> None:
        """Shows what the entries of an address ask for: ``scene``, ``iso``, ``t``, ``n``, ``tab``.

        What they leave out stays, or is the first scene at its best state.
        """
        readers, name = self._library.readers, asked.get("scene", self._library.first)
        if name not in readers:
            complain(f"There is no scene {name!r} here{did_you_mean(name, readers)}")
            name = self._library.first
        settings, self._following = asked_settings(asked), True
        self._episode.fill(asked)
        self._address = urlencode(asked, safe="/:")
        self._panels.value = _TABS.get(asked.get("tab", ""), self._panels.value)
        if name != self._scene:
            await self.open(name, settings)
        elif settings is not None:
            await self._exposure.set(settings)
        self._following = False
        self._show_address("replaceState")

    def _show_address(self, how: str = "") -> None:
        """Puts what is shown into the address: another scene or tab is a place to go back to."""
        tab = next(key for key, title in _TABS.items() if title == self._panels.value)
        place, settings = {"scene": self._scene, "tab": tab}, self._exposure.asked
        if tab == "episode":
            settings |= self._episode.asked
        address, before = urlencode(place | settings, safe="/:"), self._address
        if self._following or address == before:
            return
        stays = before.startswith(urlencode(place, safe="/:"))
        how, self._address = how or ("replaceState" if stays else "pushState"), address
        ui.run_javascript(f"history.{how}(null, '', {json.dumps('?' + address)})")

    async def _show_tab(self) -> None:
        self._show_address()
        await self._show_raw()

    # -- scenes and files -------------------------------------------------------------------------

    async def _open_picker(self) -> None:
        self._picker.open()
        with self._thumbs:
            for name in self._library.readers:
                if name in self._listed:
                    continue
                self._listed.add(name)
                button = ui.element("button").classes("thumb")
                with button:
                    ui.element("img").props(f'alt="" loading=lazy src={self._thumbnail(name)}')
                    ui.label(name)
                button.on("click", partial(self.open, name))

    def _thumbnail(self, name: str) -> str:
        """Address of the thumbnail of the scene called `name`."""
        options, library = self._options, self._options.library
        key = f"all/{name}"
        if name not in library.readers:  # an upload
            library, key = self._library, f"{self._folder.name}/{name}"
        return options.pictures.thumbnail_address(
            key, lambda: options.viewed(library, name).thumbnail()
        )

    async def open(self, name: str, settings: CameraSettings | None = None) -> None:
        """Shows the scene called `name` on all tabs, at `settings` or at its best state."""
        self._picker.close()
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
        self._scene = name
        self._episode.show_scene(viewed)
        self._one_raw.take_scene(viewed)
        await self._exposure.show_scene(viewed, before, settings)
        if viewed is self._exposure.viewed:  # no other was opened meanwhile
            self._title.text = name
        await self._show_raw()

    async def _show_raw(self) -> None:
        if self._panels.value == _RAW:
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
            await self._exposure.download(self._save, name, partial(viewed.write_dng, view=view))
