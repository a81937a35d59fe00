"""Private parts of other packages that are used here: a version that lacks one is named."""

import inspect
import signal
from importlib.metadata import version

import can.interfaces.slcan
import numba.core.event
import pytest
import rclpy.executors
import typer
from mcap.stream_reader import StreamReader
from rclpy.impl.implementation_singleton import rclpy_implementation
from rosbags.rosbag1 import reader as ros1
from rosbags.rosbag2 import Reader, storage_mcap

from asi_analysis import command
from asi_analysis.bags.bag import write_bag
from torture.inputs import recording


def storages(folder):
    write_bag(recording(), folder / 'bag')
    with Reader(folder / 'bag') as reader:
        return [storage.messages for storage in reader.storage.storages] and (
            # Replaced by those with a limit.
            {'bz2', 'lz4'} <= ros1.decompressors.keys()
            and {'zstd', 'lz4'} <= storage_mcap.DECOMPRESSORS.keys()
            and 'decompressors[' in inspect.getsource(ros1)
            and 'DECOMPRESSORS[compression](data, size)' in inspect.getsource(storage_mcap))


PARTS = {
    # ClickException, which typer brings along and does not export.
    'typer': lambda _: typer.BadParameter.__mro__[2].__name__ == 'ClickException',
    'mcap': lambda _: all(name in inspect.getsource(StreamReader)
                          for name in ('_read_record(', '_stream')),
    'rosbags': storages,
    'numba': lambda _: {'on_start', 'on_end'} <= vars(numba.core.event.Listener).keys(),
    'python-can': lambda _: all(name in inspect.getsource(can.interfaces.slcan) for name in (
        'def _read(', 'def _write(', 'LINE_TERMINATOR', '_buffer', 'serialPortOrig', '_ERROR')),
    'rclpy': lambda _: all(name in inspect.getsource(rclpy.executors)
                           for name in ('self._guard = ', 'self._tasks: ')) and all(
        hasattr(rclpy_implementation, name)
        for name in ('WaitSet', 'RCLError', 'rcl_time_point_t')),
}


@pytest.mark.parametrize('package', PARTS)
def test_private_part_is_there(package, tmp_path):
    try:
        found = PARTS[package](tmp_path)
    except AttributeError:
        found = False
    assert found, (f'{package} {version(package)} lacks a private part that is used here: '
                   'replace its use, or set an upper bound in setup.py')


def test_python_has_the_signals_that_the_command_takes_from_it():
    """`asi_analysis.command` cannot wait for the module `signal` to be imported."""
    built_in = command.signal
    assert built_in.default_int_handler is signal.default_int_handler
    assert (built_in.SIGINT, built_in.SIG_IGN) == (signal.SIGINT, signal.SIG_IGN)
    assert built_in.getsignal(signal.SIGINT) is signal.getsignal(signal.SIGINT)
    assert built_in.pthread_kill is not None
