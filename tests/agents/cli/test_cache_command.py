import re
from pathlib import Path


def test_cache_is_shown_and_cleared(ae_env, tmp_path: Path, monkeypatch) -> None:
    folder = tmp_path / "kept [1]"
    monkeypatch.setenv("AE_ENV_CACHE", str(folder))
    (folder / "scenes").mkdir(parents=True)
    for i in range(2):
        (folder / "scenes" / f"bundled-train-64-{i:024d}.safetensors").write_bytes(b"x" * 1000)
    (folder / "denoised").mkdir()
    (folder / "denoised" / f"{5:024d}.safetensors").write_bytes(b"x" * 123)
    (folder / "denoised" / "mine.safetensors").write_bytes(b"x")
    expected = {"scenes": ["2", "2,000"], "denoised": ["1", "123"]}
    for arguments in ((), ("--clear",)):
        code, out, _ = ae_env("cache", *arguments)
        assert code == 0
        for kind, numbers in expected.items():
            (line,) = (text for text in out.splitlines() if f" {kind} " in text)
            assert re.findall(r"[\d,]+", line) == numbers
        assert str(folder) in out.replace("\n", "")
    assert [p.name for p in folder.rglob("*.safetensors")] == ["mine.safetensors"]
    code, out, _ = ae_env("cache")
    assert "1 " not in out.replace("kept [1]", "")
