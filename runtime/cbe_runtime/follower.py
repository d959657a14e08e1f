"""Repeats a route: one decision a step from image and scan, without any I/O (paper, Sec. III)."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cbe.controller import Motion, RmpController, twist
from cbe.errors import ModelError
from cbe.parking import REACH_M
from cbe.robot import STEP_S, Robot
from cbe.signature import OVERRUN_M
from cbe.stop_zone import limit
from cbe_runtime.approach import Approach
from cbe_runtime.behavior import Behavior
from cbe_runtime.berth import Berth
from cbe_runtime.caution import slowed
from cbe_runtime.decision import Asked, Decision
from cbe_runtime.followerconfig import FollowerConfig
from cbe_runtime.joining import Search, Whereabouts, advice
from cbe_runtime.likeness import visible
from cbe_runtime.lost import LostBelief
from cbe_runtime.observation import Observation, StampWatch, newer, usable_image, usable_ranges
from cbe_runtime.plausible import PictureWatch, ReturnWatch
from cbe_runtime.state import Events, Reason, State, StateMachine

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cbe_runtime.joining import Hypothesis
    from cbe_runtime.networks import Networks, Prediction
    from cbe_runtime.observation import Frame
    from cbe_runtime.route import Route


AHEAD_RAD = math.radians(20.0)
"""To each side, what is straight ahead."""


class Follower:
    """Drives one robot along one route, a behavior at a time.

    `start` and `stop` take effect in the next `step`. A start from IDLE or ARRIVED begins at the
    route's first segment, one from STOPPED goes on where it was.

    Raises:
        RouteError: the route was taught with another model.
    """

    def __init__(
        self,
        networks: Networks,
        route: Route,
        robot: Robot | None = None,
        config: FollowerConfig | None = None,
    ) -> None:
        route.require_model(networks)
        self._networks = networks
        self._route = route
        self._robot = robot or Robot()
        self._config = config or FollowerConfig()
        self._controller = RmpController(self._robot)
        self._berth = Berth(self._robot, self._config.berth)
        self._approach = Approach(self._config.approach)
        self._camera_watch = StampWatch(
            self._config.fresh_s, Reason.STALE_CAMERA, Reason.FROZEN_CAMERA
        )
        self._scan_watch = StampWatch(self._config.fresh_s, Reason.STALE_SCAN, Reason.FROZEN_SCAN)
        self._picture_watch = PictureWatch(self._config.fresh_s)
        self._return_watch = ReturnWatch()
        self._machine = StateMachine()
        self._asking: deque[Asked] = deque()  # filled by other threads
        self.asked = Asked()
        """What the last step was asked."""
        self._motion = Motion(np.zeros(1), np.zeros(1))
        self._command = (0.0, 0.0)  # m/s, rad/s
        self._behavior = Behavior(networks, route, 0)
        self._belief = LostBelief(self._config.lost)
        self._search: Search | None = None
        self._age_steps = 0  # steps spent on the present segment
        self._done_ticks = 0  # ticks in a row that called it done
        self._since_tick_steps = networks.network_period
        self._gap_steps = 0  # between the last two ticks
        self._seen_stamp_ns: int | None = None
        self._prediction: Prediction | None = None
        self._waypoint_m: tuple[float, float] | None = None  # at the present pose
        self._ranges_m: NDArray[np.float64] | None = None  # of the present step

    @property
    def model_id(self) -> str:
        """Of the networks in use."""
        return self._networks.model_id

    @property
    def state(self) -> State:
        """The state after the last step."""
        return self._machine.state

    @property
    def segments(self) -> int:
        """Of the route."""
        return len(self._route.segments)

    @property
    def advice(self) -> str | None:
        """What a person can do for the robot, where it is LOST."""
        if self._machine.state is not State.LOST:
            return None
        return advice(self._place(), self._route)

    def start(self) -> None:
        """Ask to follow the route."""
        self._asking.append(Asked(start=True))

    def stop(self) -> None:
        """Ask to stop until the next start; wins over a start asked for in the same step."""
        self._asking.append(Asked(stop=True))

    def ask(self, asked: Asked) -> None:
        """Ask for what was asked of another follower."""
        self._asking.append(asked)

    def relocalise(self, near: Whereabouts | None = None) -> None:
        """Ask to look for the robot's place on the route, first `near` a place, and to go on."""
        self._asking.append(Asked(relocalise=True, near=near))

    def step(self, observation: Observation, now_s: float) -> Decision:
        """Decide what to command for the next 0.1 s; call once a step.

        Args:
            observation: newest frame and scan.
            now_s: on the clock of their `received_s`.
        """
        self.asked = asked = self._take_asked()
        self._carry_waypoint()
        image, ranges_m, fault = self._judge(observation, now_s)
        self._ranges_m = ranges_m
        before = self._machine.state
        if asked.start and before not in {State.FOLLOWING, State.STOPPED}:
            self._restart()
        elif asked.start:
            self._age_steps = 0
        self._machine.update(Events(asked.start, asked.stop, fault, relocalise=asked.relocalise))
        state = self._machine.state
        if state is State.JOINING and (asked.relocalise or before is not State.JOINING):
            self._seek(asked.near)

        ticked = False
        if state in {State.FOLLOWING, State.LOST, State.JOINING}:
            assert image is not None
            assert observation.frame is not None
            tick = self._follow if state is State.FOLLOWING else self._look_for_place
            ticked = tick(image, observation.frame)
        self._move(ranges_m, now_s)
        return self._decision(observation, now_s, ticked)

    def _take_asked(self) -> Asked:
        asked = [self._asking.popleft() for _ in range(len(self._asking))]
        hints = [each.near for each in asked if each.relocalise]
        return Asked(
            any(each.start for each in asked),
            any(each.stop for each in asked),
            bool(hints),
            hints[-1] if hints else None,
        )

    def _judge(
        self, observation: Observation, now_s: float
    ) -> tuple[NDArray[np.uint8] | None, NDArray[np.float64] | None, Reason | None]:
        """Image and ranges where they can be relied on, and the first thing that is wrong."""
        frame, scan = observation.frame, observation.scan
        camera_fault = self._camera_watch.fault(frame, now_s)
        scan_fault = self._scan_watch.fault(scan, now_s)
        image = None if camera_fault or frame is None else usable_image(frame)
        ranges_m = None if scan_fault or scan is None else usable_ranges(scan, self._robot)
        if image is None:
            return image, ranges_m, camera_fault or Reason.BAD_IMAGE
        if ranges_m is None or not self._return_watch.plausible(ranges_m):
            return image, None, scan_fault or Reason.BAD_SCAN
        assert frame is not None
        fault = self._picture_watch.fault(frame, image, ranges_m, self._command[0], now_s)
        return image, ranges_m, fault

    def _follow(self, image: NDArray[np.uint8], frame: Frame) -> bool:
        """Run the networks if they are due; tells whether they ran."""
        self._age_steps += 1
        config = self._config
        if self._age_steps > config.timeout_factor * self._behavior.steps + config.timeout_steps:
            self._machine.update(Events(fault=Reason.TIMEOUT))
            return False
        if self._berth.taken:
            return self._park(image, frame)
        try:
            if not self._due(frame):
                self._behavior.look_onward()
                return False
            prediction = self._behavior.tick(image)
            waypoint_m = self._behavior.waypoint_m(prediction)
        except ModelError:
            self._machine.update(Events(fault=Reason.MODEL_FAULT))
            return False
        self._ticked(frame, prediction, waypoint_m)
        self._belief.update(prediction.on_route)
        self._judge_progress(prediction)
        if self._belief.lost and self._machine.state is State.FOLLOWING:
            self._lose()
        return True

    def _due(self, frame: Frame) -> bool:
        """Whether the networks are to run on this frame; call once a step."""
        self._since_tick_steps += 1
        # A frame is seen once and in order, however it is delivered: the encoder counts frames.
        due = self._since_tick_steps >= self._networks.network_period
        new = self._camera_watch.newest(frame) and newer(frame.stamp_ns, self._seen_stamp_ns)
        return due and new and self._picture_watch.shows

    def _ticked(
        self,
        frame: Frame,
        prediction: Prediction | None,
        waypoint_m: tuple[float, float] | None,
    ) -> None:
        """Keep what a tick on the frame said, if anything, and where it leads."""
        self._gap_steps, self._since_tick_steps = self._since_tick_steps, 0
        self._seen_stamp_ns = frame.stamp_ns
        self._prediction, self._waypoint_m = prediction, waypoint_m
        if prediction is not None and self._behavior.pinned:
            self._approach.read(float(prediction.end[0]))

    def _judge_progress(self, prediction: Prediction) -> None:
        """Start the next behavior, or arrive, once enough ticks in a row say so."""
        config, behavior, last = self._config, self._behavior, self._behavior.last
        rest = self._end(prediction)
        range_m = math.hypot(rest[0], rest[1])
        done = config.ends(prediction, behavior.steps, last=last)
        if not done and last and behavior.pinned and config.may_see_end(prediction, range_m):
            walled = self._free_ahead_m() <= config.walled_m
            done = walled and behavior.unlike_goal <= config.seen_unlike
        self._done_ticks = self._done_ticks + 1 if done else 0
        if self._done_ticks < config.progress_ticks:
            return
        as_remembered = range_m <= REACH_M and behavior.unlike_goal <= config.lost.unlike_end
        if not as_remembered:
            self._belief.contradict()
        if not last:
            self._begin(behavior.segment + 1)
        elif as_remembered:
            self._berth.take(rest, behavior.unlike_goal, prediction.on_route)
            self._waypoint_m = self._berth.place_m

    def _free_ahead_m(self) -> float:
        """Range of the nearest return straight ahead of the lidar, inf without one."""
        if self._ranges_m is None:
            return math.inf
        half = round(AHEAD_RAD / self._robot.scan_angle_increment_rad)
        middle = len(self._ranges_m) // 2
        return float(np.fmin.reduce(self._ranges_m[middle - half : middle + half]))

    def _end(self, prediction: Prediction) -> NDArray[np.float64]:
        """The behavior's last pose (3,) in base_link, as the view shows it."""
        if self._behavior.pinned:
            x, y, cos, sin = prediction.end
            return np.array([x, y, math.atan2(sin, cos)])
        x, y = prediction.waypoint_m  # nothing else tells
        return np.array([x - OVERRUN_M, y, 0.0])

    def _park(self, image: NDArray[np.uint8], frame: Frame) -> bool:
        """Look whether the end is still ahead, and arrive there; tells whether the networks ran."""
        if float(self._motion.speed_mps[0]) <= 0.0:
            self._stand(image)
            return False
        if not self._due(frame):
            return False
        try:
            prediction = self._behavior.tick(image)
        except ModelError:
            self._machine.update(Events(fault=Reason.MODEL_FAULT))
            return False
        end = self._end(prediction) if self._behavior.pinned else self._berth.pose
        self._berth.look(end, self._behavior.unlike_goal, prediction.on_route)
        self._ticked(frame, prediction, self._berth.place_m)
        return True

    def _stand(self, image: NDArray[np.uint8]) -> None:
        """Having come to stand, arrive if this is the end."""
        self._berth.taken = False
        self._done_ticks = 0
        if self._berth.held_up:
            return  # by an obstacle: it goes on
        lost, berth, seen = self._config.lost, self._berth, visible(image)
        sure = berth.most_doubt <= lost.doubt_rest
        alike = berth.lowest <= lost.unlike_rest * seen**lost.narrow
        nearer = self._approach.nearer_m >= lost.nearer_rest_m or seen < lost.wide
        if sure and alike and nearer and self._apart_m() <= lost.apart_rest_m:
            self._machine.update(Events(arrived=True))
            return
        self._lose().give_up()  # to look again it would drive on past the end

    def _apart_m(self) -> float:
        """How far from where the view shows the end the waypoint, which runs past it, puts it."""
        if self._prediction is None:
            return 0.0
        x, y, yaw = self._end(self._prediction)
        ahead_x, ahead_y = self._prediction.waypoint_m
        return math.hypot(
            ahead_x - OVERRUN_M * math.cos(yaw) - x, ahead_y - OVERRUN_M * math.sin(yaw) - y
        )

    def _lose(self) -> Search:
        """Stand, and look for the place."""
        self._machine.update(Events(lost=True))
        return self._seek(None)

    def _seek(self, near: Whereabouts | None) -> Search:
        """Begin to look for the robot's place."""
        search = Search(self._networks, self._route, self._config.lost, self._config.join, near)
        self._search = search
        self._prediction = None
        self._waypoint_m = None
        return search

    def _look_for_place(self, image: NDArray[np.uint8], frame: Frame) -> bool:
        """A tick of the search if it is due; tells whether the networks ran."""
        search = self._search
        assert search is not None
        if not self._due(frame) or (search.standing and self._motion.speed_mps[0] > 0.0):
            return False
        try:
            if search.failed and search.elsewhere(image):
                self._seek(None)  # somebody moved the robot
            elif not search.failed:
                search.look(image)
        except ModelError:
            self._machine.update(Events(fault=Reason.MODEL_FAULT))
            return False
        waypoint_m = None
        if search.prediction is not None:
            x, y = search.prediction.waypoint_m
            waypoint_m = (float(x), float(y))
        self._ticked(frame, search.prediction, waypoint_m)
        if search.failed:
            if search.hinted:
                self._seek(None)
            else:
                self._machine.update(Events(lost=True))
        elif self._machine.state is State.LOST and not search.standing:
            self._machine.update(Events(found=True))
        elif search.found is not None:
            self._join(search.found)
        return True

    def _join(self, hypothesis: Hypothesis) -> None:
        """Go on with a behavior that the robot was found to be on."""
        self._behavior, self._belief = hypothesis.behavior, hypothesis.belief
        self._approach = Approach(self._config.approach)
        self._berth.taken = False
        self._done_ticks = 0
        self._age_steps = 0
        self._machine.update(Events(found=True))

    def _begin(self, segment: int) -> None:
        """Enter a segment with every recurrent state reset; its first frame is the next one."""
        self._behavior = Behavior(self._networks, self._route, segment)
        self._approach = Approach(self._config.approach)
        if self._prediction is not None:  # what it said of the segment left behind
            self._prediction = replace(self._prediction, progress=0.0)
        self._berth.taken = False
        self._done_ticks = 0
        self._age_steps = 0

    def _restart(self) -> None:
        """Forget everything and stand before the route's first segment."""
        self._prediction = None
        self._waypoint_m = None
        self._search = None
        self._belief = LostBelief(self._config.lost)
        self._seen_stamp_ns = None
        self._since_tick_steps = self._networks.network_period
        self._begin(0)

    def _move(self, ranges_m: NDArray[np.float64] | None, now_s: float) -> None:
        """Set the motion commanded for this step."""
        state = self._machine.state
        driving = state in {State.FOLLOWING, State.JOINING}
        if not driving or ranges_m is None or self._waypoint_m is None:
            # The command is zero at once; the estimate follows the robot's own braking.
            braked = self._motion.speed_mps - self._robot.max_braking_mps2 * STEP_S
            self._motion = Motion(np.maximum(braked, 0.0), self._motion.steer_rad)
            self._command = (0.0, 0.0)
        else:
            scan_m = ranges_m[None]  # (1, rays)
            if state is State.FOLLOWING and self._berth.taken:
                motion = self._berth.step(self._motion)
            else:
                goal_m = np.array([self._waypoint_m])  # (1, 2)
                motion = self._controller.step(self._motion, goal_m, scan_m)
            if state is State.JOINING:
                creep_mps = np.minimum(motion.speed_mps, self._config.join.creep_mps)
                motion = Motion(creep_mps, motion.steer_rad)
            age_s = max(self._camera_watch.age_s(now_s), self._scan_watch.age_s(now_s))
            speed_mps = float(self._motion.speed_mps[0])
            motion = slowed(motion, speed_mps, age_s, self._config.fresh_s, self._robot)
            self._motion = limit(motion, scan_m, self._robot)
            speed, yaw_rate = twist(self._motion, self._robot)
            self._command = (float(speed[0]), float(yaw_rate[0]))

    def _carry_waypoint(self) -> None:
        """Express the waypoint at the present pose, dead-reckoned over the step gone by."""
        if self._waypoint_m is None:
            return
        speed, yaw_rate = twist(self._motion, self._robot)
        turn_rad = float(yaw_rate[0]) * STEP_S
        travel_m = float(speed[0]) * STEP_S
        self._approach.carry(travel_m)
        x = self._waypoint_m[0] - travel_m * math.cos(0.5 * turn_rad)
        y = self._waypoint_m[1] - travel_m * math.sin(0.5 * turn_rad)
        cos, sin = math.cos(turn_rad), math.sin(turn_rad)
        self._waypoint_m = (cos * x + sin * y, cos * y - sin * x)
        if self._berth.taken:
            self._berth.carry(self._waypoint_m, travel_m, turn_rad)

    def _decision(self, observation: Observation, now_s: float, ticked: bool) -> Decision:
        frame, scan = observation.frame, observation.scan
        prediction = self._prediction
        return Decision(
            speed_mps=self._command[0],
            yaw_rate_rad_s=self._command[1],
            state=self._machine.state,
            reason=self._machine.reason,
            segment=self._behavior.segment,
            segments=len(self._route.segments),
            progress=prediction.progress if prediction else 0.0,
            on_route=prediction.on_route if prediction else 0.0,
            waypoint_m=self._waypoint_m,
            camera_age_s=now_s - frame.received_s if frame else math.inf,
            scan_age_s=now_s - scan.received_s if scan else math.inf,
            standing=float(self._motion.speed_mps[0]) <= 0.0,
            ticked=ticked,
            gap_steps=self._gap_steps if ticked else 0,
            lost=self._belief.probability,
            place=self._place(),
        )

    def _place(self) -> Whereabouts | None:
        """Where the robot most likely is."""
        if self._machine.state in {State.LOST, State.JOINING} and self._search is not None:
            return self._search.place
        if self._prediction is None:
            return None
        progress = self._prediction.progress
        return Whereabouts(self._behavior.segment, progress, 1.0 - self._belief.probability)
