"""`Run`: slices, prints itself, refuses arrays that do not belong together."""

import numpy as np
import pytest

from asi_analysis.bags.run import Run


def a_run() -> Run:
    time = np.arange(10) / 5000.0
    force = np.arange(10.0)
    force[3] = np.nan
    return Run(time, force_n=force, command_n=-np.arange(10.0), source='somewhere',
               information={'signals': {'reference': 'm'}})


def test_rate_and_duration_come_from_the_stamps() -> None:
    run = a_run()
    assert run.rate_hz == 5000.0
    assert run.duration_s == pytest.approx(10 / 5000.0)
    assert len(run) == 10


def test_between_includes_the_start_and_leaves_out_the_end() -> None:
    part = a_run().between(0.0004, 0.001)
    assert part.time_s.tolist() == [0.0004, 0.0006, 0.0008]
    assert part.command_n.tolist() == [-2.0, -3.0, -4.0]
    assert part.velocity_m_s is None
    assert part.source == 'somewhere'


def test_prints_what_is_there_and_what_is_not() -> None:
    text = str(a_run())
    assert text.splitlines()[0] == 'somewhere: 10 samples, 5000 Hz, 0.002 s'
    assert ['force', 'N', '0', '4.6667', '9', '1'] in [line.split() for line in
                                                       text.splitlines()]
    assert text.splitlines()[-1] == 'absent: reference, valve_position, position, velocity'


def test_unit_of_an_imported_reference() -> None:
    run = a_run()
    assert (run.unit('reference'), run.controlled(), run.unit('force')) == ('m', 'position', 'N')


def test_refuses_arrays_of_other_lengths() -> None:
    with pytest.raises(ValueError, match='force'):
        Run(np.arange(3.0), force_n=np.arange(2.0))
