"""The page of ``ae-env judge``: two frames of a scene, nothing about them, and one choice."""

import asyncio
from collections.abc import Mapping
from time import perf_counter
from typing import Any

from nicegui import run, ui

from ae_env.scenes import Scene
from agents.report.judging import GRID, Judging
from agents.viewer.page import PictureStore, style_page
from agents.viewer.tab import complain, heading
from agents.viewer.viewed_scene import OpenedScene, View, ViewedScene
from simulator import CameraSimulator

#: Choices by the code of their key; the last key takes one back.
_KEYS = {"ArrowLeft": "left", "ArrowRight": "right", "ArrowDown": "equal", "Space": "equal"}
_UNDO = "Backspace"


async def show_pairs(judging: Judging, scenes: Mapping[str, Scene], store: PictureStore) -> None:
    """Puts the page together, for one tab of the browser: each shows the pair that is next."""
    style_page()
    busy, shown, begun = asyncio.Lock(), -1, 0.0
    with ui.element("header").classes("bar"):
        heading("Which picture is better?", 1)
        progress = ui.label()
    with ui.element("div").classes("players judged"):
        images = [ui.element("img").props(f"alt={side}") for side in ("left", "right")]
    ui.label("← left, → right, ↓ or space: equal, backspace: undo the last").classes("note")

    def developed(number: int) -> list[str]:
        pair: Any = judging.pairs.loc[number]
        viewed = ViewedScene(OpenedScene(scenes[pair.scene_id]), CameraSimulator(device="cpu"))
        views = [View(GRID[int(pair[side])]) for side in ("left", "right")]
        return [store.address(viewed.picture(view).jpeg) for view in views]

    async def show() -> None:
        nonlocal shown, begun
        number, count = judging.done, len(judging.pairs)
        frames = await run.io_bound(developed, number) if number < count else None
        for image, source in zip(images, frames or ("", ""), strict=True):
            image.props["src"] = source
            image.set_visibility(bool(source))
        shown, begun = number, perf_counter()
        progress.text = f"{number} of {count}{': that was the last pair' * (number == count)}"

    async def on_key(event: Any) -> None:
        code = event.key.code
        if not event.action.keydown or code not in (*_KEYS, _UNDO) or busy.locked():
            return
        async with busy:  # a key that comes before its pair is no choice
            try:
                if code == _UNDO:
                    judging.undo()
                else:
                    judging.choose(shown, _KEYS[code], perf_counter() - begun)
            except OSError as error:
                complain(error)
            await show()

    ui.keyboard(on_key, repeating=False, ignore=[])
    await show()
