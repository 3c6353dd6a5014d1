"""Where the real files are that some measurements need."""

from __future__ import annotations

import os
from pathlib import Path


def data_folder(name: str) -> Path:
    """Sub-folder `name` of the folder of real files, which the variable ``AE_ENV_DATA`` names.

    Raises:
        FileNotFoundError: If it is not there.
    """
    folder = Path(os.environ.get("AE_ENV_DATA", "../shared/data")) / name
    if not folder.is_dir():
        raise FileNotFoundError(
            f"there is no folder {str(folder)!r}: set AE_ENV_DATA to the folder that holds {name!r}"
        )
    return folder
