"""Faults strike link, processor or process; the robot stops or drives on, as it must."""

import json
import math

import numpy as np
import pytest

from cbe.camera import MODEL_CAMERA
from cbe.messages import Twist, TwistStamped
from cbe.signature import OVERRUN_M
from cbe.topics import CMD_VEL
from cbe_bench import evaluation, scenario, single
from cbe_bench.cli import main
from cbe_bench.episode import Outcome
from cbe_bench.faultlink import FaultyLink, Lane, Timeline
from cbe_bench.faultlist import FAULTS, NONE, chosen
from cbe_bench.faultride import FaultyRide, ride
from cbe_bench.faults import _tally
from cbe_hil_sim.backend import Observation as Seen
from cbe_hil_sim.vehicle import Vehicle
from cbe_runtime.decision import Decision
from cbe_runtime.follower import Follower
from cbe_runtime.networks import Networks, Prediction
from cbe_runtime.state import State

STEPS = 48
LENGTH_M = 0.05 * STEPS
ZERO_S, STAND_S = 0.4, 0.8
GRAIN = np.random.default_rng(0).integers(60, 200, (64, 64, 3), np.uint8)


class Hall:
    """`Backend` of one car in a long hall whose pictures change with its place."""

    def __init__(self, wall_x_m=math.inf):
        self._vehicle = Vehicle(np.zeros((1, 3)))
        self._wall_x_m = wall_x_m

    @property
    def poses(self):
        return self._vehicle.poses.copy()

    @property
    def clearance_m(self):
        return np.array([self._wall_x_m - self._vehicle.poses[0, 0]], np.float32)

    @property
    def collided(self):
        return self.clearance_m < 0.0

    def reset(self, poses):
        self._vehicle.reset(poses)

    def observe(self):
        image = np.roll(GRAIN, round(200 * self._vehicle.poses[0, 0]), axis=1)
        return Seen(image[None], np.full((1, 240), 3.0, np.float32))

    def step(self, speed_mps, yaw_rate_rad_s):
        self._vehicle.step(speed_mps, yaw_rate_rad_s)


class StraightOn:
    """Stands for `Networks`: the waypoint is ahead, and progress a function of the ticks."""

    model_id = "0011223344556677"
    network_period = 2
    segment_steps = 100
    camera = MODEL_CAMERA

    def __init__(self, progress):
        self._progress = progress

    def encoder_state(self):
        return None

    def encode(self, image, state):
        return np.zeros((1, 1), np.float32), np.zeros(32, np.float32), None

    def attract(self, features):
        return np.full(400, 0.5, np.float32)

    def recall(self, **memory):
        return 0

    def generate(self, attractor, embedding, state):
        progress = self._progress(state)
        end = np.array([(1.0 - progress) * LENGTH_M, 0.0, 1.0, 0.0])
        ahead = np.array([min(0.5, end[0] + OVERRUN_M), 0.0])
        return Prediction(ahead, progress, 1.0, end), state + 1


class Blind:
    """A driver that never looks: straight on, for ever."""

    def start(self):
        pass

    def step(self, observation, now_s):
        return Decision(
            speed_mps=0.5, yaw_rate_rad_s=0.0, state=State.FOLLOWING, reason=None,
            segment=0, segments=1, progress=0.0, on_route=1.0, waypoint_m=None,
            camera_age_s=0.0, scan_age_s=0.0, standing=False, ticked=True,
        )  # fmt: skip


def named(name):
    (fault,) = chosen([name])
    return fault


def drive(fault, seed=0, driver=None, backend=None):
    backend = backend or Hall()
    networks = StraightOn(lambda _: float(backend.poses[0, 0]) / LENGTH_M)
    if driver is None:
        driver = Follower(networks, single.teach(networks, [GRAIN] * (STEPS + 1)))
    demonstration = np.zeros((STEPS + 1, 3))
    demonstration[:, 0] = 0.05 * np.arange(STEPS + 1)
    rng = np.random.default_rng(seed)
    return ride(driver, backend, lambda image: image, demonstration, np.zeros(3), fault, rng)


def name_of(fault):
    return f"{fault.name}:{fault.level}"


def test_drive_without_a_fault_arrives():
    done = drive(NONE)
    assert done.outcome is Outcome.ARRIVED
    assert done.zero_s is None


@pytest.mark.parametrize("fault", [f for f in FAULTS if f.must_stop], ids=name_of)
def test_fault_that_must_stop_the_robot_stops_it_in_time_and_heals(fault):
    done = drive(fault)
    assert done.zero_s <= ZERO_S
    assert done.stop_s <= STAND_S
    assert done.outcome is Outcome.ARRIVED
    assert done.steps > drive(NONE).steps


@pytest.mark.parametrize("fault", [f for f in FAULTS if not f.must_stop], ids=name_of)
def test_robot_arrives_despite_any_other_fault(fault):
    assert drive(fault).outcome is Outcome.ARRIVED


def test_same_seed_gives_the_same_ride_and_another_seed_another():
    loss = named("frame-loss:50%")
    first = drive(loss, seed=3)
    assert drive(loss, seed=3) == first
    assert {drive(loss, seed=seed).steps for seed in range(4)} != {first.steps}


def test_robot_stops_by_itself_when_commands_stop_coming():
    done = drive(named("commands:rejected"), driver=Blind())
    assert done.zero_s <= ZERO_S
    assert done.stop_s <= STAND_S


def test_driver_that_ignores_a_dead_lidar_never_stands():
    fault = named("scan:dead")
    done = drive(fault, driver=Blind())
    assert done.stop_s == done.zero_s == math.inf
    row = _tally(fault, [done], [done])
    assert row["worst_stop_s"] == row["worst_zero_s"] == -1.0
    json.dumps(row, allow_nan=False)


def test_blind_driver_collides():
    done = drive(named("camera:black"), driver=Blind(), backend=Hall(wall_x_m=2.5))
    assert done.outcome is Outcome.COLLISION


def test_collision_counts_against_a_fault_only_where_there_is_none_without_it():
    hit, went = FaultyRide(Outcome.COLLISION, 9), FaultyRide(Outcome.ARRIVED, 9, 0.3, 0.5)
    row = _tally(named("camera:dead"), [hit, hit, went, went], [hit, went, hit, went])
    assert (row["collisions"], row["collisions_without"]) == (1, 2)
    assert row["success"] == 0.5
    assert (row["worst_zero_s"], row["worst_stop_s"]) == (0.3, 0.5)


def twist(speed_mps):
    return TwistStamped(0, "base_link", Twist.planar(speed_mps, 0.0))


@pytest.fixture
def link():
    timeline = Timeline()
    link = FaultyLink(timeline, np.random.default_rng(0))
    return timeline, link, link.latest(CMD_VEL)


def test_message_comes_late_by_its_lane(link):
    timeline, link, inbox = link
    link.send(CMD_VEL, twist(0.1), Lane(late_s=0.2))
    timeline.advance(0.19)
    assert inbox.get() is None
    timeline.advance(0.21)
    assert inbox.get().received_s == pytest.approx(0.201)


def test_held_messages_come_at_once_and_the_newest_last(link):
    timeline, link, inbox = link
    for number in range(5):
        link.send(CMD_VEL, twist(0.1 * number), Lane(held=True), until_s=2.0)
        timeline.advance(timeline.now_s + 0.1)
    timeline.advance(1.999)
    assert inbox.get() is None
    timeline.advance(2.01)
    assert inbox.stats.received == 5
    assert inbox.get().message.twist.speed_mps == pytest.approx(0.4)


def test_share_of_lost_messages_is_that_of_the_lane(link):
    timeline, link, inbox = link
    for _ in range(1000):
        link.send(CMD_VEL, twist(0.1), Lane(lost=0.3))
    timeline.advance(1.0)
    assert 660 < inbox.stats.received < 740


@pytest.fixture
def straight_on(monkeypatch):
    monkeypatch.setattr(scenario, "GROUP", 2)
    monkeypatch.setattr(evaluation, "GROUP", 2)
    monkeypatch.setattr(
        Networks, "load", classmethod(lambda cls, folder: StraightOn(lambda n: n / 10))
    )
    yield
    evaluation._networks.cache_clear()


def test_command_writes_the_promised_keys(straight_on, tmp_path, capsys):
    path = tmp_path / "faults.json"
    options = ["--steps", "20", "--episodes", "2", "--world", "val", "--jobs", "1"]
    named = ["--faults", "camera:black,frame-loss", "--json", str(path)]
    assert main(["faults", *options, *named]) == 0
    result = json.loads(path.read_text())
    assert [row["fault"] for row in result["faults"]] == ["frame-loss"] * 3 + ["camera"]
    for row in result["faults"]:
        assert row.keys() >= {
            "fault", "level", "episodes", "success", "collisions", "collisions_without",
            "worst_stop_s",
        }  # fmt: skip
        assert row["episodes"] == 2
    assert "frame-loss" in capsys.readouterr().out


def test_unknown_fault_is_refused_by_name(capsys):
    assert main(["faults", "--faults", "camera:purple"]) == 1
    assert "camera:purple" in capsys.readouterr().err
