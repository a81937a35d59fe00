"""Bandwidth and delay of known filters, and of a real servo-hydraulic press."""

import gzip
import os
from pathlib import Path

import numpy as np
import pytest
from scipy import optimize, signal

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.loop.closed_loop import simulate_loop
from asi_analysis.loop.in_process import simulate
from asi_analysis.measures.analysis import analyze
from asi_analysis.measures.correlation import correlation_delay
from asi_analysis.measures.frequency_response import (
    actuator_bandwidth,
    estimate,
    frequency_response,
    is_sine,
    loop_bandwidth,
)
from asi_common.parameter import completed

RATE_HZ = 5000.0
DATA = Path(os.environ.get('ASI_DATA', Path(__file__).parents[4] / 'shared' / 'data'))


def excitation(kind):
    t = np.arange(50000) / RATE_HZ
    if kind == 'chirp':
        return signal.chirp(t, 2.0, t[-1], 500.0, 'logarithmic')
    if kind == 'multisine':
        return sum(np.sin(2 * np.pi * f * t + 0.05 * f * f) for f in np.arange(5.0, 300.0, 5.0))
    return np.repeat(np.random.default_rng(5).choice([-1.0, 1.0], 5000), 10)


@pytest.mark.parametrize('kind', ['chirp', 'multisine', 'prbs'])
def test_bandwidth_and_delay_of_a_known_filter(kind):
    """A second-order Butterworth low pass at 50 Hz behind 3 ms of dead time."""
    b, a = signal.butter(2, 50.0, fs=RATE_HZ)
    x = excitation(kind)
    y = np.concatenate([np.zeros(15), signal.lfilter(b, a, x)[:-15]])
    found = estimate(x, y, 1.0 / RATE_HZ)
    assert found.bandwidth_hz == pytest.approx(50.0, rel=0.03)
    w, expected = signal.freqz(b, a, found.frequency_hz, fs=RATE_HZ)
    expected = expected * np.exp(-2j * np.pi * w * 15 / RATE_HZ)
    near = (w > 4.0) & (w < 150.0)
    assert np.max(np.abs(found.response - expected)[near]) < 0.05
    assert found.coherence.min() > 0.8


def test_pure_delay():
    x = excitation('prbs')
    y = np.concatenate([np.zeros(15), x[:-15]])
    assert estimate(x, y, 1.0 / RATE_HZ).delay_s == pytest.approx(0.003, rel=1e-2)
    assert correlation_delay(x, y, 1.0 / RATE_HZ) == pytest.approx(0.003, abs=1e-5)


@pytest.mark.parametrize('delay_s', [0.0, 0.006, 0.088, 0.34])
@pytest.mark.parametrize('kind', ['staircase', 'chirp', 'noise', 'multisine', 'step'])
def test_delay_by_correlation_is_the_delay(kind, delay_s):
    rate, count = 1000.0, 8000
    t, rng = np.arange(count) / rate, np.random.default_rng(3)
    x = {'staircase': np.repeat(rng.choice(np.arange(5) * 50.0, 20), 400),
         'chirp': np.sin(2.0 * np.pi * (0.5 * t + 3.0 * t * t)),
         'noise': rng.standard_normal(count),
         'multisine': sum(np.sin(2.0 * np.pi * f * t + f * f) for f in np.arange(0.5, 40.0, 1.3)),
         'step': np.where(t > 1.0, 100.0, 0.0)}[kind]
    late = np.concatenate([np.full(int(delay_s * rate), x[0]), x])[:count]
    noisy = late + 0.02 * np.std(x) * rng.standard_normal(count)
    assert correlation_delay(x, noisy, 1.0 / rate) == pytest.approx(delay_s, rel=0.02,
                                                                    abs=1.0 / rate)


def test_a_delay_where_the_input_nearly_repeats():
    """The start of a run makes the correlation a little larger one repetition later."""
    run = simulate({'load.type': 'free'}, {
        'reference.shape': 'multisine', 'reference.amplitude': 100.0, 'reference.frequency': 2.0,
        'reference.end_frequency': 80.0}, 2.0, 1000.0)
    assert analyze(run).correlation_delay_s == pytest.approx(0.002, abs=5e-4)
    reference = run.signal('reference')
    late = np.concatenate([np.zeros(977), reference])[:len(run)]
    assert correlation_delay(reference, late, 1e-3) == pytest.approx(0.977, abs=1e-4)


def test_signals_with_nothing_in_common_have_no_delay():
    rng = np.random.default_rng(5)
    assert correlation_delay(rng.standard_normal(4000), rng.standard_normal(4000), 1e-3) is None


def test_a_single_sine_tells_no_bandwidth():
    t = np.arange(8000) / 1000.0
    run = Run(t, reference_n=100.0 * np.sin(2.0 * np.pi * 10.0 * t),
              force_n=70.0 * np.sin(2.0 * np.pi * 10.0 * t - 0.5))
    found = loop_bandwidth(run)
    assert found.bandwidth_hz is None and found.delay_s is None
    assert 'single sine of 10 Hz' in found.reason
    assert '0.7' in found.reason and '-29 degrees' in found.reason


@pytest.mark.parametrize('cycles', [1.0, 1.4, 2.0, 4.0, 5.4])
def test_a_sine_of_few_cycles_has_its_own_frequency(cycles):
    """That of 2 cycles had 2.5 times its frequency: the first line of the spectrum in use."""
    t = np.arange(4100) / 1000.0
    turn = np.maximum(t - 0.1, 0.0) * 2.0 * np.pi * cycles / 4.0
    run = Run(t, reference_n=100.0 * np.sin(turn), force_n=70.0 * np.sin(turn - 0.2))
    reason = loop_bandwidth(run).reason
    assert f'single sine of {cycles / 4.0:.4g} Hz' in reason
    assert ' 0.7, ' in reason and '-11 degrees' in reason
    with pytest.raises(InputError, match='a single sine shows one frequency only'):
        frequency_response(run)   # its spectrum is that of the ends of the recording
    noise = np.random.default_rng(1).standard_normal(t.size)
    unrelated = Run(t, reference_n=run.reference_n, force_n=noise)
    assert 'too few frequencies' in loop_bandwidth(unrelated).reason


@pytest.mark.parametrize('cycles', [1.0, 1.4, 2.6, 9.3])
def test_a_sine_is_one_in_any_number_of_cycles_and_stairs_are_none(cycles):
    """The harmonics of a slow wave are among the lines next to it."""
    turn = cycles * np.arange(4000) / 4000
    stairs = np.floor(8.0 * np.abs(2.0 * (turn % 1.0) - 1.0))
    assert is_sine(3.0 + np.sin(2.0 * np.pi * turn + 1.0))
    assert not is_sine(stairs)
    assert not is_sine(np.empty(0))
    for constant in (0.0, 0.1, 3.3):   # and no warning: the noise of rounding has no shape
        assert not is_sine(np.full(1000, constant))
    last = np.zeros(20000)
    last[-1] = 1.0   # left out where a long signal is thinned
    assert not is_sine(last)


def test_what_the_input_does_not_move_is_not_told():
    """Beyond the chirp's last frequency and in an output of noise there is no response."""
    x = excitation('chirp')
    assert estimate(x, x, 1.0 / RATE_HZ).frequency_hz.max() < 600.0
    assert estimate(x, np.random.default_rng(1).normal(size=x.size),
                              1.0 / RATE_HZ) is None


def test_bandwidth_from_a_step():
    """Second order, zeta 0.456, 100 rad/s: -3 dB where the closed form says."""
    t = np.arange(5000) / RATE_HZ
    zeta, w = 0.456, 100.0
    _, y = signal.step((w * w, [1.0, 2 * zeta * w, w * w]), T=t)
    force = np.concatenate([np.zeros(250), 80.0 * y[:-250]])
    found = loop_bandwidth(Run(t, reference_n=np.where(t >= 0.05, 80.0, 0.0), force_n=force))
    q = 1 - 2 * zeta**2
    assert found.method == 'step'
    assert found.bandwidth_hz == pytest.approx(
        w * np.sqrt(q + np.sqrt(q * q + 1)) / (2 * np.pi), rel=0.01)


def test_actuator_in_the_loop_against_its_linear_blocks():
    """With its nonlinear blocks off the actuator is four known filters and two delays."""
    linear = {'valve_hysteresis.model': 'off', 'valve_characteristic.model': 'off',
              'hydraulic_damping.model': 'off', 'friction.model': 'off'}
    p = completed(linear, ACTUATOR_PARAMETERS)
    run = Run(*simulate_loop(linear, {
        'reference.shape': 'chirp', 'reference.frequency': 1.0, 'reference.duration': 8.0,
        'reference.end_frequency': 300.0}, 8.5))

    def second_order(block, f):
        natural = p[f'{block}.natural_frequency']
        return 1 / (1 - (f / natural)**2 + 2j * p[f'{block}.damping_ratio'] * f / natural)

    def gain(f):
        return abs(second_order('valve_flexure', f) * second_order('force_sensor', f)
                   / (1 + 1j * f / p['valve_flexure.coil_frequency'])
                   / (1 + 1j * f / p['fluid_dynamics.frequency']))

    expected = optimize.brentq(lambda f: gain(f) - np.sqrt(0.5), 1.0, 200.0)
    found, doubt = actuator_bandwidth(run)
    assert found == pytest.approx(expected, rel=0.02) and doubt is None


@pytest.mark.parametrize('lowest_hz', [
    2.0, 30.0, pytest.param(15.0, marks=pytest.mark.slow)])
def test_bandwidth_from_the_command_is_doubtful_without_low_frequencies(lowest_hz):
    """With the lead at first, and hysteresis, the command has lower ones: it was 92 Hz for 25."""
    run = simulate({}, {'compensator': 'lead_lag', 'reference.shape': 'chirp',
                        'reference.frequency': lowest_hz, 'reference.end_frequency': 200.0,
                        'reference.duration': 3.0}, 3.2)
    found = analyze(run)
    low = found.actuator_bandwidth_hz == pytest.approx(25.2, rel=0.02)
    assert found.reliable['actuator_bandwidth_hz'] is low is (lowest_hz == 2.0)
    assert any('bandwidth from the command: doubtful' in each for each in found.notes) is not low


@pytest.mark.parametrize('current', ['0A', pytest.param('1A', marks=pytest.mark.slow)])
def test_servohydraulic_press(current):
    """
    Reference to displacement of a real press: its lag is found in both recordings alike.

    The correlation peaks where the chirp has most of its power, so it may differ from the phase
    slope; the whole-record comparison below needs neither of our functions.
    """
    path = DATA / 'servohydraulic_mts' / f'actuator_chirp_damper_{current}.txt.gz'
    if not path.exists():
        pytest.skip(f'no measured data at {DATA}')
    lines = gzip.open(path, 'rt').read().splitlines()[7:]
    table = np.array([[float(cell) for cell in line.split(',')[2:5]]
                      for line in lines if line.count(',') >= 4])
    table -= table[:1000].mean(0)
    measured, reference = table[:, 0] / 100.0, table[:, 2] / 100.0
    run = Run(np.arange(len(table)) / 1000.0, reference_n=reference, position_m=measured,
              information={'signals': {'reference': 'm'}})
    found = loop_bandwidth(run)
    shifts = np.arange(60)
    best = shifts[np.argmin([np.mean((measured[100:] - reference[100 - k:len(reference) - k])**2)
                             for k in shifts])]
    assert found.method == 'excitation'
    assert found.correlation_delay_s == pytest.approx(best / 1000.0, abs=1.5e-3)
    assert 0.015 < found.delay_s < 0.03
    # The gain of a plain sine fit near the bandwidth, where the chirp passes it.
    assert 5.0 < found.bandwidth_hz < 10.0


@pytest.mark.parametrize('shape', ['noise', 'chirp', 'tones'])
@pytest.mark.parametrize('late', [6, 39])
def test_the_delay_by_the_phase_is_that_of_the_signal(shape, late):
    # By the slope of the phase alone it was 27 samples for 39, and 2.6 for 5.5.
    rng = np.random.default_rng(late)
    time = np.arange(4000) / 100.0
    source = {'noise': signal.sosfiltfilt(signal.butter(3, 4.0, fs=100.0, output='sos'),
                                          rng.standard_normal(time.size + late)),
              'chirp': signal.chirp(np.arange(time.size + late) / 100.0, 0.03, 40.0, 1.5),
              'tones': sum(np.sin(2.0 * np.pi * hz * np.arange(time.size + late) / 100.0 + hz)
                           for hz in (0.15, 0.4, 0.9, 3.1))}[shape]
    output = source[:time.size] + 0.01 * source.std() * rng.standard_normal(time.size)
    found = estimate(source[late:], output, 0.01)
    assert 100.0 * found.delay_s == pytest.approx(late, abs=1.0)


@pytest.mark.parametrize('steps', [5, 8, 14])
def test_a_staircase_that_only_rises_is_no_sine_and_has_its_delay(steps):
    # It was "a single sine of 0.05 Hz", or had a delay of a thousandth of its own.
    reference = np.floor(np.arange(4200) * steps / 4200.0) / steps
    noise = np.random.default_rng(steps).standard_normal(4200)
    run = Run(np.arange(4200) / 50.0, reference_n=reference,
              position_m=np.concatenate([np.zeros(60), reference[:-60]]) + 0.001 * noise,
              information={'signals': {'reference': 'm'}})
    found = loop_bandwidth(run)
    assert found.method == 'excitation'
    assert 50.0 * found.delay_s == pytest.approx(60.0, abs=1.2)
    assert 50.0 * found.correlation_delay_s == pytest.approx(60.0, abs=1.2)
