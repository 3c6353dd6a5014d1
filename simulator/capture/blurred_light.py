"""The lights of one scene: as recorded, denoised, with the aperture opened, and blurred.

Defocus comes first, by one disc or by each pixel's circle of confusion. Then the background moves
along the camera's path, with what is nearest in place of the subject, and the subject in front of
it along its own: what its smeared mask leaves uncovered shows the background. Uniform light stays
uniform. Blur and exposure are linear: one light per f-number, and one per f-number and motion,
serve every ISO.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from simulator.capture.blurred_frames import BLUR, BlurredFrames, Layout
from simulator.capture.columns import Origin, blur_tables, remaining_energy
from simulator.capture.statistics import DenoisedLight, LightStatistics, ResidualStatistics
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.optics import discs
from simulator.optics.discs import HALO, LIGHT_LIMIT, DiscBank
from simulator.optics.motion import Path, path_blur, path_taps
from simulator.optics.vignetting import Vignetting
from simulator.utils.cache import LruCache
from simulator.utils.tiles import TILE, Tile, make_tiles

#: Memory that the cached blurred light of one scene may take, and that its cached opened light may
#: [byte].
CACHE_BYTES, OPENED_BYTES = 512 * 2**20, 256 * 2**20
#: The numbers of a `Path` in `BLUR`.
_PATH = ["extent", "direction", "turn", "drift_x", "drift_y"]


class ApertureBlur:
    """Opens the aperture of one scene's light; results are cached, as f-numbers are few.

    The light was recorded at the effective `f_number`. `everywhere` says whether it opens also
    where a positive tolerance needs no network.
    """

    #: Whether it works on the noise-reduced light only.
    needs_denoised = False
    #: Mean square of the circle of confusion in the light itself [pixel^2]; 0 if unknown.
    mean_square_diameter: float = 0.0

    def __init__(self, f_number: float, everywhere: bool = True) -> None:
        self.f_number, self.everywhere = f_number, everywhere
        self.forget()

    def forget(self) -> None:
        """Drops what is cached."""
        self._opened: LruCache[Tensor] = LruCache(OPENED_BYTES)

    def extent(self, f_number: float) -> float:
        """Largest diameter of the blur that opening to `f_number` adds [pixel]; 0 for none."""
        return math.inf if f_number < self.f_number else 0.0  # unknown before a network ran

    def opened(self, f_number: float, denoised: DenoisedLight | None = None) -> Tensor:
        """Light (4, H, W) at a wider aperture, of `denoised` or as recorded, equally exposed."""
        key = f_number, None if self.needs_denoised else denoised
        result = self._opened.get(key)
        if result is None:
            result = self._open(f_number, denoised)
            self._opened.put(key, result, result.nbytes)
        return result

    def remaining_variance(self, f_number: float) -> Tensor | None:
        """(H, W) share of the recorded noise's variance that the blur leaves; None for all."""
        return None

    def _open(self, f_number: float, denoised: DenoisedLight | None) -> Tensor:
        raise NotImplementedError


class MapApertureBlur(ApertureBlur):
    """Blurs by the estimated circle of confusion of each pixel (preset ``"compact"``).

    Only the parts of the frame that are out of focus are blurred, tile by tile; the rest is copied.

    Args:
        light: (4, H, W) as recorded.
        diameter: (H, W) circle of confusion at `f_number` [pixel of `light`], or a function that
            estimates it, called when an aperture first opens.
    """

    def __init__(
        self,
        light: Tensor,
        diameter: Tensor | Callable[[], Tensor],
        f_number: float,
        *,
        everywhere: bool = True,
    ) -> None:
        super().__init__(f_number, everywhere)
        self._recorded, self._diameter = light, diameter

    def forget(self) -> None:
        """Drops what is cached; the map stays."""
        super().forget()
        self._banks: dict[tuple[Tile, DenoisedLight | None], DiscBank] = {}
        self._extents, self._left = dict[float, float](), dict[float, Tensor]()

    @functools.cached_property
    def diameter(self) -> Tensor:
        """(H, W) circle of confusion at the light's own f-number [pixel]."""
        return self._diameter if isinstance(self._diameter, Tensor) else self._diameter()

    def extent(self, f_number: float) -> float:
        """See `ApertureBlur`."""
        if f_number < self.f_number and f_number not in self._extents:
            self._extents[f_number] = float(self._added(self.diameter.max(), f_number))
        return self._extents.get(f_number, 0.0)

    def remaining_variance(self, f_number: float) -> Tensor:
        """See `ApertureBlur`."""
        if f_number not in self._left:
            self._left[f_number] = discs.remaining_variance(self._added(self.diameter, f_number))
        return self._left[f_number]

    @functools.cached_property
    def mean_square_diameter(self) -> float:  # type: ignore[override]
        """See `ApertureBlur`."""
        return float(self.diameter.square().mean())

    def _added(self, diameter: Tensor, f_number: float) -> Tensor:
        return discs.added_blur(diameter, self.f_number, f_number)

    def _open(self, f_number: float, denoised: DenoisedLight | None) -> Tensor:
        light = self._recorded if denoised is None else denoised.light

        def blurred(tile: Tile) -> Tensor:
            added = self._added(self.diameter[tile.outer], f_number)
            # Close f-numbers share most of their discs; on large frames they take too much memory.
            cache = self._banks if self.diameter.numel() <= TILE**2 else {}
            if (tile, denoised) not in cache:  # sums of more would not resolve the shadows
                bank = DiscBank(light[tile.outer].clamp(-LIGHT_LIMIT, LIGHT_LIMIT))
                cache[tile, denoised] = bank
            return cache[tile, denoised].blurred(added)[tile.core]

        result = light.clamp(-LIGHT_LIMIT, LIGHT_LIMIT)
        for tile in make_tiles(*self.diameter.shape, halo=HALO, needed=self.diameter > 0):
            result[tile.inner] = blurred(tile)
        return result


class NetworkApertureBlur(ApertureBlur):
    """Runs the paper's attention U-Net for every f-number (presets ``"paper"``, ``"ncs"``).

    The light has little noise: none of the recorded is left to account for. `module` is the trained
    network, called as `ApertureModule` is.
    """

    needs_denoised = True

    def __init__(
        self,
        denoised: DenoisedLight,
        module: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor],
        f_number: float,
    ) -> None:
        super().__init__(f_number)
        self._denoised, self._module = denoised, module

    @torch.no_grad()
    def _open(self, f_number: float, denoised: DenoisedLight | None) -> Tensor:
        image = self._denoised.light[None]
        f_numbers = (torch.tensor([n], device=image.device) for n in (self.f_number, f_number))
        return self._module(image, torch.zeros_like(image), *f_numbers)[0]


class BlurredLight:
    """Blurs a scene's light, each blur when it is first needed, and caches the latest.

    `light` is (4, H, W) as recorded, `nlf` its noise. Wider apertures add the `aperture_blur`.
    """

    def __init__(
        self,
        light: Tensor,
        nlf: NoiseLevelFunction,
        aperture_blur: ApertureBlur | None,
        statistics: LightStatistics | None = None,
        residuals: ResidualStatistics | None = None,
    ) -> None:
        self.light, self.aperture_blur = light, aperture_blur
        self.statistics = LightStatistics(light) if statistics is None else statistics
        self.residuals = ResidualStatistics(light, nlf) if residuals is None else residuals
        self._cache: LruCache[Tensor] = LruCache(CACHE_BYTES)

    def copy(self, cache_bytes: int = CACHE_BYTES) -> BlurredLight:
        """One of the same light with an empty cache of its own, of `cache_bytes`."""
        copied = copy.copy(self)
        copied._cache = LruCache(cache_bytes)
        return copied

    def source(self, origin: Origin) -> Tensor:
        """The light (4, H, W) as recorded, denoised or opened."""
        denoised, opened_to = origin
        if opened_to is not None and self.aperture_blur is not None:
            return self.aperture_blur.opened(opened_to, denoised)
        return self.light if denoised is None else denoised.light

    def lights(
        self,
        origins: Sequence[Origin],
        blurs: np.ndarray,
        owners: tuple[Layout | None, Vignetting | None],
    ) -> list[Tensor]:
        """Lights (4, H, W) with the `blurs` (N,) `BLUR`, not exposed yet; not to be changed.

        Those that are alike are one. The `blurs` have addresses of arrays of the `owners`.
        """
        if not (blurs["defocus_px"] + blurs["motion_px"] + blurs["vignetting"]).any():
            return [self.source(origin) for origin in origins]
        lens, fields = np.zeros_like(blurs), ["defocus_px", "diameter", "sorts", "num_sorts"]
        lens[fields] = blurs[fields]
        still = lens.copy()  # where nothing moves, its path makes no other light
        still["vignetting"] = blurs["vignetting"]
        blurs = np.where(blurs["motion_px"] > 0.0, blurs, still)
        # Blurs that change what is behind the disc of defocus.
        changes = (blurs["motion_px"] > 0.0) | (blurs["vignetting"] > 0)
        numbers = blurs.view(f"V{BLUR.itemsize}").tolist()
        keys = [(*key, owners) for key in zip(origins, numbers, strict=True)]
        found = {key: self._cache.get(key) for key in set(keys)}
        some = [*{key: row for row, key in enumerate(keys) if found[key] is None}.values()]
        if some:
            own, origins = blurs[some], [origins[row] for row in some]
            if changes[some].any():  # it starts from what is out of focus
                lights, own["defocus_px"] = self.lights(origins, lens[some], owners), 0.0
            else:
                lights = [self.source(origin) for origin in origins]
            made = self._made(lights, own, changes[some])
            found |= zip((keys[row] for row in some), made, strict=True)
            for row, light, before in zip(some, made, lights, strict=True):
                if light is not before:
                    self._cache.put(keys[row], light, light.nbytes)
        return [found[key] for key in keys]  # type: ignore[misc]

    def _made(self, lights: list[Tensor], blurs: np.ndarray, changes: np.ndarray) -> list[Tensor]:
        """Lights (4, H, W) out of focus, or that `changes`; the others as they are."""
        result, device = [*lights], self.light.device
        todo = np.flatnonzero((blurs["defocus_px"] > 0.0) | changes)
        if not len(todo):
            return result
        sources = [lights[i].float().contiguous() for i in todo]
        frames = new_frames(len(todo), 1, 0, None if device.type == "cpu" else device)
        places, indices = frames.places(sources), np.arange(len(todo))
        owners = np.unique(places, return_inverse=True)[1]
        done, planned = frames.plan(indices, 0 * indices, blurs[todo], places, owners)
        frames.run(planned)
        for i, light in zip(todo.tolist(), frames.kept(done), strict=True):
            result[i] = light
        return result

    def remaining_variance(
        self,
        blur: np.void,
        layout: Layout | None,
        vignetting: np.ndarray | None,
        opened_to: float | None,
    ) -> Tensor | None:
        """`Transitions.remaining_variance` behind a `BLUR`; None where the table has all of it.

        The others are of the scene, and of the f-number that its aperture opens to, if it does.
        """
        (height, width), device = self.light.shape[-2:], self.light.device
        moves, numbers = blur["motion_px"] > 0.0, blur[_PATH].item()
        left, energy, own = None, 1.0, moves and blur["mask"]
        if layout is not None and (blur["defocus_px"] or own):
            paths = Path(*numbers[:3]) if moves else None, Path(*numbers) if own else None
            left = _noise_map(layout, *paths, float(blur["defocus_px"])).to(device)
        else:
            energy = float(remaining_energy(blur, (height, width), blur_tables()))
        if opened_to is not None and self.aperture_blur is not None:
            share = self.aperture_blur.remaining_variance(opened_to)
            if share is not None:
                # Noise that one blur has smeared is correlated: a second, smaller one hardly
                # averages it further. Both together leave about what the larger leaves alone.
                opened = (share / energy).clamp(max=1.0)
                left = opened if left is None else torch.minimum(left, opened)
        if vignetting is not None:
            # The variance goes with the square of the share r, its top-up with r: exact for shot
            # noise, and off by r (1 - r) of the source's read noise (`simulator.capture.sensor`).
            share = torch.from_numpy(vignetting).to(device)
            left = share if left is None else left * share
        return None if left is None else left.float().contiguous()


def new_frames(
    num_scenes: int, num_apertures: int, most_bytes: int, device: torch.device | None
) -> BlurredFrames:
    """Memory for blurred light, see `BlurredFrames`; with a `device`, by torch operations on it."""
    if device is None:
        return BlurredFrames(num_scenes, num_apertures, most_bytes)
    from simulator.capture.device_frames import DeviceFrames  # few need it

    return DeviceFrames(num_scenes, num_apertures, most_bytes, device)


@functools.lru_cache(maxsize=2)  # a plan needs the same again
def _noise_map(layout: Layout, path: Path | None, own: Path | None, defocus_px: float) -> Tensor:
    """Share of a source's noise variance that blurs leave of each pixel (H, W)."""
    height, width = layout.defocus.shape
    diameter = layout.defocus * defocus_px
    if path is None:
        return discs.remaining_variance(diameter)
    taps = path_taps(path, height, width)
    left = discs.remaining_variance(diameter, taps)
    if own is None:
        return path_blur(left[None], taps)[0]
    # Taps of pixels that differ leave the mean of what each of these would leave alone.
    assert layout.subject is not None
    taps_own, mask = path_taps(own, height, width), layout.subject[None].float()
    left = path_blur(left.flatten()[layout.behind][None], taps)
    subject = path_blur(mask * discs.remaining_variance(diameter, taps_own), taps_own)
    seen = 1.0 - path_blur(mask, taps_own)
    return (seen.square() * left + subject)[0].clamp(max=1.0)
