import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]


def test_a_foreign_package_of_a_common_name_is_named(tmp_path: Path) -> None:
    """Else the first import from it fails with a puzzle."""
    (tmp_path / "simulator").mkdir()
    (tmp_path / "simulator" / "__init__.py").touch()
    code = f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(ROOT)!r}]; import ae_env"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert found.returncode == 1
    message = found.stderr.strip().splitlines()[-1]
    assert message.startswith("ImportError: ae-env needs its own package 'simulator'")
    assert str(tmp_path / "simulator") in message
    assert str(ROOT / "simulator") in message
