"""`ae_env/AutoExposure-v0`: what its frames are worth, and the environment of one episode."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, Unpack

import gymnasium as gym
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec

from ae_env.episodes.core import (
    EpisodeCore,
    FindTransitions,
    FrameBatch,
    Frames,
    FrameSource,
    MakeTask,
    Task,
    check_actions,
)
from ae_env.episodes.lookup import RECORDED
from ae_env.episodes.state import Episode, Episodes, check_options
from ae_env.first_frame import compile_beside
from ae_env.grid import ExposureGrid
from ae_env.options import EnvArguments, EnvOptions, takes_env_arguments
from ae_env.registration import InProcessSpec, is_json
from ae_env.scenes import Scene
from ae_env.scorers.captures import Captures, ShownScenes
from ae_env.scorers.score_table import ScoreTable, ScoreTables
from ae_env.scorers.terms import CompositeScorer, depends_on
from simulator.camera import CameraProfile
from simulator.capture.batch import MODULES
from simulator.capture.sensor import CodeMeans
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.utils.cache import LruCache
from simulator.utils.checks import check_seed, check_word
from simulator.utils.compute import keep_memory

logger = logging.getLogger(__name__)

Observation = dict[str, np.ndarray]
#: Memory for score tables [byte]: some eight thousand of 64 states.
TABLES_BYTES = 2**25
_FIRST = np.array([0])


class AutoExposure(Task):
    """Scores each frame, takes the costs off, and compares it with the oracle.

    Parts of the score that look at no frame are cached in static light, and so are expectations.
    With `transitions` (`CaptureBatch.transitions`), parts that are measured on frames are replaced
    by their expectation.
    """

    def __init__(
        self,
        episodes: Episodes,
        captures: FrameSource,
        scorer: CompositeScorer,
        transitions: FindTransitions | None,
    ) -> None:
        super().__init__(episodes)
        self._captures, self._transitions, self.scorer = captures, transitions, scorer
        options, expected = episodes.options, transitions is not None
        self.tables = ScoreTables(
            episodes.grid,
            episodes.camera,
            scorer,
            noise=bool(options.noise),
            tolerance=options.tolerance,
        )
        self._terms = terms = self.tables.term_scores
        # Some expectation has no closed form.
        self._reads_tables = expected and not terms.closed_form
        self._reads_images = not expected and not terms.closed_form
        self.outputs = ("images",) if self._reads_images else ()
        if self._reads_images:
            keep_memory()
        if (terms.parts and not expected) or "flicker" in options.costs:  # else no code is made
            self.outputs += ("codes",)
        torch_parts = {} if terms.torch_terms is None else terms.torch_terms.parts
        # By `Episodes.light_index` and state; and which have been scored.
        count, states = len(episodes.begun), len(episodes.grid)
        lights = len(episodes.scenes) + count
        self._known = [n for n, part in torch_parts.items() if depends_on(part) != "image"]
        self._scores = np.zeros((len(self._known), lights * states))
        self._scored = np.zeros((lights, states), bool)
        # Of the parts that depend on a scene's light alone; NaN where they are not known.
        self._of_light = [n for n in self._known if depends_on(torch_parts[n]) == "light"]
        self._light_scores = np.full((len(self._of_light), len(episodes.scenes), states), np.nan)
        self._unlit = len(episodes.scenes)  # of how many scenes they are not
        self._sharp = terms.only_sharpness
        # Whether these are cheap to work out, and differ from episode to episode: none is kept.
        direct = len(self._of_light) + len(self._sharp) == len(self._known)
        self._fleeting = direct and not episodes.at_rest
        self._means = options.placed(np.zeros((lights, states, 3) if expected else 0))
        self._expected = np.zeros((lights, states), bool)  # whether these means are known
        self._shown = ShownScenes(episodes.scenes, terms.captures)
        self._tables: LruCache[ScoreTable] = LruCache(max(TABLES_BYTES, 128 * count * states))

    def forget(self, lights: np.ndarray) -> None:
        """Makes the scores under these `Episodes.light_index` unknown."""
        self._scored[lights] = self._expected[lights] = False

    def code_means(self, env_indices: np.ndarray) -> CodeMeans | None:
        """Those of the terms; on a device the frames alone have what these need."""
        if not self._terms.parts or self._transitions or self.episodes.options.device is not None:
            return None
        return self._terms.means_of(self.episodes.state.take(env_indices))

    def measure(self, frames: FrameBatch) -> dict[str, Any]:
        """Scores (B,) by ``score:`` and part, and ``image_mean`` where a cost needs it."""
        columns: dict[str, Any] = {}
        if not self._reads_tables:
            columns = {f"score:{name}": each for name, each in self._score(frames).items()}
        if "flicker" in self.episodes.options.costs:
            flat = frames.outputs["codes"].reshape(len(frames.gains), -1)
            integers: Any = torch.int64 if torch.is_tensor(flat) else np.int64
            total = flat.sum(1, dtype=integers)
            total = total.float() if torch.is_tensor(total) else total
            columns["image_mean"] = total / (255.0 * flat.shape[1])
        return columns

    def reward(
        self, env_indices: np.ndarray, columns: dict[str, Any]
    ) -> tuple[dict[str, Any], Any]:
        """Terms of the reward by name, and the reward (B,): the score minus weighted costs.

        Takes the scores and the image means out of `columns`, and adds the oracle's.
        """
        options, states = self.episodes.options, self.episodes.state.take(env_indices)
        tables: list[ScoreTable] = []
        if self._reads_tables or options.with_oracle:
            tables = [self.score_table(env_index) for env_index in env_indices.tolist()]
        if self._reads_tables:  # the expectation takes captures to work out
            pairs = list(zip(tables, states.tolist(), strict=True))
            terms = {n: np.array([t.parts[n][s] for t, s in pairs]) for n in self.scorer.parts}
            terms["score"] = options.placed(np.array([table.mean[state] for table, state in pairs]))
        else:
            terms = {n: options.placed(columns.pop(f"score:{n}")) for n in self.scorer.parts}
            terms["score"] = options.placed(self.scorer.totals(terms))
        reward = 1.0 * terms["score"]
        for name, cost in self._costs(env_indices, columns.pop("image_mean", None)).items():
            terms[name] = cost
            reward -= options.costs[name] * options.placed(cost)
        if options.with_oracle:
            best = np.array([t.mean[t.oracle] for t in tables])
            columns["oracle_state"] = np.array([t.oracle for t in tables])
            columns["regret"] = best - [t.mean[s] for t, s in zip(tables, states, strict=True)]
        return terms, reward

    def _costs(self, env_indices: np.ndarray, means: Any) -> dict[str, Any]:
        """(B,) each; 0 in the first frame of an episode."""
        episodes, costs = self.episodes, self.episodes.options.costs
        found: dict[str, Any] = {}
        if means is not None:
            change = abs(means - episodes.image_mean[env_indices])  # NaN where no frame was before
            found["flicker"] = (torch if torch.is_tensor(change) else np).nan_to_num(change)
            episodes.image_mean[env_indices] = means
        if "switch" in costs:
            now = episodes.grid.controls(episodes.state[env_indices])
            first = episodes.previous[env_indices] < 0
            before = episodes.grid.controls(np.where(first, 0, episodes.previous[env_indices]))
            found["switch"] = np.where(first, 0.0, (before != now).mean(axis=-1))
        return found

    def score_table(self, env_index: int) -> ScoreTable:
        """Expected scores of all states in the current frame of environment `env_index`."""
        episodes, lighting = self.episodes, self.episodes.lighting
        episode = episodes[env_index]
        gain: float | np.ndarray = 1.0
        rows = None
        if lighting.within_frame:
            moment: tuple[float, ...] = (episode.frame, episode.phase)
        else:
            moment = (gain := episodes.gains(np.array([env_index]), np.zeros(1))[0].item(),)
        # All that a table depends on: tables of episodes that were seen before are cached.
        lens = episodes.lens(env_index)
        key = (episode.scene, episode.speed, episode.defocus, episode.movement, moment, lens)
        table = self._tables.get(key)
        if table is None:
            if lighting.within_frame:
                gain, rows = episodes.gains_by_state(env_index)
            prepared = self._captures.prepared_scene(episodes.light_index.item(env_index))
            scene = episodes.scenes[episode.scene]
            table = self.tables.table(scene, gain=gain, row_gain=rows, prepared=prepared)
            self._tables.put(key, table, table.nbytes)
        return table

    def _score(self, frames: FrameBatch) -> dict[str, Any]:
        """Scores (B,) of the captures by part."""
        episodes, terms = self.episodes, self._terms
        boxes, source_noise = episodes.box_factor, frames.statistics.source_noise
        if self._transitions is not None or source_noise is not None:
            boxes = boxes[episodes.scene[frames.env_indices]]
        if source_noise is not None:
            source_noise = source_noise * np.square(boxes)[:, None, None]
        captures: Captures | None = None
        if self._reads_images or not episodes.static or terms.reads_captures:
            captures = self._describe(frames, source_noise, device=episodes.options.torch_device)
        if episodes.static:
            scores: dict[str, Any] = self._known_scores(frames, source_noise)
        else:
            assert captures is not None
            scores = terms.torch_scores(None, captures, "light", "blur")
        if terms.parts:
            states = episodes.state[frames.env_indices]
            if frames.means is not None and source_noise is None:
                means = frames.means.means
            elif self._transitions is None:
                means = terms.measured(frames.outputs["codes"], states, source_noise)
            else:
                means = self._expected_means(frames, self._transitions, boxes)
            scores |= terms.score(means, captures)
        if self._reads_images and captures is not None:
            images = torch.as_tensor(frames.outputs["images"])
            scores |= terms.torch_scores(images, captures, "image")
        return scores

    def _known_scores(
        self, frames: FrameBatch, source_noise: np.ndarray | None
    ) -> dict[str, np.ndarray]:
        """Scores (B,) in static light of the parts that look at no frame."""
        episodes, env_indices = self.episodes, frames.env_indices
        clean = source_noise is None or self._terms.ignores_noise
        if clean and self._fleeting:
            return self._clean_scores(frames, env_indices)
        rows = episodes.light_index.take(env_indices) * self._scored.shape[1]
        rows += episodes.state.take(env_indices)
        if np.count_nonzero(known := self._scored.take(rows)) < len(rows) and self._known:
            new = np.flatnonzero(~known)
            if clean or source_noise is None or not source_noise[new].any():
                found = self._clean_scores(frames, env_indices[new], new)
            else:  # blur averages it
                described = self._describe(frames, source_noise, new)
                found = self._terms.torch_scores(None, described, "light", "blur")
            self._scores[:, rows[new]] = [found[name] for name in self._known]
            self._scored.reshape(-1)[rows[new]] = True
        return dict(zip(self._known, self._scores.take(rows, axis=1), strict=True))

    def _clean_scores(
        self, frames: FrameBatch, env_indices: np.ndarray, part: Any = slice(None)
    ) -> dict[str, np.ndarray]:
        """The same of `part` of the frames, those of `env_indices` (K,), from light without noise.

        Motion is no matter to what depends on the light alone.
        """
        episodes, found = self.episodes, {}
        scenes, states = episodes.scene.take(env_indices), episodes.state.take(env_indices)
        if self._of_light:
            lit = self._light_scores.reshape(len(self._of_light), -1)
            rows = scenes * self._scored.shape[1] + states
            known = lit.take(rows, axis=1)
            if self._unlit and (unknown := np.isnan(known[0])).any():
                for scene, k in {scenes.item(i): i for i in np.flatnonzero(unknown)}.items():
                    light = episodes.light_index.item(env_indices[k])
                    shown = episodes.scenes[scene], self._captures.prepared_scene(light)
                    of_light = self._terms.closed_form_terms(*shown, "light")
                    self._light_scores[:, scene] = [*of_light.values()]
                    self._unlit -= 1
                known = lit.take(rows, axis=1)
            found = dict(zip(self._of_light, known, strict=True))
        if self._sharp:
            *_, scores = self._shown.blur(scenes, states, **self._moves(env_indices))
            found |= dict.fromkeys(self._sharp, scores)
        elif len(self._known) > len(self._of_light):
            described = self._describe(frames, None, part)
            found |= self._terms.torch_scores(None, described, "blur")
        return found

    def _expected_means(
        self, frames: FrameBatch, transitions: FindTransitions, boxes: np.ndarray
    ) -> Any:
        """`TermScores.expected` of the captures; in static light, cached."""
        episodes, env_indices = self.episodes, frames.env_indices
        lights, states = episodes.light_index[env_indices], episodes.state[env_indices]
        missing = ~self._expected[lights, states] | (not episodes.static)
        if missing.any():
            exposed = transitions(lights[missing], states[missing])
            some = None if frames.rows is None else frames.rows[missing]
            found = self._terms.expected(exposed, states[missing], boxes[missing], some)
            self._means[lights[missing], states[missing]] = found
            self._expected[lights[missing], states[missing]] = True
        return self._means[lights, states]

    def _describe(
        self,
        frames: FrameBatch,
        source_noise: np.ndarray | None,
        part: Any = slice(None),
        **where: Any,
    ) -> Captures:
        episodes, env_indices = self.episodes, frames.env_indices[part]
        noises, rows = None, frames.rows
        if source_noise is not None and source_noise[part].any():
            pairs = source_noise[part].tolist()
            noises = [NoiseLevelFunction(tuple(shot), tuple(read)) for shot, read in pairs]
        return self._terms.captures.of(
            self._shown,
            episodes.state[env_indices],
            which=episodes.scene[env_indices],
            **self._moves(env_indices),
            gain=frames.gains[part],
            row_gain=None if rows is None else rows[part],
            source_noise=noises,
            **where,
        )

    def _moves(self, env_indices: np.ndarray) -> dict[str, Any]:
        """How the scenes move, as `SceneCaptures.of` takes it."""
        episodes = self.episodes
        speed, defocus = episodes.speed.take(env_indices), episodes.defocus.take(env_indices)
        moves = episodes.movements.take(env_indices, axis=0)
        return {"speed": speed, "defocus": defocus, "movements": moves}


class AutoExposureBase:
    """The public surface that `AutoExposureEnv` and `AutoExposureVectorEnv` have in common.

    Policies and evaluations need nothing else of an environment.
    """

    core: EpisodeCore
    render_mode: str | None
    _make_task: MakeTask = AutoExposure
    _last: Frames | None
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """Spec that Gymnasium made the environment from; None if it was constructed directly."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None and not is_json(spec.kwargs):  # then it says why it is none
            spec = InProcessSpec(**{f.name: getattr(spec, f.name) for f in fields(spec) if f.init})
        self._spec = spec

    def _set_up(self, arguments: Mapping[str, Any], num_envs: int, render_mode: str | None) -> None:
        """Makes the core of `num_envs` episodes."""
        check_word("render_mode", render_mode, ("rgb_array",), None)
        compile_beside()
        self.render_mode, self._last = render_mode, None
        self.core = EpisodeCore(EnvOptions.from_kwargs(arguments), num_envs, self._make_task)

    def __getstate__(self) -> dict[str, Any]:
        # Torch does not unpickle uint16: the same frames are made again.
        return vars(self) | ({} if self.core.options.device is None else {"_last": None})

    @property
    def grid(self) -> ExposureGrid:
        """The states that actions choose from."""
        return self.core.grid

    @property
    def camera(self) -> CameraProfile:
        """The simulated body."""
        return self.core.camera

    @property
    def scenes(self) -> Sequence[Scene]:
        """Scenes that episodes draw from; of a sequence, its first frame.

        Bundled ones that are not cached yet are drawn when they are looked at.
        """
        return self.core.episodes.first_scenes

    @property
    def scene_ids(self) -> tuple[str, ...]:
        """Names of all scenes (of sequences: frames), by a vector environment's ``scene_id``."""
        return self.core.scene_ids

    @property
    def module_names(self) -> tuple[str, ...]:
        """Steps of the simulator, joined by ``"+"``, by a vector environment's ``modules``."""
        return (*MODULES, RECORDED)

    @property
    def delays(self) -> tuple[int, int, int]:
        """Frames after the next until an action's ISO, exposure time and f-number are in effect."""
        return self.core.options.delays

    def episode(self, env_index: int = 0) -> Episode:
        """What was drawn for an environment's episode, and its current frame and state."""
        return self.core.episode(env_index)

    def scene(self, env_index: int = 0) -> Scene:
        """The scene that an environment photographs now; of a sequence, the current frame's."""
        return self.core.scene(env_index)

    def score_table(self, env_index: int = 0) -> ScoreTable:
        """Expected scores in an environment's current frame, with standard errors and parts."""
        return self.core.score_table(env_index)

    def info_of(self, columns: Mapping[str, Any], row: int) -> dict[str, Any]:
        """The info of one environment, plain numbers and names, from the columns of many."""
        info: dict[str, Any] = {
            name: values[row].item() if values.ndim == 1 else values[row]
            for name, values in columns.items()
        }
        info["scene_id"] = self.scene_ids[info["scene_id"]]
        info["modules"] = self.module_names[info["modules"]]
        return info

    def _pictures(self, num_envs: int) -> tuple[np.ndarray, ...] | None:
        """The latest captures, developed, one per environment; None without a render mode."""
        from ae_env.rendering import render_frame

        if self.render_mode is None:
            logger.warning(
                "render() returns None, because the environment was made without a render mode; "
                "give render_mode='rgb_array' to gymnasium.make"
            )
            return None
        if self._last is None:
            self.core.check_begun(envs := np.arange(num_envs))
            self._last = self.core.observe(envs)
        info, scores = self._last.info, self._last.info["rewards.score"]
        return tuple(
            render_frame(
                torch.as_tensor(self._last.raw[i]).cpu().numpy(),
                self.scene(i),
                self.camera,
                self.grid[int(info["state"][i])],
                float(scores[i]),
            )
            for i in range(num_envs)
        )


class AutoExposureEnv(AutoExposureBase, gym.Env[Observation, np.int64]):
    """Choose ISO, shutter and aperture, frame by frame, for a scene on a simulated raw sensor.

    ## Description

    Each episode photographs one scene. An action picks one of the exposure states of a grid; the
    camera simulator turns the scene's light into the raw that the camera would have recorded there,
    with the noise, the blur and the clipping of these settings; a scorer rates it. The image may
    move and be out of focus: only a shorter exposure or smaller aperture helps, at a price of noise.

    In light that stays, without delay, this is a contextual bandit: an action changes the next
    frame and nothing else, two frames tell nearly all that an episode tells, and a discount of 0 is
    the right one. `AutoExposureVideo-v0` is the task that asks for memory and foresight.

    ## Action Space

    `Discrete(64)`: index into `ExposureGrid.default()`,
    `(iso_index * 4 + time_index) * 4 + aperture_index`.

    | control | values |
    |---|---|
    | ISO | 100, 400, 1600, 6400 |
    | exposure time [s] | 1/1000, 1/125, 1/15, 1/2 |
    | f-number | 4, 5.6, 8, 11 |

    `action_masks()` gives the states that the current scene allows: all of them, unless the scene
    is one with holes (`Scene.allowed`). Another state is photographed all the same, but the oracle
    does not count it, so its regret may be negative; on a recorded grid, the nearest state that was
    captured is shown, as `info["state"]` says. Wrappers in `ae_env.wrappers` offer the
    controls one by one, relative steps, and continuous APEX values.

    ## Observation Space

    A `Dict`; the functions of `ae_env.observation` invert each entry.

    | key | space | meaning |
    |---|---|---|
    | `raw` | `Box(0, 255, (4, R, R), uint8)` | planes R, G1, G2, B, `255 sqrt((x + p) / (1 + p))`, x clipped to [-p, 1], p = 1/1024 |
    | `settings` | `Box(-1, 1, (3,), float32)` | Av, Tv, Sv of the current state, from [0, 10], [-5, 15], [4, 17] |
    | `sensors` | `Box(-1, 1, (2,), float32)` | log2 speed of the camera's shake [frame heights/s] from [-9, 3] and log2 of the largest defocus [pixel of a 64-pixel frame at f/4] from [-4, 4], each with 15 % noise |

    With `observation="statistics"`, `raw` is (4, 12, 16): the mean signals of 12 x 16 zones, encoded
    alike, with `histogram`, `Box(0, 1, (128,), float32)`: shares of all samples by code, two codes a
    bin; and `clipped`, `Box(0, 1, (2,), float32)`: shares at white and at black.

    ## Rewards

    Score of the capture in [0, 1] minus the weighted costs. The terms are in the info, as `rewards.`
    and their name: clipping and noise are those of the recorded frame.

    ## Info

    The same keys from `reset` and `step`.

    | key | meaning |
    |---|---|
    | `scene_id` | name of the scene |
    | `state` | index of the exposure state of this capture |
    | `iso`, `exposure_time`, `f_number`, `ev100` | its settings |
    | `clipped_high`, `clipped_low` | shares of the samples at white, and at or below 2^-10 of it |
    | `excess_noise` | noise variance beyond that of the camera at these settings |
    | `illuminance_spread` | standard deviation of the incident EV; 0 where the light is known |
    | `predicted_error` | the plan's error of this capture, in units of the noise that it should have: what was left out, and of a raw also what networks and saturated highlights are off by |
    | `modules` | steps of the simulator that this capture took |
    | `rewards.score`, `rewards.noise`, ... | the score, each part of the scorer, and the costs |
    | `oracle_state`, `regret` | best state, and its expected score minus that of `state`; only with `with_oracle` |
    | `subject` | (R, R) bool, the pixels of the scene's subject; none where it has no subject; only with `with_subject` |

    ## Starting State

    `reset` draws a scene, a start state, an image speed (nothing moves in a third of the episodes,
    else it is log-normal around the scene's median, usually 1/8 frame height per second, sigma 1.3)
    and a defocus spread (blur diameter at f/4, log-normal around 1 pixel of a 64-pixel frame, sigma
    0.9, in [0.1, 8]; with `depth="unknown"` the scene's own is found instead). The shake has any
    direction, which turns by a normal rate of pi rad/s. In half of the moving episodes the subject
    of a scene moves on its own besides, drawn likewise; in 15 % nothing but the subject moves.
    Where a scene has a `layout`, the defocus drawn is that of what is least in focus; the other
    pixels have less. `reset(options={"scene": id, "state": index, "frame": 0})` chooses; in a recorded sequence, `frame` is the raw to begin with.

    ## Episode End

    A scene never terminates; `max_episode_steps` truncates, by default after 8 steps.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `scenes` | `"bundled"` | name (`"bundled:snow"`: of one kind), path, glob, mapping (`{"sequence": folder}`: raws as the frames of one scene over time), `"recorded:FOLDER"` (every state is a real capture), `"package.module:name"` or list of `Scene`; `"polyhaven"`: views of real places, `"polyhaven:unknown"`: without their metered light, `"mixed"`: as many real as procedural ones |
    | `split` | `"train"` | `"train"`, `"validation"`, `"test"` or `"all"`, by source group |
    | `grid` | `None`: `"default"`, or of recorded scenes that of their captures | `"default"`, `"third_stop"`, `"video"`, or a mapping of `isos`, `exposure_times`, `f_numbers` |
    | `scorer` | `"balanced"` | name, mapping of names to weights, `"my_file.py:name"`, `"package.module:name"`, or a callable |
    | `costs` | `None` | mapping to the weights of `flicker` (change of the image mean) and `switch` (share of the controls that changed) |
    | `observation` | `"uint8"` | `"uint8"`, `"linear"` (float32 in [-p, 1]), `"dn"` (the camera's uint16), or `"statistics"`: what an image processor hands to its auto exposure, 18 times fewer numbers |
    | `sensors` | `True` | whether `sensors` is observed |
    | `resolution` | 64 | height and width R of the packed frame, >= 36 |
    | `crop` | `"box"` | `"box"` averages sensor pixels down to R; `"native"` crops R pixels |
    | `motion` | `"random"` | `"random"`, `"none"`, or a speed of the whole image [frame heights/s], in a drawn direction |
    | `depth` | `"random"` | `"random"`, `"far"` (all in focus), `"unknown"` (networks find what is out of focus in the scene itself; it grows as the aperture opens), or a blur diameter at f/4, of what is least in focus |
    | `lighting` | `"static"` | how the light changes: `"static"`, `"step"`, `"ramp"`, `"sine"`, `"tunnel"`, `"lens_cap"`, `"flicker"`, or a mapping with a `kind` and its options, such as `{"kind": "schedule", "ev": [0, -1]}` |
    | `delay` | 0 | frames between an action and the first capture that has it; a mapping by control, such as `{"exposure_time": 2, "iso": 1}`, where some are slower |
    | `source` | `"light"` | `"light"`: each scene's light is known; `"raw"`: it was photographed once, metered by its mean and up to a stop off, at an ISO between 100 and 6400, and all captures are simulated from that raw; a scene that is a raw already stays it |
    | `camera` | `"nikon_z6"` | built-in camera, `"ctt:FILE"`, `"darktable:MAKER MODEL"`, `"emva:FILE"`, or a `CameraProfile` |
    | `lens` | `None` | whose vignetting frames have: `"lensfun:NAME"` (extra `lens`), a `Vignetting`, or `"random"`: one of 64 for each episode; `None`: none |
    | `simulator` | `"compact"` | name or path of the trained networks, loaded only if a scene carries noise or `depth="unknown"`; `None`: noise is only ever added |
    | `noise` | `True` | whether captures are noisy, and how the noise is made: `True` or `"bank"` looks it up in a bank of normals (`simulator.capture.sensor`), `"exact"` draws it, which takes longer, `"sensor"` with row noise and tails, for cameras that have them |
    | `tolerance` | 0.1 | how far the distribution of a pixel may move by blur and noise reduction that are left out, in units of the noise's standard deviation; 0 leaves out only what changes nothing |
    | `reward` | `"capture"` | `"capture"` scores the capture, `"expected"` its expectation over noise |
    | `with_oracle` | `False` | adds `oracle_state` and `regret` to `info` |
    | `with_subject` | `False` | adds `subject` to `info` |
    | `device` | `None` | of environments side by side: torch device on which frames are made and stay, `"cpu"`, `"cuda"` or `"auto"`; `None`: compiled loops on the CPU |
    | `blur_memory` | 512 | memory that blurred light may take before less of it is cached [MiB] |
    | `render_mode` | `None` | `"rgb_array"`: `render()` returns the developed capture, (H, W, 3) uint8, with its settings and score written on it; `None`: it returns None |

    ## Version History

    * v0: first version
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012
    _ended = True  # until the first episode begins

    @takes_env_arguments()
    def __init__(
        self, *, render_mode: str | None = None, **arguments: Unpack[EnvArguments]
    ) -> None:
        if arguments.get("device") is not None:
            raise ValueError(
                f"`device` (={arguments['device']!r}) must be None: only environments side by side "
                "have one (gymnasium.make_vec)"
            )
        self._set_up(arguments, 1, render_mode)
        self.action_space = gym.spaces.Discrete(self.core.num_actions)
        self.observation_space: Any = self.core.observation_space()

    @property
    def state(self) -> int:
        """Index of the current exposure state."""
        return self.core.episode(0).state

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode; `seed` restarts the random numbers, see the class for `options`."""
        chosen = check_options(options)
        super().reset(seed=check_seed(seed))
        self.core.begin(_FIRST, [self.np_random], [chosen])
        self._ended = False
        return self._observe()

    def step(self, action: np.int64) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Takes the next frame with the state `action`."""
        chosen = check_actions("action", action, ())[None]
        if self._ended:
            raise gym.error.ResetNeeded("no episode runs: call reset() before step()")
        self._ended = bool(self.core.transition(_FIRST, chosen)[0])
        observation, info = self._observe()
        assert self._last is not None
        return observation, float(self._last.reward[0]), self._ended, False, info

    def _observe(self) -> tuple[Observation, dict[str, Any]]:
        self._last = self.core.observe(_FIRST)
        observation = {name: values[0] for name, values in self._last.observation.items()}
        return observation, self.info_of(self._last.info, 0)

    def action_masks(self) -> np.ndarray:
        """(S,) bool: states that the scene allows."""
        return np.asarray(self.core.task.allowed(_FIRST)[0])

    def expected_scores(self) -> np.ndarray:
        """(S,) float64: expectation over noise of every state's score in the current frame."""
        return self.score_table().mean

    def render(self) -> np.ndarray | None:
        """The developed capture, (H, W, 3) uint8, with its settings and score written on it.

        None, and a warning in the log, without a `render_mode`.
        """
        pictures = self._pictures(1)
        return None if pictures is None else pictures[0]
