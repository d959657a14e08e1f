"""Where a route leads past a joint, so that a turn right behind it is begun in time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial.polynomial import polyvander

from cbe.signature import LOOKAHEAD_M, OVERRUN_M, SHAPE_POINTS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cbe_runtime.networks import Prediction

_GIVEN = np.linspace(0.0, 1.0, SHAPE_POINTS + 1)[1:]  # the points' shares of the path's time
_FINE = np.linspace(0.0, 1.0, 65)
# As many points determine the path, for it is a polynomial of its time.
_REFINE = polyvander(_FINE, SHAPE_POINTS - 1) @ np.linalg.inv(polyvander(_GIVEN, SHAPE_POINTS - 1))


class Onward:
    """The path of a behavior that ends in a joint, and the next one's that goes on from there.

    A behavior knows nothing of the next: near its end its waypoint runs on straight and comes to
    lie 0.3 m ahead instead of 0.6. In the last 0.25 m it was 0.12 to 0.22 m off the demonstration
    (median, validation routes), and 0.03 to 0.05 m with the next path.
    """

    def __init__(self, own_m: NDArray[np.float64], next_m: NDArray[np.float64]) -> None:
        """Both paths (8, 2) as `PathShape.read` gives them."""
        self._length_m = float(_arc(_REFINE @ own_m)[-1])
        path_m = _REFINE @ next_m
        self._path_m = path_m - path_m[0]
        self._arc_m = _arc(path_m)

    def waypoint_m(self, prediction: Prediction) -> NDArray[np.float64]:
        """The behavior's waypoint (2,) in base_link, past the joint moved to the next path."""
        beyond_m = LOOKAHEAD_M - (1.0 - min(prediction.progress, 1.0)) * self._length_m
        if beyond_m <= 0.0:
            return prediction.waypoint_m
        x, y = (np.interp(beyond_m, self._arc_m, axis) for axis in self._path_m.T)
        x -= min(beyond_m, OVERRUN_M)  # what the waypoint ran on straight
        _, _, cos, sin = prediction.end
        onward = np.array([[cos, -sin], [sin, cos]]) @ (x, y)
        return np.asarray(prediction.waypoint_m + onward)


def _arc(path_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Length (N,) of a path (N, 2) up to each of its points."""
    legs = np.hypot(*np.diff(path_m, axis=0).T)
    return np.concatenate([[0.0], legs.cumsum()])
