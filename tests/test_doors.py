"""A stranger's files end in answers or clear errors: a short run of benchmarks/fuzz_doors.py."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.fuzz_doors import CASES, copied, fuzz, prepare


@pytest.fixture(scope="module")
def samples(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare(small_dataset, tmp_path_factory.mktemp("doors") / "samples")


@pytest.mark.parametrize(
    ("first", "n"),
    [(0, 80), *(pytest.param(first, 100, marks=pytest.mark.long) for first in (80, 1000, 2000))],
)
def test_every_door_ends_in_an_answer_or_a_clear_error(samples: Path, first: int, n: int) -> None:
    result = fuzz(samples, seed=7, first=first, n=n)
    assert result.broken == []
    assert result.counts["refused"] > n / 5
    assert result.counts["answered"] > n / 5


def test_every_unchanged_sample_passes_every_door(samples: Path, tmp_path: Path) -> None:
    """So that what the fuzz refuses is refused for what was changed."""
    for number, (sample, _, _, doors) in enumerate(CASES.values()):
        for name, door in doors.items():
            if (sample, name) == ("crashed.zarr", "create"):
                continue  # a data set is made of complete runs
            folder = tmp_path / f"{number}" / name.replace(" ", "")
            folder.mkdir(parents=True)
            door(copied(samples / sample, folder))
