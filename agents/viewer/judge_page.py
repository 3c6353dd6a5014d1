"""The page of ``ae-env judge``: two frames of a scene, nothing about them, and one choice."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from time import perf_counter
from typing import Any

from nicegui import run, ui

from ae_env.scenes import Scene
from agents.report.judging import GRID, Judging, Row
from agents.viewer.page import STYLE, PictureStore
from agents.viewer.tab import complain
from agents.viewer.viewed_scene import OpenedScene, View, ViewedScene
from simulator import CameraSimulator

#: Choices by the code of their key; the last key takes one back.
_KEYS = {"ArrowLeft": "left", "ArrowRight": "right", "ArrowDown": "equal", "Space": "equal"}
_UNDO = "Backspace"


async def show_pairs(judging: Judging, scenes: Mapping[str, Scene], store: PictureStore) -> None:
    """Puts the page together, for one tab of the browser: each shows the pair that is next."""
    await JudgePage(judging, scenes, store).show()


class JudgePage:
    """One tab of the browser."""

    def __init__(self, judging: Judging, scenes: Mapping[str, Scene], store: PictureStore) -> None:
        ui.add_css(STYLE.read_text())
        self._judging, self._scenes, self._store = judging, scenes, store
        self._shown: Row | None = None
        self._begun, self._busy = 0.0, asyncio.Lock()
        with ui.element("header").classes("bar"):
            ui.label("Which picture is better?").classes("title")
            self._progress = ui.label()
        with ui.element("div").classes("players judged"):
            self._images = [ui.element("img").props(f"alt={side}") for side in ("left", "right")]
        ui.label("← left, → right, ↓ or space: equal, backspace: undo the last").classes("note")
        ui.keyboard(self._on_key, repeating=False, ignore=[])

    async def show(self) -> None:
        """Shows the next pair, or that there is none."""
        pair, done = self._judging.next_pair(), len(self._judging.choices)
        frames = None if pair is None else await run.io_bound(self._developed, pair)
        for image, source in zip(self._images, frames or ("", ""), strict=True):
            image.props["src"] = source
            image.set_visibility(bool(source))
        self._shown, self._begun = pair, perf_counter()
        ended = "" if pair is not None else ": that was the last pair"
        self._progress.text = f"{done} of {len(self._judging.pairs)}{ended}"

    def _developed(self, pair: Row) -> list[str]:
        """Addresses of the two frames."""
        opened, seed = OpenedScene(self._scenes[pair["scene_id"]]), pair["noise_seed"]
        viewed = ViewedScene(opened, CameraSimulator(device="cpu"))
        views = [View(GRID[pair[side]], noise_seed=seed) for side in ("left", "right")]
        return [self._store.address(viewed.picture(view).jpeg) for view in views]

    async def _on_key(self, event: Any) -> None:
        code = event.key.code
        if not event.action.keydown or code not in (*_KEYS, _UNDO) or self._busy.locked():
            return
        async with self._busy:  # a key that comes before its pair is no choice
            try:
                if code == _UNDO:
                    self._judging.undo()
                else:
                    self._judging.choose(self._shown, _KEYS[code], perf_counter() - self._begun)
            except OSError as error:
                complain(error)
            await self.show()
