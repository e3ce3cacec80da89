"""The Hugging Face hub: its own client against a stand-in for its HTTP API."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import huggingface_hub
import huggingface_hub.constants
import numpy as np
import pytest

import tipl
import weighttraj as wt
from tests.remote import hub as stand_in
from tests.remote.conftest import files_of
from tipl.models.gate import Gate
from weighttraj.errors import RegistryError, RemoteError
from weighttraj.format import DatasetInfo
from weighttraj.remote import RemotePath
from weighttraj.remote.store import store_at
from weighttraj.store.catalog import read_dataset_info, write_dataset_info

GATE = "tipl-gate-inverted-pendulum-v4"


def test_a_data_set_goes_there_and_back(hub: stand_in.Hub, published: Path, tmp_path: Path) -> None:
    place = wt.upload(published, "hf://us/small")
    assert place.commit is not None
    there = hub.files("datasets/us/small")
    assert {n: c for n, c in there.items() if n != ".gitattributes"} == files_of(published)
    assert hub.repositories["datasets/us/small"].tags == {"v1": place.commit}
    remote, local = wt.open("hf://us/small"), wt.open(published)
    assert str(remote.path) == str(place)
    np.testing.assert_array_equal(remote.runs[1].weights[3:9], local.runs[1].weights[3:9])
    dataset = wt.load_dataset("hf://us/small", download=True)
    assert dataset.path == tmp_path / "store/us/small"
    assert files_of(Path(dataset.path)) == files_of(published)
    assert wt.open("us/small").path == dataset.path


def test_it_is_one_commit(hub: stand_in.Hub, published: Path) -> None:
    """Readers see the empty repository or the whole data set."""
    wt.upload(published, "hf://us/small")
    sizes = [len(tree) for tree in hub.repositories["datasets/us/small"].trees.values()]
    assert sizes == [1, len(files_of(published)) + 1]
    commits = [path for method, path in hub.log if method == "POST" and "/commit/" in path]
    assert len(commits) == 1
    wt.upload(published, "hf://us/small")  # nothing to do
    assert len(hub.repositories["datasets/us/small"].trees) == 2


def test_a_version_stays_and_another_one_is_added(
    hub: stand_in.Hub, published: Path, large: Path, tmp_path: Path
) -> None:
    wt.upload(published, "hf://us/data")
    with pytest.raises(RegistryError, match="what is published stays"):
        wt.upload(large, "hf://us/data")
    second = tmp_path / "second"
    shutil.copytree(large, second)
    info = read_dataset_info(second)
    write_dataset_info(
        second, DatasetInfo(id=info.id, runs=info.runs, status="complete", version="2")
    )
    wt.seal(second)
    wt.upload(second, "hf://us/data")
    assert set(hub.files("datasets/us/data")) == {".gitattributes", *files_of(second)}
    assert len(wt.open("hf://us/data")) == 2
    assert len(wt.open("hf://us/data", revision="v1")) == 4
    assert len(wt.open("hf://us/data@v1")) == 4


def test_another_publisher_was_quicker(
    hub: stand_in.Hub, published: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    create = huggingface_hub.HfApi.create_commit

    def late(
        api: huggingface_hub.HfApi, repo: str, *arguments: object, **options: object
    ) -> object:
        repository = hub.repositories[f"datasets/{repo}"]
        repository.commit({"other": b"other"})
        return create(api, repo, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(huggingface_hub.HfApi, "create_commit", late)
    with pytest.raises(RemoteError, match="412"):
        wt.upload(published, "hf://us/small")
    assert hub.files("datasets/us/small") == {"other": b"other"}


def test_a_later_commit_changes_nothing_for_a_reader(
    hub: stand_in.Hub, published: Path, large: Path
) -> None:
    wt.upload(large, "hf://us/data")
    dataset = wt.open("hf://us/data")
    repository = hub.repositories["datasets/us/data"]
    repository.commit({"dataset.json": b"{}"})
    assert dataset.runs[0].weights[100:120].shape == (20, 122)
    with pytest.raises(ValueError, match="dataset"):
        wt.open("hf://us/data")


def test_what_is_private_needs_a_token(
    hub: stand_in.Hub, published: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wt.upload(published, "hf://us/secret", private=True)
    assert len(wt.open("hf://us/secret")) == 4
    monkeypatch.setenv("HF_TOKEN", "hf_theirs")
    with pytest.raises(RemoteError, match=r"(?s)RepositoryNotFound.*HF_TOKEN"):
        wt.open("hf://us/secret")
    with pytest.raises(RemoteError, match="the hub does not do what was asked"):
        wt.upload(published, "hf://us/another")


def test_what_is_not_there(hub: stand_in.Hub, published: Path) -> None:
    with pytest.raises(RemoteError, match=r"(?s)RepositoryNotFound.*hf auth login"):
        wt.open("hf://us/none")
    wt.upload(published, "hf://us/small")
    with pytest.raises(RemoteError, match="RevisionNotFound"):
        wt.open("hf://us/small", revision="v9")
    with pytest.raises(RemoteError, match="RepositoryNotFound"):
        tipl.load("hf://us/none")


def test_a_busy_hub_is_asked_again(hub: stand_in.Hub, published: Path) -> None:
    wt.upload(published, "hf://us/small")
    hub.faults += [("resolve/.*/dataset.json", 503), ("resolve/.*zip", 429)]
    assert wt.open("hf://us/small").runs[0].weights[0].size > 0
    assert not hub.faults


def test_another_revision_is_not_taken_for_the_one_that_is_here(
    hub: stand_in.Hub, published: Path
) -> None:
    wt.upload(published, "hf://us/small")
    wt.load_dataset("hf://us/small", revision="v1", download=True)
    assert len(wt.load_dataset("hf://us/small", revision="v1")) == 4
    with pytest.raises(RegistryError, match="another revision"):
        wt.load_dataset("hf://us/small", revision="v2")


def test_a_model_goes_there_and_back(hub: stand_in.Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    address = tipl.push(GATE, "hf://us/gate")
    assert RemotePath.parse(address).commit is not None
    assert set(hub.files("models/us/gate")) > {"README.md", "config.json", "model.safetensors"}
    model, own = tipl.load("hf://us/gate"), tipl.load(GATE)
    assert model.name == "gate"
    run = wt.open("inverted-pendulum-v4-ppo-v1").split("test").runs[0]
    np.testing.assert_array_equal(
        model.forecast(run, starts=[100], horizons=[1, 10]),
        own.forecast(run, starts=[100], horizons=[1, 10]),
    )
    # From now on without a network.
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    assert tipl.load("hf://us/gate").name == "gate"
    assert tipl.load(address).name == "gate"


def test_a_model_of_ones_own(hub: stand_in.Hub, tmp_path: Path) -> None:
    model = tipl.load("ar-20-phase-inverted-pendulum-v4")
    with pytest.raises(ValueError, match="with a card"):
        tipl.push(model, "hf://us/mine")
    card = tmp_path / "card.md"
    card.write_text("# Mine\n")
    tipl.push(model, "hf://us/mine", card=card)
    assert hub.files("models/us/mine")["README.md"] == b"# Mine\n"
    assert type(tipl.load("hf://us/mine")) is type(model)
    gate = tipl.load(GATE)
    assert isinstance(gate, Gate)
    tipl.push(gate, "hf://us/mine-too", card=card)
    assert tipl.load("hf://us/mine-too").name == "mine-too"


def test_of_a_training_only_the_model_is_published(hub: stand_in.Hub, tmp_path: Path) -> None:
    folder = tmp_path / GATE  # called as one of the zoo: a folder comes first, as in load
    tipl.load("ar-20-phase-inverted-pendulum-v4").save(folder)
    for name in ("state.safetensors", "train.json", "log.jsonl"):
        (folder / name).write_text("of this machine")
    (folder / "README.md").write_text("# Mine\n")
    tipl.push(folder, "hf://us/mine")
    files = hub.files("models/us/mine")
    assert not {"state.safetensors", "train.json", "log.jsonl"} & set(files)
    assert files["README.md"] == b"# Mine\n"
    assert type(tipl.load("hf://us/mine")) is type(tipl.load(folder))


def test_code_in_a_repository_is_left_there(hub: stand_in.Hub, tmp_path: Path) -> None:
    tipl.push(GATE, "hf://us/gate")
    repository = hub.repositories["models/us/gate"]
    repository.commit(hub.files("models/us/gate") | {"x.py": b"raise", "x.pkl": b"pickle"})
    tipl.load("hf://us/gate")
    found = {name for _, _, names in os.walk(tmp_path / "cache") for name in names}
    assert "config.json" in found
    assert not found & {"x.py", "x.pkl"}


def test_without_the_client(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "huggingface_hub", None)
    with pytest.raises(ImportError, match=r"pip install -e '.\[hub\]'"):
        wt.open("hf://us/small")


def test_without_obstore(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    store_at.cache_clear()
    for module in ("obstore", "obstore.store"):
        monkeypatch.setitem(__import__("sys").modules, module, None)
    with pytest.raises(ImportError, match=r"pip install -e '.\[remote\]'"):
        wt.open(f"file://{tmp_path}")
