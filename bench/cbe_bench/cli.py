"""Command line of cbe-bench."""

import argparse
import json
import signal
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cbe.errors import CbeError, ConfigError
from cbe_bench import options as shared
from cbe_runtime.route import AttractorPrecision

if TYPE_CHECKING:
    from cbe_bench.evaluation import Evaluation


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
    shared.add_behaviors(single)
    shared.add_precision(single)
    single.add_argument("--plot", type=Path, metavar="FILE", help="write a sheet of traces")
    single.set_defaults(run=_single)

    sweep = commands.add_parser("sweep", help="success against length")
    sweep.add_argument(
        "--steps", type=shared.integers, metavar="N,N,...", help="lengths in steps of 0.1 s"
    )
    shared.add_behaviors(sweep)
    sweep.add_argument("--plot", type=Path, metavar="FILE", help="write the curve")
    sweep.set_defaults(run=_sweep)

    ablation = commands.add_parser("ablation", help="what each part of the memory is worth")
    ablation.add_argument("--steps", type=int, default=128, help="length, 0.1 s each (%(default)s)")
    shared.add_behaviors(ablation)
    ablation.add_argument(
        "--cloned", type=Path, metavar="DIR", help="also run this model, trained without DAgger"
    )
    ablation.set_defaults(run=_ablation)

    route = commands.add_parser("route", help="repeat long drives from room to room")
    shared.add_journeys(route)
    shared.add_teaching(route)
    route.add_argument(
        "--no-relocation", action="store_true", help="hide the joints' attractors from the robot"
    )
    route.add_argument("--plot", type=Path, metavar="FILE", help="write a sheet of traces")
    route.set_defaults(run=_route)

    compression = commands.add_parser("compression", help="success against memory, as the paper's")
    shared.add_journeys(compression)
    compression.add_argument(
        "--segment-steps", type=shared.integers, metavar="K,K,...", help="longest segments"
    )
    compression.add_argument(
        "--precision", type=shared.precisions, default=list(AttractorPrecision),
        metavar="P,P,...", help="of attractors: f32, u8, u4 (all three)",
    )  # fmt: skip
    compression.add_argument("--adaptive", action="store_true", help="as cbe-bench route's")
    compression.add_argument("--plot", type=Path, metavar="FILE", help="write the figure")
    compression.set_defaults(run=_compression)

    kidnap = commands.add_parser(
        "kidnap", help="carry robots elsewhere, or give them another route's memory"
    )
    shared.add_journeys(kidnap, length_m=12.0)
    shared.add_teaching(kidnap)
    kidnap.add_argument(
        "--stop", type=float, metavar="P",
        help="LOST above this probability; near 1 the curve shows what others would do",
    )  # fmt: skip
    kidnap.set_defaults(run=_kidnap, episodes=1000)

    join = commands.add_parser("join", help="set robots down anywhere along long routes")
    shared.add_journeys(join)
    shared.add_teaching(join)
    join.set_defaults(run=_join)

    lint = commands.add_parser("lint", help="whether routes that pass the lint succeed more often")
    shared.add_journeys(lint, length_m=10.0)
    shared.add_teaching(lint)
    lint.set_defaults(run=_lint, episodes=200)

    long = commands.add_parser("long", help="file, load time, memory and tick of very long routes")
    long.add_argument(
        "--length-m", type=shared.numbers, default=[1000.0, 10000.0], metavar="M,M,...",
        help="beside 20 m (1000,10000)",
    )  # fmt: skip
    shared.add_precision(long)
    long.add_argument("--model", type=Path, metavar="DIR", help="folder of ONNX files")
    shared.add_output(long)
    long.set_defaults(run=_long)

    manifold = commands.add_parser("manifold", help="map the embeddings of many demonstrations")
    manifold.add_argument("--steps", type=int, default=100, help="length, 0.1 s each (%(default)s)")
    manifold.add_argument("--episodes", type=int, default=1000, help="how many (%(default)s)")
    manifold.add_argument("--seed", type=int, default=0, help="of worlds, drives and map")
    manifold.add_argument("--world", choices=("val", "test"), default="test")
    shared.add_model(manifold)
    manifold.add_argument("--plot", type=Path, metavar="FILE", help="write the map")
    shared.add_output(manifold)
    manifold.set_defaults(run=_manifold)

    faults = commands.add_parser("faults", help="drive under injected faults")
    faults.add_argument("--steps", type=int, default=128, help="length, 0.1 s each (%(default)s)")
    faults.add_argument(
        "--faults", type=lambda text: text.split(","), default=[], metavar="NAME[:LEVEL],...",
        help='such as "frame-loss,camera:black" (all)',
    )  # fmt: skip
    shared.add_behaviors(faults)
    faults.set_defaults(run=_faults, episodes=40)

    card = commands.add_parser("card", help="all figures of the model card, going on where it was")
    card.add_argument(
        "--folder", type=Path, default=Path("runs/card"),
        help="of the results (%(default)s); begin a new one when more than the model has changed",
    )  # fmt: skip
    card.add_argument(
        "--only", metavar="TEXT", default="", help="runs whose names contain this, as route or bin"
    )
    card.add_argument(
        "--share", type=float, default=1.0, metavar="S", help="of the episodes (%(default)s)"
    )
    card.add_argument("--scenes", type=Path, metavar="DIR", help="folder of the mesh scenes")
    card.add_argument("--model", type=Path, metavar="DIR", help="folder of ONNX files")
    card.set_defaults(run=_card)

    compare = commands.add_parser("compare", help="compare two results episode by episode")
    for name in ("a", "b"):
        compare.add_argument(name, type=Path, help="JSON of cbe-bench single or route")
    shared.add_output(compare)
    compare.set_defaults(run=_compare)

    speed = commands.add_parser("speed", help="time renderer, controller and networks")
    speed.add_argument("--model", type=Path, metavar="DIR", help="folder of ONNX files")
    speed.add_argument("--blocks", type=int, default=6, help="blocks of 500 ticks (%(default)s)")
    speed.add_argument(
        "--paced-seconds", type=float, default=30.0, metavar="S",
        help="how long to pace at 10 Hz, 0 for not at all (%(default)s)",
    )  # fmt: skip
    shared.add_output(speed)
    speed.set_defaults(run=_speed)

    soak = commands.add_parser("soak", help="repeat a route in real time and hold it to bars")
    soak.add_argument("--minutes", type=float, default=15.0, help="how long (%(default)s)")
    soak.add_argument("--seed", type=int, default=1, help="house and drive (%(default)s)")
    soak.add_argument("--model", type=Path, metavar="DIR", help="folder of ONNX files")
    shared.add_output(soak)
    soak.set_defaults(run=_soak)
    return parser


def _single(options: argparse.Namespace) -> None:
    from cbe_bench import single
    from cbe_bench.route import precision_of

    behaviors, precision = shared.behaviors(options, options.steps), precision_of(options.precision)
    done = single.run(behaviors, precision=precision)
    _report(options, done, f"{options.steps} steps")


def _route(options: argparse.Namespace) -> None:
    from cbe_bench import route
    from cbe_bench.memory import Memory

    journeys = shared.journeys(options)
    if options.no_relocation:
        journeys = replace(journeys, memory=Memory.NO_RELOCATION)
    done = route.run(route.RouteConfig(journeys, shared.teaching(options)))
    _report(options, done, f"{options.length_m:g} m")


def _report(options: argparse.Namespace, done: "Evaluation", what: str) -> None:
    from cbe_bench import sheet

    result = done.summary
    _write(options.json, result)
    _say(json.dumps({key: value for key, value in result.items() if key != "runs"}, indent=2))
    if options.plot:
        title = f"{what}, {options.world}: success {result['success']:.3f}"
        sheet.draw(done.traces, options.world, options.plot, title)


def _kidnap(options: argparse.Namespace) -> None:
    from cbe_bench import kidnap

    config = kidnap.KidnapConfig(shared.journeys(options), shared.teaching(options), options.stop)
    result = kidnap.measure(config)
    _write(options.json, result)
    _say(kidnap.table(result))


def _join(options: argparse.Namespace) -> None:
    from cbe_bench import join

    result = join.measure(join.JoinConfig(shared.journeys(options), shared.teaching(options)))
    _write(options.json, result)
    _say(json.dumps({key: value for key, value in result.items() if key != "runs"}, indent=2))


def _lint(options: argparse.Namespace) -> None:
    from cbe_bench import lint

    result = lint.measure(lint.LintConfig(shared.journeys(options), shared.teaching(options)))
    _write(options.json, result)
    _say(lint.table(result))


def _long(options: argparse.Namespace) -> None:
    from cbe_bench import long
    from cbe_bench.route import precision_of

    precision, model = precision_of(options.precision), shared.model(options)
    result = long.measure(options.length_m, model, precision, _note)
    _write(options.json, result)
    _say(long.table(result))


def _compression(options: argparse.Namespace) -> None:
    from cbe_bench import compression
    from cbe_bench.route import RouteConfig, Teaching

    lengths = options.segment_steps or compression.SEGMENT_STEPS
    config = RouteConfig(shared.journeys(options), Teaching(adaptive=options.adaptive))
    result = compression.measure(config, lengths, options.precision)
    _write(options.json, result)
    _say(compression.table(result))
    if options.plot:
        compression.draw(result, options.plot)


def _sweep(options: argparse.Namespace) -> None:
    from cbe_bench import sweep

    steps = options.steps or sweep.STEPS
    result = sweep.sweep(shared.behaviors(options, max(steps)), steps)
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

    result = ablation.ablate(shared.behaviors(options, options.steps), options.cloned)
    _write(options.json, result)
    _say(ablation.table(result))


def _manifold(options: argparse.Namespace) -> None:
    from cbe_bench import manifold

    config = manifold.ManifoldConfig(
        options.world,
        options.steps,
        options.episodes,
        options.seed,
        shared.model(options),
        options.jobs,
    )
    result = manifold.measure(config, options.plot)
    _write(options.json, result)
    _say(manifold.table(result))


def _faults(options: argparse.Namespace) -> None:
    from cbe_bench import faults
    from cbe_bench.faultlist import chosen

    run = shared.behaviors(options, options.steps)
    result = faults.measure(faults.FaultsConfig(run, chosen(options.faults)))
    _write(options.json, result)
    _say(faults.table(result))


def _card(options: argparse.Namespace) -> None:
    from cbe_bench import card

    def call(arguments: list[str]) -> None:
        asked = _parser().parse_args(arguments)
        asked.run(asked)

    every = [line.of(options.share) for line in card.lines(options.scenes)]
    chosen = [line for line in every if options.only in line.name]
    if not chosen:
        names = ", ".join(line.name for line in every)
        raise ConfigError(f"no run's name contains {options.only!r}; there are {names}")
    done = card.run(chosen, options.folder, shared.model(options), call, _note)
    _say(card.table(done))


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


def _soak(options: argparse.Namespace) -> None:
    from cbe_bench import soak

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # its children end with it
    soaked = soak.run(options.minutes, options.seed, options.model, _note)
    _write(options.json, soaked.json())
    _say(soaked.table())
    if soaked.failures:
        raise soak.BarError("; ".join(soaked.failures))


def _speed(options: argparse.Namespace) -> None:
    from cbe_bench.speed import SpeedConfig, measure

    config = SpeedConfig(
        shared.model(options), blocks=options.blocks, paced_s=options.paced_seconds
    )
    result = measure(config, lambda what: _note(f"measuring {what} ..."))
    _write(options.json, result)
    _say(json.dumps(result, indent=2))


def _read(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read {path}: {error}") from error
    if not isinstance(value, dict):
        raise ConfigError(f"{path} is no result of cbe-bench")
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
