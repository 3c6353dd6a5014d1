"""Trained modules on disk: safetensors for the numbers, JSON for the model card; no pickle."""

import hashlib
import json
import reprlib
from collections.abc import Callable, Mapping
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any, get_args

import torch
from safetensors.torch import load, save
from torch import Tensor, nn

from simulator.capture.statistics import Residual
from simulator.networks.aperture_module import ApertureModule, AperturePreset
from simulator.networks.exposure_module import ExposureModule
from simulator.networks.noise_module import NoiseModule, Preset
from simulator.utils.cache import DAMAGE, safetensors_header
from simulator.utils.checks import check_type, check_word, did_you_mean
from simulator.utils.files import read_bounded, sibling, write_atomically


def _untrained(preset: Any) -> nn.ModuleDict:
    if preset not in get_args(AperturePreset):
        return nn.ModuleDict({"noise": NoiseModule(preset)})
    aperture = ApertureModule(preset)
    both = {"exposure": ExposureModule(), "noise": NoiseModule(preset)}
    return nn.ModuleDict({**both, "aperture": aperture})


#: What makes the untrained modules of a preset, by stage: the simulator's networks in three sizes,
#: the paper's, and those of its authors' released code. `benchmarks.paper_baselines` adds the
#: paper's two baselines.
BUILDERS: dict[str, Callable[[], nn.ModuleDict]] = {
    preset: partial(_untrained, preset) for preset in get_args(Preset)
}
#: Increased when the networks change such that older weights no longer fit.
FORMAT_VERSION = 2
#: Types that weights may have, but for the integers in which batch normalisation counts.
_FLOATS, _COUNTER = ("F64", "F32", "F16", "BF16"), "num_batches_tracked"
#: Most bytes of the header of a weights file, and most tensors that a message names.
_MOST_HEADER, _MOST_NAMED = 2**20, 8


def build_modules(preset: str) -> nn.ModuleDict:
    """The untrained modules of a preset, by stage."""
    if preset in ("pc", "dl") and preset not in BUILDERS:
        raise ValueError(f"`preset` (={preset!r}) is made in a clone only{_hint(preset, [])}")
    check_word("preset", preset, tuple(BUILDERS))
    return BUILDERS[preset]()


def list_pretrained() -> list[str]:
    """Names of the weights that come with the package."""
    folder = resources.files("simulator").joinpath("pretrained")
    names = [file.name for file in folder.iterdir()] if folder.is_dir() else []
    return sorted(name.removesuffix(".json") for name in names if name.endswith(".json"))


def save_modules(path: Path, modules: nn.Module, preset: str, card: dict[str, Any]) -> None:
    """Writes ``path.safetensors`` and ``path.json``, the card with the hash of the weights.

    The `modules` are what `build_modules` makes of `preset`; the entries of `card`, JSON values,
    say how they were trained and what they score. A `ValueError` if the weights are not finite;
    nothing is written then.
    """
    head = {"format": FORMAT_VERSION, "preset": preset}
    head["parameters"] = sum(p.numel() for p in modules.parameters())
    write_pair(path, modules.state_dict(), {**head, **card})


def write_pair(path: Path, tensors: Mapping[str, Tensor], card: Mapping[str, Any]) -> None:
    """Writes the card, then the weights whose hash it gets; `read_pair` reads them in reverse.

    Whatever other processes write in between, weights never come with an older card.
    """
    check_finite(tensors)
    content = save({name: value.detach().cpu().contiguous() for name, value in tensors.items()})
    card = {**card, "sha256": hashlib.sha256(content).hexdigest()}
    write_atomically(sibling(path, ".json"), json.dumps(card, indent=1) + "\n")
    write_atomically(sibling(path, ".safetensors"), content)


def read_pair(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and the card that `write_pair` wrote; a card without a hash is not compared.

    A `ValueError` if a file cannot be read or is damaged, the card is no JSON object, or its hash
    is not that of the weights.
    """
    card_file, file = sibling(path, ".json"), sibling(path, ".safetensors")
    given = f"`weights` (={str(path)!r})"
    try:
        content, text = read_bounded(file, 2**30), read_bounded(card_file)
    except OSError as error:
        raise ValueError(f"{given} cannot be read: {error}") from error
    try:
        card = json.loads(text)
        if not isinstance(card, dict):
            raise ValueError("it must hold a JSON object")
    except (ValueError, RecursionError) as error:
        damage = f"{card_file.name} is damaged: {error}; train them again"
        raise ValueError(f"{given}: {damage}") from error
    digest = hashlib.sha256(content).hexdigest()
    if card.get("sha256", digest) != digest:
        raise ValueError(
            f"{given}: the hash of {file.name} (={digest[:12]}...) must be that in "
            f"{card_file.name} (={str(card['sha256'])[:12]}...): one of them is damaged or of "
            "another training, or being written at this moment; train or copy both again"
        )
    try:
        tensors = read_weights(content)
    except ValueError as error:
        damage = f"{file.name} cannot be read: {error}; train them again"
        raise ValueError(f"{given}: {damage}") from error
    return tensors, card


def read_weights(content: bytes) -> dict[str, Tensor]:
    """The tensors of a safetensors file; a `ValueError` unless they are finite floating-point."""
    try:
        header = safetensors_header(content, _MOST_HEADER)
        header.pop("__metadata__", None)
        for name, kind in ((name, entry["dtype"]) for name, entry in header.items()):
            if kind not in _FLOATS and not (kind == "I64" and name.endswith(_COUNTER)):
                raise ValueError(f"{reprlib.repr(name)} is not of {', '.join(_FLOATS)}")
        tensors = load(content)
    except DAMAGE as error:
        raise ValueError(" ".join(str(error)[:200].split())) from error
    check_finite(tensors)
    return tensors


def load_into(module: nn.Module, tensors: Mapping[str, Tensor], given: str) -> None:
    """Gives `module`, which may be on the meta device, its `tensors`.

    A `ValueError`, which begins with `given`, names the first that are missing or do not fit.
    """
    own = module.state_dict()
    faults = [f"{n} is missing" for n in own if n not in tensors and not n.endswith(_COUNTER)]
    faults += [f"{reprlib.repr(n)} is none of its tensors" for n in tensors if n not in own]
    for name in (n for n in own if n in tensors and tensors[n].shape != own[n].shape):
        faults.append(f"{name} has shape {[*tensors[name].shape]}, not {[*own[name].shape]}")
    if faults:
        more = f" (and {len(faults) - _MOST_NAMED} more)" if len(faults) > _MOST_NAMED else ""
        raise ValueError(f"{given} do not fit the network: {'; '.join(faults[:_MOST_NAMED])}{more}")
    missing = {n: value for n, value in own.items() if n not in tensors}
    module.load_state_dict({**missing, **tensors}, assign=any(v.is_meta for v in own.values()))


def check_finite(tensors: Mapping[str, Tensor]) -> None:
    """Raises a `ValueError` that names the first of `tensors` that holds a NaN or an infinity."""
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            rule = "must be finite; a training that diverged needs a lower learning_rate"
            raise ValueError(f"weights, of {reprlib.repr(name)}, {rule}")


def load_modules(name: str | Path) -> tuple[nn.ModuleDict, dict[str, Any]]:
    """Trained modules, in evaluation mode, and their model card.

    `name` is one of `list_pretrained()`, or the path of a ``.safetensors`` file with its ``.json``.
    A `ValueError` if there is no such file, its hash is not the card's, or its tensors are not
    those of the preset's networks.
    """
    check_type("weights", name, str, Path)
    known = list_pretrained()
    path: Any = name
    if str(name) in known:
        path = resources.files("simulator").joinpath("pretrained", str(name))
    else:
        for file in (sibling(name, ".json"), sibling(name, ".safetensors")):
            if not file.is_file():
                raise ValueError(
                    f"`weights` (={str(name)!r}) must be one of {known} or the path of a "
                    f".safetensors file with its .json; there is no {file}{_hint(str(name), known)}"
                )
    tensors, card = read_pair(path)
    wanted: dict[str, list[Any]] = {"format": [FORMAT_VERSION], "preset": list(BUILDERS)}
    wrong = [entry for entry, values in wanted.items() if card.get(entry) not in values]
    wrong += [] if "sha256" in card else ["sha256"]
    if wrong:
        rule = f"the .json must be a model card of {wanted}, with the hash `sha256`"
        got = reprlib.repr(card.get("kind", card.get(wrong[0])))  # an agent's card has a kind
        raise ValueError(f"`weights` (={str(name)!r}): {rule}; got {got}")
    modules = build_modules(card["preset"])
    load_into(modules, tensors, f"`weights` (={str(name)!r})")
    if "noise" in modules and card.get("residual") is not None:
        modules["noise"].residual = Residual.from_card(card["residual"])  # type: ignore[assignment]
    modules.eval().requires_grad_(False)
    return modules.to(memory_format=torch.channels_last), card  # type: ignore[call-overload]


def _hint(name: str, known: list[str]) -> str:
    if name == "ncs":
        return "; examples/convert_ncs.py converts the authors' files"
    if name in BUILDERS or name in ("pc", "dl"):
        program = "ae-env" if name in BUILDERS else "python -m benchmarks.paper_baselines"
        return f"; train it: {program} train-simulator configs/simulator/{name}.yaml"
    return did_you_mean(name, known)
