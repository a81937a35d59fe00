"""The replay of a bag: the same bytes, in its order, at its pace, as told."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from conftest import NodeProcess, wait_for_silence, wait_until
from geometry_msgs.msg import WrenchStamped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from asi_analysis.bags.bag import write_bag
from asi_analysis.bags.bag_file import read_contents
from asi_analysis.bags.run import Run

REPLAY = 'asi_analysis.bags.nodes.replay_node'

Start = Callable[..., NodeProcess]
Call = Callable[[type, str, Any], Any]


def a_bag(path: Path, count: int = 100, rate_hz: float = 100.0) -> list[bytes]:
    """Write a bag; return the messages of /force."""
    write_bag(Run(np.arange(count) / rate_hz, force_n=np.arange(float(count))), path)
    return read_contents(path, lambda name: name == '/force').topics['/force'].data


def hear(node: Any) -> list[bytes]:
    """Return a list that fills with the bytes of /force."""
    heard: list[bytes] = []
    # A replay with await_recorder begins when both topics of the bag are subscribed to.
    node.create_subscription(JointState, '/joint_states', lambda _: None, 1000)
    node.create_subscription(WrenchStamped, '/force', heard.append, 1000, raw=True)
    return heard


def test_plays_the_same_bytes_at_its_pace(start_node: Start, ros_node: Any, call: Call,
                                          tmp_path: Path) -> None:
    """Slowed down to half, a bag of one second lasts two: a busy machine cannot shorten that."""
    expected = a_bag(tmp_path / 'bag')
    heard = hear(ros_node)
    replay = start_node(REPLAY, bag=tmp_path / 'bag', rate=0.5, start_paused=True,
                        await_recorder=True)
    begin = time.monotonic()
    assert call(SetBool, '/asi_replay/pause', SetBool.Request(data=False)).message == 'running'
    assert replay.exit_status() == 0
    assert time.monotonic() - begin > 1.9
    wait_until(lambda: len(heard) == 100, '100 messages')
    assert heard == expected
    assert 'published all 200 messages' in replay.text


def test_pauses_and_loops_as_told(start_node: Start, ros_node: Any, call: Call, tmp_path: Path
                                  ) -> None:
    expected = a_bag(tmp_path / 'bag', 50)
    heard = hear(ros_node)
    replay = start_node(REPLAY, bag=tmp_path / 'bag', loop=True, start_paused=True,
                        await_recorder=True)
    wait_until(lambda: ros_node.count_publishers('/force'), 'the publisher')
    wait_for_silence('nothing', heard)
    assert not heard
    assert call(SetBool, '/asi_replay/pause', SetBool.Request(data=False)).message == 'running'
    wait_until(lambda: len(heard) > 120, 'more than two rounds')
    assert call(SetBool, '/asi_replay/pause', SetBool.Request(data=True)).message == 'paused'
    wait_for_silence('the replay', heard)
    assert heard[:100] == expected * 2
    assert replay.stop() == 0


def test_gives_the_time_of_the_bag(start_node: Start, ros_node: Any, tmp_path: Path) -> None:
    a_bag(tmp_path / 'bag')
    hear(ros_node)
    times: list[float] = []
    ros_node.create_subscription(
        Clock, '/clock', lambda m: times.append(m.clock.sec + m.clock.nanosec * 1e-9), 5000)
    replay = start_node(REPLAY, bag=tmp_path / 'bag', clock=True, await_recorder=True)
    assert replay.exit_status() == 0
    wait_until(lambda: times and times[-1] == 1.0, 'the last stamp')
    assert times == sorted(times)


def test_refuses_what_is_no_bag(start_node: Start, tmp_path: Path) -> None:
    replay = start_node(REPLAY, bag=tmp_path)
    assert replay.exit_status() == 2
    assert f'{tmp_path} is not a bag' in replay.text
    assert len(replay.text.splitlines()) == 1
