"""Converts result files of before version 1: ``python -m tipl.evaluation.convert FILE ...``.

Converts ``results.json`` and ``metrics.json`` in place; a file that is converted already stays as
it is.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import msgspec

from tipl.evaluation.results import Results, write_document

RENAMED_SETTINGS = {"validate_every": "save_every"}
"""Settings of trainings that have another name now."""


def convert(document: dict[str, Any]) -> dict[str, Any]:
    """Return an old result document in the form of version 1."""
    forecasters = {}
    for name, old in document["forecasters"].items():
        scores = {key: value for key, value in old.items() if key != "floor"}
        forecasters[name] = scores | ({"is_oracle": True} if old.get("floor") else {})
    return {"format": 1, **document, "forecasters": forecasters}


def convert_file(file: Path) -> bool:
    """Convert a file in place; return whether it was an old one."""
    document = json.loads(file.read_text(encoding="utf-8"))
    is_metrics = "judged_as" in document or "evaluated_as" in document
    results = document["results"] if is_metrics else document
    if "format" in results:
        return False
    typed = msgspec.convert(convert(results), Results)
    if not is_metrics:
        write_document(file, typed)
        return True
    renamed = {"judged_as": "evaluated_as"}
    document = {renamed.get(key, key): value for key, value in document.items()}
    document["results"] = msgspec.to_builtins(typed)
    settings = document.get("settings", {})
    for part in (settings, settings.get("of_gate", {})):
        for old, new in RENAMED_SETTINGS.items():
            if old in part:
                part[new] = part.pop(old)
    write_document(file, document)
    return True


def main() -> None:
    """Convert the files that are named."""
    for name in sys.argv[1:]:
        done = "converted" if convert_file(Path(name)) else "is of this version already"
        sys.stdout.write(f"{name}: {done}\n")


if __name__ == "__main__":
    main()
