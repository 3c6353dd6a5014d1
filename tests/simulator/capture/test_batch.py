"""Plans and blurred light that are kept between frames."""

from __future__ import annotations

import pickle

import numpy as np

from simulator.capture.batch import _Buffers, _Rows


def test_forgetting_a_scene_leaves_the_others() -> None:
    plans = _Rows(3, 4)
    plans.gain[:] = 1.0
    plans.light[:] = "light"
    plans.forget(1)
    assert (plans.gain == 1.0).tolist() == [True] * 4 + [False] * 4 + [True] * 4
    assert plans.light[4:8].tolist() == [None] * 4
    assert plans.light[8] == "light"


def test_nothing_is_known_at_first_or_in_a_pickled_copy() -> None:
    plans, buffers = _Rows(2, 3), _Buffers((1, 2))
    plans.gain[:] = 1.0
    buffers.give_back(buffers.take())
    for empty in (_Rows(2, 3), pickle.loads(pickle.dumps(plans))):
        assert np.isnan(empty.gain).all()
        assert len(empty.gain) == 6
    assert pickle.loads(pickle.dumps(buffers)).take().shape == (1, 2)


def test_an_image_that_was_given_back_is_taken_again() -> None:
    buffers = _Buffers((4, 2, 2))
    first, second = buffers.take(), buffers.take()
    assert first.data_ptr() != second.data_ptr()
    buffers.give_back(second)
    assert buffers.take() is second
