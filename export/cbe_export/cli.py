"""Command line of cbe-export."""

import argparse
import logging
import sys
from pathlib import Path

from cbe.errors import CbeError
from cbe_export.export import export


def main() -> int:
    """Export a checkpoint; returns an exit code."""
    parser = argparse.ArgumentParser(
        prog="cbe-export", description="Export a training checkpoint to ONNX, gated by parity."
    )
    parser.add_argument(
        "--checkpoint", type=Path, default=Path("training/checkpoint"), help="checkpoint folder"
    )
    parser.add_argument(
        "--output", type=Path, default=Path("runtime/cbe_runtime/models"), help="folder to write"
    )
    parser.add_argument(
        "--network-period", type=int, choices=(1, 2), default=2, help="steps between network ticks"
    )
    parser.add_argument(
        "--segment-steps", type=int, default=72, help="K: longest behavior in steps (%(default)s)"
    )
    parser.add_argument(
        "--cache", type=Path, default=Path("runs/drives"), help="folder of cached drives"
    )
    parser.add_argument(
        "--precision", choices=("fp32", "int8"), default="fp32",
        help="int8: weights and activations of 8 bits, calibrated on rollouts",
    )  # fmt: skip
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        done = export(
            arguments.checkpoint,
            arguments.output,
            network_period=arguments.network_period,
            segment_steps=arguments.segment_steps,
            cache=arguments.cache,
            precision=arguments.precision,
        )
    except CbeError as error:
        sys.stderr.write(f"cbe-export: {error}\n")
        return 1
    sys.stdout.write(
        f"model {done.model_id}: torch and onnxruntime differ by at most "
        f"{done.worst_difference:.1e} over {done.ticks} ticks\n"
    )
    for name, size in done.sizes.items():
        sys.stdout.write(f"  {name:16s} {size / 1e6:6.2f} MB\n")
    return 0
