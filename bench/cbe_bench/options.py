"""Options that the commands of cbe-bench share, and the runs that they ask for."""

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from cbe.camera import CameraModel
from cbe_runtime.route import AttractorPrecision

if TYPE_CHECKING:
    from cbe_bench.drives import Drives
    from cbe_bench.evaluation import RunConfig
    from cbe_bench.route import Teaching

CAMERA_PX = 160, 120


def add_run(parser: argparse.ArgumentParser) -> None:
    """What all runs of episodes take."""
    parser.add_argument("--episodes", type=int, default=500, help="how many (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of worlds, drives, starts and noise")
    parser.add_argument(
        "--world", default="test", metavar="val|test|SCENE_DIR|PGM_YAML",
        help="generated worlds of a split, a mesh scene or a floor plan (%(default)s)",
    )  # fmt: skip
    jitter = parser.add_mutually_exclusive_group()
    jitter.add_argument(
        "--jitter-scale", type=float, default=1.0, help="times the paper's jitter (%(default)s)"
    )
    jitter.add_argument(
        "--no-jitter", action="store_const", const=0.0, dest="jitter_scale",
        help="start at the demonstration's first pose",
    )  # fmt: skip
    parser.add_argument("--world-seeds", type=_range, metavar="A:B", help="worlds A to B-1 only")
    parser.add_argument("--backend", choices=("column", "bullet"), default="column")
    parser.add_argument(
        "--noise", type=float, default=0.0, metavar="S", help="actuation noise, the paper's s"
    )
    parser.add_argument(
        "--camera", type=_camera, metavar="WxH",
        help="field of view of the robot's camera in degrees (the networks' own, 120x107)",
    )  # fmt: skip
    add_model(parser)
    add_output(parser)


def add_model(parser: argparse.ArgumentParser) -> None:
    """Which model, in how many processes."""
    parser.add_argument("--model", type=Path, metavar="DIR", help="folder of ONNX files")
    parser.add_argument("--jobs", type=int, default=0, metavar="N", help="processes (one a core)")


def add_output(parser: argparse.ArgumentParser) -> None:
    """Where the result goes."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result")


def add_behaviors(parser: argparse.ArgumentParser) -> None:
    """Runs of single behaviors, but for their length."""
    add_run(parser)
    parser.add_argument(
        "--obstacle-offset", type=float, metavar="M", help="put a bin so far beside the path"
    )


def add_teaching(parser: argparse.ArgumentParser) -> None:
    """How long drives are cut and stored."""
    parser.add_argument(
        "--segment-steps", type=int, metavar="K", help="longest segment (the model's own)"
    )
    add_precision(parser)
    parser.add_argument(
        "--adaptive", action="store_true",
        help="put joints where the view pins the place best, in place of equal segments",
    )  # fmt: skip


def add_precision(parser: argparse.ArgumentParser) -> None:
    """How exactly drives are stored."""
    parser.add_argument(
        "--precision", type=AttractorPrecision, choices=list(AttractorPrecision),
        default=AttractorPrecision.U8, metavar="f32|u8|u4",
        help="of attractors; with f32 embeddings are f32 too, else f16 (%(default)s)",
    )  # fmt: skip


def teaching(options: argparse.Namespace) -> "Teaching":
    """How routes are taught.

    Raises:
        ConfigError: they cannot be.
    """
    from cbe_bench.route import Teaching, precision_of

    return Teaching(options.segment_steps, precision_of(options.precision), options.adaptive)


def add_journeys(parser: argparse.ArgumentParser, length_m: float = 20.0) -> None:
    """Runs of long drives."""
    parser.add_argument(
        "--length-m", type=float, default=length_m, metavar="M", help="about so long (%(default)s)"
    )
    add_run(parser)
    parser.add_argument(
        "--obstacles", type=int, default=0, metavar="N", help="put so many bins on the path"
    )
    parser.add_argument(
        "--hairpins", action="store_true",
        help="where a world is too small for a straight way and is toured, turn back in passages",
    )  # fmt: skip


def behaviors(options: argparse.Namespace, steps: int) -> "RunConfig":
    """The run of single behaviors asked for.

    Raises:
        ConfigError: it cannot be run.
    """
    from cbe_bench.drives import Pieces

    offset_m: float | None = options.obstacle_offset
    return _run(options, Pieces(steps), int(offset_m is not None), offset_m or 0.0)


def journeys(options: argparse.Namespace) -> "RunConfig":
    """The run of long drives asked for.

    Raises:
        ConfigError: it cannot be run.
    """
    from cbe_bench.drives import Journeys

    return _run(options, Journeys(options.length_m, options.hairpins), options.obstacles, 0.0)


def _run(
    options: argparse.Namespace, drives: "Drives", obstacles: int, offset_m: float
) -> "RunConfig":
    from cbe_bench.evaluation import RunConfig
    from cbe_bench.scenario import Terms

    return RunConfig(
        Terms(options.world, drives, options.seed, options.jitter_scale, obstacles, offset_m),
        episodes=options.episodes,
        world_seeds=options.world_seeds,
        backend=options.backend,
        noise=options.noise,
        model=model(options),
        jobs=options.jobs,
        camera=options.camera,
    )


def model(options: argparse.Namespace) -> Path:
    """The model's folder; the shipped one where none is named."""
    from cbe_runtime.networks import PACKAGED_MODELS

    return options.model or PACKAGED_MODELS


def integers(text: str) -> list[int]:
    """Numbers between commas."""
    return [int(part) for part in text.split(",")]


def numbers(text: str) -> list[float]:
    """Numbers above 0 between commas."""
    values = [float(part) for part in text.split(",")]
    if not all(0.0 < value < math.inf for value in values):
        raise argparse.ArgumentTypeError(f"numbers above 0 are needed; found {text!r}")
    return values


def precisions(text: str) -> list[AttractorPrecision]:
    """Precisions between commas."""
    return [AttractorPrecision(part) for part in text.split(",")]


def _range(text: str) -> range:
    first, _, end = text.partition(":")
    return range(int(first), int(end))


def _camera(text: str) -> CameraModel:
    """A pinhole of so many degrees in `CAMERA_PX` pixels."""
    try:
        across_deg, down_deg = (float(part) for part in text.split("x"))
    except ValueError:
        across_deg = down_deg = math.nan
    if not (0.0 < across_deg < 180.0 and 0.0 < down_deg < 180.0):
        raise argparse.ArgumentTypeError(
            f"degrees between 0 and 180 are needed, such as 70x55; found {text!r}"
        )
    width, height = CAMERA_PX
    fx, fy = (
        0.5 * size / math.tan(math.radians(0.5 * angle))
        for size, angle in ((width, across_deg), (height, down_deg))
    )
    return CameraModel(width, height, fx, fy, 0.5 * width, 0.5 * height)
