"""Networks of many learners, stacked: one batched matrix product a layer for all of them.

A learner's bits depend neither on the number of learners nor on its place among them, with one
exception that was found by trying: a stack of one takes other kernels (MKL's matrix-vector product
where a layer has a single unit) than a stack of several. So a stack has at least two.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

_TENSOR = 16
"""Each tensor begins at a multiple of so many floats: 64 bytes, a vector register and a cache line.
Matrix products may round otherwise on operands that lie otherwise."""
_ROW = 64
"""Each learner's row has a multiple of so many floats, so that no learner's end is in the remainder
of a vectorised loop, which may be rounded otherwise."""


class Stack:
    """Parameters of several learners of one structure, a row a learner.

    Args:
        shapes: shape of each parameter by name, in the order of the rows.
        learners: number of learners, at least 2.
    """

    def __init__(self, shapes: Mapping[str, torch.Size], learners: int) -> None:
        self.shapes = dict(shapes)
        self._offsets: dict[str, int] = {}
        width = 0
        for name, shape in self.shapes.items():
            self._offsets[name] = width
            width += _round_up(shape.numel(), _TENSOR)
        self.values = torch.zeros(learners, _round_up(width, _ROW))
        self.gradients = torch.zeros_like(self.values)

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, learners: slice) -> Stack:
        """Return some of the learners, in the same memory."""
        part = object.__new__(Stack)
        part.shapes, part._offsets = self.shapes, self._offsets
        part.values, part.gradients = self.values[learners], self.gradients[learners]
        return part

    def value(self, name: str) -> Tensor:
        """Return a parameter of all learners, (learner, *shape)."""
        return self._view(self.values, name)

    def gradient(self, name: str) -> Tensor:
        """Return the gradient of a parameter of all learners, (learner, *shape)."""
        return self._view(self.gradients, name)

    def places(self, names: Sequence[str]) -> np.ndarray:
        """Return columns of some parameters, one after the other."""
        offsets, shapes = self._offsets, self.shapes
        ranges = [np.arange(offsets[n], offsets[n] + shapes[n].numel()) for n in names]
        return np.concatenate(ranges)

    def _view(self, rows: Tensor, name: str) -> Tensor:
        offset, shape = self._offsets[name], self.shapes[name]
        return rows[:, offset : offset + shape.numel()].view(len(rows), *shape)


@dataclass(frozen=True, kw_only=True)
class _Layer:
    weight: Tensor
    """(learner, out, in)."""
    bias: Tensor
    """(learner, 1, out)."""
    weight_gradient: Tensor
    """(learner, out, in)."""
    bias_gradient: Tensor
    """(learner, out)."""
    output: Tensor
    """Buffer, (learner, sample, out)."""
    output_gradient: Tensor
    """Buffer, (learner, sample, out)."""


class MLP:
    """A network of each learner of a stack, with buffers for one batch size.

    The gradient is written out: with buffers that are kept, and products that write into the stack,
    it takes two thirds of the time of autograd, which allocates each intermediate again.

    Args:
        stack: where the parameters are.
        layers: prefixes of the parameters' names, from the first layer to the last.
        batch: samples that each learner takes at once.
        activation: function between the layers, ``tanh`` or ``relu``.
    """

    def __init__(self, stack: Stack, layers: Sequence[str], batch: int, activation: str) -> None:
        def make(prefix: str) -> _Layer:
            weight, bias = f"{prefix}.weight", f"{prefix}.bias"
            shape = (len(stack), batch, stack.shapes[bias][0])
            return _Layer(
                weight=stack.value(weight),
                bias=stack.value(bias)[:, None],
                weight_gradient=stack.gradient(weight),
                bias_gradient=stack.gradient(bias),
                output=torch.empty(shape),
                output_gradient=torch.empty(shape),
            )

        self._layers = [make(prefix) for prefix in layers]
        self._activate, self._activation_gradient = _ACTIVATIONS[activation]

    def forward(self, inputs: Tensor) -> Tensor:
        """Return outputs (learner, sample, out), in a buffer that the next call writes again.

        Args:
            inputs: (learner, sample, in).
        """
        for layer in self._layers:
            torch.baddbmm(layer.bias, inputs, layer.weight.mT, out=layer.output)
            inputs = layer.output
            if layer is not self._layers[-1]:
                self._activate(inputs)
        return inputs

    def backward(self, inputs: Tensor, gradient: Tensor) -> None:
        """Write the parameters' gradients into the stack, after ``forward`` of the same inputs.

        Args:
            inputs: (learner, sample, in).
            gradient: of the loss by the outputs, (learner, sample, out).
        """
        for layer, below in zip(self._layers[:0:-1], self._layers[-2::-1], strict=True):
            _layer_gradient(layer, below.output, gradient)
            torch.bmm(gradient, layer.weight, out=below.output_gradient)
            gradient = below.output_gradient
            self._activation_gradient(gradient, below.output)
        _layer_gradient(self._layers[0], inputs, gradient)


def _tanh_gradient(gradient: Tensor, output: Tensor) -> None:
    """Turn the gradient by tanh's output into that by its input, in place."""
    torch.ops.aten.tanh_backward.grad_input(gradient, output, grad_input=gradient)


def _relu_gradient(gradient: Tensor, output: Tensor) -> None:
    """Turn the gradient by ReLU's output into that by its input, in place."""
    torch.ops.aten.threshold_backward.grad_input(gradient, output, 0, grad_input=gradient)


_ACTIVATIONS: dict[str, tuple[Callable[[Tensor], Tensor], Callable[[Tensor, Tensor], None]]] = {
    "tanh": (torch.tanh_, _tanh_gradient),
    "relu": (torch.relu_, _relu_gradient),
}
"""Each activation in place, and what it does to a gradient."""


def _layer_gradient(layer: _Layer, inputs: Tensor, gradient: Tensor) -> None:
    torch.bmm(gradient.mT, inputs, out=layer.weight_gradient)
    torch.sum(gradient, 1, out=layer.bias_gradient)


def _round_up(n: int, unit: int) -> int:
    return -(-n // unit) * unit
