"""Command line of cbe-bench."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cbe.errors import CbeError, ConfigError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one benchmark; returns an exit code."""
    options = _parser().parse_args(arguments)
    try:
        options.run(options)
    except CbeError as error:
        sys.stderr.write(f"cbe-bench: {error}\n")
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="cbe-bench", description="Closed-loop evaluation on the runtime's own follower."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    single = commands.add_parser("single", help="repeat single behaviors in many worlds")
    single.add_argument("--steps", type=int, default=128, help="length, 0.1 s each (%(default)s)")
    _add_run_options(single)
    single.add_argument("--plot", type=Path, metavar="FILE", help="write a sheet of traces")
    single.set_defaults(run=_single)

    sweep = commands.add_parser("sweep", help="success against length")
    sweep.add_argument(
        "--steps", type=_integers, default=None, metavar="N,N,...", help="lengths in steps of 0.1 s"
    )
    _add_run_options(sweep)
    sweep.add_argument("--plot", type=Path, metavar="FILE", help="write the curve")
    sweep.set_defaults(run=_sweep)

    ablation = commands.add_parser("ablation", help="what each part of the memory is worth")
    ablation.add_argument("--steps", type=int, default=128, help="length, 0.1 s each (%(default)s)")
    _add_run_options(ablation)
    ablation.add_argument(
        "--cloned", type=Path, metavar="DIR", help="also run this model, trained without DAgger"
    )
    ablation.set_defaults(run=_ablation)

    manifold = commands.add_parser("manifold", help="map the embeddings of many demonstrations")
    manifold.add_argument("--steps", type=int, default=100, help="length, 0.1 s each (%(default)s)")
    manifold.add_argument("--episodes", type=int, default=1000, help="how many (%(default)s)")
    manifold.add_argument("--seed", type=int, default=0, help="of worlds, drives and map")
    manifold.add_argument("--world", choices=("val", "test"), default="test")
    manifold.add_argument("--model", type=Path, metavar="DIR", help="folder of ONNX files")
    manifold.add_argument("--jobs", type=int, default=0, metavar="N", help="processes (one a core)")
    manifold.add_argument("--plot", type=Path, metavar="FILE", help="write the map")
    manifold.add_argument("--json", type=Path, metavar="FILE", help="write the result")
    manifold.set_defaults(run=_manifold)

    compare = commands.add_parser("compare", help="compare two results episode by episode")
    compare.add_argument("a", type=Path, help="JSON of cbe-bench single")
    compare.add_argument("b", type=Path, help="JSON of cbe-bench single")
    compare.add_argument("--json", type=Path, metavar="FILE", help="write the result")
    compare.set_defaults(run=_compare)

    speed = commands.add_parser("speed", help="time renderer, controller and networks")
    speed.add_argument("--model", type=Path, metavar="DIR", help="folder of ONNX files")
    speed.add_argument("--blocks", type=int, default=6, help="blocks of 500 ticks (%(default)s)")
    speed.add_argument(
        "--paced-seconds", type=float, default=30.0, metavar="S",
        help="how long to pace at 10 Hz, 0 for not at all (%(default)s)",
    )  # fmt: skip
    speed.add_argument("--json", type=Path, metavar="FILE", help="write the result")
    speed.set_defaults(run=_speed)
    return parser


def _add_run_options(parser: argparse.ArgumentParser) -> None:
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
        "--obstacle-offset", type=float, metavar="M", help="put a bin so far beside the path"
    )
    parser.add_argument("--model", type=Path, metavar="DIR", help="folder of ONNX files")
    parser.add_argument("--jobs", type=int, default=0, metavar="N", help="processes (one a core)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result")


def _config(options: argparse.Namespace, steps: int) -> Any:
    from cbe_bench.scenario import Terms
    from cbe_bench.single import SingleConfig

    terms = Terms(
        world=options.world,
        steps=steps,
        seed=options.seed,
        jitter_scale=options.jitter_scale,
        obstacle_offset_m=options.obstacle_offset,
    )
    return SingleConfig(
        terms,
        episodes=options.episodes,
        world_seeds=options.world_seeds,
        backend=options.backend,
        noise=options.noise,
        model=_model(options),
        jobs=options.jobs,
    )


def _model(options: argparse.Namespace) -> Path:
    from cbe_runtime.networks import PACKAGED_MODELS

    return options.model or PACKAGED_MODELS


def _single(options: argparse.Namespace) -> None:
    from cbe_bench import sheet, single

    done = single.run(_config(options, options.steps))
    result = done.summary
    brief = {key: value for key, value in result.items() if key != "runs"}
    _write(options.json, result)
    _say(json.dumps(brief, indent=2))
    if options.plot:
        title = f"{options.steps} steps, {options.world}: success {result['success']:.3f}"
        sheet.draw(done.traces, options.world, options.plot, title)


def _sweep(options: argparse.Namespace) -> None:
    from cbe_bench import sweep

    steps = options.steps or sweep.STEPS
    result = sweep.sweep(_config(options, max(steps)), steps)
    _write(options.json, result)
    for row in result["lengths"]:
        low, high = row["ci95"]
        _say(
            f"{row['steps']:4d} steps: success {row['success']:.3f} ({low:.3f} to {high:.3f}), "
            f"paper's measure {row['success_paper']:.3f}"
        )
    if options.plot:
        sweep.draw(result, options.plot)


def _ablation(options: argparse.Namespace) -> None:
    from cbe_bench import ablation

    result = ablation.ablate(_config(options, options.steps), options.cloned)
    _write(options.json, result)
    _say(ablation.table(result))


def _manifold(options: argparse.Namespace) -> None:
    from cbe_bench import manifold

    config = manifold.ManifoldConfig(
        options.world, options.steps, options.episodes, options.seed, _model(options), options.jobs
    )
    result = manifold.measure(config, options.plot)
    _write(options.json, result)
    _say(manifold.table(result))


def _compare(options: argparse.Namespace) -> None:
    from cbe_bench.tally import compare

    result = compare(_read(options.a), _read(options.b))
    _write(options.json, result)
    low, high = (100.0 * end for end in result["ci95"])
    _say(json.dumps(result, indent=2))
    _say(
        f"b less a: {100.0 * result['difference']:+.1f} points ({low:+.1f} to {high:+.1f}) over "
        f"{result['pairs']} pairs"
    )


def _speed(options: argparse.Namespace) -> None:
    from cbe_bench.speed import SpeedConfig, measure

    config = SpeedConfig(_model(options), blocks=options.blocks, paced_s=options.paced_seconds)
    result = measure(config, lambda what: _note(f"measuring {what} ..."))
    _write(options.json, result)
    _say(json.dumps(result, indent=2))


def _integers(text: str) -> list[int]:
    return [int(part) for part in text.split(",")]


def _range(text: str) -> range:
    first, _, end = text.partition(":")
    return range(int(first), int(end))


def _read(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read {path}: {error}") from error
    if not isinstance(value, dict):
        raise ConfigError(f"{path} is no result of cbe-bench single")
    return value


def _write(path: Path | None, value: dict[str, Any]) -> None:
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(value, indent=1) + "\n")


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")


def _note(text: str) -> None:
    sys.stderr.write(text + "\n")


if __name__ == "__main__":
    sys.exit(main())
