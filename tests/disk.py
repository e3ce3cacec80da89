"""A disk that grows."""

from __future__ import annotations

import subprocess
from pathlib import Path


def grow(disk: Path, size: str) -> None:
    subprocess.run(["mount", "-o", f"remount,size={size}", str(disk)], check=True)  # noqa: S607
