"""Which errors a tolerance lets a transition keep, and how they add up."""

from __future__ import annotations

import math

import pytest

from simulator.capture.exposure import DEFAULT_TOLERANCE, Budget, check_tolerance


def test_the_default_is_a_tenth_of_the_noise() -> None:
    assert DEFAULT_TOLERANCE == 0.1


@pytest.mark.parametrize("value", [0, 0.0, 1e-9, 0.1, 3, 1e6])
def test_numbers_from_nought_are_tolerances(value: float) -> None:
    assert check_tolerance(value) == value
    assert isinstance(check_tolerance(value), float)


@pytest.mark.parametrize("value", [-1e-9, float("inf"), float("nan"), None, "0.1", True])
def test_anything_else_is_not(value: object) -> None:
    with pytest.raises(ValueError, match=r"`tolerance` \(=.*\) must be a finite number >= 0"):
        check_tolerance(value)  # type: ignore[arg-type]


def test_noise_and_blur_add_as_squares() -> None:
    """3, 4, 5: a blur of 0.4 fits beside noise of 0.3 within 0.5, and nothing more does."""
    budget = Budget(0.5)
    assert budget.leaves_out_noise_reduction(0.3)
    assert budget.leaves_out_blur("defocus", 0.4)
    assert not budget.leaves_out_blur("motion_blur", 1e-3)
    assert not Budget(0.4999).leaves_out_noise_reduction(0.5)


def test_blurs_add_up_in_the_mean() -> None:
    """0.3 and 0.4 shift a pixel by up to 0.7; the second is booked with sqrt(0.49 - 0.09)."""
    budget = Budget(0.7)
    assert budget.leaves_out_blur("aperture", 0.3)
    assert budget.leaves_out_blur("defocus", 0.4)
    assert budget.errors["defocus"] == pytest.approx(math.sqrt(0.4))
    assert math.hypot(*budget.errors.values()) == pytest.approx(0.7)
    assert not Budget(0.5).leaves_out_blur("aperture", 0.6)


def test_a_blur_that_runs_takes_nothing_of_the_tolerance() -> None:
    budget = Budget(0.2)
    assert not budget.leaves_out_blur("aperture", 5.0)
    assert budget.leaves_out_blur("defocus", 0.2)
    assert budget.errors == {"aperture": 5.0, "defocus": pytest.approx(0.2)}


def test_a_pointless_network_is_left_out_at_any_cost_but_leaves_nothing_over() -> None:
    budget = Budget(0.1)
    assert budget.leaves_out_noise_reduction(0.3, pointless=True)
    assert not budget.leaves_out_blur("motion_blur", 1e-6)


def test_tolerance_nought_leaves_nothing_out() -> None:
    budget = Budget(0.0)
    assert not budget.leaves_out_noise_reduction(0.0, pointless=True)
    assert not budget.leaves_out_blur("aperture", 0.0)
    assert not budget.leaves_out_blur("defocus", math.inf)
    assert budget.errors == {"noise_reduction": 0.0, "aperture": 0.0, "defocus": math.inf}
