"""Results of networks, cached so that no network runs twice for one result."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from simulator.utils.cache import LruCache, cache_key, content_digest, disk_cache
from simulator.utils.checks import check_word
from simulator.utils.compute import release_memory

#: ``"memory"``, or ``"disk"``: both in memory and in files that later runs find.
Where = Literal["memory", "disk"]
#: Most bytes in memory; one 24-megapixel frame takes 96 million.
MEMORY_BYTES = 2**28


class NetworkCache:
    """Results by the content of everything that they depend on: inputs, numbers and weights.

    With `where` None nothing is cached; `max_bytes` bounds those in memory.
    """

    def __init__(self, where: Where | None, *, max_bytes: int = MEMORY_BYTES) -> None:
        check_word("cache", where, get_args(Where), None)
        self.where = where
        self.memory: LruCache[tuple[Tensor, int]] = LruCache(max_bytes)
        self._disk = disk_cache() if where == "disk" else None
        self._fingerprints: dict[int, tuple[list[Any], str]] = {}

    def result(
        self,
        kind: str,
        modules: Sequence[nn.Module],
        inputs: Mapping[str, Tensor | None],
        make: Callable[[], Tensor],
        *,
        shape: Sequence[int] | None = None,
        **numbers: Any,
    ) -> Tensor:
        """The result of `make`, or an earlier one of the same inputs: the same values, bit by bit.

        It depends on its `kind`, on the `modules` that `make` runs, whose weights may change in
        between, on the tensors `inputs` and the JSON values `numbers`. A stored result that is not
        finite, or not of `shape`, where that is known beforehand, is made again.
        """
        if self.where is None:
            return _made(make)
        given = {name: tensor for name, tensor in inputs.items() if tensor is not None}
        device = next(modules[0].parameters()).device
        description = {
            "weights": [self._fingerprint(module) for module in modules],
            "inputs": content_digest(given),
            "device": device.type,
            **numbers,
        }
        key = cache_key(kind, description)
        cached = self.memory.get(key)
        if cached is not None and cached[1] == _changes(cached[0]):
            return cached[0]
        tensor = self._stored(key, shape)
        if tensor is not None:
            tensor = tensor.to(device)
        else:
            tensor = _made(make).contiguous()  # as it comes from disk: later sums round alike
            if self._disk is not None:
                self._disk.put(key, {"result": tensor})
        self.memory.put(key, (tensor, _changes(tensor)), tensor.nbytes)
        return tensor

    def called(self, kind: str, module: nn.Module, *inputs: Tensor) -> Tensor:
        """``module(*inputs)``, of the shape of the first input; see `result`."""
        named = {str(i): tensor for i, tensor in enumerate(inputs)}
        return self.result(kind, [module], named, lambda: module(*inputs), shape=inputs[0].shape)

    def _stored(self, key: str, shape: Sequence[int] | None) -> Tensor | None:
        """A result from disk, if there is a plausible one."""
        stored = None if self._disk is None else self._disk.get(key)
        tensor = None if stored is None else stored.get("result")
        if tensor is None or (shape is not None and tensor.shape != tuple(shape)):
            return None
        return tensor if bool(tensor.isfinite().all()) else None

    def _fingerprint(self, module: nn.Module) -> str:
        """Digest of the module's weights, computed again only after one was changed in place."""
        tensors = [t.detach() for t in (*module.parameters(), *module.buffers())]
        # Fused optimisers change values without counting it, so the sums are compared, too.
        sums = torch.stack([tensor.sum(dtype=torch.float64) for tensor in tensors])
        marks = [*sums.tolist(), *((t.data_ptr(), _changes(t)) for t in tensors)]
        known = self._fingerprints.get(id(module))
        if known is None or known[0] != marks:
            known = self._fingerprints[id(module)] = marks, content_digest(module.state_dict())
        return known[1]


def _made(make: Callable[[], Tensor]) -> Tensor:
    """The result of networks, whose memory goes back to the system after a large frame."""
    tensor = make()
    release_memory(tensor.shape[-2:].numel())
    return tensor


def _changes(tensor: Tensor) -> int:
    """How often the tensor was changed in place, as far as torch counts it."""
    return 0 if torch.is_inference(tensor) else tensor._version
