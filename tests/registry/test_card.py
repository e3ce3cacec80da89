"""Cards of data sets: facts from the data, prose from hands; metadata that others can read."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import mlcroissant
import numpy as np
import pandas as pd
import pytest
import yaml

import weighttraj as wt
from weighttraj.errors import RegistryError
from weighttraj.registry import write_card
from weighttraj.registry.card import SECTIONS, START, new_card, refreshed
from weighttraj.store.catalog import read_dataset_info, write_dataset_info

RELEASED = Path(__file__).parents[2] / "datasets/inverted-pendulum-v4-ppo-v1/data"


@pytest.fixture
def data(small_dataset: Path, tmp_path: Path) -> Path:
    path = tmp_path / "small"
    shutil.copytree(small_dataset, path)
    return path


def test_a_new_card_is_part_of_the_data_set(data: Path) -> None:
    card = write_card(data)
    text = card.read_text()
    assert all(START.format(section) in text for section in SECTIONS)
    assert "4 runs of 49 snapshots, one every 2 gradient steps" in text
    assert "- runs: 2 train, 2 test" in text
    assert "- seeds 0 to 3" in text
    assert "\n\n\n" not in text
    headings = [i for i, line in enumerate(text.split("\n")) if line.startswith("## ")]
    assert all(text.split("\n")[i + 2].strip() for i in headings)  # none without a text
    assert wt.verify(data) == []


def test_it_is_written_anew_and_prose_stays(data: Path) -> None:
    card = write_card(data)
    before = card.read_text()
    card.write_text(before.replace("4 runs of 49", "9 runs of 99") + "\nBy hand.\n")
    write_card(data)
    assert card.read_text() == before + "\nBy hand.\n"
    assert wt.verify(data) == []


def test_the_front_matter_is_the_hubs(data: Path) -> None:
    front = yaml.safe_load(write_card(data).read_text().split("---\n")[1])
    assert front["license"] == "cc-by-4.0"
    assert front["task_categories"] == ["reinforcement-learning"]
    tables = {config["config_name"]: config["data_files"] for config in front["configs"]}
    assert len(pd.read_parquet(data / tables["runs"])) == 4
    assert len(pd.read_parquet(data / tables["snapshots"])) == 4 * 49


@pytest.mark.filterwarnings("ignore")  # of the libraries that mlcroissant stands on
def test_croissant_is_valid_and_reads_the_tables(data: Path) -> None:
    write_card(data)
    document = mlcroissant.Dataset(jsonld=str(data / "croissant.json"))
    assert not document.metadata.ctx.issues.errors
    assert not document.metadata.ctx.issues.warnings
    rows = list(document.records("runs"))
    assert [row["runs/run_id"].decode() for row in rows] == [run.id for run in wt.open(data)]
    assert len(list(document.records("snapshots"))) == 4 * 49


def test_the_released_card_is_fresh() -> None:
    dataset = wt.open(RELEASED)
    text = (RELEASED / "README.md").read_text()
    assert refreshed(text, dataset) == text, "run: weighttraj card inverted-pendulum-v4-ppo-v1"
    stale = text.replace("50 runs of 1,951", "49 runs of 1,951")
    assert refreshed(stale, dataset) == text != stale
    assert json.loads((RELEASED / "croissant.json").read_text())["name"] == dataset.info.id


def test_bad_cards(data: Path, tmp_path: Path) -> None:
    dataset = wt.open(data)
    with pytest.raises(RegistryError, match="no place for the facts"):
        refreshed("# A card\n", dataset)
    wrong = new_card(dataset).replace("facts, summary:", "facts, sumary:")
    with pytest.raises(RegistryError, match=r"(?s)facts that there are not.*sumary"):
        refreshed(wrong, dataset)
    before = (data / "MANIFEST.sha256").read_bytes()
    (data / "README.md").write_text("# A card\n")
    with pytest.raises(RegistryError):
        write_card(data)
    assert (data / "MANIFEST.sha256").read_bytes() == before
    wt.export_hdf5(data, tmp_path / "one.h5")
    with pytest.raises(RegistryError, match="only a complete data set has a card"):
        write_card(tmp_path / "one.h5")


def test_a_data_set_of_which_little_is_said(tmp_path: Path) -> None:
    layout = wt.ParamLayout.of({"w": ((3,), "weight", ("input",))})
    with wt.RunWriter(tmp_path / "a.zarr", wt.RunInfo(run_id="a", layout=layout)) as writer:
        for t in range(5):
            writer.append(np.full(3, t, np.float32), num_timesteps=t)
    wt.registry.create([tmp_path / "a.zarr"], tmp_path / "bare")
    text = write_card(tmp_path / "bare").read_text()
    assert "while training trains them on an unrecorded environment: 1 runs of 5 snapshots" in text
    assert wt.verify(tmp_path / "bare") == []


def test_a_data_set_without_runs_has_no_card(data: Path) -> None:
    write_dataset_info(data, replace(read_dataset_info(data), runs=()))
    with pytest.raises(RegistryError, match="this one has none"):
        write_card(data)
