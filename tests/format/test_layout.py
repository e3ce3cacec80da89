from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from weighttraj.errors import FormatError, SnapshotError
from weighttraj.format import ParamLayout, ParamSpec

shapes = st.lists(st.lists(st.integers(1, 4), max_size=3).map(tuple), min_size=1, max_size=5)


def layout_of(shapes: list[tuple[int, ...]]) -> ParamLayout:
    return ParamLayout.of(
        {f"p{i}": (s, "other", ("fixed",) * len(s)) for i, s in enumerate(shapes)}
    )


@given(shapes, st.integers(0, 2**32 - 1))
def test_flatten_and_unflatten_are_inverse(shapes: list[tuple[int, ...]], seed: int) -> None:
    layout = layout_of(shapes)
    weights = np.random.default_rng(seed).normal(size=layout.size).astype(np.float32)
    tensors = layout.unflatten(weights)
    assert [t.shape for t in tensors.values()] == shapes
    assert np.array_equal(layout.flatten(tensors), weights)


def test_unflatten_keeps_batch_axes_and_copies_nothing() -> None:
    layout = layout_of([(2, 3), (2,)])
    weights = np.zeros((5, 8), np.float32)
    tensors = layout.unflatten(weights)
    assert tensors["p0"].shape == (5, 2, 3)
    assert np.shares_memory(tensors["p1"], weights)


def test_wrong_size_says_expected_and_got() -> None:
    with pytest.raises(SnapshotError, match=r"expected: \(\.\.\., 8\)\n  got: \(7,\)"):
        layout_of([(2, 3), (2,)]).unflatten(np.zeros(7, np.float32))


def test_missing_tensor_is_named() -> None:
    with pytest.raises(SnapshotError, match="no such tensor\n  where: parameter 'p1'"):
        layout_of([(1,), (2,)]).flatten({"p0": np.zeros(1)})


@pytest.mark.parametrize(
    ("offset", "shape", "axes"), [(1, (2,), ("a",)), (0, (0,), ("a",)), (0, (2,), ())]
)
def test_gaps_empty_tensors_and_missing_labels_are_refused(
    offset: int, shape: tuple[int, ...], axes: tuple[str, ...]
) -> None:
    spec = ParamSpec(name="p", shape=shape, offset=offset, role="other", axes=axes)
    with pytest.raises(FormatError, match="parameter 'p'"):
        ParamLayout(params=(spec,))


def test_names_are_unique() -> None:
    specs = [ParamSpec(name="p", shape=(1,), offset=i, role="other", axes=("a",)) for i in range(2)]
    with pytest.raises(FormatError, match="unique"):
        ParamLayout(params=tuple(specs))
