"""Networks on images they never saw: flat, tiny, black, blinding, at any exposure."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator

import torch
from torch import Tensor, nn

from benchmarks.stability.case import Row, time_ratio
from simulator.networks.noise_module import NoiseModule, smoothed, variance_map
from simulator.networks.paper_baselines import NUM_PARAMETERS
from simulator.networks.unet import instance_norm
from simulator.networks.weights import PRESETS, build_modules, load_modules
from simulator.training.data import Batch
from simulator.training.losses import ApertureLoss, BaselineLoss, ExposureLoss, NoiseLoss

GROUP = "networks"
EPS32 = 2.0**-24
_SIZES = ((1, 1), (1, 17), (17, 1), (2, 3), (16, 16), (33, 31))
#: Levels of flat images: black, negative, ordinary, saturated, blinding.
_LEVELS = (0.0, -0.07, 2.0**-14, 0.2, 1.0, 1e4)
_NOISE = 1e-4


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The cases of this group."""
    yield _flat_norm()
    for preset in PRESETS:
        yield from _anything(preset, range(seed, seed + (1 if quick else 8)))
    trained, _ = load_modules("compact")
    yield from _homogeneous(trained["noise"], seed)
    yield _reduced(trained["noise"], seed, 128 if quick else 256)
    for preset in PRESETS:
        yield _gradients(preset, seed)


def _flat_norm() -> Row:
    """A flat map, and a map of one pixel, becomes the shift: 0 / 0 in the formula."""
    worst, finite = 0.0, True
    for shape in ((1, 1), (1, 9), (8, 8)):
        for level in _LEVELS:
            x = torch.full((1, 3, *shape), level)
            scale, shift = torch.full((1, 3), 50.0), torch.tensor([[-1.0, 0.0, 2.0]])
            out = instance_norm(x, scale, shift)
            finite &= bool(torch.isfinite(out).all())
            worst = max(worst, float((out - shift[:, :, None, None]).abs().max()))
    return Row(GROUP, "instance norm of flat and 1 x 1 maps", worst, limit=0.0, finite=finite)


def _runs(modules: nn.ModuleDict) -> dict[str, Callable[[Tensor], Tensor]]:
    """What each network of a preset makes of an image."""

    def noise(image: Tensor) -> Tensor:
        variance = torch.full((len(image), 4), _NOISE)
        return modules["noise"](image, variance, variance * 0.01)

    def aperture(image: Tensor) -> Tensor:
        f_source, f_target = image.new_full((len(image),), 8.0), image.new_full((len(image),), 4.0)
        return modules["aperture"](image, torch.full_like(image, 0.01), f_source, f_target)

    def baseline(image: Tensor) -> Tensor:
        parameters = torch.tensor([0.0, -6.0, 2.0, 3.0, -9.0, 1.0]).expand(len(image), -1)
        return modules["baseline"](image, parameters)

    if "baseline" in modules:
        return {"baseline": baseline}
    return {"noise": noise, "aperture": aperture}


def _anything(preset: str, seeds: range) -> Iterator[Row]:
    """Random weights of the initialisation, every size and level: finite, and timed."""
    finite: dict[str, bool] = {}
    largest: dict[str, float] = {}
    times: dict[str, float] = {}
    with torch.inference_mode():
        for seed in seeds:
            torch.manual_seed(seed)
            modules = build_modules(preset).eval()
            for name, run in _runs(modules).items():
                for size in _SIZES:
                    images = torch.stack([torch.full((4, *size), level) for level in _LEVELS])
                    noisy = images + 0.05 * torch.randn(images.shape)
                    for batch in (images, noisy):
                        out = run(batch)
                        good = bool(torch.isfinite(out).all()) and out.shape == batch.shape
                        finite[name] = finite.get(name, True) and good
                        gain = float((out.abs().amax((1, 2, 3)) / _size(batch)).max())
                        largest[name] = max(largest.get(name, 0.0), gain)
                black, usual = torch.zeros(1, 4, 64, 64), torch.rand(1, 4, 64, 64)
                if name not in times:
                    times[name] = time_ratio(
                        lambda r=run, x=black: r(x), lambda r=run, x=usual: r(x), repeats=5
                    )
    for name in finite:
        yield Row(
            GROUP,
            f"{preset}: {name}, random weights, flat and noisy, 1 x 1 to 33 x 31",
            None,
            finite=finite[name],
            time_ratio=times[name],
            note=f"output at most {largest[name]:.3g} times the input",
        )


def _size(batch: Tensor) -> Tensor:
    return batch.abs().amax((1, 2, 3)).clamp(min=0.01)


def _homogeneous(noise: nn.Module, seed: int) -> Iterator[Row]:
    """Denoising commutes with exposure: against float64, from 2^-24 to 2^24."""
    assert isinstance(noise, NoiseModule)
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(1, 4, 32, 32, generator=generator)
    shot, read = torch.full((1, 4), 1e-3), torch.full((1, 4), 1e-5)
    image += 0.02 * torch.randn(image.shape, generator=generator)
    exact = copy.deepcopy(noise.network).double()
    with torch.inference_mode():
        deviation = variance_map(smoothed(image), shot, read).sqrt()
        wanted = exact(image.double(), deviation.double())
        for dtype in (torch.float32, torch.bfloat16):
            worst, finite = 0.0, True
            for stops in range(-24, 25):
                scale = 2.0**stops
                with torch.autocast("cpu", dtype=dtype, enabled=dtype != torch.float32):
                    out = noise(image * scale, shot * scale, read * scale * scale)
                finite &= bool(torch.isfinite(out).all())
                error = (out.double() / scale - wanted).abs().max() / wanted.abs().max()
                worst = max(worst, float(error))
            yield Row(
                GROUP,
                "compact: exposed by 2^-24 to 2^24, denoised, exposed back",
                worst,
                error="of the brightest",
                limit=1e-5 if dtype == torch.float32 else 0.03,
                dtype=str(dtype).removeprefix("torch."),
                finite=finite,
            )


def _reduced(noise: nn.Module, seed: int, size: int) -> Row:
    """What bfloat16 adds to the error, in units of the noise that is removed."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(1, 4, size, size, generator=generator) * 0.3
    shot, read = torch.full((1, 4), 2e-3), torch.full((1, 4), 2e-5)
    noisy = image + (image * 2e-3 + 2e-5).sqrt() * torch.randn(image.shape, generator=generator)
    with torch.inference_mode():
        full = noise(noisy, shot, read)

        def reduced() -> Tensor:
            with torch.autocast("cpu", dtype=torch.bfloat16):
                return noise(noisy, shot, read)

        difference = (reduced() - full).square().mean().sqrt()
        unit = (image * 2e-3 + 2e-5).mean().sqrt()
        return Row(
            GROUP,
            "compact: denoised in bfloat16 against float32",
            float(difference / unit),
            error="of the noise",
            limit=0.1,
            dtype="bfloat16",
            time_ratio=time_ratio(reduced, lambda: noise(noisy, shot, read), repeats=5),
            note="float16 is not offered: its variances would be subnormal",
        )


def _gradients(preset: str, seed: int) -> Row:
    """Training on black and on blown-out batches: losses and gradients stay finite."""
    torch.manual_seed(seed)
    modules = build_modules(preset).train()
    finite, largest = True, 0.0
    for level in (0.0, 1.0, 1e4):
        for noise in (0.0, _NOISE):
            batch = _batch(level, noise)
            for loss in _losses(modules):
                modules.zero_grad()
                values = loss(batch)
                finite &= bool(torch.isfinite(values["loss"]))
                if not values["loss"].requires_grad:
                    continue
                values["loss"].backward()
                for parameter in modules.parameters():
                    if parameter.grad is not None:
                        finite &= bool(torch.isfinite(parameter.grad).all())
                        largest = max(largest, float(parameter.grad.abs().max()))
    return Row(
        GROUP,
        f"{preset}: gradients on black, white and blinding batches",
        None,
        finite=finite,
        note=f"largest {largest:.2g}",
    )


def _losses(modules: nn.ModuleDict) -> list[nn.Module]:
    if "baseline" in modules:
        return [BaselineLoss(modules["baseline"])]
    exposure, noise, aperture = (modules[name] for name in ("exposure", "noise", "aperture"))
    return [
        ExposureLoss(exposure),  # type: ignore[arg-type]
        NoiseLoss(exposure, noise),  # type: ignore[arg-type]
        ApertureLoss(exposure, noise, aperture),  # type: ignore[arg-type]
    ]


def _batch(level: float, noise: float) -> Batch:
    image = torch.full((2, 4, 32, 32), level)
    variance = torch.full((2, 4), noise)
    return Batch(
        source=image,
        target=image.clamp(max=1.0),
        sample=image.clamp(max=1.0),
        ratio=torch.ones(2),
        shot=variance,
        read=variance * 0.01,
        f_source=torch.full((2,), 8.0),
        f_target=torch.full((2,), 4.0),
        parameters=torch.zeros(2, NUM_PARAMETERS),
        defocus=torch.zeros(2, 32, 32),
    )
