"""Images handed to kernels by their address: a batch need not lie in one piece of memory."""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np
import torch
from numba import types


def addresses(images: Sequence[torch.Tensor | None]) -> np.ndarray:
    """(B,) uintp addresses of contiguous float32 images, 0 for None.

    To be taken anew for each call: sharing a tensor with another process moves its memory.
    """
    return np.array([0 if i is None else i.data_ptr() for i in images], np.uintp)


@numba.extending.intrinsic
def as_pointer(typing, address):  # type: ignore[no-untyped-def]
    """An address as a pointer to float32."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

    return types.CPointer(types.float32)(types.uintp), generate
