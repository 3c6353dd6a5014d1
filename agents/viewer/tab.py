"""What the tabs of the page share: the scene, work in the background, pictures and charts."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import run, ui

from agents.viewer.viewed_scene import ViewedScene

_CHART_WIDTH = 640
_DIVIDE = (
    "(e) => e.target.closest('.columns').querySelector('.stage')"
    ".style.setProperty('--cut', e.target.value + '%')"
)


def new_file(folder: Path, name: str) -> Path:
    """Where the file called `name` may be written, in a folder of its own below `folder`."""
    if name in ("", "..") or "\0" in name or len(name.encode(errors="replace")) > 255:
        raise ValueError(f"A file cannot be called {name[:40]!r}.")
    return Path(tempfile.mkdtemp(dir=folder), name)


class Tab:
    """One tab of the page, put together where it is made.

    `address` gives a picture an address for the browser; files to download lie in `folder`.
    """

    def __init__(self, address: Callable[[bytes], str], folder: Path) -> None:
        self.address, self.folder = address, folder
        self.viewed: ViewedScene | None = None

    def show(self, image: ui.element, jpeg: bytes | None) -> None:
        """Shows a picture in an ``img``, or none."""
        image.props.pop("src", None)
        if jpeg is not None:
            image.props["src"] = self.address(jpeg)
        image.update()

    async def work(self, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """What `function` returns in another thread; None if another scene was opened meanwhile."""
        viewed = self.viewed
        found = await run.io_bound(function, *arguments, **options)
        return found if viewed is self.viewed else None

    async def download(self, button: ui.button, name: str, write: Callable[[Path], object]) -> None:
        """Sends the browser the file called `name` that `write` writes to a path."""
        with loading(button):
            path = new_file(self.folder, name)
            await run.io_bound(write, path)
            ui.download.file(path)


@contextmanager
def loading(
    element: ui.button | ui.spinner, errors: Any = (ValueError, OSError, ImportError, RuntimeError)
) -> Iterator[None]:
    """Shows by a button or spinner that work is under way; `errors` become notices."""

    def show(busy: bool) -> None:
        if isinstance(element, ui.spinner):
            element.visible = busy
        else:
            element.props["loading"] = busy

    show(True)
    try:
        yield
    except errors as error:
        complain(error)
    finally:
        show(False)


def complain(error: Exception | str) -> None:
    """Shows an error as a notice."""
    text = " ".join(str(error).split()).encode(errors="replace").decode()  # names of files, too
    ui.notify(text, type="negative", multi_line=True, timeout=10_000)


class Stage:
    """A picture, and another one over it on the right of a divider.

    It is put together where it is made, within an element of class ``columns``; `alt` and `divider`
    say what the picture is, and what is divided.
    """

    def __init__(self, tab: Tab, alt: str, divider: str) -> None:
        self._tab = tab
        with ui.element("div").classes("stage whole") as self._holder:
            self._image = ui.element("img").props(f'alt="{alt}" draggable=false')
            self._over = ui.element("img").classes("over").props('alt="" draggable=false')
            self._edge = ui.element("div").classes("edge")
        self._divider = ui.element("input").classes("divider")
        self._divider.props(f'type=range min=0 max=100 value=50 step=1 aria-label="{divider}"')
        self._divider.on("input", js_handler=_DIVIDE)
        self.compare(None)

    @property
    def images(self) -> tuple[ui.element, ui.element]:
        """The picture, and the one over it."""
        return self._image, self._over

    def show(self, jpeg: bytes, aspect: float, kind: str = "whole") -> None:
        """Shows a picture: ``"whole"``, or its ``"pixels"``."""
        self._tab.show(self._image, jpeg)
        self._holder.classes(replace=f"stage {kind}")
        self._holder.style(f"--aspect: {aspect:.4f}")

    def compare(self, jpeg: bytes | None) -> None:
        """Shows a picture right of the divider, or none."""
        for element in (self._over, self._edge, self._divider):
            element.set_visibility(jpeg is not None)
        if jpeg is not None:
            self._tab.show(self._over, jpeg)

    def clear(self) -> None:
        """Shows no picture."""
        self.compare(None)
        self._tab.show(self._image, None)


def curves(lines: Iterable[tuple[str, Any]], low: float, high: float, height: int) -> str:
    """An SVG of lines, pairs of a colour and values from `low` to `high`: numbers alone."""
    scale, drawn = (height - 4) / max(high - low, 1e-9), []
    for colour, values in lines:
        step = _CHART_WIDTH / max(len(values) - 1, 1)
        heights = height - 2 - (np.asarray(values, float) - low) * scale
        points = " ".join(f"{i * step:.1f},{y:.1f}" for i, y in enumerate(heights))
        drawn.append(
            f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2" '
            'vector-effect="non-scaling-stroke"/>'
        )
    return (
        f'<svg viewBox="0 0 {_CHART_WIDTH} {height}" preserveAspectRatio="none" '
        f'style="width:100%;height:{height}px;display:block">{"".join(drawn)}</svg>'
    )
