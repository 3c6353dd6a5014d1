"""What the tabs of the page share: the scene, work in the background, pictures and charts."""

import asyncio
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nicegui import ElementFilter, run, ui
from nicegui.elements.mixins.text_element import TextElement

from agents.viewer.viewed_scene import ViewedScene
from simulator.raw.read import RawFileError

#: Gives a picture an address for the browser.
Address = Callable[[bytes], str]
#: Time after which a spinner shows that work is under way [s].
_SPINNER_AFTER = 0.3
#: What to do where a raw cannot be opened.
_CHOOSE = ". Choose a DNG, CR2, NEF or another raw of a camera with a Bayer sensor."
_SAY = ". Run ae-env view FILE with --source-iso, --source-shutter and --source-aperture."


def new_file(folder: Path, name: str) -> Path:
    """Where the file called `name` may be written, in a folder of its own below `folder`."""
    if name in ("", "..") or "\0" in name or len(name.encode(errors="replace")) > 255:
        raise ValueError(f"A file cannot be called {name[:40]!r}.")
    return Path(tempfile.mkdtemp(dir=folder), name)


class Tab:
    """One tab of the page, put together where it is made; files to download lie in `folder`."""

    def __init__(self, address: Address, folder: Path) -> None:
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

    def save_button(self, ending: str, save: Callable[[str], Any]) -> ui.button:
        """A button that calls `save` with the ending of a file."""
        button = ui.button(ending.upper(), icon="download", on_click=lambda: save(ending))
        return button.props(f'dense aria-label="save {ending.upper()}"')

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
    """Shows by a button, or a spinner soon, that work is under way; `errors` become notices."""

    def show(busy: bool) -> None:
        if isinstance(element, ui.spinner):
            element.visible = busy
        else:
            element.props["loading"] = busy

    if isinstance(element, ui.button):  # a new action: an error of the last one is past
        _dismiss_notices()
    # What is over at once shows no spinner: the page would be drawn for it twice more.
    wait = _SPINNER_AFTER if isinstance(element, ui.spinner) else 0.0
    shown = asyncio.get_running_loop().call_later(wait, show, True)
    try:
        yield
    except errors as error:
        complain(error)
    finally:
        shown.cancel()
        show(False)


def complain(error: Exception | str) -> None:
    """Shows an error, without names of arguments, as the page's only notice."""
    text = " ".join(str(error).split()).encode(errors="replace").decode()  # names of files, too
    text = re.sub(r"`\w+` (?:\(='?(.*?)'?\)|must be given: '(.*?)')", r"\1\2", text).replace(
        "`", ""
    )
    if isinstance(error, RawFileError):
        text = text.partition(";")[0].replace("not a raw", "not a raw file") + _CHOOSE
    elif "; pass settings=" in text:
        text = text.partition(";")[0].replace("_", "-") + _SAY
    _dismiss_notices()
    ui.notification(text, type="negative", multi_line=True, timeout=None, close_button="Close")


def _dismiss_notices() -> None:
    for notice in list(ElementFilter(kind=ui.notification)):
        notice.dismiss()


def heading(text: str, level: int) -> TextElement:
    """A heading of the page: 1 for its title."""
    return TextElement(tag=f"h{level}", text=text).classes("title")


def labelled_slider(name: str, most: float, step: float, text: Callable[[Any], str]) -> ui.slider:
    """A slider from 0 to `most` after its name, before its value as `text`, which is read out."""
    with ui.element("div").classes("setting"):
        ui.label(name)
        slider = ui.slider(min=0, max=most, step=step, value=0)
        slider.props(f'aria-label="{name}" aria-valuetext="{text(0)}" dense')
        slider.on_value_change(lambda e: slider.props.update({"aria-valuetext": text(e.value)}))
        ui.label().classes("value").bind_text_from(slider, "value", text)
    return slider


class Stage:
    """A picture, and another one over it on the right of a divider; wheel and drags zoom and move.

    It is put together where it is made, within an element of class ``columns``; `alt` says what the
    picture is, `tags` what lies on either side of the divider.
    """

    def __init__(self, tab: Tab, alt: str, tags: tuple[str, str]) -> None:
        self._tab, self._kind = tab, ""
        with ui.element("div").classes("stage whole") as self._holder:
            keys = f"{alt}: plus and minus zoom, arrows move it"
            self._holder.props(f'tabindex=0 role=group aria-label="{keys}"')
            with ui.element("div").classes("zoomed"):
                self._image = ui.element("img").props(f'alt="{alt}" draggable=false')
                self._over = ui.element("img").classes("over").props('alt="" draggable=false')
                self._overlay = ui.element("img").classes("overlay").props('alt="" draggable=false')
            self._edge = ui.element("div").classes("edge")
            self.tags = [ui.label(t).classes(f"tag {x}") for x, t in zip("AB", tags, strict=True)]
            ui.label().classes("scale")
        self._divider = ui.element("input").classes("divider")
        about = f"divider of {tags[0]} and {tags[1]}"
        self._divider.props(f'type=range min=0 max=100 step=1 aria-label="{about}"')
        divide = "(e) => divide(e.target.parentElement.querySelector('.stage'), e.target.value)"
        self._divider.on("input", js_handler=divide)
        self.compare(None)
        self.draw_over(None)

    def on(self, event: str, handler: Callable[[Any], Any]) -> None:
        """Calls `handler` with the place of an event, down and right as shares of the picture."""
        place = "(e) => emit(e.offsetY / e.target.height, e.offsetX / e.target.width)"
        for image in (self._image, self._over):
            image.on(event, handler, js_handler=place, throttle=0.05)

    def show(self, jpeg: bytes, aspect: float, kind: str = "whole", photosites: int = 0) -> None:
        """Shows a picture: ``"whole"``, or its ``"pixels"``; so many photosites wide."""
        self._tab.show(self._image, jpeg)
        self._holder.classes(replace=f"stage {kind}")
        self._holder.style(f"--aspect: {aspect:.4f}; --photosites: {photosites}")
        if kind != self._kind:
            self._kind = kind
            ui.run_javascript(f"place(getHtmlElement({self._holder.id}), 0, 0, 1)")

    def compare(self, jpeg: bytes | None) -> None:
        """Shows a picture right of the divider, or none."""
        for element in (self._over, self._edge, self._divider, *self.tags):
            element.set_visibility(jpeg is not None)
        if jpeg is not None:
            self._tab.show(self._over, jpeg)

    def draw_over(self, png: bytes | None) -> None:
        """Draws a transparent picture over both, or none."""
        self._overlay.set_visibility(png is not None)
        self._tab.show(self._overlay, png)

    def clear(self) -> None:
        """Shows no picture."""
        self.compare(None)
        self._tab.show(self._image, None)
        self._kind = ""


def line_chart(x: str, y: str, height: int) -> ui.echart:
    """A chart of lines with named axes, still empty, see `draw_lines`."""
    axis = {"type": "value", "scale": True, "nameLocation": "middle", "splitNumber": 4}
    axis |= {"axisLabel": {"color": "#b4b4b4"}, "nameTextStyle": {"color": "#b4b4b4"}}
    axis |= {"splitLine": {"lineStyle": {"color": "#333"}}}
    options = {
        "animation": False,
        "grid": {"left": 52, "right": 14, "top": 18, "bottom": 40},
        "xAxis": axis | {"name": x, "nameGap": 24, "min": "dataMin", "max": "dataMax"},
        "yAxis": axis | {"name": y, "nameGap": 36},
        "tooltip": {"trigger": "axis", ":valueFormatter": "v => (+v).toPrecision(3)"},
    }
    chart = ui.echart(options).style(f"height:{height}px")
    return chart.props(f'role=img aria-label="{y} against {x}"')


def draw_lines(chart: ui.echart, lines: Iterable[Any], marks: Sequence[Any] = ()) -> None:
    """Draws lines, each a name, colour and points (x, y); `marks` as ECharts takes them."""
    looks: dict[str, Any] = {"type": "line", "step": "middle", "symbol": "none"}
    series = [looks | {"name": n, "color": c, "data": list(points)} for n, c, points in lines]
    label = {"color": "#ececec"}
    series[0]["markLine"] = {"symbol": "none", "silent": True, "label": label, "data": marks}
    chart.options["series"] = series
    chart.update()
