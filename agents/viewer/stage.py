"""A picture on the page, and another one over it on the right of a divider."""

from __future__ import annotations

from collections.abc import Callable

from nicegui import ui

_DIVIDE = (
    "(e) => e.target.closest('.columns').querySelector('.stage')"
    ".style.setProperty('--cut', e.target.value + '%')"
)


class Stage:
    """Put together where it is made, within an element of class ``columns``.

    Args:
        address: Gives a picture an address that the browser can fetch it from.
        alt: What the picture is.
        divider: What the divider divides.
    """

    def __init__(self, address: Callable[[bytes], str], alt: str, divider: str) -> None:
        self._address = address
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
        self._image.props["src"] = self._address(jpeg)
        self._image.update()
        self._holder.classes(replace=f"stage {kind}")
        self._holder.style(f"--aspect: {aspect:.4f}")

    def compare(self, jpeg: bytes | None) -> None:
        """Shows a picture right of the divider, or none."""
        for element in (self._over, self._edge, self._divider):
            element.set_visibility(jpeg is not None)
        if jpeg is not None:
            self._over.props["src"] = self._address(jpeg)
            self._over.update()

    def clear(self) -> None:
        """Shows no picture."""
        self.compare(None)
        self._image.props.pop("src", None)
        self._image.update()
