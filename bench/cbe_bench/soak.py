"""A long drive in real time: one runtime repeats a route again and again and is held to bars."""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cbe.errors import CbeError, LinkError
from cbe.link import Link
from cbe.linkconfig import LinkConfig
from cbe_bench.demo_course import choose
from cbe_bench.demo_processes import Child, Crew, ProcessError, free_port, rss_mib
from cbe_bench.demo_stage import DemoConfig, Stage
from cbe_bench.demo_witness import Witness
from cbe_hil_sim.generate import TEST_HOUSES, generate

if TYPE_CHECKING:
    from collections.abc import Callable

    from cbe.inbox import Latest
    from cbe.link import JsonObject
    from cbe_bench.demo_course import Course

SIM_START_S = 180.0
POLL_S = 0.2
LAP_S = 120.0
"""A lap that takes longer is begun anew: what is judged here is time, not navigation."""
WARM_SHARE = 0.2
"""Of the time, until memory is compared: by then every buffer has its size."""
GROWTH_MIB, MISSED_SHARE, P99_MS, WORST_MS = 2.0, 0.001, 5.0, 50.0


class BarError(CbeError):
    """A bar was not met."""


@dataclass(frozen=True, slots=True)
class Soaked:
    """What was measured of one runtime's process; CPU as a share of one core.

    `stolen` is the share of the time wanted by all processes that a virtual machine's host gave to
    others: a tick that falls into such a gap is late whatever the runtime does.
    """

    minutes: float
    laps: int
    ticks: int
    missed: int
    over_p99_bar: int  # ticks that took longer than `P99_MS`
    worst_tick_ms: float
    camera_to_command_ms: dict[str, float | None]
    rss_mib: float
    growth_mib: float
    cpu: float
    stolen: float

    @property
    def failures(self) -> list[str]:
        """The bars that were not met."""
        judged = {
            f"memory grew by {self.growth_mib:.1f} MiB": self.growth_mib < GROWTH_MIB,
            f"{self.missed} of {self.ticks} ticks were missed": self.missed
            < MISSED_SHARE * self.ticks,
            f"{self.over_p99_bar} ticks took more than {P99_MS:g} ms": self.over_p99_bar
            < 0.01 * self.ticks,
            f"a tick took {self.worst_tick_ms:.1f} ms": self.worst_tick_ms < WORST_MS,
        }
        return [what for what, met in judged.items() if not met]

    def json(self) -> dict[str, Any]:
        """For a file."""
        return asdict(self) | {"failures": self.failures}

    def table(self) -> str:
        """For a reader."""
        answered = self.camera_to_command_ms
        rows = (
            ("driven", f"{self.minutes:.1f} min, {self.laps} laps, {self.ticks} ticks", ""),
            ("memory growth", f"{self.growth_mib:+.2f} MiB", f"< {GROWTH_MIB:g} MiB"),
            ("missed ticks", f"{self.missed}", f"< {100 * MISSED_SHARE:g} %"),
            (f"ticks over {P99_MS:g} ms", f"{self.over_p99_bar}", "< 1 %"),
            ("worst tick", f"{self.worst_tick_ms:.1f} ms", f"< {WORST_MS:g} ms"),
            ("camera to command", f"{answered['p50']} / {answered['p99']} ms", ""),
            ("RSS, CPU", f"{self.rss_mib:.0f} MiB, {100 * self.cpu:.1f} % of one core", ""),
            ("taken by the host", f"{100 * self.stolen:.1f} % of the time wanted", ""),
        )
        return "\n".join(f"{name:<20} {value:<34} {bar}".rstrip() for name, value, bar in rows)


def run(minutes: float, seed: int, model: Path | None, note: Callable[[str], None]) -> Soaked:
    """Teach a drive in simulation and repeat it for so long.

    Raises:
        CbeError: a part refused to work, or ended.
    """
    course = choose(generate(TEST_HOUSES[seed]), seed)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with tempfile.TemporaryDirectory() as folder, Crew(Path(folder)) as crew:
        config = DemoConfig(seed, None, False, False, Path(folder), model)
        sim = crew.start(
            "cbe-sim", "--backend", "column", "--world", str(TEST_HOUSES[seed]),
            "--listen", endpoint, "--start=" + ",".join(f"{value:.6f}" for value in course.start),
        )  # fmt: skip
        with _connected(endpoint, sim) as link:
            with Witness(link) as witness:
                stage = Stage(config, crew, link, witness, sim, endpoint)
                note("demonstrating and teaching ...")
                drive = stage.demonstrate(course, lambda _: None)
                route = stage.teach(drive, lambda _: None)
            note(f"repeating for {minutes:g} min ...")
            runtime = crew.start(
                "cbe-runtime", "--memory", str(route), "--connect", endpoint, "--wait",
                *config.model_options,
            )  # fmt: skip
            return _soak(link, runtime, course, 60.0 * minutes)


def _soak(link: Link, runtime: Child, course: Course, duration_s: float) -> Soaked:
    statuses = link.latest_json("status")
    before = status = _first(statuses, runtime)
    began_s, cpu_s = time.monotonic(), _cpu_s(runtime.pid)
    wanted, stolen = _processors()
    laps, lap_s = 0, -np.inf
    rss: list[float] = []
    while (now_s := time.monotonic()) - began_s < duration_s:
        runtime.require_running()
        if status["state"] in {"IDLE", "ARRIVED"} or now_s - lap_s > LAP_S:
            laps += status["state"] == "ARRIVED"
            link.call("stop")
            link.call("reset", {"pose": course.start.tolist()}, timeout_s=30.0)
            link.call("start")
            lap_s = now_s
        time.sleep(5.0 * POLL_S if now_s == lap_s else POLL_S)
        rss.append(rss_mib(runtime.pid))
        newest = statuses.get()
        if newest is not None and newest.message is not None:
            status = newest.message
    wall_s = time.monotonic() - began_s
    then_wanted, then_stolen = _processors()
    warm = rss[int(WARM_SHARE * len(rss)) :]
    tenth = max(len(warm) // 10, 1)
    bounds = status["histograms"]["bounds_ms"]
    counts = np.array(status["histograms"]["tick"]) - before["histograms"]["tick"]
    return Soaked(
        minutes=wall_s / 60.0,
        laps=laps,
        ticks=int(counts.sum()),
        missed=status["overruns"] - before["overruns"],
        over_p99_bar=int(counts[bounds.index(P99_MS) + 1 :].sum()),
        worst_tick_ms=status["tick_ms"]["max"],
        camera_to_command_ms=status["camera_to_command_ms"],
        rss_mib=max(rss),
        growth_mib=float(np.median(warm[-tenth:]) - np.median(warm[:tenth])),
        cpu=(_cpu_s(runtime.pid) - cpu_s) / wall_s,
        stolen=(then_stolen - stolen) / max(then_wanted - wanted, 1),
    )


def _first(statuses: Latest[JsonObject], runtime: Child) -> JsonObject:
    """The first status that counts ticks; while it hangs, a runtime says no more than that."""
    began_s, count = time.monotonic(), 0
    while time.monotonic() - began_s < SIM_START_S:
        heard = statuses.wait(count, POLL_S)
        if heard is not None and heard.message is not None and "histograms" in heard.message:
            return heard.message
        count = heard.count if heard is not None else count
    raise ProcessError(f"the runtime says nothing:\n{runtime.tail()}")


def _connected(endpoint: str, sim: Child) -> Link:
    began_s = time.monotonic()
    while True:
        sim.require_running()
        try:
            return Link.open(LinkConfig(connect=(endpoint,), open_timeout_s=0.5))
        except LinkError:
            if time.monotonic() - began_s > SIM_START_S:
                raise


def _cpu_s(pid: int) -> float:
    """Time that a process has spent on processors."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _processors() -> tuple[int, int]:
    """Time (clock ticks) that processes wanted all processors, and of it what the host took."""
    line = Path("/proc/stat").read_text().splitlines()[0].split()
    user, nice, system, _, _, irq, soft, steal = (int(field) for field in line[1:9])
    return user + nice + system + irq + soft + steal, steal
