"""The signals that the controller plays: shape, spectrum, bound, end."""

import math

import numpy as np
import numpy.typing as npt
import pytest
from scipy import signal

from asi_analysis.errors import InputError
from asi_analysis.experiments.experiment import planned
from asi_common.parameter import ParameterError, Value, defaults
from asi_common.record import record_of
from asi_controller.controller import Controller
from asi_controller.parameters import COMPENSATOR_PARAMETERS, REFERENCE_PARAMETERS, SHAPES
from asi_controller.reference import FREQUENCIES, reference_force

RATE = 5000.0


def played(shape: str, seconds: float, rate: float = RATE, **values: Value
           ) -> npt.NDArray[np.float64]:
    """Return the signal (N) of amplitude 1 without a start, one sample a tick."""
    record = record_of({'reference.shape': shape, 'reference.start': 0.0,
                        'reference.amplitude': 1.0}
                       | {f'reference.{name}': value for name, value in values.items()},
                       REFERENCE_PARAMETERS)
    return np.array([reference_force(k / rate, record) for k in range(round(seconds * rate))])


@pytest.mark.parametrize('shape', [shape for shape in SHAPES if shape != 'topic'])
def test_rests_at_the_offset_then_stays_within_the_amplitude(shape: str) -> None:
    out = played(shape, 2.0, start=0.1, offset=30.0, amplitude=-20.0, frequency=3.0)
    assert np.all(out[:500] == 30.0)
    assert np.ptp(out[500:]) > 0.0 or shape == 'step'
    assert out[501] != 30.0
    assert np.abs(out - 30.0).max() <= 20.0


@pytest.mark.parametrize(('shape', 'most'), [
    ('sine', 500.0), ('triangle', 500.0), ('chirp', 500.0), ('multisine', 500.0),
    ('prbs', 1000.0), ('ramp', 9e3)])
def test_frequencies_that_the_control_rate_cannot_show_are_refused(shape: str, most: float
                                                                   ) -> None:
    values = defaults(COMPENSATOR_PARAMETERS + REFERENCE_PARAMETERS) | {'reference.shape': shape}
    names = ['reference.frequency', 'reference.end_frequency']
    Controller.check(values | dict.fromkeys(names, most), 1000.0)
    for name in names:
        wrong = values | {name: most + 1.0}
        if name.removeprefix('reference.') not in FREQUENCIES.get(shape, ()):
            continue
        with pytest.raises(ParameterError, match=f'{name} = {most + 1.0} is not allowed for a '
                                                 f'{shape} at a control rate of 1000 Hz'):
            Controller.check(wrong, 1000.0)
        with pytest.raises(InputError, match=name):
            planned({}, {'reference.shape': shape, name: most + 1.0}, 1.0, 'lockstep', 1000.0)


def test_step_begins_at_exactly_its_start() -> None:
    # 0.1 s is 500 ticks of 1/5000 s, whose product rounds to just below or above.
    out = played('step', 0.11, start=0.1)
    assert np.flatnonzero(np.diff(out)).tolist() == [499]


def test_ramp_rises_evenly_and_holds() -> None:
    out = played('ramp', 1.0, duration=0.5)
    np.testing.assert_allclose(out, np.minimum(np.arange(5000) / 2500, 1.0), atol=1e-12)


def test_sine_and_triangle_are_scipys() -> None:
    time = np.arange(5000) / RATE
    np.testing.assert_allclose(played('sine', 1.0, frequency=7.0),
                               np.sin(2 * np.pi * 7 * time), atol=1e-12)
    np.testing.assert_allclose(
        played('triangle', 1.0, frequency=7.0),
        signal.sawtooth(2 * np.pi * (7 * time + 0.25), 0.5), atol=1e-11)


@pytest.mark.parametrize(('first', 'last'), [(1.0, 100.0), (80.0, 2.0), (10.0, 10.0),
                                             (10.0, 10.000001)])
def test_chirp_is_scipys_and_ends_without_a_jump(first: float, last: float) -> None:
    out = played('chirp', 3.0, frequency=first, end_frequency=last, duration=2.0)
    time = np.arange(out.size) / RATE
    theirs = signal.chirp(time[:10000], first, 2.0, last, 'logarithmic', phi=-90)
    np.testing.assert_allclose(out[:10000], theirs, atol=1e-6)
    steepest = 2 * math.pi * max(first, last) / RATE
    assert np.abs(np.diff(out)).max() <= steepest * (1 + 1e-9)
    after = 10000 + math.ceil(0.5 * RATE / last) + 1
    assert not out[after:].any()


def test_multisine_has_equal_tones_where_asked_and_nothing_else() -> None:
    # 5, 10 ... 100 Hz over a whole number of their periods.
    spectrum = np.abs(np.fft.rfft(played('multisine', 1.0, frequency=5.0, end_frequency=100.0)))
    tones = np.arange(5, 101, 5)
    np.testing.assert_allclose(spectrum[tones], spectrum[5], rtol=1e-9)
    assert np.delete(spectrum, tones).max() < 1e-9 * spectrum[5]


def test_multisine_uses_its_amplitude_whatever_the_tones() -> None:
    for tones in (1, 2, 4, 5, 20, 100):
        peak = np.abs(played('multisine', 1.0, frequency=1.0, end_frequency=float(tones),
                             tones=tones)).max()
        assert 0.7 < peak <= 1.0


def test_schroeders_phases_bound_the_multisine_for_every_number_of_tones() -> None:
    for tones in range(1, 1001):
        k = np.arange(tones)
        # The envelope: the sum can never exceed it, wherever the frequencies lie.
        envelope = np.abs(np.fft.fft(np.exp(-1j * np.pi * k * (k + 1) / tones), 16 * tones))
        assert envelope.max() <= min(tones, 1.53 * math.sqrt(tones)) + 1e-9


def test_prbs_is_white_balanced_and_repeats_with_its_seed() -> None:
    out = played('prbs', 4.0, frequency=1000.0, seed=3)
    assert set(out) == {-1.0, 1.0}
    held = out.reshape(-1, 5)
    assert np.all(held == held[:, :1])
    bits, n = held[:, 0], held.shape[0]
    # Four standard errors: the seed is fixed, so this cannot fail by chance.
    for lag in (1, 2, 3, 7, 64, 256):
        assert abs(np.mean(bits[lag:] * bits[:-lag])) < 4 / math.sqrt(n)
    assert abs(bits.mean()) < 4 / math.sqrt(n)
    assert np.array_equal(out, played('prbs', 4.0, frequency=1000.0, seed=3))
    other = played('prbs', 4.0, frequency=1000.0, seed=4).reshape(-1, 5)[:, 0]
    assert abs(np.mean(bits * other)) < 4 / math.sqrt(n)
