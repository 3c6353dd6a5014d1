"""The tab of episodes: two policies in the same light, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from threading import Event
from time import perf_counter
from typing import Any

import gymnasium as gym
import numpy as np
from nicegui import ui

import ae_env  # noqa: F401  (registers the environments)
from ae_env.grid import ExposureGrid
from ae_env.lighting.moving import KIND_SETS, MOVES
from ae_env.scenes import Scene
from agents.evaluation.engine import fit_policies
from agents.policy import PolicyContext
from agents.policy_names import make_policy
from agents.report.film import FRAME_RATE, Recording, record
from agents.rollouts import WatchedEnvs
from agents.viewer.tab import Tab, curves, loading
from agents.viewer.viewed_scene import ViewedScene, encoded

#: Kinds of moving light, and light that stays.
STILL = "still"
LIGHTS = (STILL, *MOVES, *KIND_SETS)
#: Frames after which a policy has settled in still light.
SETTLED = 8
#: Policies that are offered, the first two by default, which learn nothing; others are typed.
NAMES = (
    *("average", "regression:video?foresight=learnt", "regression:video", "ppo:video", "rpi_agc"),
    *("average:tuned", "average:tuned?foresight=model", "matrix", "regression", "ppo"),
)
_FRAMES = 64
#: Colour of the best state, and of each policy.
_BEST, _POLICIES = "#a0a0a0", ("#D55E00", "#56B4E9")


class Stopped(BaseException):
    """The user wants no result; no `Exception`, which would be a policy's mistake."""


def play(
    names: Sequence[str],
    scene: Scene,
    *,
    light: str = STILL,
    frames: int = 64,
    seed: int = 0,
    watch: Callable[[str], None] = lambda _: None,
) -> list[Recording]:
    """One episode of each policy in `scene` (at most 64 pixels a side), all in the same light.

    `light` is one of `LIGHTS`: `AutoExposure-v0` where it stays, else `AutoExposureVideo-v0`.
    Before each step `watch` gets what it is for, and may raise `Stopped`.
    """
    fitted_on: dict[str, Any] = {"scenes": "bundled"}
    options: dict[str, Any] = {"scenes": [scene], "camera": scene.camera}
    options |= {"resolution": scene.light.shape[-1], "max_episode_steps": frames + 1}
    options |= {"render_mode": "rgb_array", "with_oracle": True, "with_subject": True}
    if light != STILL:
        options["lighting"] = {"kind": "moving", "kinds": light}
        fitted_on["grid"] = "video"
    task = f"ae_env/AutoExposure{'' if light == STILL else 'Video'}-v0"
    with closing(gym.make_vec(task, num_envs=1, **options)) as envs:
        context = PolicyContext.from_envs(envs)
        policies = {name: make_policy(name, context) for name in names}
        learns = "{} learns on the training scenes, once for this camera (about a minute)"
        fit_policies(policies, fitted_on, watch=lambda n: watch(learns.format(n)), keep=True)
        found = []
        for name, policy in policies.items():
            watched = WatchedEnvs(envs, partial(watch, f"episode of {name}"))
            found.append(record(name, policy, watched, frames, seed))
        return found


def settled(names: Sequence[str], scene: Scene) -> dict[str, int]:
    """State of the default grid that each policy holds after `SETTLED` frames of still light."""
    return {r.name: r.states[-1] for r in play(names, scene, frames=SETTLED)}


class EpisodePage(Tab):
    """The tab, see `Tab`."""

    def __init__(self, address: Callable[[bytes], str], folder: Path) -> None:
        super().__init__(address, folder)
        self._recordings: list[Recording] = []
        self._grid = ExposureGrid.video()
        self._stopped, self._doing, self._begun = Event(), "", 0.0
        ui.context.client.on_delete(self._stop)
        with ui.element("div").classes("column w-full"):
            with ui.element("div").classes("bar"):
                choices = "".join(f'<option value="{name}">' for name in NAMES)
                ui.html(choices, sanitize=False, tag="datalist").props("id=policies")
                self._policies = [ui.input("policy A", value=NAMES[0])]
                self._policies += [ui.input("policy B", value=NAMES[1])]
                for policy in self._policies:
                    policy.props("dense list=policies").classes("w-72")
                self._light = ui.select(list(LIGHTS), label="light", value="shadows").props("dense")
                self._frames = ui.number("frames", value=_FRAMES, min=2, max=512, precision=0)
                self._seed = ui.number("seed", value=0, min=0, max=2**31, precision=0)
                for number in (self._frames, self._seed):
                    number.props("dense").classes("w-20")
                self._run = ui.button("Run", icon="play_circle", on_click=self._record)
                self._cancel = ui.button("Cancel", icon="close", on_click=self._stop)
                self._status = ui.label().classes("note").props("role=status")
            self._clock = ui.timer(0.5, self._tick, active=False)
            for element in (self._cancel, self._status):
                element.bind_visibility_from(self._clock, "active")
            with ui.element("div").classes("column w-full") as self._shown:
                self._build_player()
        self._shown.set_visibility(False)

    def _build_player(self) -> None:
        with ui.element("div").classes("players"):
            self._images, self._facts = [], []
            for colour in _POLICIES:
                with ui.element("div").classes("column"):
                    self._images.append(ui.element("img").props('alt="frame"'))
                    self._facts.append(ui.label().classes("note").style(f"color:{colour}"))
        with ui.element("div").classes("bar"):
            self._timer = ui.timer(1.0 / FRAME_RATE, self._advance, active=False)
            play = ui.button(icon="play_arrow", on_click=self._toggle)
            play.props('dense aria-label="play or pause"')
            play.bind_icon_from(
                self._timer, "active", lambda plays: "pause" if plays else "play_arrow"
            )
            self._frame = ui.slider(min=0, max=1, step=1, value=0, on_change=self._show_frame)
            self._frame.props('aria-label="frame"').classes("flex-1")
            self._number = ui.label().classes("note")
        self._charts = {}
        for name in ("EV100: the best state's (grey) and the policies'", "Score", "Regret"):
            ui.label(name).classes("note")
            with ui.element("div").classes("chart") as holder:
                content = ui.html(sanitize=False)
                ui.element("div").classes("now")
            self._charts[name.partition(":")[0]] = (holder, content)

    def show_scene(self, viewed: ViewedScene) -> None:
        """Takes another scene for the next episode."""
        self._stop()
        self.viewed, self._recordings = viewed, []
        self._timer.active = False
        self._shown.set_visibility(False)

    async def _record(self) -> None:
        if self.viewed is None:
            return
        names = [str(field.value) for field in self._policies]
        names = list(dict.fromkeys(names))  # a policy beside itself is shown once
        light, frames = str(self._light.value), int(self._frames.value or _FRAMES)
        options = {"light": light, "frames": frames, "seed": int(self._seed.value or 0)}
        found: list[Recording] | None = None
        self._stopped, self._doing, self._begun = Event(), "starting", perf_counter()
        watch = partial(self._step, self._stopped)
        self._clock.active = True
        with suppress(Stopped), loading(self._run, Exception):  # of a policy of the user's
            found = await self.work(play, names, self.viewed.scored, watch=watch, **options)
        self._clock.active = False
        if found is not None:
            self._grid = ExposureGrid.default() if light == STILL else ExposureGrid.video()
            self._show_recordings(found)

    def _step(self, stopped: Event, doing: str) -> None:
        if stopped.is_set():
            raise Stopped
        self._doing = doing

    def _stop(self) -> None:
        self._stopped.set()
        self._doing = "stopping"

    def _tick(self) -> None:
        self._status.text = f"{self._doing} ... {perf_counter() - self._begun:.0f} s"

    def _show_recordings(self, recordings: list[Recording]) -> None:
        self._recordings = recordings
        lines = list(zip(_POLICIES, recordings, strict=False))
        ev100 = [(_BEST, recordings[0].best), *((c, r.ev100) for c, r in lines)]
        values = np.concatenate([np.asarray(v) for _, v in ev100])
        self._draw("EV100", ev100, float(values.min()) - 0.5, float(values.max()) + 0.5)
        self._draw("Score", [(c, r.scores) for c, r in lines], 0.0, 1.0)
        regrets = [(c, r.regrets) for c, r in lines]
        self._draw("Regret", regrets, 0.0, max(0.1, *(max(v) for _, v in regrets)))
        self._frame.props(f"max={self._last}")
        self._frame.value = 0
        self._show_frame()
        self._shown.set_visibility(True)
        self._timer.active = True

    def _draw(
        self, name: str, lines: Sequence[tuple[str, Sequence[float]]], low: float, high: float
    ) -> None:
        ends = f'<span class="high">{high:.3g}</span><span class="low">{low:.3g}</span>'
        self._charts[name][1].content = curves(lines, low, high, 110) + ends

    @property
    def _last(self) -> int:
        return len(self._recordings[0].states) - 1

    def _show_frame(self) -> None:
        if not self._recordings:
            return
        frame = int(self._frame.value)
        self._number.text = f"frame {frame} of {self._last}"
        for holder, _ in self._charts.values():
            holder.style(f"--now: {100.0 * frame / max(self._last, 1):.2f}%")
        for i, (image, facts) in enumerate(zip(self._images, self._facts, strict=True)):
            if i >= len(self._recordings):
                facts.text = ""
                image.set_visibility(False)
                continue
            one = self._recordings[i]
            image.set_visibility(True)
            self.show(image, encoded(one.pictures[frame]))
            facts.text = (
                f"{'AB'[i]} {one.name}: {self._grid[one.states[frame]]}, score "
                f"{one.scores[frame]:.3f}, regret {one.regrets[frame]:.3f}; mean score so far "
                f"{np.mean(one.scores[: frame + 1]):.3f}"
            )

    def _toggle(self) -> None:
        self._timer.active = not self._timer.active
        if self._timer.active and self._frame.value >= self._last:
            self._frame.value = 0

    def _advance(self) -> None:
        if self._recordings and self._frame.value < self._last:
            self._frame.value = int(self._frame.value) + 1
        else:
            self._timer.active = False
