"""The topic table and its Zenoh keys."""

import pytest
import zenoh

from cbe.messages import MESSAGE_TYPES, Twist, TwistStamped
from cbe.topics import (
    CMD_VEL,
    CMD_VEL_UNSTAMPED,
    SCAN,
    TOPICS,
    KeyStyle,
    Topic,
    key_expression,
    subscription,
)


def test_key_is_built_as_rmw_zenoh_builds_it() -> None:
    assert key_expression(CMD_VEL_UNSTAMPED, KeyStyle.RMW_ZENOH, 7) == (
        "7/cmd_vel/geometry_msgs::msg::dds_::Twist_/"
        "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"
    )


def test_bare_key_is_the_topics_name() -> None:
    assert key_expression(SCAN, KeyStyle.BARE) == subscription(SCAN, KeyStyle.BARE) == "scan"


@pytest.mark.parametrize("style", KeyStyle)
@pytest.mark.parametrize("topic", TOPICS.values(), ids=TOPICS)
def test_subscription_catches_its_own_topic_alone(topic: Topic, style: KeyStyle) -> None:
    caught = [
        other
        for other in (*TOPICS.values(), CMD_VEL_UNSTAMPED)
        if zenoh.KeyExpr(subscription(topic, style)).includes(key_expression(other, style))
    ]
    # A bare name does not tell its message.
    expected = [topic, CMD_VEL_UNSTAMPED] if (topic, style) == (CMD_VEL, KeyStyle.BARE) else [topic]
    assert caught == expected


def test_subscription_catches_a_sender_without_type_hash() -> None:
    humble = "0/scan/sensor_msgs::msg::dds_::LaserScan_/TypeHashNotSupported"
    assert zenoh.KeyExpr(subscription(SCAN, KeyStyle.RMW_ZENOH)).includes(humble)


def test_every_topic_has_a_known_message() -> None:
    assert all(topic.message.TYPE in MESSAGE_TYPES for topic in TOPICS.values())
    assert (CMD_VEL.message, CMD_VEL_UNSTAMPED.message) == (TwistStamped, Twist)
