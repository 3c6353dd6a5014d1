"""An exported agent on a camera: NumPy, ONNX Runtime and pydantic, no torch.

One file is enough: beside the network it holds the exposure states, and what the agent keeps in
mind between frames.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

#: Entry of the file's metadata that holds the description, and the form that it has.
METADATA, FORMAT = "ae_env", 1
#: Signals beyond this many times white are digital numbers.
_MOST_SIGNAL = 16.0

Positive = Annotated[float, Field(gt=0.0, lt=1e9)]
Range = tuple[float, float]


class Card(BaseModel):
    """What an exported file says about its agent: the network, and how a camera's frames go in."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    format: Literal[1]
    kind: Literal["regression", "ppo"]
    #: ISO speed, exposure time [s] and marked f-number of each state.
    states: Annotated[list[tuple[Positive, Positive, Positive]], Field(min_length=1)]
    #: Planes R, G1, G2, B, and their height and width.
    frame_shape: tuple[Literal[4], Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]
    sensors: bool
    same_light_ev: Positive
    pedestal: Positive
    ranges: dict[Literal["settings", "sensors"], list[Range]]


class ExposureState(NamedTuple):
    """What a camera is to be set to: ISO speed, exposure time [s] and marked f-number."""

    iso: float
    exposure_time: float
    f_number: float


class Decision(NamedTuple):
    """The next exposure, and the reason why it is still the last one; empty where it is not."""

    state: ExposureState
    reason: str = ""

    @property
    def held(self) -> bool:
        """Whether the frame or a reading was bad, so that the last state was kept."""
        return bool(self.reason)


class Controller:
    """Chooses the next exposure from the frame in hand, as the agent that it was exported from.

    The predictions of frames of the same light count together, weighted by their precision; when
    the metered light moves by more than the agent's tolerance, the earlier ones are forgotten.
    (PPO without a history remembers nothing.) A bad reading counts for nothing: the camera keeps
    the state that was chosen last, or before the first choice the nearest to its own settings.

    Args:
        path: An ``.onnx`` file of `agents.onboard.export.export_agent`.
        num_cameras: Cameras that are driven at once.

    Raises:
        ImportError: If ONNX Runtime is not installed.
        ValueError: If the file is not such an export, or is damaged.
    """

    def __init__(self, path: str | Path, num_cameras: int = 1) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            how = "pip install onnxruntime, or the extra 'ae-env[onnx]'"
            raise ImportError(f"a Controller needs ONNX Runtime: {how}") from error
        given = f"`path` (={str(path)!r})"
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # the network is small: threads cost more than they bring
        try:
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
            found = self._session.get_modelmeta().custom_metadata_map
        except Exception as error:  # ONNX Runtime has errors of its own
            raise ValueError(f"{given} cannot be read: {error}") from error
        if METADATA not in found:
            raise ValueError(f"{given} must be an export of `ae-env export`")
        try:
            self.card = Card.model_validate_json(found[METADATA])
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise ValueError(f"{given} is damaged: its {where}: {first['msg']}") from None
        self.states = [ExposureState(*state) for state in self.card.states]
        self.num_states = len(self.states)
        #: Shape of a camera's frame: planes R, G1, G2, B, and their height and width.
        self.frame_shape = self.card.frame_shape
        self._shapes = {"raw": self.frame_shape, "settings": (3,)}
        if self.card.sensors:
            self._shapes["sensors"] = (2,)
        inputs = {node.name: tuple(node.shape[1:]) for node in self._session.get_inputs()}
        if inputs != self._shapes or self._session.get_outputs()[0].shape[1] != self.num_states:
            raise ValueError(f"{given} is damaged: its network takes {inputs}, not {self._shapes}")
        self._encoded = np.stack([self.encode_settings(state) for state in self.states])
        self.reset(num_cameras)

    def reset(self, num_cameras: int = 1) -> None:
        """Forgets the frames so far."""
        self._weighted, self._precision = np.zeros((2, num_cameras, self.num_states))
        self._light, self._frames = np.zeros((2, num_cameras))
        self._last = np.full(num_cameras, -1)
        #: Of each camera, why it kept its state at the last `act`; empty where one was chosen.
        self.reasons = [""] * num_cameras

    def act(
        self,
        raw: NDArray[np.uint8],
        settings: NDArray[np.float32],
        sensors: NDArray[np.float32] | None = None,
        action_masks: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.int64]:
        """Indices into `states` (N,) for the next frame of N cameras; `reasons` says which held.

        Args:
            raw: (N, *`frame_shape`) uint8 as the environment observes it, see `encode_frame`.
            settings: (N, 3) in [-1, 1] that the frames were taken with, see `encode_settings`.
            sensors: (N, 2) in [-1, 1], where the agent was trained with them; a camera whose
                reading is not finite keeps its state.
            action_masks: (N, S) bool, False where a state is not allowed.

        Raises:
            ValueError: If an array has the wrong shape or dtype, a setting is out of range, or a
                mask allows nothing.
        """
        shown: dict[str, NDArray[Any]] = {"raw": np.asarray(raw)}
        if shown["raw"].dtype != np.uint8:
            raise ValueError(f"`raw` (dtype {shown['raw'].dtype}) must be uint8")
        shown["settings"] = np.asarray(settings, np.float32)
        if sensors is not None:
            shown["sensors"] = np.asarray(sensors, np.float32)
        masks = self._checked(shown, action_masks)
        bad = ~np.isfinite(shown.get("sensors", self._light[:, None])).all(axis=1)
        return self._act(shown, masks, ["a sensor is not finite" if held else "" for held in bad])

    def decide(
        self,
        planes: NDArray[np.floating] | None,
        current: ExposureState,
        *,
        image_speed: float = 0.0,
        defocus: float = 0.0,
        fixed_aperture: bool = False,
    ) -> Decision:
        """The next exposure of one camera.

        Args:
            planes: (4, H, W) signal of R, G1, G2, B, 0 at black and 1 at white; of any size that is
                at least that of `frame_shape`. None for a frame that was dropped.
            current: What the frame was really taken with, as its metadata say.
            image_speed: Of the image, as a gyro reads it [frame heights/s].
            defocus: Diameter of the largest disc of defocus at f/4 [pixel of a 64-pixel frame].
            fixed_aperture: Choose among the states whose f-number is nearest to the current one.

        Returns:
            The state, and a reason where the last one is held: a dropped frame, or a value of the
            frame, gyro or focus drive that is not finite.

        Raises:
            ValueError: If `planes` is no signal (integers, digital numbers), a reading is negative,
                or `current` is not positive and finite.
        """
        for name, value in zip(ExposureState._fields, current, strict=True):
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"`current.{name}` (={value!r}) must be positive and finite")
        readings = {"image_speed": image_speed, "defocus": defocus}
        for name, value in readings.items():
            if value < 0.0:
                raise ValueError(f"`{name}` (={value!r}) must be at least 0")
        bad = [name for name, value in readings.items() if not np.isfinite(value)]
        reason = f"`{bad[0]}` is not finite" if bad else ""
        raw = np.zeros(self.frame_shape, np.uint8)
        if planes is None:
            reason = "no frame"
        elif np.isfinite(planes := self._check_planes(planes)).all():
            raw = self._encode(planes)
        else:
            reason = "the frame is not finite"
        masks = np.ones((1, self.num_states), bool)
        if fixed_aperture:
            stops = np.array([abs(np.log2(s.f_number / current.f_number)) for s in self.states])
            masks = (stops < stops.min() + 0.01)[None]
        shown: dict[str, NDArray[Any]] = {"raw": raw[None]}
        shown["settings"] = self.encode_settings(current)[None]
        if self.card.sensors:
            least = np.maximum([*readings.values()], 2.0**-64)
            shown["sensors"] = self._unit(np.log2(least), "sensors")[None]
        return Decision(self.states[int(self._act(shown, masks, [reason])[0])], reason)

    def encode_frame(self, planes: NDArray[np.floating]) -> NDArray[np.uint8]:
        """The observed frame of a signal (4, H, W): averaged to `frame_shape`, companded."""
        return self._encode(self._check_planes(planes))

    def _encode(self, planes: NDArray[np.floating]) -> NDArray[np.uint8]:
        _, height, width = self.frame_shape
        averaged = _averaged(_averaged(np.asarray(planes, np.float64), height, 1), width, 2)
        pedestal = self.card.pedestal
        shown = np.clip(averaged, -pedestal, 1.0)
        root = np.sqrt((shown + pedestal) / (1.0 + pedestal))
        return np.rint(255.0 * root).astype(np.uint8)

    def encode_settings(self, state: ExposureState) -> NDArray[np.float32]:
        """The observed settings (3,) of a state: Av, Tv and Sv in [-1, 1]."""
        aperture, time = 2 * np.log2(state.f_number), -np.log2(state.exposure_time)
        return self._unit(np.array([aperture, time, np.log2(state.iso / 3.125)]), "settings")

    def _unit(self, values: NDArray[np.float64], name: Any) -> NDArray[np.float32]:
        low, high = np.array(self.card.ranges[name]).T
        return np.clip(2.0 * (values - low) / (high - low) - 1.0, -1.0, 1.0).astype(np.float32)

    def _act(
        self, shown: dict[str, NDArray[Any]], masks: NDArray[np.bool_], reasons: list[str]
    ) -> NDArray[np.int64]:
        """`act` of what is checked; cameras with a reason keep their state."""
        self.reasons = reasons
        good = np.flatnonzero([not reason for reason in reasons])
        # Of a camera that is held: minus the distance to its last state, else to its settings.
        kept = np.where((self._last < 0)[:, None], shown["settings"], self._encoded[self._last])
        utility = -np.square(kept[:, None] - self._encoded).sum(axis=2, dtype=np.float64)
        if len(good):
            found = self._session.run(None, {name: value[good] for name, value in shown.items()})
            ppo = self.card.kind == "ppo"
            utility[good] = found[0] if ppo else self._accumulated(good, *found)
        chosen = np.argmax(np.where(masks, utility, -np.inf), axis=1).astype(np.int64)
        self._last[good] = chosen[good]
        return chosen

    def _accumulated(
        self, good: NDArray[Any], scores: NDArray[Any], precision: NDArray[Any], ev: NDArray[Any]
    ) -> NDArray[np.float64]:
        """Mean scores of the cameras `good` over the frames of the light that they see."""
        moved = np.abs(ev - self._light[good]) > self.card.same_light_ev
        other = good[(self._frames[good] > 0) & moved]
        for sums in (self._weighted, self._precision, self._light, self._frames):
            sums[other] = 0.0
        self._frames[good] += 1.0
        self._light[good] += (ev - self._light[good]) / self._frames[good]
        self._weighted[good] += precision.astype(np.float64) * scores
        self._precision[good] += precision
        return self._weighted[good] / self._precision[good]

    def _check_planes(self, planes: NDArray[np.floating]) -> NDArray[np.floating]:
        planes, (count, height, width) = np.asarray(planes), self.frame_shape
        if not np.issubdtype(planes.dtype, np.floating):
            rule = "floating point, 0 at black and 1 at white; digital numbers are no signal"
            raise ValueError(f"`planes` (dtype {planes.dtype}) must be {rule}")
        least = planes.ndim == 3 and planes.shape[1] >= height and planes.shape[2] >= width
        if not least or len(planes) != count:
            rule = f"({count}, H, W), at least {height} x {width}"
            raise ValueError(f"`planes` (shape {planes.shape}) must be {rule}")
        most = float(np.max(planes, initial=0.0, where=np.isfinite(planes)))
        if most > _MOST_SIGNAL:
            raise ValueError(f"`planes` must be a signal, 1 at white, but reach {most:g}")
        return planes

    def _checked(
        self, shown: dict[str, NDArray[Any]], action_masks: NDArray[np.bool_] | None
    ) -> NDArray[np.bool_]:
        """The masks of `act`; raises what is wrong with its arguments."""
        count = len(self._light)
        for name in self._shapes.keys() | shown.keys():
            wanted = (count, *self._shapes[name]) if name in self._shapes else None
            given = shown[name].shape if name in shown else None
            if given != wanted:
                raise ValueError(f"`{name}` (shape {given}) must be {wanted}")
        if not (np.abs(shown["settings"]) <= 1.0 + 1e-6).all():
            raise ValueError("`settings` must be in [-1, 1]; see `Controller.encode_settings`")
        masks = np.ones((count, self.num_states), bool) if action_masks is None else action_masks
        masks = np.asarray(masks)
        if masks.shape != (count, self.num_states) or masks.dtype != bool:
            rule = f"({count}, {self.num_states}) of bool"
            raise ValueError(f"`action_masks` ({masks.shape} of {masks.dtype}) must be {rule}")
        if not masks.any(axis=1).all():
            raise ValueError("`action_masks` must allow a state to every camera")
        return masks


def _averaged(values: NDArray[np.float64], size: int, axis: int) -> NDArray[np.float64]:
    """Means over `size` stretches of an axis, as even as they can be."""
    length = values.shape[axis]
    starts = np.arange(size) * length // size
    counts = np.diff(starts, append=length)
    return np.add.reduceat(values, starts, axis=axis) / np.expand_dims(counts, (0, 3 - axis))
