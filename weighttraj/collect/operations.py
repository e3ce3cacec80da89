"""Lists the operations that lead from observations to actions.

Equal actions for some observations do not prove equal actions for all others: code of a user's own
may treat rare observations in another way. Two policies that apply the same operations to every
observation, and read no value of it back into Python, act alike for all.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

_MOVING = {
    *("alias", "clone", "detach", "expand", "permute", "reshape", "select", "slice", "squeeze"),
    *("t", "transpose", "unsqueeze", "view", "_to_copy", "_unsafe_view"),
}
"""Operations that move numbers and change none: they do the same to every observation."""
_READING = {
    *("__array__", "__bool__", "__contains__", "__float__", "__index__", "__int__", "allclose"),
    *("data_ptr", "equal", "is_nonzero", "item", "numpy", "storage", "tolist", "untyped_storage"),
}
"""Functions of a tensor through which Python sees its values, and may branch on them."""


def operations(
    act: Callable[[Tensor], Tensor | Sequence[Tensor]], observations: Tensor
) -> Counter[str]:
    """Return the operations on which the result depends and that depend on the observations.

    Args:
        act: a function of the observations.
        observations: what it is called with.
    """
    dispatched = _Dispatched(observations)
    with _unvalidated(), torch.no_grad(), dispatched, _Read(dispatched):
        result = act(observations)
    return dispatched.leading_to([x for x in tree_leaves(result) if isinstance(x, Tensor)])


def difference(got: Counter[str], expected: Counter[str]) -> str:
    """Return the operations that one of two has more of, in words; empty: there are none."""
    more, fewer = sorted((got - expected).keys()), sorted((expected - got).keys())
    words = [f"more of {', '.join(more[:4])}"] if more else []
    words += [f"fewer of {', '.join(fewer[:4])}"] if fewer else []
    return " and ".join(words)


@dataclass(frozen=True)
class _Operation:
    text: str
    inputs: list[Tensor]
    outputs: list[Tensor]
    counts: bool
    """Whether it changes numbers."""
    always: bool
    """Whether it changes a tensor in place, on which anything may depend."""


class _Dispatched(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Notes each operation on what was computed from the observations."""

    def __init__(self, observations: Tensor) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        # The tensors are kept, so that no later one gets the id of an earlier one.
        self._computed = {id(observations): observations}
        self._operations: list[_Operation] = []
        self.read: list[str] = []

    def depends(self, values: Any) -> bool:
        """Return whether one of some values was computed from the observations."""
        return any(id(x) in self._computed for x in tree_leaves(values) if isinstance(x, Tensor))

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        given, made = tree_leaves((args, kwargs or {})), tree_leaves(result)
        inputs = [x for x in given if isinstance(x, Tensor)]
        if any(id(x) in self._computed for x in inputs):
            outputs = [x for x in made if isinstance(x, Tensor)]
            self._computed |= {id(x): x for x in outputs}
            name = func.overloadpacket.__name__
            self._operations.append(
                _Operation(
                    text=f"{name}({', '.join(_settings(given))})",
                    inputs=inputs,
                    outputs=outputs,
                    counts=name not in _MOVING,
                    always=func._schema.is_mutable,
                )
            )
        return result

    def leading_to(self, results: Sequence[Tensor]) -> Counter[str]:
        """Return the operations on which some results depend."""
        needed = {id(x) for x in results}
        found = Counter(f"{name} (read by Python)" for name in self.read)
        for operation in reversed(self._operations):
            if operation.always or any(id(x) in needed for x in operation.outputs):
                needed |= {id(x) for x in operation.inputs}
                found.update([operation.text] if operation.counts else [])
        return found


class _Read(TorchFunctionMode):
    """Notes where Python reads values that were computed from the observations."""

    def __init__(self, dispatched: _Dispatched) -> None:
        super().__init__()
        self._dispatched = dispatched

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        name = getattr(func, "__name__", "")
        if name in _READING and self._dispatched.depends((args, kwargs)):
            self._dispatched.read.append(name)
        return func(*args, **(kwargs or {}))


def _settings(values: Sequence[Any]) -> list[str]:
    """Return the numbers among the arguments of an operation, such as the bounds of a clip."""
    return [f"{float(x):g}" for x in values if isinstance(x, int | float)]


@contextlib.contextmanager
def _unvalidated() -> Iterator[None]:
    """Without the checks of distributions, which read their parameters."""
    before = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution._validate_args = before
