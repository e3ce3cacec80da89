"""Several processes that train one model, as `torchrun` starts them.

Each process is a *rank*. Rank 0 alone reads and writes the folder of the training. Every batch is
the batch that one process would have: a rank takes its share of the examples, and the gradients of
the shares are added.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar, cast

import torch
import torch.distributed as dist
from jaxtyping import Float
from torch import Tensor

from tipl.errors import TrainError

if dist.is_available():
    # On import, default arguments of its functions keep the group of that time. Torch imports it
    # with the first optimizer. If a group had started by then, its threads would outlive it, and
    # sometimes abort the process at its end.
    import torch.distributed.nn.functional

T = TypeVar("T")

# Ranks wait while rank 0 reads the data and fits bases. One that dies is noticed without it.
TIMEOUT = timedelta(days=1)


@dataclass(frozen=True, kw_only=True)
class Ranks:
    """This process among those that train together."""

    rank: int = 0
    """Number of this process, from 0."""
    world: int = 1
    """Number of processes."""

    @property
    def first(self) -> bool:
        """Whether this is the process that writes."""
        return self.rank == 0

    def from_first(self, make: Callable[[], T]) -> T:
        """Return what ``make`` returns on rank 0; the other ranks wait for it."""
        if self.world == 1:
            return make()
        box = [make() if self.first else None]
        with self.talking():
            dist.broadcast_object_list(box, src=0, device=torch.device("cpu"))
        return cast(T, box[0])

    def sum(self, value: Float[Tensor, ""]) -> Float[Tensor, ""]:
        """Return the sum of a number over all ranks."""
        if self.world > 1:
            value = value.clone()
            with self.talking():
                dist.all_reduce(value)
        return value

    @contextmanager
    def talking(self) -> Iterator[None]:
        """Turn errors of what ranks do together into one that says that a rank is gone."""
        try:
            yield
        except RuntimeError as error:
            if self.world == 1:
                raise
            raise TrainError(
                "another rank of this training has ended",
                got=str(error).partition(". ")[0],
                where=f"rank {dist.get_rank()}",
                do="read what the other rank says; give the same command again to go on from the "
                "last checkpoint",
            ) from error

    def share(self, batch_size: int) -> slice:
        """Return the examples of a batch that this rank takes.

        Raises:
            TrainError: there are more ranks than examples.
        """
        if self.world > batch_size:
            raise TrainError(
                "some ranks would have no example",
                expected=f"at most {batch_size} ranks",
                got=self.world,
                do="raise --batch-size, or lower --nproc-per-node",
            )
        return slice(*(batch_size * r // self.world for r in (self.rank, self.rank + 1)))


@contextmanager
def open_ranks(device: str) -> Iterator[Ranks]:
    """Join the processes that `torchrun` started, or the caller's group; else stay alone.

    Gradients go over NCCL from GPUs, over Gloo from elsewhere.

    Raises:
        TrainError: the processes cannot reach each other, or one of them ends.
    """
    if dist.is_available() and dist.is_initialized():
        yield Ranks(rank=dist.get_rank(), world=dist.get_world_size())
    elif not launched():
        yield Ranks()
    else:
        try:
            dist.init_process_group(
                "cpu:gloo,cuda:nccl" if device.startswith("cuda") else "gloo", timeout=TIMEOUT
            )
        except (RuntimeError, ValueError) as error:
            raise TrainError(
                "the ranks cannot reach each other",
                expected="Gloo for cpu, NCCL and a GPU for each rank for cuda",
                got=error,
                do="choose another --device; GLOO_SOCKET_IFNAME names the network interface",
            ) from error
        try:
            yield Ranks(rank=dist.get_rank(), world=dist.get_world_size())
        finally:
            dist.destroy_process_group()


def launched() -> bool:
    """Return whether `torchrun` started this process."""
    return dist.is_available() and dist.is_torchelastic_launched()


def rank_here() -> int:
    """Return the rank of this process; 0 without `torchrun`."""
    return int(os.environ["RANK"]) if launched() else 0


def device_here(device: str) -> str:
    """Return the device of this process: ``cuda`` stands for one GPU for each."""
    return f"cuda:{os.environ['LOCAL_RANK']}" if launched() and device == "cuda" else device
