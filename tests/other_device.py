"""A device that needs no hardware: what mixes it with the CPU fails, what is read is counted.

A tensor there holds one on the CPU, with which its operations are done.
"""

import functools
from collections import Counter

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

NAME = "privateuseone"  # as torch calls a device that is none of its own
#: Operations whose results the CPU needs, beside copies to it. Copies to the device do not count,
#: although CUDA may wait for those, too.
READS = ("_local_scalar_dense", "nonzero", "masked_select", "equal", "_unique2", "bincount")
_MAY_MIX = ("copy_", "_to_copy", "index", "index_put_", "_index_put_impl_")


class Held(torch.Tensor):
    """A tensor of the other device."""

    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, held):
        layout = {"strides": held.stride(), "storage_offset": held.storage_offset()}
        kind = {"dtype": held.dtype, "device": f"{NAME}:0"}
        return torch.Tensor._make_wrapper_subclass(cls, held.shape, **layout, **kind)

    def __init__(self, held):
        self.held = held

    @classmethod
    def __torch_dispatch__(cls, op, types, args=(), kwargs=None):
        raise AssertionError(f"{op} where there is no `OtherDevice`")


class OtherDevice(TorchDispatchMode):
    """While it is entered there is a device `NAME`; `reads` counts what the CPU reads back."""

    def __init__(self):
        super().__init__()
        self.reads, self._library = Counter(), _registered()

    def __torch_dispatch__(self, op, types, args=(), kwargs=None):
        name, kwargs = op.overloadpacket.__name__, dict(kwargs or {})
        given = [x for x in tree_leaves((args, kwargs)) if torch.is_tensor(x)]
        there = [x for x in given if isinstance(x, Held)]
        stays = bool(there)
        if (to := kwargs.get("device")) is not None:
            stays, kwargs["device"] = torch.device(to).type == NAME, torch.device("cpu")
        elif name == "copy_":
            stays = isinstance(args[0], Held)
        if there and name not in _MAY_MIX:
            mixed = [x for x in given if x.ndim and not isinstance(x, Held)]
            assert not mixed, f"{op} has tensors of both devices"
        if there and (name in READS or not stays):
            self.reads[name] += 1
        args, kwargs = tree_map(lambda x: x.held if isinstance(x, Held) else x, (args, kwargs))
        found, known = op(*args, **kwargs), {id(x.held): x for x in there}

        def put(x):
            return known[id(x)] if id(x) in known else Held(x) if torch.is_tensor(x) else x

        return tree_map(put, found) if stays else found


def _empty(size, stride, *, device, **kind):
    return Held(torch.empty_strided(size, stride, **kind))


def _copy(to, source, wait=True):
    to.held.copy_(source.held if isinstance(source, Held) else source)
    return to


@functools.cache
def _registered():
    """Makes torch know the device, which it does from then on: see `tests/on_other_device.py`."""
    backends = pytest.importorskip("torch.utils.backend_registration")
    if not hasattr(backends, "_setup_privateuseone_for_python_backend"):
        pytest.skip("this torch takes no device that is written in Python")
    backends._setup_privateuseone_for_python_backend()
    library = torch.library.Library("aten", "IMPL")  # for what torch itself calls beneath modes
    library.impl("empty_strided", _empty, "PrivateUse1")
    library.impl("copy_", _copy, "PrivateUse1")
    return library
