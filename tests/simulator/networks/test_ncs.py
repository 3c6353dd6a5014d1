"""The preset `ncs` against networks of the released layout, made here of plain torch layers."""

import copy
import hashlib
import json
import re
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from simulator import CameraSettings, CameraSimulator, RawImage, get_camera
from simulator.networks.noise_module import variance_map
from simulator.networks.unet import light_of_aperture
from simulator.networks.weights import load_modules
from tests.simulator.networks.released_modules import make_released

#: Planes R, G1, G2, B as R, G1, B, G2, and back.
SWAP = [0, 1, 3, 2]
F11, F4 = 2.0 ** (7 / 2), 4.0
DOCS = Path(__file__).parents[3] / "docs" / "networks.md"


@pytest.fixture(scope="module")
def released() -> dict[str, nn.Module]:
    return make_released()


@pytest.fixture(scope="module")
def weights(released: dict[str, nn.Module], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the script of docs/networks.md makes of the authors' checkpoints."""
    folder = tmp_path_factory.mktemp("demo")
    for name, module in released.items():
        held = nn.DataParallel(module) if name == "unet_model" else module
        torch.save({"model": held, "iteration": 544000}, folder / name)
    script = re.search(r"needs the authors' files -->\n```python\n(.*?)```", DOCS.read_text(), re.S)
    assert script is not None
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(script[1], {})
    return folder / "ncs.safetensors"


@pytest.fixture(scope="module")
def ncs(weights: Path) -> nn.ModuleDict:
    return load_modules(weights)[0]


def test_parameters_are_as_many_as_published(ncs: nn.ModuleDict, released) -> None:
    counts = {kind: sum(p.numel() for p in module.parameters()) for kind, module in ncs.items()}
    assert counts == {"exposure": 5, "noise": 13_398_404, "aperture": 8_852_224}
    assert float(ncs["exposure"].w) == pytest.approx(0.97)
    assert ncs["exposure"].b.tolist() == pytest.approx([0.001, 0.002, 0.004, 0.003])


def close(ours: Tensor, theirs: Tensor, tolerance: float = 1e-5) -> None:
    assert float(theirs.std()) > 1e-3
    torch.testing.assert_close(ours, theirs, rtol=0, atol=tolerance * float(theirs.abs().max()))


@torch.no_grad()
def test_networks_compute_what_the_released_ones_do(ncs: nn.ModuleDict, released) -> None:
    """In float64: in float32, the rounding alone grows to 4e-5 over eighteen normalisations."""
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(2, 8, 32, 48, generator=generator, dtype=torch.float64)
    planes = [*SWAP, *(4 + p for p in SWAP)]
    unet, ours = (copy.deepcopy(n).double() for n in (released["unet_model"], ncs["noise"].network))
    close(ours(image), unet(image[:, planes])[:, SWAP], 1e-9)
    apertures = torch.tensor([[4.0, 32.0], [1.0, 16.0]]).double()  # f/11 to f/4, f/22 to f/5.6
    f_numbers = torch.tensor([[F11, F4], [2.0**4.5, 2.0**2.5]], dtype=torch.float64)
    attention = copy.deepcopy(released["ap_model"]).double()
    ours = copy.deepcopy(ncs["aperture"].network).double()
    opened = attention(image[:, SWAP], apertures)[:, SWAP]
    close(ours(image[:, :4], f_numbers), opened, 1e-9)


@torch.no_grad()
def test_the_full_run_is_that_of_the_released_demo(weights: Path, released) -> None:
    """Every stage by the formulas of their demo, of the sample of noise that ours draws."""
    simulator = CameraSimulator.from_pretrained(
        weights, device="cpu", body_correction=True, cache=None
    )
    camera = get_camera("nikon_z6")
    data = 0.05 + 0.1 * torch.rand(4, 32, 32, generator=torch.Generator().manual_seed(0))
    raw = RawImage(data, CameraSettings(400, 1 / 64, 11.0), camera)
    target = CameraSettings(100, 1 / 64, 4.0)
    stages = simulator.stages(raw, target, seed=3)
    shown: list[Tensor] = []
    handle = simulator.noise.network.register_forward_hook(
        lambda _, inputs, __: shown.append(inputs[0])
    )
    simulator.stages(raw, target)
    handle.remove()
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


@pytest.mark.parametrize(
    ("name", "tensor"),
    [
        ("exposure.surplus", torch.zeros(1)),
        ("exposure.bias", None),
        ("exposure.bias", torch.zeros(3)),
        ("noise.outc.conv.bias", torch.zeros(3)),
        ("exposure.bias", torch.full((4,), torch.nan)),
    ],
)
def test_tensors_that_do_not_fit(weights: Path, tmp_path: Path, name: str, tensor) -> None:
    tensors = load_file(weights)
    tensors.pop(name, None)
    save_file(tensors | ({} if tensor is None else {name: tensor}), tmp_path / "a.safetensors")
    digest = hashlib.sha256((tmp_path / "a.safetensors").read_bytes()).hexdigest()
    (tmp_path / "a.json").write_text(json.dumps({"format": 2, "preset": "ncs", "sha256": digest}))
    with pytest.raises(ValueError, match="`weights`"):
        load_modules(tmp_path / "a")
