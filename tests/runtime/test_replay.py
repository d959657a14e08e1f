import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cbe import signature
from cbe.errors import RecordingError
from cbe.robot import Robot
from cbe_runtime import carried, cli, routefile
from cbe_runtime.comparison import Comparison, Tolerance
from cbe_runtime.decisionlog import parse
from cbe_runtime.follower import Follower
from cbe_runtime.followerconfig import FollowerConfig
from cbe_runtime.lost import LostConfig
from cbe_runtime.mcapfile import Recorder
from cbe_runtime.networks import Networks
from cbe_runtime.retrace import moments, retrace
from cbe_runtime.route import Precision, Route, Segment
from cbe_runtime.state import Reason, State

spec = importlib.util.spec_from_file_location("blackdrive", Path(__file__).parent / "blackdrive.py")
blackdrive = importlib.util.module_from_spec(spec)
spec.loader.exec_module(blackdrive)

# The tiny networks say nothing of sense about places: never lost.
NEVER_LOST = FollowerConfig(lost=LostConfig(usual=-50.0, unlike_end=99.0, unlike_rest=99.0))


@pytest.fixture(scope="module")
def module_route(networks):
    """Two segments of 30 steps."""
    rng = np.random.default_rng(1)
    precision = Precision()
    return Route(
        model_id=networks.model_id,
        camera=networks.camera,
        network_period=networks.network_period,
        precision=precision,
        attractors=tuple(
            precision.attractor.pack(rng.random(signature.ATTRACTOR_SIZE, np.float32))
            for _ in range(3)
        ),
        segments=tuple(
            Segment(precision.embedding.pack(np.zeros(signature.EMBEDDING_SIZE, np.float32)), 30)
            for _ in range(2)
        ),
    )


@pytest.fixture(scope="module")
def day(networks, module_route):
    return blackdrive.bad_day(Follower(networks, module_route, None, NEVER_LOST))


@pytest.fixture
def again(networks, module_route):
    """Make the decisions of some messages again: what came out, and the comparison."""

    def again(messages, tolerance=None, networks=networks):
        comparison = Comparison(tolerance)
        route = replace(module_route, model_id=networks.model_id)

        def make(config):
            return Follower(networks, route, Robot(), config)

        made = list(retrace(moments(messages, Robot()), make))
        for each in made:
            comparison.add(each)
        return made, comparison

    return again


def is_decision(message):
    return message.type_name == "cbe/Decision"


def changed(messages, index, change):
    """The messages with the record of one decision changed."""
    (at,) = [i for i, m in enumerate(messages) if is_decision(m) and record(m)["step"] == index]
    values = record(messages[at])
    change(values)
    return [
        *messages[:at],
        replace(messages[at], data=msgspec.json.encode(values)),
        *messages[at + 1 :],
    ]


def record(message):
    return msgspec.json.decode(message.data)


def test_day_shows_what_it_should(day):
    seen = {(each.state, each.reason) for each in day.decisions}
    reasons = (Reason.STALE_CAMERA, Reason.STALE_SCAN, Reason.BAD_IMAGE, Reason.OPERATOR)
    assert seen >= {(State.STOPPED, reason) for reason in reasons}
    assert seen >= {(State.IDLE, None), (State.FOLLOWING, None), (State.ARRIVED, None)}


def test_every_decision_comes_out_the_same(day, again):
    made, comparison = again(day.messages)
    assert [each.made for each in made] == day.decisions
    assert comparison.same
    assert "all are the same, bit for bit" in comparison.summary()


@pytest.mark.parametrize("cut", [60, 150, 300])
def test_drive_that_began_before_the_ring_is_taken_up_at_the_next_behavior(day, again, cut):
    made, comparison = again(day.messages[cut:])
    first = next(i for i, each in enumerate(made) if each.made is not None)
    assert 0 < first < len(made) - 20
    assert made[first - 1].moment.record.carried is not None
    assert all(each.made == each.moment.record.decision for each in made[first:])
    assert f"from step {made[first].moment.record.step} " in comparison.summary()


def test_changed_output_is_named(day, again):
    def change(values):
        faster_mps = np.nextafter(values["decision"]["speed_mps"], 1.0)
        values["decision"]["speed_mps"] = float(faster_mps)

    _, comparison = again(changed(day.messages, 15, change))
    assert not comparison.same
    assert (comparison.first.step, comparison.first.field) == (15, "speed_mps")
    assert "first step 15" in comparison.summary()


@pytest.mark.parametrize("kind", ["now_s", "asked"])
def test_changed_input_shows(day, again, kind):
    """What is compared depends on all that is recorded of clock and calls."""

    def change(values):
        if kind == "now_s":
            values["now_s"] += 10.0
        else:
            values["asked"]["stop"] = True

    _, comparison = again(changed(day.messages, 15, change))
    assert comparison.first.step == 15


def test_missing_frame_leaves_a_gap_until_the_next_behavior(day, again):
    frames = [i for i, m in enumerate(day.messages) if m.topic == blackdrive.CAMERA]
    without = [m for i, m in enumerate(day.messages) if i != frames[10]]
    made, comparison = again(without)
    assert made[10].made is None
    assert comparison.same
    assert "1 decision(s) whose frame or scan is not in the recording" in comparison.summary()
    assert any(each.made for each in made[11:])


def test_frame_of_the_right_stamp_but_another_picture_is_not_taken(day, again):
    frames = [i for i, m in enumerate(day.messages) if m.topic == blackdrive.CAMERA]
    other = day.messages[frames[11]]
    forged = blackdrive.CompressedImage.from_cdr(day.messages[frames[10]].data)
    forged = replace(forged, data=blackdrive.CompressedImage.from_cdr(other.data).data)
    messages = list(day.messages)
    messages[frames[10]] = replace(messages[frames[10]], data=forged.to_cdr())
    made, _ = again(messages)
    assert made[10].moment.observation is None


def test_lost_decision_leaves_a_gap(day, again):
    decisions = [i for i, m in enumerate(day.messages) if is_decision(m)]
    _, comparison = again([m for i, m in enumerate(day.messages) if i != decisions[20]])
    assert comparison.same
    assert "1 gap(s)" in comparison.summary()


def test_second_run_begins_anew(networks, module_route, day, again):
    first_ns = day.messages[-1].log_time_ns + 1
    follower = Follower(networks, module_route, None, NEVER_LOST)
    second = blackdrive.Drive(follower, seed=9, first_ns=first_ns)
    follower.start()
    second.step(20)
    made, comparison = again([*day.messages, *second.messages])
    assert all(each.made is not None for each in made)
    assert comparison.same


def test_other_model_is_compared_within_a_tolerance(day, again, model_writer, tmp_path):
    metadata = {"cbe.model_id": "ffffffffffffffff"}
    other = Networks.load(model_writer(tmp_path, waypoint_m=(0.5, 0.2), **metadata))
    _, strict = again(day.messages, Tolerance(), other)
    assert strict.first.field == "waypoint_m"
    assert "between waypoints" in strict.summary()
    near = Networks.load(model_writer(tmp_path, waypoint_m=(0.5, 0.002), **metadata))
    assert again(day.messages, Tolerance(), near)[1].same


def test_record_holds_numbers_exactly(day):
    for message, decision in zip(filter(is_decision, day.messages), day.decisions, strict=True):
        assert parse(message.data).decision == decision


def test_nothing_that_the_follower_carries_is_left_out(networks, module_route):
    """A new kind of attribute must be carried, or begun anew with each behavior."""
    follower = Follower(networks, module_route, None, NEVER_LOST)
    assert carried.take(follower) is not None
    drive = blackdrive.Drive(follower)
    follower.start()
    while follower.state is not State.ARRIVED:
        drive.step()
        told = carried.take(follower)
        assert (told is not None) == carried.is_all(follower)


@pytest.mark.parametrize(
    "damage",
    [
        lambda state: state.pop("segment"),
        lambda state: state.update(segment=99),
        lambda state: state["follower"].pop("_motion"),
        lambda state: state["follower"].update(_motion={"dataclass": ["os:system", {}]}),
        lambda state: state["follower"].update(_motion={"enum": ["subprocess:Popen", "ls"]}),
        lambda state: state["follower"].update(_motion={"array": ["O", [1], "AAAAAAAAAAA="]}),
        lambda state: state["follower"].update(_motion={"array": ["<f8", [10**12], "AAAA"]}),
        lambda state: state["follower"].update(_motion={"a": 1, "b": 2}),
    ],
)
def test_damaged_state_is_refused(networks, module_route, damage):
    state = msgspec.json.decode(
        msgspec.json.encode(carried.take(Follower(networks, module_route, None, NEVER_LOST)))
    )
    damage(state)
    with pytest.raises(RecordingError, match="another version or damaged"):
        carried.give(state, Follower(networks, module_route, None, NEVER_LOST))


def test_damaged_record_is_refused(day, again):
    broken = replace(next(filter(is_decision, day.messages)), data=b'{"version": 1}')
    with pytest.raises(RecordingError, match="another version or damaged"):
        again([broken])


@pytest.fixture
def written(day, module_route, model_folder, tmp_path):
    """The recorded day as a file, and the arguments to replay it with."""
    path, route = tmp_path / "day.mcap", tmp_path / "route.msgpack"
    with Recorder(path) as recorder:
        for message in day.messages:
            recorder.write(message)
    routefile.save(module_route, route)
    return [str(path), "--memory", str(route), "--model", str(model_folder)]


def test_command_tells_a_black_box_from_footage(day, written, capsys):
    assert cli.replay_main(written) == 0
    shown = capsys.readouterr()
    lines = [json.loads(line) for line in shown.out.splitlines()]
    assert [line["step"] for line in lines] == list(range(1, len(day.decisions) + 1))
    assert all(line["same"] for line in lines)
    assert "bit for bit" in shown.err

    assert cli.replay_main([*written, "--footage"]) == 0
    shown = capsys.readouterr()
    assert "same" not in json.loads(shown.out.splitlines()[0])
    assert "it came as far as segment" in shown.err


def test_pictures_and_a_film_are_written(written, tmp_path, capsys):
    import cv2

    sheet, film = tmp_path / "sheet.png", tmp_path / "drive.avi"
    arguments = [*written, "--quiet", "--sheet", str(sheet), "--video", str(film)]
    assert cli.replay_main(arguments) == 0
    assert capsys.readouterr().out == ""
    assert cv2.imread(str(sheet)).std() > 20
    frames = cv2.VideoCapture(str(film))
    assert frames.get(cv2.CAP_PROP_FRAME_COUNT) > 100
    assert frames.read()[1].std() > 20


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--video", "x.gif"], "should end in"), (["--video", "none/x.mp4"], "cannot write")],
)
def test_film_that_cannot_be_written_is_refused(written, arguments, message, capsys):
    assert cli.replay_main([*written, *arguments]) == 2
    assert message in capsys.readouterr().err


def test_another_route_is_refused(written, module_route, tmp_path, capsys):
    routefile.save(replace(module_route, tags={"name": "another"}), tmp_path / "route.msgpack")
    assert cli.replay_main(written) == 2
    assert "the recorded drive was of route" in capsys.readouterr().err
