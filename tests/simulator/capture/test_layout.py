"""Layouts: what they accept, their shares, and that of a known depth."""

import numpy as np
import pytest
import torch

from simulator.capture.prepared_scene import Layout
from simulator.optics.thin_lens import Lens


def _layout(size: int = 12) -> Layout:
    rng = np.random.default_rng(0)
    defocus = torch.from_numpy(rng.random((size, size)).astype(np.float32))
    return Layout(defocus, torch.from_numpy(rng.random((size, size)) < 0.3))


@pytest.mark.parametrize(
    ("defocus", "subject"),
    [
        (torch.zeros(3, 4, 4), None),
        (torch.full((4, 4), 1.5), None),
        (torch.full((4, 4), torch.nan), None),
        (torch.zeros(4, 4), torch.zeros(4, 4)),
        (torch.zeros(4, 4), torch.zeros(4, 5, dtype=torch.bool)),
    ],
)
def test_what_is_no_layout(defocus: torch.Tensor, subject: torch.Tensor | None) -> None:
    with pytest.raises(ValueError, match=r"`defocus`|`subject`"):
        Layout(defocus, subject)


@pytest.mark.parametrize("everywhere", [False, True])
def test_a_subject_that_is_nothing_or_everything_is_none(everywhere: bool) -> None:
    assert Layout(torch.zeros(4, 4), torch.full((4, 4), everywhere)).subject is None


def test_shares_are_means_over_pixels() -> None:
    layout = _layout()
    shares = layout.shares
    assert shares.share.sum() == pytest.approx(1.0)
    mean = (shares.share * shares.defocus).sum()
    assert mean == pytest.approx(float(layout.defocus.mean()), abs=2e-3)
    found = shares.share[shares.subject].sum()
    assert found == pytest.approx(float(layout.subject.double().mean()))


def test_behind_the_subject_is_the_nearest_background() -> None:
    layout = _layout()
    mask, behind = layout.subject.numpy(), layout.behind.numpy()
    y, x = np.nonzero(~mask)
    for row, column in zip(*np.nonzero(mask), strict=True):
        at = divmod(int(behind[row, column]), 12)
        nearest = np.hypot(y - row, x - column).min()
        assert not mask[at]
        assert np.hypot(at[0] - row, at[1] - column) == pytest.approx(nearest)
    assert (behind[~mask] == np.flatnonzero(~mask)).all()


def test_a_depth_gives_the_circles_of_a_thin_lens() -> None:
    depth = torch.rand(9, 9, generator=torch.Generator().manual_seed(0)) * 5.0 + 0.5
    circles = Lens(0.05, 1.7).circle_of_confusion(depth, 4.0).abs()
    layout = Layout.from_depth(depth, 1.7, in_focus=0.2)
    torch.testing.assert_close(layout.defocus, circles / circles.max(), rtol=1e-4, atol=1e-5)
    assert torch.equal(layout.subject, layout.defocus <= 0.2)


def test_averages_and_windows() -> None:
    layout = _layout()
    small = layout.cut(slice(0, 8), slice(2, 10)).averaged(4)
    tile = slice(4, 8), slice(2, 6)
    assert float(small.defocus[1, 0]) == pytest.approx(float(layout.defocus[tile].mean()))
    wanted = bool(layout.subject[tile].double().mean() > 0.5)
    assert (False if small.subject is None else bool(small.subject[1, 0])) == wanted


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: Layout([[0.0]]), "defocus"),
        (lambda: Layout(torch.zeros(2, 2), [[True]]), "subject"),
        (lambda: Layout.from_depth(torch.zeros(2, 2), 1.0, in_focus=0.1), "depth"),
        (lambda: Layout.from_depth(torch.ones(2, 2), 0.0, in_focus=0.1), "distance"),
        (lambda: Layout.from_depth(torch.ones(2, 2), 1.0, in_focus=5.0), "in_focus"),
    ],
)
def test_errors_name_the_argument(make, name: str) -> None:
    with pytest.raises(ValueError, match=f"`{name}`"):
        make()
