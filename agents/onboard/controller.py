"""An exported agent on a camera: NumPy and ONNX Runtime, no torch.

One file is enough: beside the network it holds the exposure states, and what the agent keeps in
mind between frames.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

#: Entry of the file's metadata that holds the description, and the form that it has.
METADATA, FORMAT = "ae_env", 1


class ExposureState(NamedTuple):
    """What a camera is to be set to: ISO speed, exposure time [s] and marked f-number."""

    iso: float
    exposure_time: float
    f_number: float


class Controller:
    """Chooses the next exposure from the frame in hand, as the agent that it was exported from.

    The predictions of frames of the same light count together, weighted by their precision; when
    the metered light moves by more than the agent's tolerance, the earlier ones are forgotten.
    (PPO without a history remembers nothing.)

    Args:
        path: An ``.onnx`` file of `agents.onboard.export.export_agent`.
        num_cameras: Cameras that are driven at once.

    Raises:
        ImportError: If ONNX Runtime is not installed.
        ValueError: If the file is not such an export.
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
            found = self._session.get_modelmeta().custom_metadata_map.get(METADATA, "{}")
        except Exception as error:  # ONNX Runtime has errors of its own
            raise ValueError(f"{given} cannot be read: {error}") from error
        self.card: dict[str, Any] = json.loads(found)
        if self.card.get("format") != FORMAT:
            raise ValueError(f"{given} must be an export of `ae-env export`, of format {FORMAT}")
        self.states = [ExposureState(*state) for state in self.card["states"]]
        self.reset(num_cameras)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """Shape of a camera's frame: planes R, G1, G2, B, and their height and width."""
        return tuple(self.card["frame_shape"])

    def reset(self, num_cameras: int = 1) -> None:
        """Forgets the frames so far."""
        self._weighted, self._precision = np.zeros((2, num_cameras, len(self.states)))
        self._light, self._frames = np.zeros((2, num_cameras))

    def act(
        self,
        raw: NDArray[np.uint8],
        settings: NDArray[np.float32],
        sensors: NDArray[np.float32] | None = None,
        action_masks: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.int64]:
        """Indices into `states` (N,) for the next frame of N cameras.

        Args:
            raw: (N, *`frame_shape`) as the environment observes it, see `encode_frame`.
            settings: (N, 3) in [-1, 1] that the frames were taken with, see `encode_settings`.
            sensors: (N, 2) in [-1, 1], where the agent was trained with them.
            action_masks: (N, S), False where a state is not allowed.

        Raises:
            ValueError: If an array has the wrong shape.
        """
        shown: dict[str, NDArray[Any]] = {"raw": np.asarray(raw, np.uint8)}
        shown["settings"] = np.asarray(settings, np.float32)
        if sensors is not None:
            shown["sensors"] = np.asarray(sensors, np.float32)
        self._check(shown)
        found = self._session.run(None, shown)
        utility = found[0] if self.card["kind"] == "ppo" else self._accumulated(*found)
        if action_masks is not None:
            utility = np.where(action_masks, utility, -np.inf)
        return np.argmax(utility, axis=1).astype(np.int64)

    def decide(
        self,
        planes: NDArray[np.floating],
        current: ExposureState,
        *,
        image_speed: float = 0.0,
        defocus: float = 0.0,
        fixed_aperture: bool = False,
    ) -> ExposureState:
        """The next exposure of one camera.

        Args:
            planes: (4, H, W) signal of R, G1, G2, B, 0 at black and 1 at white; of any size that is
                at least that of `frame_shape`.
            current: What the frame was really taken with, as its metadata say.
            image_speed: Of the image, as a gyro reads it [frame heights/s].
            defocus: Diameter of the largest disc of defocus at f/4 [pixel of a 64-pixel frame].
            fixed_aperture: Choose among the states whose f-number is nearest to the current one.
        """
        masks = None
        if fixed_aperture:
            stops = np.array([abs(np.log2(s.f_number / current.f_number)) for s in self.states])
            masks = (stops < stops.min() + 0.01)[None]
        sensors = None
        if self.card["sensors"]:
            sensors = self._unit(np.log2(np.maximum([image_speed, defocus], 2.0**-64)), "sensors")
            sensors = sensors[None]
        raw, settings = self.encode_frame(planes)[None], self.encode_settings(current)[None]
        return self.states[int(self.act(raw, settings, sensors, masks)[0])]

    def encode_frame(self, planes: NDArray[np.floating]) -> NDArray[np.uint8]:
        """The observed frame of a signal (4, H, W): averaged to `frame_shape`, companded."""
        count, height, width = self.frame_shape
        if planes.ndim != 3 or len(planes) != count or planes[0].size < height * width:
            rule = f"({count}, H, W), at least {height} x {width}"
            raise ValueError(f"`planes` (shape {planes.shape}) must be {rule}")
        averaged = _averaged(_averaged(np.asarray(planes, np.float64), height, 1), width, 2)
        pedestal = self.card["pedestal"]
        shown = np.clip(averaged, -pedestal, 1.0)
        root = np.sqrt((shown + pedestal) / (1.0 + pedestal))
        return np.rint(255.0 * root).astype(np.uint8)

    def encode_settings(self, state: ExposureState) -> NDArray[np.float32]:
        """The observed settings (3,) of a state: Av, Tv and Sv in [-1, 1]."""
        aperture, time = 2 * np.log2(state.f_number), -np.log2(state.exposure_time)
        return self._unit(np.array([aperture, time, np.log2(state.iso / 3.125)]), "settings")

    def _unit(self, values: NDArray[np.float64], name: str) -> NDArray[np.float32]:
        low, high = np.array(self.card["ranges"][name]).T
        return np.clip(2.0 * (values - low) / (high - low) - 1.0, -1.0, 1.0).astype(np.float32)

    def _accumulated(
        self, scores: NDArray[Any], precision: NDArray[Any], ev100: NDArray[Any]
    ) -> NDArray[np.float64]:
        other = (self._frames > 0) & (np.abs(ev100 - self._light) > self.card["same_light_ev"])
        for sums in (self._weighted, self._precision, self._light, self._frames):
            sums[other] = 0.0
        self._frames += 1.0
        self._light += (ev100 - self._light) / self._frames
        self._weighted += precision.astype(np.float64) * scores
        self._precision += precision
        return self._weighted / self._precision

    def _check(self, shown: dict[str, NDArray[Any]]) -> None:
        shapes = {"raw": self.frame_shape, "settings": (3,)}
        if self.card["sensors"]:
            shapes["sensors"] = (2,)
        for name in shapes.keys() | shown.keys():
            wanted = (len(self._light), *shapes[name]) if name in shapes else None
            given = shown[name].shape if name in shown else None
            if given != wanted:
                raise ValueError(f"`{name}` (shape {given}) must be {wanted}")


def _averaged(values: NDArray[np.float64], size: int, axis: int) -> NDArray[np.float64]:
    """Means over `size` stretches of an axis, as even as they can be."""
    length = values.shape[axis]
    starts = np.arange(size) * length // size
    counts = np.diff(starts, append=length)
    return np.add.reduceat(values, starts, axis=axis) / np.expand_dims(counts, (0, 3 - axis))
