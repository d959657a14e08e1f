"""Schemas of our own JSON objects, so that viewers can offer and plot their fields."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import msgspec

NUMBER, INTEGER, TEXT, YES_NO = (
    {"type": name} for name in ("number", "integer", "string", "boolean")
)
NUMBERS = {"type": "array", "items": NUMBER}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_STATE: dict[str, Any] = {
    "state": TEXT,
    "reason": TEXT,
    "segment": INTEGER,
    "segments": INTEGER,
    "progress": NUMBER,
    "on_route": NUMBER,
    "waypoint_m": NUMBERS,
    "speed_mps": NUMBER,
    "yaw_rate_rad_s": NUMBER,
    "standing": YES_NO,
    "camera_age_s": NUMBER,
    "scan_age_s": NUMBER,
    "lost": NUMBER,
}
_SEEN = _object(stamp_ns=INTEGER, received_s=NUMBER, crc=INTEGER)

JSON_TYPES: Mapping[str, bytes] = MappingProxyType(
    {
        name: msgspec.json.encode({"title": name} | schema)
        for name, schema in (
            ("cbe/Status", _object(**_STATE, overruns=INTEGER, model_id=TEXT)),
            (
                "cbe/Decision",
                _object(
                    run=TEXT,
                    step=INTEGER,
                    now_s=NUMBER,
                    asked=_object(start=YES_NO, stop=YES_NO),
                    frame=_SEEN,
                    scan=_SEEN,
                    decision=_object(**_STATE, ticked=YES_NO),
                ),
            ),
        )
    }
)
"""By name; what is not described here can be there all the same."""
