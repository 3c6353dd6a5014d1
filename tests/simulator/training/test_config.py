from pathlib import Path
from typing import Any

import pytest

from simulator.training.train import SimulatorConfig, load_config

STAGES = "exposure: {steps: 2}\nnoise: {steps: 3}\naperture: {minutes: 0.5, crop: 128}\n"
COMPACT = f"preset: compact\n{STAGES}"
CONFIGS = Path(__file__).resolve().parents[3] / "configs" / "simulator"


def load(folder: Path, text: str) -> SimulatorConfig:
    (folder / "a.yaml").write_text(text)
    return load_config(folder / "a.yaml")


def test_stages_in_order_with_their_defaults(tmp_path):
    config = load(tmp_path, COMPACT)
    assert list(config.stages()) == ["noise", "exposure", "aperture"]
    assert (config.noise.average, config.card()["noise"]["average"]) == (0.0, 0.0)
    assert (config.noise.steps, config.noise.minutes, config.noise.batch) == (3, None, 8)
    assert (config.aperture.steps, config.aperture.minutes) == (None, 0.5)
    for preset, stage in (("pc", "baseline"), ("nano", "noise"), ("large", "noise")):
        assert list(load(tmp_path, f"preset: {preset}\n{stage}: {{steps: 1}}").stages()) == [stage]


@pytest.mark.parametrize("file", sorted(CONFIGS.glob("*.yaml")), ids=lambda f: f.name)
def test_shipped_configurations_are_valid(file):
    assert load_config(file).preset == file.stem


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"preset: compact\nnoize: {{steps: 1}}\n{STAGES}", "noize"),
        (COMPACT.replace("{steps: 3}", "{stesp: 3}"), "noise.stesp"),
        (COMPACT.replace("steps: 3", "steps: 3, minutes: 1"), "exactly one"),
        (COMPACT.replace("{steps: 3}", "{batch: 3}"), "exactly one"),
        (COMPACT.replace("128", "257"), "`aperture.crop` (=257) must not"),
        (COMPACT.replace("steps: 3", "steps: 3, average: 1"), "noise.average (=1)"),
        (COMPACT.replace("compact", "nano"), "`exposure` must be left out for preset 'nano'"),
        (COMPACT.replace("128", "8"), "aperture.crop (=8)"),
        (COMPACT.replace("compact", "pc"), "`noise` must be left out for preset 'pc'"),
        ("preset: pc", "`baseline` must be given for preset 'pc'"),
        (f"{COMPACT}baseline: {{steps: 1}}", "`baseline` must be left out"),
        (COMPACT.replace("compact", "tiny"), "preset (='tiny')"),
        (f"{COMPACT}camera: nikon_z7", "nikon_z6"),
    ],
)
def test_errors_name_the_entry(tmp_path, text, message):
    with pytest.raises(ValueError) as caught:
        load(tmp_path, text)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def config(**changes: Any) -> SimulatorConfig:
    stages = {name: {"steps": 2} for name in ("exposure", "noise", "aperture")}
    return SimulatorConfig.model_validate({"preset": "compact", **stages, **changes})


def test_a_later_stage_does_not_change_what_an_earlier_one_is():
    """Else a checkpoint was lost when the aperture's budget is raised; the noise stage, which has
    pictures of its own, depends on nothing else but the seed."""
    plain, longer = config(), config(aperture={"steps": 9})
    for stage, equal in (("noise", True), ("exposure", True), ("aperture", False), (None, False)):
        assert (plain.card(stage) == longer.card(stage)) is equal
    for changes in {"body": 2}, {"scenes": {"size": 512}}, {"exposure": {"steps": 3}}:
        assert config(**changes).card("exposure") != plain.card("exposure"), changes
        assert config(**changes).card("noise") == plain.card("noise"), changes
    for changes in {"seed": 1}, {"noise": {"steps": 3}}, {"precision": "bfloat16"}:
        assert config(**changes).card("noise") != plain.card("noise"), changes
