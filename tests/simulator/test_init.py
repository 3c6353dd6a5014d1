"""The public names of the package."""

import subprocess
import sys

import pytest

import simulator


def test_public_names_are_all_there_is_and_load_when_used() -> None:
    assert dir(simulator) == sorted(simulator.__all__)
    for name in simulator.__all__:
        assert getattr(simulator, name).__name__ == name
    listed = [name for names in simulator._MODULES.values() for name in names]
    assert sorted(listed) == simulator.__all__
    with pytest.raises(AttributeError, match="module 'simulator' has no attribute 'Raw'"):
        simulator.Raw  # noqa: B018
    program = (
        "import sys, simulator; assert not {'torch', 'numpy'} & set(sys.modules); "
        "import ae_env; assert not {'torch', 'numba'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
