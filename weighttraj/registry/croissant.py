"""Metadata that machines read: Croissant 1.0 (MLCommons), as search engines and loaders do.

It describes the two tables, a row a run and a row a snapshot, column by column. The runs are named
as files: what is in a Zarr group, Croissant has no words for.
"""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

from weighttraj.dataset import Dataset
from weighttraj.text import printable
from weighttraj.tools.tables import RUNS, SNAPSHOTS, read_schema

CROISSANT = "croissant.json"

_TERMS = (
    *("citeAs", "column", "equivalentProperty", "extract", "field", "fileObject", "fileProperty"),
    *("fileSet", "format", "includes", "isLiveDataset", "jsonPath", "key", "md5", "parentField"),
    *("path", "recordSet", "references", "regex", "repeated", "replace", "samplingRate"),
    *("separator", "source", "subField", "transform"),
)
"""Names that are Croissant's own."""
_NAMES: dict[str, Any] = {name: f"cr:{name}" for name in _TERMS} | {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
}
_CONTEXT = dict(sorted(_NAMES.items()))
_LICENCES = {
    "CC-BY-4.0": "https://creativecommons.org/licenses/by/4.0/",
    "CC0-1.0": "https://creativecommons.org/publicdomain/zero/1.0/",
}


def croissant(dataset: Dataset) -> str:
    """Return ``croissant.json`` of a complete data set.

    Raises:
        MissingExtraError: pyarrow is not installed.
    """
    folder = Path(dataset.path)
    created = max((run.info.provenance.created for run in dataset), default="")
    licence = dataset.info.licence
    names = {"runs": RUNS, "snapshots": SNAPSHOTS}
    document = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": dataset.info.id,
        "description": f"Policy weight trajectories: {len(dataset)} runs, "
        f"{sum(len(run) for run in dataset)} snapshots.",
        "version": f"{dataset.info.version}.0.0",
        "citeAs": citation(dataset),
        "license": _LICENCES.get(licence, f"https://spdx.org/licenses/{licence}.html"),
        "keywords": ["reinforcement learning", "policy weights", "weight space learning"],
        "isLiveDataset": False,
        **({"datePublished": created[:10]} if created else {}),
        "distribution": [_file(folder, key, name) for key, name in names.items()],
        "recordSet": [_records(folder, key, name) for key, name in names.items()],
    }
    return json.dumps(document, indent=1) + "\n"


def citation(dataset: Dataset) -> str:
    """How the data set is cited, as BibTeX: by its id and version, the year of its last run."""
    created = max((run.info.provenance.created for run in dataset), default="")
    fields = {
        "title": f"{{{dataset.info.id}}}: policy weight trajectories",
        "version": dataset.info.version,
        "year": created[:4],
    }
    plain = {name: re.sub(r"[\\{}`]", "", printable(value)) for name, value in fields.items()}
    plain["title"] = fields["title"]  # an id has no such characters
    lines = [f"  {name} = {{{value}}}" for name, value in plain.items() if value]
    key = dataset.info.id.replace(".", "-")
    return f"@misc{{{key},\n" + ",\n".join(lines) + "\n}"


def _file(folder: Path, key: str, name: str) -> dict[str, Any]:
    content = (folder / name).read_bytes()
    return {
        "@type": "cr:FileObject",
        "@id": f"{key}.parquet",
        "name": f"{key}.parquet",
        "contentUrl": name,
        "contentSize": f"{len(content)} B",
        "encodingFormat": "application/x-parquet",
        "sha256": hashlib.sha256(content).hexdigest(),
    }


def _records(folder: Path, key: str, name: str) -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": key,
        "name": key,
        "description": f"A row for each {'run' if key == 'runs' else 'snapshot'}.",
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"{key}/{column.name}",
                "name": column.name,
                "dataType": _kind(str(column.type)),
                "source": {
                    "fileObject": {"@id": f"{key}.parquet"},
                    "extract": {"column": column.name},
                },
            }
            for column in read_schema(folder, name)
        ],
    }


def _kind(arrow: str) -> str:
    """Croissant's name of a column's type."""
    if arrow == "bool":
        return "sc:Boolean"
    if arrow.startswith(("int", "uint")):
        return "sc:Integer"
    return "sc:Float" if arrow.startswith(("float", "double", "half")) else "sc:Text"
