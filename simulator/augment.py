"""Augmentation for training: the same picture under another exposure, with its noise and blur.

A picture is taken back to scene-linear light, photographed by the simulator (exposure, defocus,
motion, the noise of the target's ISO, clip, whole digital numbers) and developed again. What is
drawn for a picture is a function of its seed alone, whatever the batch or the worker.
"""

import functools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.utils.data import Dataset

from simulator.camera import CameraProfile, get_camera
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import clip_and_quantise
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.optics.motion import Movement
from simulator.raw.develop import develop, develop_inverse
from simulator.raw.image import check_packed
from simulator.settings import CameraSettings
from simulator.utils.checks import check_integer, check_type

#: Parts of the augmentation, in the order in which they act.
MODULES = ("exposure", "blur", "noise")
#: Displayed level from which a pixel counts as clipped by the camera that took the picture.
_CLIPPED = 0.97
#: Widest blur [pixel].
_WIDEST = 64.0
#: Elements of a piece that is developed at a time. PyTorch splits larger arrays among its threads,
#: and the last bits then depend on their number.
_PIECE = 2**15
#: f-number of every capture: the defocus of a `PreparedScene` is stated at f/4.
_F_NUMBER, _TIME = 4.0, 1.0


class DrawnSettings(NamedTuple):
    """What an `ExposureAugmentation` draws for one picture."""

    stops: float  # exposure relative to the picture's [EV]
    iso: float  # speed, whose noise the new picture has
    defocus: float  # diameter of the disc [pixel]
    motion: float  # length of the blur [pixel]
    direction: float  # of the motion [rad]; 0 is along the rows
    highlights: float  # by how much light that was clipped is raised above white [EV]


@dataclass(frozen=True)
class ExposureAugmentation:
    """Photographs pictures again at settings drawn at random.

    Seeds decide everything: the same seed gives the same picture, bit for bit on one device, alone
    or in a batch, in any process and on any number of threads. It can be pickled. Ranges are drawn
    from uniformly, that of the ISO speed in its logarithm.

    >>> augment = ExposureAugmentation(stops=(-2.0, -2.0), modules=("exposure",))
    >>> grey = torch.full((1, 4, 2, 2), 0.4)
    >>> augment(grey, [0])[0, 0, 0, 0]
    tensor(0.1000)
    """

    #: The body whose noise, black level and digital numbers the pictures get: a `CameraProfile`
    #: with a noise calibration, or the name of a built-in one.
    camera: CameraProfile | str = "nikon_z6"
    stops: tuple[float, float] = (-4.0, 4.0)  #: exposure relative to the picture's [EV]
    isos: tuple[float, float] = (100.0, 12800.0)  #: ISO speed
    defocus: tuple[float, float] = (0.0, 2.0)  #: diameter of the defocus disc [pixel], in [0, 64]
    #: Length of the motion blur [pixel], in [0, 64]; its direction is random.
    motion: tuple[float, float] = (0.0, 3.0)
    #: By how much clipped light of an RGB picture is raised above white [EV], so that it is not
    #: grey in a darker picture; raws hold what is known.
    highlights: tuple[float, float] = (0.0, 2.5)
    #: Which of ``"exposure"``, ``"blur"`` and ``"noise"`` act. What is drawn does not depend on it.
    #: With none, pictures are returned as they are.
    modules: tuple[str, ...] = MODULES

    def __post_init__(self) -> None:
        if not isinstance(self.camera, CameraProfile):
            object.__setattr__(self, "camera", get_camera(self.camera))
        self.profile.nlf(100.0)  # raises where there is no noise calibration
        blurs, bounds = (0.0, _WIDEST), {"stops": (-20.0, 20.0), "isos": (1.0, 1e7)}
        bounds |= {"defocus": blurs, "motion": blurs, "highlights": (0.0, 20.0)}
        for name, (low, high) in bounds.items():
            object.__setattr__(self, name, _check_range(name, getattr(self, name), low, high))
        named = isinstance(self.modules, Iterable) and not isinstance(self.modules, str)
        if not named or not set(self.modules) <= set(MODULES):
            raise ValueError(f"`modules` (={self.modules!r}) must be some of {list(MODULES)}")
        object.__setattr__(self, "modules", tuple(self.modules))

    @property
    def profile(self) -> CameraProfile:
        """The camera."""
        assert isinstance(self.camera, CameraProfile)
        return self.camera

    def draw(self, seed: int) -> DrawnSettings:
        """The settings of a picture with this seed, those that `modules` leaves out included."""
        rng = np.random.default_rng([int(seed), 0xA06])
        low, high = (math.log2(iso) for iso in self.isos)
        return DrawnSettings(
            stops=rng.uniform(*self.stops),
            iso=2.0 ** rng.uniform(low, high),
            defocus=rng.uniform(*self.defocus),
            motion=rng.uniform(*self.motion),
            direction=rng.uniform(0.0, math.pi),
            highlights=rng.uniform(*self.highlights),
        )

    def __call__(
        self,
        images: torch.Tensor,
        seeds: Sequence[int] | np.ndarray | torch.Tensor | torch.Generator,
        *,
        nlf: NoiseLevelFunction | None = None,
    ) -> torch.Tensor:
        """The same pictures, photographed again. No gradient flows through it.

        Args:
            images: (B, 3, H, W) sRGB pictures, floating point in [0, 1] or uint8, taken for
                `develop`'s; or (B, 4, H, W) floating point, packed raws, 1.0 at sensor white. On
                any device; the steps run there.
            seeds: (B,) integers >= 0, one for each picture (`sample_seeds`), or a generator on the
                CPU that draws them.
            nlf: Noise that raws have already: only what is missing is added. None stands for none.

        Returns:
            Tensor of the shape and on the device of `images`, float32: pictures in [0, 1], raws
            in whole digital numbers from minus the pedestal to 1. Without modules, `images`.
        """
        images = _check_images(images)
        words = _check_seeds(seeds, len(images))
        check_type("nlf", nlf, NoiseLevelFunction, None)
        if not self.modules:
            return images
        source = NoiseLevelFunction.zero() if nlf is None else nlf
        out = torch.empty(images.shape, device=images.device)
        for image, seed, frame in zip(images.detach(), words, out, strict=True):
            drawn = self.draw(seed)
            if len(image) == 4:
                frame.copy_(self._raw(image.float(), seed, drawn, source))
                continue
            light = _in_pieces(lambda piece: develop_inverse(piece[None])[0], image)
            if "exposure" in self.modules:  # at white raised, fading in from just below it
                peak = image.amax(dim=0).float() / (1.0 if image.is_floating_point() else 255.0)
                blown = ((peak - _CLIPPED) / (1.0 - _CLIPPED)).clamp_(0.0, 1.0)
                light = light * (1.0 + blown.square_() * (2.0**drawn.highlights - 1.0))
            raw = self._raw(light, seed, drawn, source)
            frame.copy_(_in_pieces(lambda piece: develop(piece[None])[0], raw))
        return out

    def _raw(
        self, light: torch.Tensor, seed: int, drawn: DrawnSettings, source: NoiseLevelFunction
    ) -> torch.Tensor:
        """(4, H, W) as the camera records `light`.

        The capture takes 1 s at f/4 and at the drawn ISO; the exposure of the picture that it is
        made of is as much less or more as the drawn stops say.
        """
        stops = drawn.stops if "exposure" in self.modules else 0.0
        blurs = "blur" in self.modules
        settings = CameraSettings(drawn.iso, _TIME, _F_NUMBER)
        prepared = PreparedScene(
            light=light,
            reference=CameraSettings(drawn.iso, _TIME * 2.0**-stops, _F_NUMBER),
            camera=self.profile,
            nlf=source,
            image_speed=drawn.motion / (_TIME * light.shape[-2]) if blurs else 0.0,
            defocus=drawn.defocus if blurs else 0.0,
            movement=Movement(drawn.direction),
            tolerance=0.0,
        )
        if "noise" in self.modules:
            return prepared.expose([settings], seed=seed)[0]
        return clip_and_quantise(prepared.expected(settings), self.profile)


def _in_pieces(
    function: Callable[[torch.Tensor], torch.Tensor], image: torch.Tensor
) -> torch.Tensor:
    """A function of single pixels of (C, H, W), some rows at a time."""
    pieces = torch.split(image, max(1, _PIECE // (4 * image.shape[-1])), dim=1)
    return torch.cat([function(piece.contiguous()) for piece in pieces], dim=1)


def sample_seeds(seed: int, epoch: int, indices: Sequence[int] | torch.Tensor) -> list[int]:
    """Seeds of the samples `indices` of an epoch, for a batch that is augmented once collated.

    Each is a function of its index, of the training's `seed` and of the `epoch`, all >= 0.
    """
    given = indices.tolist() if isinstance(indices, torch.Tensor) else indices
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise ValueError(f"`indices` (={indices!r}) must be integers, one for each sample")
    words = _check_seed("seed", seed), _check_seed("epoch", epoch)
    sequences = [np.random.SeedSequence([*words, _check_seed("indices", i)]) for i in given]
    return [int(s.generate_state(1, np.uint64)[0] >> np.uint64(1)) for s in sequences]


class AugmentedDataset(Dataset[Any]):
    """A data set whose pictures are augmented where they are loaded, in the workers.

    Neither the order of the samples nor the number of workers matters. `dataset` is a map-style one
    of pictures (C, H, W) that `augmentation` takes, or of tuples and lists that begin with one;
    `seed` is that of the training, >= 0.
    """

    def __init__(
        self, dataset: Dataset[Any], augmentation: ExposureAugmentation, *, seed: int = 0
    ) -> None:
        check_type("augmentation", augmentation, ExposureAugmentation)
        self.dataset, self.augmentation = dataset, augmentation
        self.seed = _check_seed("seed", seed)
        # Shared memory: workers that persist see it change.
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()  # type: ignore[no-untyped-call]

    @property
    def epoch(self) -> int:
        """Number of the epoch."""
        return int(self._epoch)

    def set_epoch(self, epoch: int) -> None:
        """Begins an epoch; call it before the loader is iterated, as that of a sampler."""
        self._epoch.fill_(_check_seed("epoch", epoch))

    def __len__(self) -> int:
        return len(self.dataset)  # type: ignore[arg-type]

    def __getitem__(self, index: int) -> Any:
        """Sample `index`, its picture augmented; a negative one counts from the end."""
        number = operator.index(index)  # also of a tensor
        number += len(self) if number < 0 else 0
        if number < 0:
            raise IndexError(f"`index` (={index}) must be in [-{len(self)}, {len(self) - 1}]")
        sample = self.dataset[number]
        image, *rest = sample if isinstance(sample, tuple | list) and sample else [sample]
        if not isinstance(image, torch.Tensor) or image.ndim != 3:
            rule = "must hold tensors (C, H, W), or tuples that begin with one"
            raise ValueError(f"`dataset` ({type(image).__name__} at {number}) {rule}")
        (augmented,) = self.augmentation(image[None], sample_seeds(self.seed, self.epoch, [number]))
        if sample is image:
            return augmented
        named = hasattr(sample, "_fields")  # a named tuple
        return type(sample)(*(augmented, *rest)) if named else type(sample)((augmented, *rest))


# -- checks ---------------------------------------------------------------------------------------

_check_seed = functools.partial(check_integer, low=0, high=2**63 - 1)


def _check_range(name: str, given: Any, low: float, high: float) -> tuple[float, float]:
    try:
        first, last = (math.nan if isinstance(v, bool) else float(v) for v in given)
    except (TypeError, ValueError, OverflowError):
        first = last = math.nan
    if not low <= first <= last <= high:
        raise ValueError(
            f"`{name}` (={given!r}) must be two numbers in [{low:g}, {high:g}], the lower one first"
        )
    return first, last


def _check_images(images: Any) -> torch.Tensor:
    check_type("images", images, torch.Tensor)
    shape, dense = tuple(images.shape), images.layout == torch.strided and not images.is_complex()
    if len(shape) != 4 or shape[1] not in (3, 4) or min(shape[2:]) < 1 or not dense:
        rule = "must be (B, 3, H, W) of pictures or (B, 4, H, W) of packed raws, dense and real"
        raise ValueError(f"`images` (shape {shape}, {images.layout}, {images.dtype}) {rule}")
    if shape[1] == 4 and len(images):
        return check_packed("images", images, ndim=4)
    if images.dtype == torch.uint8 or not len(images):
        return images
    low, high = torch.aminmax(images)
    if not images.is_floating_point() or not (low >= 0.0 and high <= 1.0):  # also refuses NaN
        found = f"{images.dtype}, {low.item():g} to {high.item():g}"
        raise ValueError(f"`images` ({found}) must be floating point in [0, 1], or uint8")
    return images


def _check_seeds(seeds: Any, count: int) -> list[int]:
    if isinstance(seeds, torch.Generator):
        return torch.randint(2**62, (count,), generator=seeds).tolist()
    given = seeds.tolist() if isinstance(seeds, torch.Tensor | np.ndarray) else seeds
    if isinstance(given, str | Real) or not isinstance(given, Sequence) or len(given) != count:
        raise ValueError(f"`seeds` (={seeds!r}) must be {count} integers, one for each picture")
    return [_check_seed("seeds", value) for value in given]
