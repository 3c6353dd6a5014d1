"""`Scene`: light at known settings, the noise left in it, and facts such as the illuminance."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, get_args, overload

import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.capture.blurred_frames import Layout
from simulator.capture.blurred_light import BlurredLight, MapApertureBlur
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.statistics import (
    DenoisedLight,
    LightStatistics,
    Residual,
    ResidualStatistics,
)
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.radiance.incident_light import POSTERIOR, IncidentLight
from simulator.radiance.light import DEFAULT_EV100, camera_light, mean_anchor
from simulator.raw.develop import neutral_highlights
from simulator.raw.image import RawImage, check_packed
from simulator.settings import CameraSettings, incident_ev100
from simulator.utils.cache import content_digest
from simulator.utils.checks import check_integer, check_number, check_type, check_word

if TYPE_CHECKING:
    from ae_env.scenes.ladder import Ladder

#: Median image speed of a moving episode [frame heights / s].
DEFAULT_SPEED = 0.125

Crop = Literal["box", "native"]
Split = Literal["train", "validation", "test", "all"]
#: Brings a scene to a resolution by a crop, as `Scene.resized` does.
Resize = Callable[["Scene", int | None, Crop], "Scene"]


@dataclass(frozen=True, eq=False)
class Scene:
    """The light before a camera, as the raw it would record at reference settings, not clipped.

    `from_array`, `from_raw` and `from_radiance` make scenes and check all of this; the constructor
    itself trusts its caller.
    """

    scene_id: str  #: unique and stable, such as ``"snow-012"``
    #: Source group: the photograph, panorama or physical subject. All scenes of a group stay in one
    #: split and are resampled together.
    group: str
    #: (4, H, W) float32 packed light at `reference`, planes R, G1, G2, B, 1.0 at sensor white; not
    #: clipped, so lamps exceed 1.
    light: torch.Tensor
    #: Settings at which `light` is. With `illuminance` known, an 18 % grey card under it has 0.119
    #: of white in green there.
    reference: CameraSettings
    camera: CameraProfile  #: camera in whose colour space `light` is
    #: Noise left in `light` at `reference`, per pixel of `light`; zero if noise-free.
    nlf: NoiseLevelFunction
    #: Light on the subject as an incident-light meter with a dome reads it there, in the lux of a
    #: flat receptor that asks for the same (`simulator.radiance.incident_light`); None if unknown.
    illuminance: float | None
    white_balance: tuple[float, float, float]  #: gains of R, G, B that make a grey card grey
    kind: str  #: sort of scene, such as ``"snow"``
    #: Whether it belongs to the hard part (back light, snow, night, spot light, motion).
    hard: bool = False
    #: Median image speed of a moving episode [frame heights / s].
    median_speed: float = DEFAULT_SPEED
    box_factor: int = 1  #: sensor pixels averaged per side into one pixel of `light`
    source: str = ""  #: provenance and licence in one line
    #: (H, W) bool, pixels whose light is a guess because the source raw was saturated there
    #: (`simulator.raw.develop`); None if there are none.
    saturated: torch.Tensor | None = None
    #: (4, H, W) `light` with its noise removed by a noise module; None where there is no noise, or
    #: no such module.
    denoised: torch.Tensor | None = None
    #: What the network that made `denoised` gets wrong; None where that is not known.
    residual: Residual | None = None
    #: (H, W) circle of confusion at the reference's f-number [pixel of `light`], of a scene whose
    #: own defocus is to grow as the aperture opens; None where all is far.
    defocus_map: torch.Tensor | None = None
    #: What is out of focus, by how much relative to an episode's defocus, and what is the subject,
    #: which may move apart from the rest; None where the whole frame has one defocus and one
    #: motion.
    layout: Layout | None = None
    #: Whether each plane was sampled at its own place, as a sensor does. False: the four share
    #: their places, G1 equals G2, as in every bundled scene; averaged by a large `box_factor` there
    #: is hardly a difference.
    sampled: bool = False
    #: (R, 4, H, W) float32, the real captures of the states that are `allowed`, in their order,
    #: white is 1. With it nothing is simulated: environments show these frames, and `light` is what
    #: they tell together. None where captures are simulated.
    recorded: torch.Tensor | None = None
    sequence: str = ""  #: video that it is a frame of; empty for a still scene
    #: (S,) bool, exposure states that may be chosen, as a recorded grid with holes has them; None
    #: for every state of any grid.
    allowed: np.ndarray | None = None
    ladder: Ladder | None = None  #: codes drawn into it, and where (`ae_env.scenes.ladder`)

    @property
    def noise_free(self) -> bool:
        """Whether no noise is left in `light`."""
        return self.nlf.is_zero

    @property
    def clean_light(self) -> torch.Tensor:
        """(4, H, W) the light as free of noise as it is known: `denoised`, or else `light`."""
        return self.light if self.denoised is None else self.denoised

    @property
    def prepared(self) -> PreparedScene:
        """The light, ready to be exposed: at rest, by the scene's own camera."""
        aperture_blur = None
        if self.defocus_map is not None:
            f_number = self.reference.effective_f_number
            aperture_blur = MapApertureBlur(self.light, self.defocus_map, f_number)
        known = aperture_blur, *self._statistics
        return PreparedScene(
            light=self.light,
            reference=self.reference,
            camera=self.camera,
            nlf=self.nlf,
            saturated=self.saturated,
            white_balance=self.white_balance,
            box_factor=self.box_factor,
            denoised_lights=self._denoised_lights,
            aperture_blur=aperture_blur,
            layout=self.layout,
            blurred_light=BlurredLight(self.light, self.nlf, *known),
        )

    @cached_property
    def content(self) -> str:
        """Digest of the light, of the networks' results for it, and of its layout."""
        tensors = {"light": self.light, "denoised": self.denoised, "defocus_map": self.defocus_map}
        if self.recorded is not None:
            tensors |= {"recorded": self.recorded, "allowed": torch.tensor(self.allowed)}
        if self.layout is not None:
            tensors |= {"layout": self.layout.defocus, "subject": self.layout.subject}
        return content_digest({name: t for name, t in tensors.items() if t is not None})

    @cached_property
    def frame_of_state(self) -> np.ndarray:
        """(S,) int64, which of `recorded` is a state's; any of them where it is not `allowed`."""
        assert self.allowed is not None
        return np.maximum(np.cumsum(self.allowed) - 1, 0)

    @cached_property
    def _denoised_lights(self) -> tuple[DenoisedLight, ...]:
        if self.denoised is None:
            return ()
        return (DenoisedLight(self.denoised, residual=self.residual),)

    @cached_property
    def _statistics(self) -> tuple[LightStatistics, ResidualStatistics]:
        # Each of their values is computed when it is first asked for.
        return LightStatistics(self.light), ResidualStatistics(self.light, self.nlf)

    def own_blur(self, f_number: float) -> float:
        """Root mean square of the scene's own circle of confusion at an effective `f_number` [px].

        It grows as the aperture opens; a smaller aperture than the reference's leaves its blur. 0
        without a `defocus_map`.
        """
        if self.defocus_map is None:
            return 0.0
        own = float(self.defocus_map.double().square().mean().sqrt())
        return own * max(1.0, self.reference.effective_f_number / f_number)

    @cached_property
    def incident_light(self) -> IncidentLight:
        """The incident light, as `illuminance` says or as the frame lets infer.

        A `ValueError` where the light is unknown and the frame is black.
        """
        green = self.light[1:3].mean(dim=0)
        try:
            factor = mean_anchor(green)
        except ValueError:
            if self.illuminance is None:
                raise
            return IncidentLight(incident_ev100(self.illuminance), 0.0, None)
        reflected = -self.reference.log2_exposure - math.log2(factor)
        if self.illuminance is not None:
            return IncidentLight(incident_ev100(self.illuminance), 0.0, reflected)
        return POSTERIOR.infer(green * factor, reflected)

    @cached_property
    def ev100(self) -> float:
        """EV100 of the right exposure; the mean of what is likely where the light is unknown."""
        return float(self.incident_light.right_ev100.mean())

    @classmethod
    def from_array(
        cls,
        packed: torch.Tensor | np.ndarray,
        reference: CameraSettings,
        camera: CameraProfile,
        *,
        scene_id: str,
        group: str | None = None,
        nlf: NoiseLevelFunction | None = None,
        illuminance: float | None = None,
        white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0),
        kind: str = "array",
        **fields: Any,
    ) -> Scene:
        """A scene from a packed raw in an array.

        `packed` is (4, H, W) float, planes R, G1, G2, B, 1.0 at sensor white, which it may exceed;
        `group` is `scene_id` by default, `nlf` no noise. `reference`, `camera`, `illuminance`,
        `white_balance`, `kind` and further `fields` are those of `Scene`.
        """
        scene = cls(
            scene_id=scene_id,
            group=scene_id if group is None else group,
            light=check_packed("packed", packed).contiguous(),
            reference=reference,
            camera=camera,
            nlf=NoiseLevelFunction.zero() if nlf is None else nlf,
            illuminance=illuminance,
            white_balance=white_balance,
            kind=kind,
            **fields,
        )
        return _checked(scene)

    @classmethod
    def from_raw(cls, raw: RawImage, *, scene_id: str, kind: str = "raw", **fields: Any) -> Scene:
        """A scene, called `scene_id` of `kind`, from `raw`: light, noise, neutral highlights.

        Its settings become the reference; the other `fields`, such as a measured `illuminance`,
        are those of `from_array`. A `ValueError` if neither the raw nor its camera knows the noise.
        """
        saturated = raw.saturated
        fields |= {"scene_id": scene_id, "kind": kind, "saturated": saturated, "sampled": True}
        return cls.from_array(
            neutral_highlights(raw, saturated),
            raw.settings,
            raw.camera,
            nlf=raw.noise,
            white_balance=raw.white_balance,
            box_factor=raw.box_factor,
            **fields,
        )

    @classmethod
    def from_radiance(
        cls,
        rgb: torch.Tensor | np.ndarray,
        camera: CameraProfile,
        *,
        illuminance: float | None = None,
        ev100: float = DEFAULT_EV100,
        illuminant: tuple[float, float, float] = (1.0, 1.0, 1.0),
        kind: str = "radiance",
        sampled: bool = False,
        **fields: Any,
    ) -> Scene:
        """A noise-free scene from linear light, taken into the camera's colours.

        `rgb` (3, H, W) has sRGB primaries; with `sampled`, its pixels are photosites (3, 2H, 2W).
        1.0 is white under `illuminance` [lux], or else the mean is set for `ev100`; `illuminant` is
        the light's colour. `camera`, `kind` and `fields` as of `from_array`.
        """
        light, reference, white_balance = camera_light(
            rgb, camera, illuminance, ev100, illuminant, sampled=sampled
        )
        fields |= {"illuminance": illuminance, "kind": kind, "sampled": sampled}
        return cls.from_array(light, reference, camera, white_balance=white_balance, **fields)

    def resized(self, resolution: int | None, crop: Crop = "box") -> Scene:
        """The central square of this scene at `resolution` packed pixels a side.

        A `ValueError` if the scene is smaller than `resolution` or an argument is invalid.

        Args:
            resolution: Packed pixels R; None keeps the scene as it is.
            crop: ``"box"`` averages ``k * k`` pixels per plane, ``k = min(H, W) // R``;
                ``"native"`` cuts R x R pixels out of the middle, ``k = 1``.

        Returns:
            The scene with ``nlf / k**2`` and ``box_factor * k``. A pixel is saturated if one that
            was averaged into it was. `defocus_map` is the root mean square, as second moments add,
            divided by k. Of `layout` it is the mean; a pixel is what most of it was.
        """
        check_word("crop", crop, get_args(Crop))
        if resolution is None:
            return self
        height, width = self.light.shape[1:]
        size = f"; scene {self.scene_id!r} has {height} x {width} packed pixels"
        check_integer("resolution", resolution, 1, min(height, width), more=size)
        k = min(height, width) // resolution if crop == "box" else 1
        if k == 1 and height == width == resolution:
            return self
        top, left = (height - k * resolution) // 2, (width - k * resolution) // 2
        rows, columns = (slice(start, start + k * resolution) for start in (top, left))
        return self.cut(rows, columns).averaged(k)

    def cut(self, rows: slice, columns: slice) -> Scene:
        """The part of this scene in these `rows` and `columns` of packed pixels."""

        def part(planes: torch.Tensor | None) -> torch.Tensor | None:
            return None if planes is None else planes[..., rows, columns]

        mask = part(self.saturated)
        return replace(
            self,
            light=self.light[..., rows, columns].contiguous(),
            saturated=mask if mask is not None and bool(mask.any()) else None,
            denoised=part(self.denoised),
            recorded=part(self.recorded),
            residual=None,  # of the whole frame
            defocus_map=part(self.defocus_map),
            layout=None if self.layout is None else self.layout.cut(rows, columns),
            ladder=self.ladder and self.ladder.within(rows.start or 0, columns.start or 0, 1),
        )

    def averaged(self, k: int) -> Scene:
        """This scene with `k` x `k` pixels per plane averaged into one, as `resized` states them.

        Rows and columns at the end that fill no such square are left out.
        """
        if k == 1:
            return self
        check_integer("k", k, 1, min(self.light.shape[1:]))
        height, width = (side // k for side in self.light.shape[1:])
        tiles = (height, k, width, k)

        def mean(planes: torch.Tensor) -> torch.Tensor:  # (..., H, W) to (..., H / k, W / k)
            whole = planes[..., : height * k, : width * k]
            return whole.reshape(*planes.shape[:-2], *tiles).double().mean(dim=(-3, -1))

        mask, found, layout = self.saturated, self.defocus_map, self.layout
        if mask is not None:
            mask = mask[: height * k, : width * k]
            mask = mask.reshape(tiles).permute(0, 2, 1, 3).flatten(2).any(dim=2)
        if layout is not None:
            layout = layout.cut(slice(height * k), slice(width * k)).averaged(k)
        return replace(
            self,
            light=mean(self.light).float(),
            nlf=self.nlf.scaled(1.0 / k**2),
            box_factor=self.box_factor * k,
            saturated=mask,
            denoised=None if self.denoised is None else mean(self.denoised).float(),
            recorded=None if self.recorded is None else mean(self.recorded).float(),
            residual=None,  # of the finer pixels
            defocus_map=None if found is None else mean(found.square()).sqrt().float() / k,
            layout=layout,
            ladder=self.ladder and self.ladder.within(0, 0, k),
        )

    def __repr__(self) -> str:
        _, height, width = self.light.shape
        light = "unknown light" if self.illuminance is None else f"{self.illuminance:.4g} lux"
        return f"Scene({self.scene_id!r}, {self.kind}, {height} x {width} packed, {light})"


def _checked(scene: Scene) -> Scene:
    """The scene with its fields in their types; a `ValueError` names one that is invalid."""
    for name in ("scene_id", "group", "kind"):
        if not isinstance(getattr(scene, name), str) or not getattr(scene, name):
            raise ValueError(f"`{name}` (={getattr(scene, name)!r}) must be a non-empty string")
    check_type("camera", scene.camera, CameraProfile)
    check_type("reference", scene.reference, CameraSettings)
    check_type("nlf", scene.nlf, NoiseLevelFunction)
    check_type("layout", scene.layout, Layout, None)
    for name in ("saturated", "denoised", "defocus_map"):
        check_type(name, getattr(scene, name), torch.Tensor, None)
    if scene.illuminance is not None:
        check_number("illuminance", scene.illuminance, 1e-300, 1e300, more=" lux")
    gains = tuple(float(gain) for gain in scene.white_balance)
    if len(gains) != 3 or not all(math.isfinite(gain) and gain > 0 for gain in gains):
        raise ValueError(f"`white_balance` (={gains}) must be 3 positive gains (R, G, B)")
    check_number("median_speed", scene.median_speed, 0.0, 1e300)
    check_integer("box_factor", scene.box_factor, 1)
    size, denoised = scene.light.shape[1:], scene.denoised
    mask, blur = scene.saturated, scene.defocus_map
    if denoised is not None:
        denoised = check_packed("denoised", denoised)
    layout = None if scene.layout is None else scene.layout.defocus
    plane = None if denoised is None else denoised[0]
    maps = {"saturated": mask, "defocus_map": blur, "layout": layout, "denoised": plane}
    for name, found in maps.items():
        if found is not None and found.shape != size:
            shape = tuple(found.shape)
            raise ValueError(f"`{name}` (shape {shape}) must be as large as `light`, {tuple(size)}")
    if mask is not None and mask.dtype != torch.bool:
        raise ValueError(f"`saturated` (dtype {mask.dtype}) must be bool")
    if blur is not None and not bool((torch.isfinite(blur) & (blur >= 0)).all()):
        raise ValueError("`defocus_map` must be finite and >= 0 everywhere")
    allowed = None if scene.allowed is None else np.asarray(scene.allowed)
    frames = scene.recorded
    if allowed is not None and (allowed.dtype != np.bool_ or allowed.ndim != 1 or not any(allowed)):
        raise ValueError("`allowed` must be bool, (S,), and allow a state")
    if frames is not None and (allowed is None or frames.shape != (allowed.sum(), 4, *size)):
        raise ValueError("`recorded` must be (R, 4, H, W), one frame for each state of `allowed`")
    return replace(
        scene,
        white_balance=gains,
        denoised=denoised,
        saturated=mask if mask is not None and bool(mask.any()) else None,
        defocus_map=None if blur is None else blur.float(),
        allowed=allowed,
    )


class SceneSet(Sequence[Scene]):
    """Scenes in a fixed order; bundled ones are drawn when they are needed.

    All `scene_ids` are known at once. `load` the scenes that are about to be used, several at a
    time; indexing and iterating load what they need. All scenes of a set that draws are alike:
    those that are `loaded` tell whether any has a layout.
    """

    def __init__(self, scenes: Iterable[Scene]) -> None:
        self._scenes: list[Scene | None] = list(scenes)
        self.scene_ids = tuple(scene.scene_id for scene in self)

    @classmethod
    def of(cls, scenes: Sequence[Scene]) -> SceneSet:
        """`scenes` as a set, which they may be already."""
        return scenes if isinstance(scenes, SceneSet) else cls(scenes)

    @property
    def loaded(self) -> list[int]:
        """Indices of the scenes that are there, at least the first."""
        return [index for index, scene in enumerate(self._scenes) if scene is not None]

    def load(self, indices: Iterable[int]) -> None:
        """Makes sure that the scenes at `indices` are there."""

    def __len__(self) -> int:
        return len(self._scenes)

    @overload
    def __getitem__(self, index: int) -> Scene: ...
    @overload
    def __getitem__(self, index: slice) -> list[Scene]: ...
    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            self.load(range(len(self))[index])
        elif self._scenes[index] is None:
            self.load([index])
        return self._scenes[index]

    def __iter__(self) -> Iterator[Scene]:
        return iter(self[:])


@dataclass(frozen=True)
class SceneRequest:
    """The split, the camera and the size that scenes are loaded for.

    `camera` is that in whose colours light is stated, unless a raw has its own; `resize` makes
    each scene fit `resolution` and `crop`, as `Scene.resized` does.
    """

    split: Split
    camera: CameraProfile
    resolution: int | None = 64
    crop: Crop = "box"
    resize: Resize = Scene.resized

    def sized(self, scene: Scene) -> Scene:
        """`scene` at the resolution asked for."""
        return self.resize(scene, self.resolution, self.crop)
