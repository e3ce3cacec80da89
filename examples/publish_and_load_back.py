"""Publish a data set at an address, load it back and compare the weights.

python examples/publish_and_load_back.py

The address here is a folder. `hf://organisation/name` and `s3://bucket/name` work the same way.
"""

from pathlib import Path

import numpy as np

import weighttraj as wt

OUT = Path("data/examples/publish").absolute()
ADDRESS = (OUT / "shelf/two-runs-v1").as_uri()

# Make a small data set of two runs. A run that you recorded yourself works as well.
released = wt.open("inverted-pendulum-v4-ppo-v1")
paths = [str(released[name].path) for name in ("seed0000", "seed0040")]
splits = {"seed0000": "train", "seed0040": "test"}
wt.registry.create(paths, OUT / "two-runs-v1", splits=splits)

# A card says what the data are and how to cite them. Then everything is verified and copied.
wt.registry.write_card(OUT / "two-runs-v1")
wt.upload(OUT / "two-runs-v1", ADDRESS)

# Read one window from the address; nothing else is transferred.
there = wt.open(ADDRESS)
print(there)
window = there["seed0040"].weights[100:120]
same = np.array_equal(window, released["seed0040"].weights[100:120])
print("the same 20 snapshots came back:", same, window.shape)
