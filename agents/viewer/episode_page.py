"""The tab of episodes: two policies in the same light, frame by frame."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from threading import Event
from time import perf_counter
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from nicegui import ui

from ae_env.grid import ExposureGrid
from ae_env.lighting.moving import KIND_SETS, MOVES
from ae_env.scenes import Scene
from agents.evaluation.engine import fit_policies
from agents.policy import PolicyContext
from agents.policy_names import make_policy
from agents.report.film import FRAME_RATE, Recording, record, write_film
from agents.rollouts import WatchedEnvs
from agents.viewer.tab import Address, Tab, draw_lines, labelled_slider, line_chart, loading
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
    """The tab, see `Tab`; `on_run` is called when it runs what `asked` tells."""

    def __init__(self, address: Address, folder: Path, on_run: Callable[[], None]) -> None:
        super().__init__(address, folder)
        self._on_run = on_run
        self._recordings: list[Recording] = []
        self._grid = ExposureGrid.video()
        self._stopped, self._doing, self._begun = Event(), "", 0.0
        ui.context.client.on_delete(self._stop)
        with ui.element("div").classes("column w-full"):
            with ui.element("div").classes("bar"):
                choices = "".join(f'<option value="{name}">' for name in NAMES)
                ui.html(choices, sanitize=False, tag="datalist").props("id=policies")
                #: What is asked for, by its name in an address.
                self._fields: dict[str, Any] = {}
                for x, name in zip("ab", NAMES, strict=False):
                    field = ui.input(f"policy {x.upper()}", value=name).props("list=policies")
                    self._fields[x] = field.classes("w-72")
                self._fields["light"] = ui.select(list(LIGHTS), label="light", value="shadows")
                for name, value, low, most in (("frames", _FRAMES, 2, 512), ("seed", 0, 0, 2**31)):
                    number = ui.number(name, value=value, min=low, max=most, precision=0)
                    self._fields[name] = number.classes("w-20")
                for field in self._fields.values():
                    field.props("dense")
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
            play.bind_icon_from(self._timer, "active", lambda on: "pause" if on else "play_arrow")
            self._frame = labelled_slider("Frame", 1, 1, "{:.0f}".format)
            self._frame.on_value_change(self._show_frame)
            next(self._frame.ancestors()).classes("flex-1")
            self._saves = {x: self.save_button(x, self._save) for x in ("csv", "gif")}
        self._charts = {}
        with ui.element("div").classes("charts") as self._holder:
            for kind, name in (("ev100", "EV100"), ("scores", "score"), ("regrets", "regret")):
                self._charts[kind] = line_chart("frame", name, 150)
            ui.element("div").classes("now")

    @property
    def asked(self) -> dict[str, str]:
        """Entries of an address that `fill` takes."""
        values = {name: field.value for name, field in self._fields.items()}
        return {n: v if isinstance(v, str) else f"{v or 0:.0f}" for n, v in values.items()}

    def fill(self, asked: Mapping[str, str]) -> None:
        """Takes what an address asks for; nothing runs, since a policy may be a file of code."""
        for name in self._fields.keys() & asked.keys():
            number, value = name in ("frames", "seed"), asked[name]
            if value.isdecimal() if number else name != "light" or value in LIGHTS:
                self._fields[name].value = int(value) if number else value

    async def _save(self, ending: str) -> None:
        film = partial(write_film, recordings=self._recordings)
        write: Any = film if ending == "gif" else self._write_csv
        await self.download(self._saves[ending], f"{Path(self._scene).stem}.{ending}", write)

    def _write_csv(self, path: Path) -> None:
        tables = []
        for one in self._recordings:
            columns: dict[str, Any] = {"policy": one.name, "ev100": one.ev100}
            columns |= {"best_ev100": one.best, "score": one.scores, "regret": one.regrets}
            for name in ("iso", "exposure_time", "f_number"):
                columns[name] = [getattr(self._grid[state], name) for state in one.states]
            tables.append(pd.DataFrame(columns).rename_axis("frame"))
        pd.concat(tables).to_csv(path)

    def show_scene(self, viewed: ViewedScene) -> None:
        """Takes another scene for the next episode."""
        self._stop()
        self.viewed, self._recordings, self._scene = viewed, [], viewed.scene.scene_id
        self._timer.active = False
        self._shown.set_visibility(False)

    async def _record(self) -> None:
        if self.viewed is None:
            return
        names = list(dict.fromkeys(self.asked[x] for x in "ab"))  # one beside itself is shown once
        asked, light = self.asked, self.asked["light"]
        options = {"light": light, "frames": int(asked["frames"]), "seed": int(asked["seed"])}
        self._on_run()
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
        next(self._images[1].ancestors()).set_visibility(len(recordings) > 1)
        best = ("best state", _BEST, enumerate(recordings[0].best))
        shown = list(zip(_POLICIES, recordings, strict=False))
        for kind, chart in self._charts.items():
            lines = [(r.name, c, enumerate(getattr(r, kind))) for c, r in shown]
            draw_lines(chart, [*lines, best] if kind == "ev100" else lines)
        self._frame.props(f"max={self._last}")
        self._frame.value = 0
        self._show_frame()
        self._shown.set_visibility(True)
        self._timer.active = True

    @property
    def _last(self) -> int:
        return len(self._recordings[0].states) - 1

    def _show_frame(self) -> None:
        if not self._recordings:
            return
        frame = int(self._frame.value)
        self._holder.style(f"--now: {frame / max(self._last, 1):.4f}")
        shown = zip("AB", self._images, self._facts, self._recordings, strict=False)
        for x, image, facts, one in shown:
            self.show(image, encoded(one.pictures[frame]))
            facts.text = (
                f"{x} {one.name}: {self._grid[one.states[frame]]}, score "
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
