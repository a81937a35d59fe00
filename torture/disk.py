"""A full disk while the recorder writes."""

import resource
import signal
import time
import warnings
from collections.abc import Callable
from typing import Final

from asi_analysis.bags.bag import read_bag
from asi_analysis.errors import InputError
from torture.rig import ACTUATOR, CONTROLLER, RECORDER, Rig, Tally

DURATION_S: Final = 0.4
# A recording of that length takes about 250 kB.
SIZES: Final = range(1_000, 150_000)


def disk(rig: Rig, tally: Tally, end: float) -> None:
    """Record with a limit on the file size, as on a full disk."""
    while time.monotonic() < end or not tally.tried:
        size = rig.random.choice(SIZES)
        tally.count(f'disk full after {size} bytes', _record(rig, size, tally))
        if tally.failures:
            return


def _full_after(size: int) -> Callable[[], None]:
    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
    return limit


def _record(rig: Rig, size: int, tally: Tally) -> str:
    bag = rig.folder / f'bag-{tally.tried}'
    recorder = rig.start(RECORDER, output=bag, limits=_full_after(size))
    controller = rig.start(CONTROLLER, await_recorder=True, **{'reference.shape': 'prbs'})
    actuator = rig.start(ACTUATOR, duration=DURATION_S, await_recorder=True,
                         **{'force_sensor.noise': 1.0})
    status = actuator.exit_status()
    controller.stop()
    if status != 0:
        return f'the run ended with {status}: {actuator.text[-300:]}'
    ended = recorder.exit_status()
    if ended == 0 or 'Traceback' in recorder.text or 'large' not in recorder.text:
        return f'the recorder ended with {ended} and said: {recorder.text[-500:]}'
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            read = read_bag(bag)
    except InputError as error:
        # Nothing had been written out of the buffer yet.
        tally.notes['nothing recorded'] = tally.notes.get('nothing recorded', 0) + 1
        return '' if size < 50_000 else f'nothing to be read of {size} bytes: {error}'
    tally.samples_lost += round(DURATION_S * 5000) - read.time_s.size
    return ''
