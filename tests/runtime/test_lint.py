import json
from dataclasses import replace

import numpy as np
import pytest

from cbe.camera import MODEL_CAMERA
from cbe.errors import RouteError
from cbe.images import compress
from cbe.messages import CompressedImage
from cbe_runtime import cli, forecast
from cbe_runtime.forecast import Flag, judge
from cbe_runtime.lint import AS_IT_IS, Findings, Joint, Pictures, Replay, Segment, look_over
from cbe_runtime.mcapfile import Recorded, Recorder
from cbe_runtime.networks import Networks
from cbe_runtime.perturb import PERTURBATIONS
from cbe_runtime.teach import Teacher

SOUND = Replay(0.03, 1.0, 1.0, 1.0, 0.05, 0.98)
LIT = Pictures(120.0, 0.1)


def views(count, seed=0):
    """A drive whose colour never repeats, under a fixed pattern."""
    rng = np.random.default_rng(seed)
    pattern = rng.integers(0, 30, (64, 64, 3))
    colours = np.cumsum(rng.uniform(1.0, 3.0, (count, 3)), axis=0) % 220
    return [(pattern + colour).astype(np.uint8) for colour in colours]


def taught(networks, frames):
    teacher = Teacher(networks, MODEL_CAMERA, total_steps=len(frames) - 1)
    for frame in frames:
        teacher.feed(frame)
    return teacher.finish()


def made(model_writer, folder, **options):
    return Networks.load(model_writer(folder, **options))


@pytest.mark.parametrize("name", PERTURBATIONS)
def test_perturbed_image_differs_and_is_the_same_every_time(name):
    (image,) = views(1)
    perturbed = PERTURBATIONS[name](image, 7)
    assert perturbed.shape == image.shape
    assert perturbed.dtype == np.uint8
    assert (perturbed != image).any()
    np.testing.assert_array_equal(perturbed, PERTURBATIONS[name](image, 7))


def test_every_step_has_its_own_noise():
    (image,) = views(1)
    assert (PERTURBATIONS["noisy"](image, 0) != PERTURBATIONS["noisy"](image, 1)).any()


def test_figures_are_of_each_segment_and_joint(networks):
    frames = views(81)
    found = look_over(networks, taught(networks, frames), frames)
    assert [segment.steps for segment in found.segments] == [40, 40]
    assert [joint.joint for joint in found.joints] == [0, 1, 2]
    for segment in found.segments:
        assert set(segment.replays) == {AS_IT_IS, *PERTURBATIONS}
        # The stub counts ticks: 1 / 19.5 at the first, 21 / 19.5 at the last.
        assert segment.plain.progress_end == pytest.approx(21 / 19.5)
        assert segment.plain.progress_error < 0.09
        assert segment.plain.done_at == pytest.approx(0.95)
        assert segment.plain.waypoint_ahead == 1.0
        assert segment.plain.waypoint_change_m == 0.0


def test_frames_that_are_not_all_of_the_drive_are_refused(networks):
    frames = views(60)
    route = taught(networks, frames)
    for wrong in (frames[:-1], [*frames, frames[0]]):
        with pytest.raises(RouteError, match="60"):
            look_over(networks, route, wrong, {})


def test_another_drive_of_the_same_length_is_refused(networks):
    frames = views(60)
    route = taught(networks, frames)
    with pytest.raises(RouteError, match="joint 0"):
        look_over(networks, route, [255 - frame for frame in frames], {})


def test_route_of_another_model_is_refused(networks, route):
    with pytest.raises(RouteError, match="re-teach"):
        look_over(networks, replace(route, model_id="ffffffffffffffff"))


def flags(networks, frames):
    verdict = judge(look_over(networks, taught(networks, frames), frames, {}))
    return verdict.segment_flags, verdict.joint_flags


def test_segment_that_never_ends_is_flagged(model_writer, tmp_path):
    slow = made(model_writer, tmp_path / "slow", ticks_to_goal=40)
    assert Flag.NEVER_DONE in flags(slow, views(41))[0][0]


def test_segment_that_ends_early_is_flagged(model_writer, tmp_path):
    fast = made(model_writer, tmp_path / "fast", ticks_to_goal=8)
    assert {Flag.DONE_EARLY, Flag.PROGRESS} <= set(flags(fast, views(41))[0][0])


def test_waypoint_behind_the_robot_is_flagged(model_writer, tmp_path):
    backward = made(model_writer, tmp_path / "back", waypoint_m=(-0.5, 0.1))
    assert Flag.WAYPOINT in flags(backward, views(41))[0][0]


def test_joint_that_looks_the_same_around_it_is_weak(networks):
    frames = [views(1)[0]] * 81
    for joint in flags(networks, frames)[1]:
        assert joint == (Flag.WEAK_JOINT, Flag.LOOK_ALIKE)


def test_look_alike_names_the_other_joint(networks):
    frames = views(121)
    frames[120] = frames[40]
    found = look_over(networks, taught(networks, frames), frames, {})
    assert found.joints[1].nearest == found.joints[3].nearest == 0.0
    assert found.joints[1].nearest_joint == 3
    assert found.joints[3].nearest_joint == 1


def test_without_frames_joints_and_lengths_are_still_judged(networks, route):
    longer = (replace(route.segments[0], steps=90), route.segments[1])
    verdict = judge(look_over(networks, replace(route, segments=longer)))
    assert verdict.segment_flags == ((Flag.TOO_LONG,), ())
    assert verdict.predicted_success is None
    assert not verdict.passed
    assert "without the drive" in verdict.summary()
    assert verdict.findings.joints[0].nearest is not None


def findings(*plain, change=0.4, nearest=0.45, perturbed=SOUND, pictures=LIT):
    segments = tuple(
        Segment(i, 60, {AS_IT_IS: each, "noisy": perturbed}, pictures)
        for i, each in enumerate(plain)
    )
    joints = tuple(Joint(i, change, nearest, 0) for i in range(len(plain) + 1))
    return Findings(segments, joints, 100)


def test_sound_route_passes_without_flags():
    verdict = judge(findings(SOUND, SOUND))
    assert verdict.passed
    assert verdict.segment_flags == ((), ())
    assert verdict.joint_flags == ((), (), ())
    assert verdict.predicted_success == pytest.approx(verdict.chances[0] ** 2)
    assert verdict.predicted_success > 0.9


@pytest.mark.parametrize(
    "worse",
    [
        findings(replace(SOUND, progress_error=0.3)),
        findings(replace(SOUND, done_at=None)),
        findings(replace(SOUND, done_at=0.5)),
        findings(replace(SOUND, waypoint_ahead=0.6)),
        findings(replace(SOUND, waypoint_change_m=0.3)),
        findings(replace(SOUND, on_route=0.2)),
        findings(SOUND, perturbed=replace(SOUND, progress_error=0.3)),
        findings(SOUND, pictures=replace(LIT, brightness=20.0)),
        findings(SOUND, pictures=replace(LIT, still=0.6)),
    ],
)
def test_every_fault_is_flagged_and_lowers_the_prediction(worse):
    verdict, sound = judge(worse), judge(findings(SOUND))
    assert verdict.segment_flags[0]
    assert verdict.predicted_success < sound.predicted_success


def test_weak_and_look_alike_joints_are_flagged():
    assert judge(findings(SOUND, change=0.05)).joint_flags == ((Flag.WEAK_JOINT,),) * 2
    assert judge(findings(SOUND, nearest=0.2)).joint_flags == ((Flag.LOOK_ALIKE,),) * 2


def test_dark_and_covered_pictures_are_told(networks):
    lit = views(41)
    dark = [(frame / 12).astype(np.uint8) for frame in lit]
    covered = [frame.copy() for frame in lit]
    for frame in covered:
        frame[:, :40] = 20
    pictures = [
        look_over(networks, taught(networks, frames), frames, {}).segments[0].pictures
        for frames in (lit, dark, covered)
    ]
    assert pictures[0].brightness > 5.0 * pictures[1].brightness
    assert pictures[0].still == 0.0
    assert pictures[2].still == pytest.approx(40 / 64)


def test_every_flag_is_explained():
    assert set(forecast.MEANING) == set(Flag)


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "drive.mcap"
    rng = np.random.default_rng(0)
    with Recorder(path) as recorder:
        for step in range(61):
            stamp = 1_000_000_000 + step * 100_000_000
            image = compress(rng.integers(0, 256, (120, 160, 3), np.uint8), stamp)
            recorder.write(Recorded("/camera/x", CompressedImage.TYPE, image.to_cdr(), stamp))
    return path


def test_teaching_says_what_to_expect_and_lint_says_more(recording, model_folder, tmp_path, capsys):
    route = tmp_path / "route.msgpack"
    model = ["--model", str(model_folder)]
    assert cli.teach_main([str(recording), "-o", str(route), *model]) == 0
    said = capsys.readouterr().out
    assert "predicted success" in said

    code = cli.route_main(["lint", str(recording), str(route), "--json", *model])
    found = json.loads(capsys.readouterr().out)
    assert code == (0 if found["passed"] else 1)
    assert len(found["segments"]) == 2
    assert set(found["segments"][0]["replays"]) == {AS_IT_IS, *PERTURBATIONS}
    # Pictures of pure noise all look alike to the stub.
    assert found["joints"][0]["flags"] == ["weak_joint", "look_alike"]

    assert cli.route_main(["lint", str(recording), str(route), *model]) == code
    assert found["segments"][0]["predicted_success"] <= 1.0
    assert "look_alike: looks like another joint" in capsys.readouterr().out

    cli.route_main(["lint", str(route), "--json", *model])
    assert json.loads(capsys.readouterr().out)["predicted_success"] is None
