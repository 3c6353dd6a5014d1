import math
import pickle
from collections import namedtuple
from functools import partial
from multiprocessing.reduction import ForkingPickler

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, TensorDataset

from simulator import NoiseLevelFunction, get_camera
from simulator.augment import AugmentedDataset, ExposureAugmentation, sample_seeds
from simulator.raw.develop import GREY_CARD_SIGNAL

CAMERA = get_camera("nikon_z6")
NOTHING = {"stops": (0.0, 0.0), "defocus": (0.0, 0.0), "motion": (0.0, 0.0)}


def pictures(count: int = 4, size: int = 24, planes: int = 3) -> torch.Tensor:
    return torch.rand(count, planes, size, size, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("planes", [3, 4])
def test_a_seed_gives_the_same_picture_alone_in_a_batch_and_in_another_order(planes: int) -> None:
    augment, given = ExposureAugmentation(), pictures(planes=planes)
    together = augment(given, [3, 1, 4, 15])
    for index, seed in enumerate((3, 1, 4, 15)):
        alone = augment(given[index : index + 1], torch.tensor([seed]))
        assert torch.equal(alone[0], together[index])
    assert torch.equal(augment(given.flip(0), np.array([15, 4, 1, 3])).flip(0), together)
    assert not torch.equal(augment(given, [3, 1, 4, 16])[3], together[3])
    drawn = [augment(given, torch.Generator().manual_seed(n)) for n in (5, 5, 6)]
    assert [torch.equal(drawn[0], other) for other in drawn[1:]] == [True, False]
    seeds = {sample_seeds(s, e, [i])[0] for s in range(3) for e in range(3) for i in range(3)}
    assert len(seeds) == 27
    assert augment(torch.zeros(0, 3, 4, 4), []).shape == (0, 3, 4, 4)
    frozen = augment(given.requires_grad_(), [3, 1, 4, 15])
    assert torch.equal(frozen, together)
    assert not frozen.requires_grad
    # The number of threads does not matter.
    found = []
    for count in (1, 3):
        torch.set_num_threads(count)
        found.append(ExposureAugmentation()(pictures(1, 200, planes), [7]))
    assert torch.equal(*found)


def test_workers_give_the_pictures_of_this_process() -> None:
    """And persistent workers, forked or with imports of their own, see that an epoch has begun."""
    samples = TensorDataset(pictures(6), torch.arange(6))
    dataset = AugmentedDataset(samples, ExposureAugmentation(), seed=2)
    options = {"multiprocessing_context": "fork", "persistent_workers": True}
    loader, epochs = DataLoader(dataset, batch_size=3, num_workers=2, **options), []
    for epoch in (0, 1):
        dataset.set_epoch(epoch)
        images, numbers = (torch.cat(parts) for parts in zip(*loader, strict=True))
        assert numbers.tolist() == list(range(6))
        here = ExposureAugmentation()(pictures(6), sample_seeds(2, epoch, numbers))
        assert torch.equal(images, here)
        epochs.append(images)
    assert not torch.equal(*epochs)
    sent = pickle.loads(ForkingPickler.dumps(dataset))  # as to a process that was not forked
    dataset.set_epoch(7)
    assert sent.epoch == 7


def test_samples_keep_what_they_hold_besides() -> None:
    labels = torch.arange(4)
    dataset = AugmentedDataset(TensorDataset(pictures(), labels), ExposureAugmentation())
    image, label = dataset[-1]
    assert (label, image.shape, len(dataset)) == (3, (3, 24, 24), 4)
    named = namedtuple("named", "image label")(pictures()[0], 7)
    assert AugmentedDataset([named], ExposureAugmentation())[0].label == 7
    alone = AugmentedDataset(pictures(), ExposureAugmentation())  # a tensor is a data set, too
    assert torch.equal(alone[3], image)
    assert torch.equal(alone[torch.tensor(3)], image)
    assert torch.equal(alone[-4], alone[0])
    with pytest.raises(IndexError, match="`index`"):
        alone[-5]


def test_nothing_asked_changes_nothing_and_highlights_above_white_stay_white() -> None:
    given = pictures()
    assert torch.equal(ExposureAugmentation(modules=())(given, range(4)), given)
    # Only the sensor's digital numbers are left, 1 / 15520 of white: at black, where the curves
    # are steepest, 12.92 * 1.618 of one.
    still = ExposureAugmentation(**NOTHING, highlights=(0.0, 0.0), modules=("exposure", "blur"))
    step = 0.5 / min(CAMERA.span)
    assert (still(given, range(4)) - given).abs().max() <= 12.92 * 1.618 * step + 1e-5
    white, darker = torch.ones(1, 3, 4, 4), {"stops": (-2.0, -2.0), "modules": ("exposure",)}
    raised = ExposureAugmentation(**darker, highlights=(2.0, 2.0))
    assert raised(white, [0]).min().item() == pytest.approx(1.0, abs=1e-6)
    grey = ExposureAugmentation(**darker, highlights=(0.0, 0.0))
    assert grey(white, [0]).max() < 0.8
    codes = torch.full((1, 3, 4, 4), 255, dtype=torch.uint8)
    assert torch.allclose(raised(codes, [0]), raised(white, [0]))


def test_raws_are_exposed_by_the_ratio_and_clipped_and_cards_two_stops_under() -> None:
    """The latter by hand: light, Schlick's curve p x / ((p - 1) x + 1), the sRGB curve."""
    given = torch.linspace(0.0, 1.0, 64).reshape(1, 1, 8, 8).expand(1, 4, 8, 8)
    for stops in (-3.0, 1.5):
        augment = ExposureAugmentation(stops=(stops, stops), modules=("exposure",))
        wanted = (given.double() * 2.0**stops).clamp(max=1.0)
        assert (augment(given, [0]) - wanted).abs().max() <= 0.51 / min(CAMERA.span)
    p = 0.18 * (1 - GREY_CARD_SIGNAL) / (GREY_CARD_SIGNAL * (1 - 0.18))

    def shown(light: float) -> float:
        return 1.055 * (p * light / ((p - 1) * light + 1)) ** (1 / 2.4) - 0.055

    augment = ExposureAugmentation(stops=(-2.0, -2.0), modules=("exposure",))
    card = torch.full((1, 3, 4, 4), shown(GREY_CARD_SIGNAL))
    wanted = shown(GREY_CARD_SIGNAL / 4)
    assert augment(card, [0]).mean().item() == pytest.approx(wanted, abs=4e-4)


@pytest.mark.parametrize("source", [None, NoiseLevelFunction((2e-5,) * 4, (1e-7,) * 4)])
def test_noise_has_the_variance_of_the_nlf(source: NoiseLevelFunction | None) -> None:
    """Of the target's ISO; a source's own noise, exposed, is taken away from it."""
    iso, stops, level = 3200.0, -1.0, 0.4
    augment = ExposureAugmentation(**NOTHING | {"stops": (stops, stops)}, isos=(iso, iso))
    flat = torch.full((1, 4, 256, 256), level)
    noisy = augment(flat, [1], nlf=source)[0]
    nlf, signal, ratio = CAMERA.nlf(iso), level * 2.0**stops, 2.0**stops
    for plane in range(4):
        wanted = nlf.read[plane] + nlf.shot[plane] * signal
        if source is not None:
            wanted -= ratio**2 * source.read[plane] + ratio * source.shot[plane] * signal
        found = noisy[plane].double()
        assert found.mean().item() == pytest.approx(signal, abs=5 * math.sqrt(wanted) / 256)
        # Standard error of a variance of 65536 normals: 0.55 %.
        assert found.var().item() == pytest.approx(wanted, rel=0.03)


def test_blur_keeps_light_and_has_the_moments_of_disc_and_streak() -> None:
    diameter, length = 6.0, 8.0
    ranges = {"defocus": (diameter, diameter), "motion": (length, length)}
    augment = ExposureAugmentation(**ranges, modules=("blur",))
    point = torch.zeros(1, 4, 33, 33)
    point[:, :, 16, 16] = 0.9
    spread = augment(point, [3])[0, 0].double()
    assert spread.sum().item() == pytest.approx(0.9, rel=0.02)
    y, x = (torch.arange(33.0).double() - 16.0 for _ in range(2))
    weights = spread / spread.sum()
    across = (weights.sum(0) * x**2).sum() + (weights.sum(1) * y**2).sum()
    # A disc of diameter d has d^2 / 16 along each axis, a streak of length l has l^2 / 12.
    assert across.item() == pytest.approx(2 * diameter**2 / 16 + length**2 / 12, rel=0.1)
    directions = {augment.draw(seed).direction for seed in range(20)}
    assert min(directions) < 1.0 < 2.0 < max(directions) <= math.pi


def test_settings_are_drawn_within_their_ranges_whatever_acts() -> None:
    full, exposure = ExposureAugmentation(), ExposureAugmentation(modules=("exposure",))
    drawn = np.array([full.draw(seed) for seed in range(200)])
    np.testing.assert_array_equal(drawn, [exposure.draw(seed) for seed in range(200)])
    drawn[:, 1] = np.log2(drawn[:, 1])
    ranges = [(-4.0, 4.0), np.log2([100.0, 12800.0]), (0.0, 2.0), (0.0, 3.0)]
    for values, (low, high) in zip(drawn.T, ranges, strict=False):
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < values.max() <= high


def test_bad_arguments():
    bad = {"stops": [(1.0, -1.0), (-1.0, math.nan), 2.0], "isos": [(0.0, 100.0)]}
    bad |= {"defocus": [(0.0, 65.0)], "motion": [(-1.0, 1.0)], "highlights": [("a", "b")]}
    bad |= {"modules": [("exposure", "colour"), "noise", None], "camera": ["nikon_z7"]}
    for name, value in ((n, v) for n, values in bad.items() for v in values):
        with pytest.raises(ValueError, match=f"`{name}`"):
            ExposureAugmentation(**{name: value})
    images = [torch.zeros(3, 4, 4), torch.zeros(1, 2, 4, 4)]
    images += [torch.full((1, 3, 4, 4), level) for level in (1.5, math.nan)]
    images += [torch.full((1, 4, 4, 4), math.inf), torch.zeros(1, 4, 4, 4, dtype=torch.uint8)]
    augment, right = ExposureAugmentation(), torch.zeros(1, 3, 4, 4)
    samples = np.zeros((3, 4, 4)), {"image": right[0]}, ()
    for call, arguments, name in (
        *((augment, (each, [0]), "images") for each in images),
        *((augment, (right, seeds), "seeds") for seeds in ([0, 1], [-1], [0.5], 3)),
        *((AugmentedDataset([sample], augment).__getitem__, (0,), "dataset") for sample in samples),
        (partial(AugmentedDataset, seed=-1), ([], augment), "seed"),
        (AugmentedDataset, ([], "x"), "augmentation"),
        *((sample_seeds, (0, -1, [0]), "epoch"), (sample_seeds, (0, 0, 5), "indices")),
    ):
        with pytest.raises(ValueError, match=f"`{name}`"):
            call(*arguments)
