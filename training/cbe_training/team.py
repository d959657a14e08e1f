"""Workers that train one model together, a CPU core each.

Two single-threaded processes outrun one with two threads: nothing waits inside a layer, and
rendering and rollouts parallelise as well.
"""

import os
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numba
import torch
from torch import distributed
from torch.multiprocessing.spawn import start_processes


class Team:
    """This worker's place among `size`; alone, every method is the identity."""

    def __init__(self, rank: int = 0, size: int = 1) -> None:
        self.rank, self.size = rank, size

    def mean(self, value: float) -> float:
        """Mean of a number over the workers."""
        return self._reduce(value, distributed.ReduceOp.SUM) / self.size

    def latest(self, value: float) -> float:
        """Largest of a number over the workers."""
        return self._reduce(value, distributed.ReduceOp.MAX)

    def _reduce(self, value: float, operation: distributed.ReduceOp.RedOpType) -> float:
        if self.size == 1:
            return value
        tensor = torch.tensor([value], dtype=torch.float64)
        distributed.all_reduce(tensor, operation)
        return float(tensor)

    def average_gradients(self, parameters: list[torch.nn.Parameter]) -> None:
        """Replace every gradient by its mean over the workers."""
        if self.size == 1:
            return
        gradients = [p.grad for p in parameters if p.grad is not None]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        distributed.all_reduce(flat)
        flat /= self.size
        for gradient, mean in zip(
            gradients, flat.split([g.numel() for g in gradients]), strict=True
        ):
            gradient.copy_(mean.view_as(gradient))


def run(work: Callable[[Team], None], size: int) -> None:
    """Run `work` in `size` processes of one thread each, or here if it is 1."""
    if size == 1:
        work(Team())
        return
    # Daemons end with this process; a plain SIGTERM would leave them training on.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    # Read when a worker starts: set later, or for torch alone, OpenMP's threads spin for the cores.
    os.environ |= {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        arguments = (size, Path(folder) / "meeting", work)
        start_processes(_join, arguments, nprocs=size, daemon=True, start_method="spawn")


def _join(rank: int, size: int, meeting: Path, work: Callable[[Team], None]) -> None:
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    distributed.init_process_group("gloo", f"file://{meeting}", rank=rank, world_size=size)
    try:
        work(Team(rank, size))
    finally:
        distributed.destroy_process_group()
