"""Trained weights on disk, the released ones, and results that are found again."""

import copy
import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file, save
from torch import nn

import examples.convert_ncs as convert_ncs
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera
from simulator.networks import weights
from simulator.networks.network_cache import NetworkCache
from simulator.networks.noise_module import variance_map
from simulator.networks.unet import light_of_aperture
from simulator.networks.weights import build_modules, list_pretrained, load_modules, save_modules
from simulator.utils.cache import disk_cache
from tests.simulator.networks.released_modules import make_released


@pytest.fixture(scope="module")
def modules() -> nn.ModuleDict:
    torch.manual_seed(0)
    return build_modules("compact")


@pytest.fixture
def saved(modules: nn.ModuleDict, tmp_path: Path) -> Path:
    save_modules(tmp_path / "net-0.5", modules, "compact", {"note": "for a test"})
    return tmp_path / "net-0.5"


def beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)


def test_round_trip(saved: Path, modules: nn.ModuleDict) -> None:
    assert sorted(p.name for p in saved.parent.iterdir()) == ["net-0.5.json", "net-0.5.safetensors"]
    expected = modules.state_dict()
    for ending in ("", ".safetensors", ".json"):
        loaded, card = load_modules(beside(saved, ending))
        state = loaded.state_dict()
        assert list(state) == list(expected)
        assert all(torch.equal(value, expected[name]) for name, value in state.items())
        assert not loaded.training
        assert not any(p.requires_grad for p in loaded.parameters())
        assert (card["preset"], card["note"]) == ("compact", "for a test")
        assert card["parameters"] == sum(p.numel() for p in modules.parameters())


@pytest.mark.parametrize("position", [20, -1])
def test_one_changed_byte_is_noticed(saved: Path, position: int) -> None:
    file = beside(saved, ".safetensors")
    content = bytearray(file.read_bytes())
    digest = json.loads(beside(saved, ".json").read_text())["sha256"]
    assert digest == hashlib.sha256(content).hexdigest()
    content[position] ^= 1
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"the hash of net-0.5.safetensors .* train or copy"):
        load_modules(saved)


@pytest.mark.parametrize(
    ("card", "message"),
    [
        *(("{", "is damaged"), ("[" * 10**6, "net-0.5.json is damaged")),
        ("[]", "must hold a JSON object"),
        ('{"format": [1]}', r"model card of .*2.*got \[1\]"),
        ({"format": 1, "kind": "ppo"}, "model card of .* got 'ppo'"),
        ({"residual": {n: [10**400] for n in ("wiener_error", "bias", "variance")}}, "`residual`"),
        *(({"preset": p}, re.escape(f"got {p!r}")) for p in ("huge", None, ["compact"])),
    ],
)
def test_damaged_cards(saved, card, message):
    path = beside(saved, ".json")
    if not isinstance(card, str):
        card = json.dumps({**json.loads(path.read_text()), **card})
    path.write_text(card)
    with pytest.raises(ValueError, match=message):
        load_modules(saved)


def test_tensors_that_do_not_fit(saved: Path) -> None:
    file, card = beside(saved, ".safetensors"), beside(saved, ".json")
    good, known = load_file(file), json.loads(card.read_text())
    changes = [("exposure.surplus", torch.zeros(1)), ("exposure.b", torch.full((4,), torch.nan))]
    changes += [(name, torch.zeros(3)) for name in ("exposure.b", "noise.network.tail.bias")]
    kinds = (torch.float8_e5m2, torch.complex64, torch.bool, torch.int64)
    changes += [("exposure.b", torch.zeros(4).to(kind)) for kind in kinds]
    lacking = {name: value for name, value in good.items() if name != "exposure.b"}
    many = {f"tensor {i}": torch.zeros(1) for i in range(999)}
    contents = [save(v) for v in (lacking, many, *(good | {n: v} for n, v in changes))]
    for shape in ([1] * 70000, [0, 2**62, 2**62], 4, None):  # torch takes 46 s for the first
        end = 0 if shape == [0, 2**62, 2**62] else 4
        entry = {"dtype": "F32", "shape": shape, "data_offsets": [0, end]}
        header = json.dumps({"exposure.b": entry}).encode()
        contents.append(len(header).to_bytes(8, "little") + header + bytes(4))
    for content in (*contents, (2**40).to_bytes(8, "little"), b"[]"):
        file.write_bytes(content)
        card.write_text(json.dumps(known | {"sha256": hashlib.sha256(content).hexdigest()}))
        with pytest.raises(ValueError, match=r"^`weights`.{,999}\Z"):  # one line
            load_modules(saved)


@pytest.mark.parametrize("ending", [".json", ".safetensors"])
def test_files_that_are_not_there_or_cannot_be_read(saved: Path, ending: str) -> None:
    file = beside(saved, ending)
    file.unlink()
    with pytest.raises(ValueError, match=re.escape(f"there is no {file}")):
        load_modules(saved)
    file.mkdir()  # a file that cannot be read
    with pytest.raises(ValueError, match=r"net-0.5'\) cannot be read: .*Is a directory"):
        weights.read_pair(saved)
    file.rmdir()
    file.symlink_to("/dev/zero")
    with pytest.raises(ValueError, match=r"cannot be read: .* no ordinary file"):
        weights.read_pair(saved)


def test_shipped_weights_load_by_name(saved, monkeypatch, tmp_path_factory):
    """From a package that ships two sizes, in a folder without any; one with its known errors."""
    root = tmp_path_factory.mktemp("package")
    (root / "pretrained").mkdir()
    for ending in (".json", ".safetensors"):
        beside(saved, ending).rename(root / "pretrained" / f"compact{ending}")
    tables = {"wiener_error": [0.0, 1.0], "bias": [0.2, 0.1], "variance": [0.0, 0.3]}
    residual = tables | {"spread": 1.5}
    save_modules(root / "pretrained/nano", build_modules("nano"), "nano", {"residual": residual})
    monkeypatch.setattr(weights, "resources", SimpleNamespace(files=lambda _: root))
    monkeypatch.chdir(saved.parent)
    assert list_pretrained() == ["compact", "nano"]
    simulators = [CameraSimulator.from_pretrained(n, device="cpu") for n in ("nano", "compact")]
    assert [[n.preset for n in s.noises] for s in simulators] == [["nano"], ["nano", "compact"]]
    for simulator in simulators:  # a noise module alone takes the aperture's of the compact set
        assert simulator.noise is simulator.noises[-1]
        assert simulator.aperture is not None
        nano = simulator.noises[0].residual
        assert nano.to_card() == residual
    assert simulators[1].noise.residual is None
    message = r"one of \['compact', 'nano'\] .* did you mean 'compact'\?"
    with pytest.raises(ValueError, match=message):
        load_modules("compcat")
    with pytest.raises(ValueError) as caught:
        load_modules("zzz")
    assert "did you mean" not in str(caught.value)
    with pytest.raises(ValueError, match=r"`preset` \(='compcat'\)"):
        build_modules("compcat")
    with pytest.raises(ValueError, match=r"train it: .*pc\.yaml"):
        load_modules("pc")


# -- results that are found again ------------------------------------------------------------------

CAMERA = get_camera("nikon_z6")
SOURCE = CameraSettings(6400, 1 / 1024, 8)


def counted(simulator: CameraSimulator) -> list[int]:
    """One entry for each run of a simulator's networks."""
    runs: list[int] = []
    networks = simulator.noise.network.tail, simulator.aperture.network

    for network in networks:
        network.register_forward_hook(lambda *_: runs.append(1))
    return runs


def _raw() -> RawImage:
    light = 0.1 + 0.2 * torch.rand(4, 24, 28, generator=torch.Generator().manual_seed(0))
    return RawImage(light, SOURCE, CAMERA)


def _simulator(**options):
    torch.manual_seed(0)
    made = CameraSimulator("nano", device="cpu", **options)
    torch.nn.init.normal_(made.noise.network.tail.weight)
    return made


def _denoised(simulator, source):
    (found,) = simulator.prepare(source).denoised_lights
    return found.light


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("depth", ["far", "unknown"])
def test_what_is_found_again_is_the_same_bit_by_bit(folder, depth):
    raw = _raw()
    made = _simulator(cache=None).prepare(raw, depth=depth)
    keeper, later = _simulator(cache="disk"), _simulator(cache="disk")
    found = [keeper.prepare(raw, depth=depth) for _ in range(2)]
    runs = counted(later)
    found.append(later.prepare(raw, depth=depth))
    assert not runs
    for prepared in found:
        light, expected = prepared.denoised_lights[0].light, made.denoised_lights[0].light
        assert torch.equal(light, expected)
        assert light.stride() == expected.stride()
        if depth == "unknown":
            assert torch.equal(prepared.aperture_blur.diameter, made.aperture_blur.diameter)


def test_without_a_cache_the_networks_run_every_time(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"`cache` \(='ram'\) must be one of None"):
        _simulator(cache="ram")
    _denoised(_simulator(), _raw())  # in memory only
    simulator = _simulator(cache=None)
    runs = counted(simulator)
    _denoised(simulator, _raw())
    once = len(runs)
    _denoised(simulator, _raw())
    assert len(runs) == 2 * once > 0
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("where", ["memory", "disk"])
def test_everything_that_changes_the_result_is_seen(where, folder):
    simulator, raw = _simulator(cache=where), _raw()
    runs = counted(simulator)
    brighter = raw.data.clone()
    brighter[3, 5, 7] += 1e-6
    sources = [raw, replace(raw, data=brighter), replace(raw, nlf=CAMERA.nlf(6400).scaled(2.0))]
    sources.append(replace(raw, data=raw.data.reshape(4, 28, 24)))
    for other, precision in [(source, "float32") for source in sources] + [(raw, "bfloat16")]:
        simulator.precision = precision
        before = len(runs)
        _denoised(simulator, other)
        assert len(runs) > before, other
    simulator.precision, before = "float32", len(runs)
    _denoised(simulator, replace(raw, data=raw.data.clone()))  # another object, the same content
    assert len(runs) == before


@pytest.mark.parametrize("change", ["counted", "uncounted", "module"])
def test_other_weights_are_seen(change: str) -> None:
    """In place, whether torch counts it or, as of a fused optimiser's step, does not."""
    simulator, raw = _simulator(), _raw()
    before = _denoised(simulator, raw)
    if change == "module":
        simulator.noises = (copy.deepcopy(simulator.noises[0]),)
    weights = next(simulator.noise.parameters())
    weights = weights.detach() if change == "counted" else weights.data
    weights.mul_(1.01)
    after = _denoised(simulator, raw)
    assert torch.equal(after, simulator.denoise(simulator.prepare(raw)))
    assert not torch.equal(after, before)


@pytest.mark.parametrize("wrong", [torch.zeros(4, 3), torch.full((1, 2, 3), torch.nan)])
def test_an_implausible_result_on_disk_is_made_again(wrong: torch.Tensor, folder: Path) -> None:
    module, image = nn.Identity(), torch.ones(1, 2, 3)
    module.weight = nn.Parameter(torch.ones(1))
    cache = NetworkCache("disk")
    assert torch.equal(cache.called("opened", module, image), image)
    (file,) = (folder / "opened").iterdir()
    disk_cache().put(f"opened/{file.stem}", {"result": wrong})
    assert torch.equal(NetworkCache("disk").called("opened", module, image), image)


# -- weights that the authors of the paper released ------------------------------------------------

#: Planes R, G1, G2, B as R, G1, B, G2, and back.
SWAP = [0, 1, 3, 2]


@pytest.fixture(scope="module")
def released() -> dict[str, nn.Module]:
    return make_released()


@pytest.fixture(scope="module")
def converted(released: dict[str, nn.Module], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `examples/convert_ncs.py` makes of the authors' checkpoints."""
    folder = tmp_path_factory.mktemp("demo")
    for name, module in released.items():
        held = nn.DataParallel(module) if name == "unet_model" else module
        torch.save({"model": held, "iteration": 544000}, folder / name)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        convert_ncs.main()
    return folder / "ncs.safetensors"


def test_parameters_are_as_many_as_published(converted: Path) -> None:
    """Of the paper's denoiser: weights 9 * in * out and biases of 19 convolutions."""
    ncs, _ = load_modules(converted)
    for modules, wanted in (
        (ncs, {"exposure": 5, "noise": 13_398_404, "aperture": 8_852_224}),
        (build_modules("paper"), {"exposure": 5, "noise": 7_849_220, "aperture": 8_784_324}),
    ):
        assert {k: sum(p.numel() for p in m.parameters()) for k, m in modules.items()} == wanted
    assert float(ncs["exposure"].w) == pytest.approx(0.97)
    assert ncs["exposure"].b.tolist() == pytest.approx([0.001, 0.002, 0.004, 0.003])


def close(ours, theirs, tolerance=1e-5):
    assert float(theirs.std()) > 1e-3
    torch.testing.assert_close(ours, theirs, rtol=0, atol=tolerance * float(theirs.abs().max()))


@torch.no_grad()
def test_the_full_run_is_that_of_the_released_demo(converted: Path, released) -> None:
    """Every stage by the formulas of their demo, of the sample of noise that ours draws."""
    options = {"device": "cpu", "body_correction": True, "cache": None}
    simulator = CameraSimulator.from_pretrained(converted, **options)
    camera = get_camera("nikon_z6")
    data = 0.05 + 0.1 * torch.rand(4, 32, 32, generator=torch.Generator().manual_seed(0))
    raw = RawImage(data, CameraSettings(400, 1 / 64, 11.0), camera)
    target = CameraSettings(100, 1 / 64, 4.0)
    stages = simulator.stages(raw, target, seed=3)
    shown = []
    network = simulator.noise.network
    with network.register_forward_hook(lambda _, inputs, __: shown.append(inputs[0])):
        simulator.stages(raw, target)
    ratio = 8.0 / 4.0  # three stops of aperture, two of ISO
    exp = released["exp_model"]
    scale = exp.linear.weight.item() * ratio
    exposed = ((data[SWAP] + exp.bias[:, None, None]) * scale).clamp(0.0, 1.0)
    close(stages.exposed, exposed[SWAP])
    nlf = raw.noise
    shot, read = (torch.tensor([v]) for v in (nlf.shot, nlf.read))
    variance = variance_map(stages.exposed[None], shot * scale, read * scale**2)
    standard = (shown[0][:, 4:] - stages.exposed) / variance.sqrt()
    assert float(standard.mean()) == pytest.approx(0.0, abs=0.05)
    assert float(standard.std()) == pytest.approx(1.0, abs=0.05)
    planes = [*SWAP, *(4 + p for p in SWAP)]
    denoised = exposed + released["unet_model"](shown[0][:, planes])[0]
    close(stages.denoised, denoised[SWAP])
    opened = denoised + released["ap_model"](denoised[None], torch.tensor([[4.0, 32.0]]))[0]
    close(stages.opened, opened[SWAP], 2e-4)  # rounding, as above


def test_apertures_are_those_of_the_released_table() -> None:
    """Marked f-numbers and what stands for them in the authors' table, thirds of stops included."""
    table = {22.0: 1, 20.0: 1.33333, 18.0: 1.666667, 16.0: 2, 14.0: 2.66667, 13.0: 3.33333}
    table |= {11.0: 4, 10.0: 5.33333, 9.0: 6.66667, 8.0: 8, 7.1: 10.66667, 6.3: 13.33333}
    table |= {5.6: 16, 5.0: 21.33333, 4.5: 26.66667, 4.0: 32, 2.8: 64, 2.0: 128, 1.4: 256}
    effective = [CameraSettings(100, 1.0, n).effective_f_number for n in table]
    found = light_of_aperture(torch.tensor(effective))
    assert found.tolist() == pytest.approx(list(table.values()), rel=1e-5)
