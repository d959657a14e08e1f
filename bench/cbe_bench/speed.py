"""How fast the renderer, the scanner, the controller and the networks are on one thread."""

import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

from cbe import signature
from cbe.camera import MODEL_CAMERA
from cbe.controller import Motion, RmpController
from cbe.robot import STEP_S, Robot
from cbe_bench import authors
from cbe_hil_sim.demonstrator import ENDPOINT_CLEARANCE_M
from cbe_hil_sim.generate import TEST_HOUSES, generate
from cbe_hil_sim.render import render
from cbe_hil_sim.scanner import scan
from cbe_hil_sim.worldbatch import WorldBatch
from cbe_runtime.networks import Networks

Tick = Callable[[], None]

BLOCK_TICKS = 500
WARM_TICKS = 50


@dataclass(frozen=True, slots=True)
class SpeedConfig:
    """What `cbe-bench speed` measures; 0 paced seconds leave that part out."""

    model: Path
    blocks: int = 6
    paced_s: float = 30.0
    renders: int = 24000


def measure(config: SpeedConfig, say: Callable[[str], None]) -> dict[str, Any]:
    """All measurements, single-threaded; `say` tells what is being measured."""
    import cv2
    import numba

    numba.set_num_threads(1)
    cv2.setNumThreads(1)
    say("renderer and scanner")
    result = _worlds(config.renders, config.blocks)
    result |= _controller(config.blocks)
    ours = OurTick(Networks.load(config.model))
    with tempfile.TemporaryDirectory() as folder:
        path = authors.write(Path(folder) / "authors.onnx")
        theirs_bytes = path.stat().st_size
        theirs = TheirTick(path)
    say(f"networks, {config.blocks} alternating blocks of {BLOCK_TICKS} ticks each")
    result["blocks"] = in_blocks(ours, theirs, config.blocks)
    if config.paced_s > 0.0:
        say(f"networks, paced at 10 Hz for {config.paced_s:.0f} s")
        result["paced"] = paced(ours, theirs, config.paced_s)
    sizes = {path.name: path.stat().st_size for path in sorted(config.model.glob("*.onnx"))}
    return result | {
        "onnx_bytes": sizes,
        "onnx_total_bytes": sum(sizes.values()),
        "authors_onnx_bytes": theirs_bytes,
    }


def _worlds(renders: int, blocks: int) -> dict[str, Any]:
    """Frames (64x64, 2x2 rays a pixel) and scans a second in furnished worlds."""
    batch_size = 64
    worlds = [generate(seed) for seed in TEST_HOUSES[:4]]
    batch = WorldBatch.pack(worlds)
    rng = np.random.default_rng(0)
    where = rng.integers(0, len(worlds), batch_size)
    poses = np.zeros((batch_size, 3))
    for row, index in enumerate(where):
        world = worlds[index]
        free = np.argwhere(world.clearance_m >= ENDPOINT_CLEARANCE_M)[:, ::-1]
        poses[row, :2] = (rng.choice(free) + 0.5) * world.resolution_m + np.array(world.origin_m)
        poses[row, 2] = rng.uniform(-np.pi, np.pi)
    robot = Robot()

    def frames() -> None:
        render(batch, where, poses, MODEL_CAMERA, supersample=2)

    def scans() -> None:
        scan(batch, where, poses, robot)

    rounds = max(1, renders // batch_size // blocks)
    frame_s = [_median_s(frames, rounds, warm=1) / batch_size for _ in range(blocks)]
    return {
        "renderer_frames_per_s": 1.0 / statistics.median(frame_s),
        "renderer_frames_per_s_range": [1.0 / max(frame_s), 1.0 / min(frame_s)],
        "scanner_scans_per_s": batch_size / _median_s(scans, rounds, warm=1),
    }


def _controller(blocks: int) -> dict[str, Any]:
    """One step of the RMP controller for one robot in a cluttered scan: median of the blocks'."""
    robot = Robot()
    controller = RmpController(robot)
    rng = np.random.default_rng(0)
    scan_m = rng.uniform(0.4, 4.0, (1, robot.scan_rays))
    motion = Motion(np.array([0.3]), np.array([0.1]))
    waypoint = np.array([[0.5, 0.1]])

    def step() -> None:
        controller.step(motion, waypoint, scan_m)

    medians = [1e3 * _median_s(step, BLOCK_TICKS, warm=WARM_TICKS) for _ in range(blocks)]
    return {
        "controller_ms": statistics.median(medians),
        "controller_ms_range": [min(medians), max(medians)],
    }


class OurTick:
    """One tick of all networks through the runtime's own interface, image to waypoint.

    What stays the same while a behavior lasts is recalled before, as it is in `TheirTick`.
    """

    def __init__(self, networks: Networks) -> None:
        self._networks = networks
        rng = np.random.default_rng(0)
        shape = (16, signature.IMAGE_SIZE, signature.IMAGE_SIZE, 3)
        self._images = rng.integers(0, 256, shape, dtype=np.uint8)
        first, start, goal = rng.random((3, signature.ATTRACTOR_SIZE), np.float32)
        self._encoder = networks.encoder_state()
        self._generator = networks.recall(
            attractor_first=first,
            attractor_start=start,
            attractor_goal=goal,
            embedding_goal=rng.standard_normal(signature.EMBEDDING_SIZE, np.float32),
        )
        self._count = 0

    def __call__(self) -> None:
        """Run encoder, attractor and generator, carrying their states."""
        networks = self._networks
        image = self._images[self._count % len(self._images)]
        self._count += 1
        features, embedding, self._encoder = networks.encode(image, self._encoder)
        _, self._generator = networks.generate(
            networks.attract(features), embedding, self._generator
        )


class TheirTick:
    """One tick of the authors' architecture, on the same session options as ours."""

    def __init__(self, path: Path) -> None:
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.add_session_config_entry("session.inter_op.allow_spinning", "0")
        self._session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        rng = np.random.default_rng(0)
        self._inputs = {
            name: np.zeros(shape, np.float32)
            if name in authors.RECURRENT
            else rng.random(shape, np.float32)
            for name, shape in authors.INPUTS.items()
        }
        self._outputs = ["progress_out", "waypoint_out", "embedding_out"]
        self._outputs += [f"{name}_next" for name in authors.RECURRENT]

    def __call__(self) -> None:
        """Run the graph, carrying its states."""
        outputs = self._session.run(self._outputs, self._inputs)
        for name, value in zip(authors.RECURRENT, outputs[3:], strict=True):
            self._inputs[name] = value


def in_blocks(ours: Tick, theirs: Tick, blocks: int) -> dict[str, Any]:
    """Back to back in alternating blocks, each with warm caches: medians of the blocks' medians."""
    medians: dict[str, list[float]] = {"ours": [], "authors": []}
    for _ in range(blocks):
        for name, tick in (("ours", ours), ("authors", theirs)):
            medians[name].append(1e3 * _median_s(tick, BLOCK_TICKS, warm=WARM_TICKS))
    ratios = [a / o for o, a in zip(medians["ours"], medians["authors"], strict=True)]
    ours_ms, authors_ms = (statistics.median(medians[name]) for name in ("ours", "authors"))
    return {
        "ours_ms": ours_ms,
        "authors_ms": authors_ms,
        "ours_ms_range": [min(medians["ours"]), max(medians["ours"])],
        "authors_ms_range": [min(medians["authors"]), max(medians["authors"])],
        "ratio": authors_ms / ours_ms,
        "ratio_range": [min(ratios), max(ratios)],
    }


def paced(ours: Tick, theirs: Tick, seconds: float) -> dict[str, float]:
    """Each at 10 Hz, half a period apart, so that each finds the other's weights in the cache."""
    times: list[list[float]] = [[], []]
    begin = time.perf_counter()
    for slot in range(2 * max(1, round(seconds / STEP_S))):
        pause = begin + slot * 0.5 * STEP_S - time.perf_counter()
        if pause > 0.0:
            time.sleep(pause)
        times[slot % 2].append(_timed_s((ours, theirs)[slot % 2]))
    ours_ms, authors_ms = (1e3 * statistics.median(each) for each in times)
    return {
        "seconds": seconds,
        "ours_ms": ours_ms,
        "ours_p99_ms": 1e3 * float(np.percentile(times[0], 99)),
        "authors_ms": authors_ms,
        "authors_p99_ms": 1e3 * float(np.percentile(times[1], 99)),
        "ratio": authors_ms / ours_ms,
    }


def _median_s(call: Callable[[], object], times: int, *, warm: int) -> float:
    for _ in range(warm):
        call()
    return statistics.median(_timed_s(call) for _ in range(times))


def _timed_s(call: Callable[[], object]) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin
