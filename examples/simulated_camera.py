"""A camera with Picamera2's interface whose frames the simulator makes."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ae_env.scenes import Scene
from ae_env.scorers.captures import prepare_scene
from simulator.camera import CameraProfile
from simulator.raw.image import unpack_mosaic
from simulator.settings import CameraSettings


class _Request:
    """A completed capture, as Picamera2 hands it out."""

    def __init__(self, mosaic: NDArray[np.uint16], metadata: dict[str, Any]) -> None:
        self.mosaic, self._metadata = mosaic, metadata

    def get_metadata(self) -> dict[str, Any]:
        """``ExposureTime`` [us], ``AnalogueGain``, and ``SensorBlackLevels`` on 16 bits."""
        return dict(self._metadata)

    def make_array(self, name: str) -> NDArray[np.uint8]:
        """The mosaic as Picamera2 gives it: (H, stride) bytes, rows padded to 64."""
        if name != "raw":
            raise ValueError(f"`name` (={name!r}) must be 'raw'")
        rows = np.ascontiguousarray(self.mosaic).view(np.uint8)
        return np.pad(rows, ((0, 0), (0, -rows.shape[1] % 64)))

    def release(self) -> None:
        """Nothing to give back."""


class SimulatedCamera:
    """Photographs a scene through Picamera2's `set_controls` and `capture_request`.

    As on a real one, settings take frames to arrive, are rounded to what the sensor can do, and
    frames are dropped.

    Args:
        scene: What is before the camera.
        camera: The body.
        f_number: Its fixed aperture.
        delay: Frames between `set_controls` and the first frame that has them.
        gains: Light of each frame relative to the scene's own; the last one stays.
        dropped: Numbers of frames that never reach `capture_request`.
        line_time: Exposure times are whole multiples of it [s].
        gain_steps: Analogue gains are ``gain_steps / (gain_steps - n)``, as an imx477's.
        seed: Of the noise.
        left_justified: Whether samples are moved up to 16 bits, as on a Raspberry Pi 5.
    """

    def __init__(
        self,
        scene: Scene,
        camera: CameraProfile,
        f_number: float,
        *,
        delay: int = 2,
        gains: Sequence[float] = (1.0,),
        dropped: Collection[int] = (),
        line_time: float = 1e-5,
        gain_steps: int = 1024,
        seed: int = 0,
        left_justified: bool = False,
    ) -> None:
        self.left_justified = left_justified
        self.camera, self.f_number, self.gains, self.seed = camera, f_number, gains, seed
        self.dropped, self.line_time, self.gain_steps = dropped, line_time, gain_steps
        self.frame = 0
        self._prepared = prepare_scene(scene, camera)
        first = {"ExposureTime": 1e4, "AnalogueGain": 1.0}
        self._pending = deque([first] * (delay + 1))

    def set_controls(self, controls: dict[str, float]) -> None:
        """Asks for ``ExposureTime`` [us] and ``AnalogueGain``; the newest request stays."""
        self._pending[-1] = {**self._pending[-1], **controls}

    def camera_configuration(self) -> dict[str, dict[str, Any]]:
        """Format and size of the raw stream."""
        height, width = (2 * side for side in self._prepared.light.shape[1:])
        bits = 16 if self.left_justified else self.camera.bit_depth
        return {"raw": {"format": f"S{self.camera.cfa.value}{bits}", "size": (width, height)}}

    def capture_request(self) -> _Request:
        """The next frame that is not dropped."""
        while True:
            frame, self.frame = self.frame, self.frame + 1
            given = self._pending.popleft()
            self._pending.append(self._pending[-1] if self._pending else given)
            if frame not in self.dropped:
                return self.photograph(frame, given)

    def photograph(self, frame: int, asked: dict[str, float]) -> _Request:
        """Frame number `frame` with the controls `asked`."""
        lines = max(1, round(asked["ExposureTime"] / 1e6 / self.line_time))
        steps = self.gain_steps
        gain = steps / (steps - round(steps - steps / max(asked["AnalogueGain"], 1.0)))
        time = lines * self.line_time
        settings = CameraSettings(100.0 * gain, time, self.f_number)
        light = self.gains[min(frame, len(self.gains) - 1)]
        found = self._prepared.expose([settings], seed=self.seed + frame, gain=np.array([light]))
        mosaic, unused = unpack_mosaic(found[0], self.camera), 16 - self.camera.bit_depth
        levels = [int(level * 2**unused) for level in self.camera.black_level]
        metadata = {"ExposureTime": round(time * 1e6), "AnalogueGain": gain}
        shown = mosaic << unused if self.left_justified else mosaic
        return _Request(shown, metadata | {"SensorBlackLevels": levels})
