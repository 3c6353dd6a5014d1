"""Pictures of the noise stage: how files become light, and that no source is on two sides."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from simulator.training import scenes as pictures
from simulator.training.data import DetailPicture
from simulator.training.scenes import detail_pictures, detail_split
from tests.ae_env.scene_files import write_hdr

SPLITS = ("train", "validation", "test")


def by_split(data: Path | None, drawn: int = 0) -> dict[str, list[DetailPicture]]:
    return {s: detail_pictures(s, data=data, drawn=drawn) for s in SPLITS}  # type: ignore[arg-type]


def the_only(folder: Path, name: str) -> DetailPicture:
    (found,) = (p for own in by_split(folder).values() for p in own if p.name == name)
    return found


def assert_no_group_is_shared(pictures: dict[str, list[DetailPicture]]) -> None:
    groups = [{p.group for p in own} for own in pictures.values()]
    assert len(set.union(*groups)) == sum(map(len, groups))
    names = [p.name for own in pictures.values() for p in own]
    assert len(set(names)) == len(names)


def test_groups_of_files_stay_together(tmp_path: Path) -> None:
    """Three photographs of each of 20 series, which a table names; and two known maps."""
    (tmp_path / "photo_pool").mkdir()
    rows = ["file,licence,group"]
    for i in range(60):
        Image.new("RGB", (12, 10), (i, 2 * i, 99)).save(tmp_path / f"photo_pool/p{i}.png")
        rows.append(f"photo_pool/p{i}.png,CC0,series{i % 20}")
    (tmp_path / "MANIFEST_POOL.csv").write_text("\n".join(rows) + "\n")
    for name in ("bridge", "venice"):
        write_hdr(tmp_path / f"hdri_cc0/{name}.hdr")
    pictures = by_split(tmp_path)
    assert_no_group_is_shared(pictures)
    found = [p for own in pictures.values() for p in own if p.kind == "photograph"]
    assert len(found) == 60
    assert {p.group for p in found} == {f"series{i}" for i in range(20)}
    assert len({p.group for p in pictures["train"]}) > len({p.group for p in pictures["test"]}) > 1
    assert [p.name for p in pictures["train"] if p.kind == "radiance"] == ["bridge"]
    assert [p.name for p in pictures["test"] if p.kind == "radiance"] == ["venice"]


def test_shares_of_the_splits() -> None:
    """62, 8 and 30 percent of 2,000 groups, within four standard errors."""
    drawn = [detail_split(f"group{i}") for i in range(2000)]
    for split, share in zip(SPLITS, (0.62, 0.08, 0.30), strict=True):
        error = 4 * (share * (1 - share) / 2000) ** 0.5
        assert drawn.count(split) / 2000 == pytest.approx(share, abs=error)


def test_a_map_has_a_median_of_one_and_no_lamp_outshines_it(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    image = np.full((8, 16, 3), 4.0, np.float32)
    image[0, 0] = 4000.0
    (tmp_path / "hdri_pool").mkdir()
    path = tmp_path / "hdri_pool" / "room.hdr"
    path.write_bytes(cv2.imencode(".hdr", image)[1].tobytes())
    light = the_only(tmp_path, "room").light
    assert light.shape == (3, 8, 16)
    assert light[:, 0, 0].tolist() == [64.0] * 3
    torch.testing.assert_close(light[:, 1:], torch.ones(3, 7, 16), rtol=0.01, atol=0)


def test_mosaics_and_linear_frames_by_hand(tmp_path: Path) -> None:
    """Black 10 and white 110; the planes lie at (0, 0), (0, 1), (1, 0), (1, 1)."""
    cv2 = pytest.importorskip("cv2")
    for folder in ("gopro_raw", "intel_tau_small"):
        (tmp_path / folder).mkdir()
    tile = np.array([[20, 30], [40, 60]], np.uint16)
    Image.fromarray(np.tile(tile, (2, 3))).save(tmp_path / "gopro_raw" / "A.png")
    meta = {"black": [10] * 4, "white": 110, "dng_tags": {"NoiseProfile": "(0.002, 0.00003)"}}
    (tmp_path / "gopro_raw" / "meta.json").write_text(json.dumps({"A.png": meta}))
    frame = np.zeros((4, 4, 3), np.uint16)
    frame[..., 2] = 65535  # red, as OpenCV writes it
    cv2.imwrite(str(tmp_path / "intel_tau_small" / "B.png"), frame)
    mosaic, linear = (the_only(tmp_path, name) for name in ("A.png", "B"))
    assert mosaic.light.shape == (4, 2, 3)
    assert mosaic.light[:, 1, 2].tolist() == pytest.approx([0.1, 0.2, 0.3, 0.5])
    assert (mosaic.nlf.shot, mosaic.nlf.read) == ((0.002,) * 4, (0.00003,) * 4)
    assert linear.light[:, 3, 0].tolist() == [1.0, 0.0, 0.0]
    assert linear.nlf.is_zero


def test_drawn_pictures(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(pictures, "_SIZE", 64)
    drawn = by_split(None, drawn=8)
    assert "AE_ENV_DATA" in caplog.text
    assert_no_group_is_shared(drawn)
    for own in drawn.values():
        assert [p.kind for p in own] == ["leaves"] * 8 + ["chart"] * 8 + ["smooth"] * 8
        for each in own:
            assert each.light.shape == (3, 64, 64)
            assert each.light.dtype == torch.float32
            assert bool(((each.light >= 0) & each.light.isfinite()).all())
    again, other = (detail_pictures("train", data=None, drawn=8, seed=s) for s in (0, 1))
    for first, same, new in zip(drawn["train"], again, other, strict=True):
        assert torch.equal(first.light, same.light)
        assert not torch.equal(first.light, new.light)
        assert first.group != new.group
    with pytest.raises(ValueError, match=r"`split` \(='tests'\)"):
        detail_pictures("tests", data=None)  # type: ignore[arg-type]


@pytest.mark.real_data
def test_recorded_mosaics_of_one_subject_are_on_one_side(data_dir: Path) -> None:
    drawn = {s: list(pictures.recorded_mosaics(data_dir, s)) for s in SPLITS}  # type: ignore[arg-type]
    assert_no_group_is_shared(drawn)
    found = {p.name: (split, p) for split, own in drawn.items() for p in own}
    assert [found[f"CRW_{n}"][0] for n in ("0101", "0112", "0117", "0119")] == 2 * ["train"] + 2 * [
        "test"
    ]
    for _, each in found.values():
        assert each.light.shape[0] == 4
        assert 0 < each.nlf.shot[1] < 1e-3
        assert -0.1 < float(each.light.min()) <= float(each.light.max()) < 1.5
