"""The topics of the loop, one row each: publishers, recorder, reader and documents use them."""

from collections.abc import Mapping
from typing import Final, NamedTuple

FRAME: Final = 'piston'
PISTON: Final = 'piston'
JOINTS: Final = (PISTON, 'valve')

# Publishers keep this many sent messages for a recorder that falls behind: 6 s at 5 kHz. On a
# machine with three times more work than cores a depth of 1000 lost one message in a thousand,
# 30000 none.
STREAM_DEPTH: Final = 30_000
# The same in real time: 2 s at 1 kHz. Fast DDS keeps what a killed reader has not received, until
# it declares the reader dead (20 s), and drops it while the loop waits: about 0.03 s for this
# depth, 2 to 3 s for STREAM_DEPTH (python -m bench.killed_reader); a command may be 0.1 s old.
REALTIME_DEPTH: Final = 2000


class TopicRow(NamedTuple):
    """
    One topic.

    name: relative, or absolute with a slash. type: as std_msgs/msg/Float64. publisher: for the
    documents; '' for a topic that only an imported bag has. content: in words, with units.
    signals: which of its numbers are which signals of a `Run`; `value` is the only number of a
    topic, `JOINT FIELD` one of joint_states. depth: history that the publisher keeps, at most
    REALTIME_DEPTH in real time; its QoS is reliable and volatile.
    """

    name: str
    type: str
    publisher: str
    content: str
    signals: Mapping[str, str] = {}
    depth: int = STREAM_DEPTH


# The order is that of the topics in a bag. Of several topics with the same signal the first with
# a number is read.
TOPICS: Final[Mapping[str, TopicRow]] = {row.name: row for row in (
    TopicRow('joint_states', 'sensor_msgs/msg/JointState', 'actuator',
             'joint `piston`: position m, velocity m/s, effort = measured, calibrated force N; '
             'joint `valve`: position m, effort = applied command N',
             {'force': 'piston effort', 'valve_position': 'valve position',
              'position': 'piston position', 'velocity': 'piston velocity'}),
    TopicRow('force', 'geometry_msgs/msg/WrenchStamped', 'actuator',
             '`force.x`: measured force N, frame `piston`', {'force': 'value'}),
    TopicRow('valve_position', 'std_msgs/msg/Float64', 'actuator', 'm',
             {'valve_position': 'value'}),
    TopicRow('velocity', 'std_msgs/msg/Float64', 'actuator', 'of the piston, m/s',
             {'velocity': 'value'}),
    TopicRow('force_reference', 'geometry_msgs/msg/WrenchStamped',
             "user, or the controller's own generator", '`force.x`: desired force N',
             {'reference': 'value'}),
    TopicRow('reference', 'std_msgs/msg/Float64', '',
             'reference of a recording that controls no force', {'reference': 'value'}),
    TopicRow('pressure', 'std_msgs/msg/Float64', '',
             'pressure of a recording, Pa', {'pressure': 'value'}),
    TopicRow('valve_command', 'geometry_msgs/msg/WrenchStamped', 'controller',
             '`force.x`: valve command N; its stamp is that of the state it answers',
             {'command': 'value'}),
    TopicRow('clock', 'rosgraph_msgs/msg/Clock', 'actuator, in lock-step',
             'simulated time; `/clock` without a namespace'),
    TopicRow('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', 'both',
             'state and fault; period, latency, saturation, lost samples', depth=10),
)}
