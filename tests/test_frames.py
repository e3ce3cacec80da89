"""Runs as tables of pandas and data sets of xarray."""

from __future__ import annotations

import numpy as np
import pytest

import weighttraj as wt


@pytest.fixture(scope="module")
def dataset() -> wt.Dataset:
    return wt.open("hopper-v4-ppo-16x16-v1")


def test_a_row_of_the_table_is_a_run(dataset: wt.Dataset) -> None:
    frame = dataset.to_pandas()
    assert list(frame.index) == [run.id for run in dataset]
    row = frame.loc["seed0040"]
    assert (row["split"], row["seed"], row["env"]) == ("test", 40, "Hopper-v4")
    assert (row["n_snapshots"], row["n_params"]) == (976, 518)
    assert row["final_mean_return"] == dataset["seed0040"].final_mean_return
    assert row["hyperparameters.gamma"] == 0.99


def test_a_row_of_a_runs_table_is_a_snapshot(dataset: wt.Dataset) -> None:
    run = dataset["seed0040"]
    frame = run.to_pandas()
    assert frame.index.name == "t"
    assert len(frame) == len(run) == 976
    assert frame["num_timesteps"].to_numpy().tolist() == run.num_timesteps.tolist()
    assert np.array_equal(frame["train.approx_kl"], run["train/approx_kl"][:], equal_nan=True)
    means = run.mean_return(deterministic=True)
    assert np.array_equal(frame["mean_return_deterministic"], means, equal_nan=True)


def test_the_table_of_no_runs_is_empty(dataset: wt.Dataset) -> None:
    assert dataset.select(seed=12345).to_pandas().empty


@pytest.mark.parametrize("key", [np.s_[5], np.s_[5:40:7], np.s_[[3, 9, 4]], np.s_[40:5:-5]])
def test_xarray_reads_what_the_run_holds(dataset: wt.Dataset, key: object) -> None:
    run = dataset["seed0040"]
    weights = run.to_xarray()["policy/weights"]
    assert weights.dims == ("time", "param")
    assert np.array_equal(weights[key].values, run.weights[:][key])
    assert np.array_equal(weights[key, 10:12].values, run.weights[:][key, 10:12])


def test_xarray_finds_tensors_and_steps_by_name(dataset: wt.Dataset) -> None:
    run = dataset["seed0040"]
    tree = run.to_xarray().swap_dims(time="num_timesteps")
    bias = tree["policy/weights"].sel(param=tree.tensor == "action_net.bias")
    expected = run.layout.unflatten(run.weights[-1])["action_net.bias"]
    assert np.array_equal(bias[-1], expected)
    assert int(tree.num_timesteps[-1]) == run.num_timesteps[-1]
