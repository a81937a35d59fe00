"""Quality of service as a bag describes it: the dictionary of rosbag2's metadata, version 9."""

import warnings
from typing import Any

from rclpy.duration import Duration, Infinite
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)

from asi_analysis.errors import InputWarning
from asi_common.node.topics import STREAM_QOS

_SECOND = 10**9
MOST_DEPTH = 10_000


def as_dictionary(profile: QoSProfile) -> dict[str, Any]:
    """Return a profile as a bag stores it."""
    return {
        'history': profile.history.name.lower(),
        'depth': profile.depth,
        'reliability': profile.reliability.name.lower(),
        'durability': profile.durability.name.lower(),
        'deadline': _time(profile.deadline),
        'lifespan': _time(profile.lifespan),
        'liveliness': profile.liveliness.name.lower(),
        'liveliness_lease_duration': _time(profile.liveliness_lease_duration),
        'avoid_ros_namespace_conventions': profile.avoid_ros_namespace_conventions,
    }


def as_profile(offered: dict[str, Any]) -> QoSProfile:
    """
    Return the profile stored in a bag, with our history, as DDS does not transmit that.

    Returns STREAM_QOS, with an InputWarning, if the description is damaged.
    """
    try:
        return _profile(offered)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        warnings.warn(f'a quality of service cannot be read ({error!r}): that of the streams is '
                      'used', InputWarning, stacklevel=2)
        return STREAM_QOS


def _profile(offered: dict[str, Any]) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=min(max(int(offered['depth']), STREAM_QOS.depth), MOST_DEPTH),
        reliability=ReliabilityPolicy[offered['reliability'].upper()],
        durability=DurabilityPolicy[offered['durability'].upper()],
        deadline=_duration(offered['deadline']),
        lifespan=_duration(offered['lifespan']),
        liveliness=LivelinessPolicy[offered['liveliness'].upper()],
        liveliness_lease_duration=_duration(offered['liveliness_lease_duration']))


def _time(duration: Duration) -> dict[str, int]:
    seconds, nanoseconds = divmod(duration.nanoseconds, _SECOND)
    return {'sec': seconds, 'nsec': nanoseconds}


def _duration(time: dict[str, int]) -> Duration:
    nanoseconds = time['sec'] * _SECOND + time['nsec']
    return Infinite if nanoseconds >= Infinite.nanoseconds else Duration(nanoseconds=nanoseconds)
