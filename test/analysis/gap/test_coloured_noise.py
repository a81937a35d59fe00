"""Noise that is not white: told from a gap, and as strong as it is."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from asi_analysis.bags.run import Run
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.inference import coloured_noise
from asi_analysis.gap.inference.coloured_noise import (
    Residual,
    _mean_square,
    noise_of_residual,
    with_coloured_noise,
)
from asi_analysis.gap.inference.probability import marginals
from asi_analysis.gap.model import simulator
from asi_analysis.gap.model.group import simulator_group
from asi_analysis.gap.model.predict import judged_error
from asi_analysis.gap.prepare import prepare as prepared
from asi_analysis.gap.sampling import noise_of_colour, noise_spectrum, whitened
from asi_analysis.loop.closed_loop import simulate_loop

LINEAR = {'load.type': 'spring', 'valve_hysteresis.model': 'off', 'friction.model': 'off',
          'hydraulic_damping.model': 'linear', 'valve_characteristic.model': 'off',
          'force_sensor.model': 'off', 'force_sensor.mass_share': 0.0}
LOOP = {'compensator': 'proportional', 'gain': 3.0, 'reference.shape': 'multisine',
        'reference.frequency': 0.5, 'reference.end_frequency': 60.0,
        'reference.amplitude': 200.0, 'reference.start': 0.05}
LEVEL = {'force_n': 1.0, 'valve_position_m': 2e-7, 'position_m': 2e-6, 'velocity_m_s': 5e-4}


# Noise of a sensor: behind a filter, averaged by its firmware, or slow beside white noise.
KINDS = {'a low-pass of 100 Hz': lambda white: lfilter(*butter(2, 0.2), white[0]),
         'a low-pass of 30 Hz': lambda white: lfilter(*butter(2, 0.06), white[0]),
         'a mean of four': lambda white: lfilter([1.0] * 4, [1.0], white[0]),
         'slow and white': lambda white: lfilter([0.2], [1.0, -0.98], white[0]) + 0.3 * white[1]}


def noise(colour, count, seed=3):
    """Return noise of standard deviation 1: of this kind, or correlation from sample to sample."""
    white = np.random.default_rng(seed).standard_normal((2, count + 1000))
    signal = (KINDS[colour](white) if colour in KINDS else
              lfilter([np.sqrt(1.0 - colour ** 2)], [1.0, -colour], white[0]))[1000:]
    return signal / signal.std() if colour in KINDS else signal


def found_in(signal, command=None):
    """Return the noise in a signal, if it is noise; command: what may cause it."""
    none = np.zeros(signal.size)
    command = none if command is None else command
    return noise_of_residual([Residual(signal, command, none, none == 0.0)])


def telegraph(count):
    """Return a signal of -1 and 1 that changes its sign now and then, at random."""
    return np.where(np.cumsum(np.random.default_rng(5).random(count) < 0.02) % 2, 1.0, -1.0)


def recorded(machine, colour, seed=0):
    """Return 3 s of the simulator at 1 kHz, with noise of this colour."""
    signals = simulate_loop(machine, LOOP, 3.0, 1000.0)._asdict()
    for number, (name, level) in enumerate(LEVEL.items()):
        own = noise(colour, signals[name].size, 10_000 + 10 * seed + number)
        signals[name] = signals[name] + level * own
    del signals['reference_n']
    return Run(**signals)


def test_what_follows_two_jumps_of_a_force_is_no_noise():
    """A velocity then: it is as smooth as noise of many orders, and its innovations are small."""
    time, white = np.arange(6000), noise(0.0, 6000)
    moved = (np.exp(-0.5 * ((time - 2200) / 20.0) ** 2)
             - np.exp(-0.5 * ((time - 3300) / 20.0) ** 2))
    for size in (5.0, 10.0, 40.0):
        assert getattr(found_in(white + size * moved), 'unsure', 1.0) > 0.0


@pytest.mark.parametrize('colour', [0.0, 0.5, 0.8, 0.95])
def test_noise_is_recognised_whatever_its_colour(colour):
    found = found_in(noise(colour, 8000))
    spectrum = noise_spectrum(np.fft.rfftfreq(8000), found.colour)[1:400].mean()
    own = 1.1 * spectrum - 0.1   # without what is added
    assert own == pytest.approx(noise_spectrum(np.fft.rfftfreq(8000), (colour,))[1:400].mean(),
                                rel=0.2)
    assert found.variance == pytest.approx(1.0, rel=0.2)


@pytest.mark.parametrize('count', [2500, 8000, 40_000])
@pytest.mark.parametrize('kind', KINDS)
def test_noise_is_recognised_whatever_its_kind(kind, count):
    signal = noise(kind, count)
    found = found_in(signal, np.random.default_rng(6).standard_normal(count))
    assert found.variance == pytest.approx(1.0, rel=0.1)
    half = noise_spectrum(np.fft.rfftfreq(count), found.colour)[:count // 20].mean()
    power = np.abs(np.fft.rfft(signal))[1:count // 20] ** 2 / count
    assert half == pytest.approx(power.mean(), rel=0.3)


@pytest.mark.parametrize('kind', [0.8, *KINDS])
def test_units_and_origins_do_not_matter(kind):
    signal, command = noise(kind, 4000), np.random.default_rng(6).standard_normal(4000)
    found = found_in(signal, command)
    again = found_in(1e-7 * signal + 3e-6, 1e4 * command - 5e5)
    assert again.variance == pytest.approx(1e-14 * found.variance, rel=1e-6)
    assert again.colour == pytest.approx(found.colour, rel=1e-4, abs=1e-6)


def test_samples_that_are_lost_do_not_matter():
    signal = noise('a low-pass of 100 Hz', 8000)
    valid = np.arange(signal.size) % 500 >= 20
    none = np.zeros(signal.size)
    found = noise_of_residual([Residual(np.where(valid, signal, 1e3), none, none, valid)])
    assert found.variance == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize('shape', [np.sin, lambda phase: np.sign(np.sin(phase)),
                                   lambda phase: np.sign(np.sin(phase)) * np.sin(phase) ** 2])
@pytest.mark.parametrize('kind', [0.8, *KINDS])
def test_what_follows_from_its_own_past_and_from_the_command_is_no_noise(shape, kind):
    phase = 2.0 * np.pi * 3e-3 * np.arange(8000)
    signal = shape(phase - 0.3) + noise(kind, phase.size)
    found = found_in(signal, 100.0 * np.sin(phase))
    assert found is None or found.variance < 1.25


@pytest.mark.parametrize('missed', [
    lambda t: 2.0 * np.sin(2.0 * np.pi * 7.0 * t),               # of a motion
    lambda t: 2.0 * np.sin(2.0 * np.pi * (0.5 + 5.0 * t) * t),   # of a chirp up to 60 Hz
    lambda t: 3.0 * (t > 4.0) * np.exp(4.0 - t)])                # of a pulse
def test_what_a_model_misses_at_low_frequencies_is_not_counted_as_noise(missed):
    time = 1e-3 * np.arange(8000)
    found = found_in(missed(time) + noise(0.8, time.size))
    assert 0.4 < found.variance < 1.25


@pytest.mark.parametrize('missed', [
    lambda t: 4.0 * telegraph(t.size),               # a force that jumps
    lambda t: 8.0 * (np.arange(t.size) % 50 == 0)])  # lost samples
def test_what_is_not_normal_is_no_noise(missed):
    """Though a force that jumps has the spectrum of noise."""
    time = 1e-3 * np.arange(8000)
    assert found_in(missed(time) + noise(0.8, time.size)) is None


def test_what_follows_a_random_command_is_no_noise():
    """Though a lag of a random command has the spectrum of noise."""
    command = np.random.default_rng(6).standard_normal(8000)
    lagged = lfilter([0.0, 0.2], [1.0, -0.8], command)
    assert found_in(lagged) is not None
    assert found_in(lagged, command) is None


@pytest.mark.parametrize('nothing', [np.zeros(100), np.ones(100), np.ones(2)])
def test_a_residual_that_is_constant_is_no_noise(nothing):
    assert found_in(nothing) is None


def test_the_spectrum_of_noise_is_that_of_its_correlation():
    frequency = np.fft.rfftfreq(200_000)
    power = np.abs(np.fft.rfft(noise(0.7, 200_000))) ** 2 / 200_000
    for low, high in ((0.0, 0.01), (0.05, 0.1), (0.3, 0.5)):
        band = (frequency > low) & (frequency < high)
        assert power[band].mean() == pytest.approx(
            noise_spectrum(frequency[band], (0.7,)).mean(), rel=0.05)


def test_noise_is_made_with_the_spectrum_that_was_found():
    colour = found_in(noise('a low-pass of 100 Hz', 40_000)).colour
    made = noise_of_colour(40_000, colour, np.random.default_rng(8))
    assert made.std() == pytest.approx(1.0, rel=0.05)
    assert found_in(made).variance == pytest.approx(1.0, rel=0.1)
    white = whitened(made, made < np.inf, colour)
    assert white.std() == pytest.approx(1.0, rel=0.05)
    power = np.abs(np.fft.rfft(white)) ** 2 / white.size
    assert [part.mean() for part in np.array_split(power, 8)] == pytest.approx([1.0] * 8, rel=0.2)


def test_the_noise_of_a_group_is_what_is_left_if_that_is_noise():
    run = recorded(LINEAR, 0.8)
    p = simulator.simulator_record(LINEAR)
    group = simulator_group(p, prepared([run]), ('valve',), linear=True)
    assert group.noise['valve'] < 0.6 * LEVEL['valve_position_m']
    found = with_coloured_noise(group, p)
    left = judged_error(found.recordings[0], 'valve', p)[found.recordings[0].known]
    assert found.error_floor['valve'] == pytest.approx(np.mean(left ** 2))
    assert found.recordings[0].noise['valve_position'] == pytest.approx(2e-7, rel=0.1)
    assert {*found.recordings[0].colour} == {'valve_position'}
    p['valve_flexure_deadband'] = 60.0
    assert math.sqrt(with_coloured_noise(group, p).error_floor['valve']) < 2.2e-7


def test_noise_is_no_more_than_what_is_left(monkeypatch):
    """Of a motion, whose noise may be strong outside of its band, and whose level is not sure."""
    monkeypatch.setattr(coloured_noise, 'noise_of_residual',
                        lambda residuals: noise_of_residual(residuals)._replace(unsure=0.1))
    run = recorded(LINEAR, 0.9)
    p = simulator.simulator_record(LINEAR)
    group = simulator_group(p, prepared([run]), ('force', 'velocity'), linear=True)
    left = _mean_square(group, 'velocity', p)
    group = replace(group, error_floor={'force': 1e6, 'velocity': left / 1.3},
                    noise=group.noise | {'velocity': math.sqrt(left / 1.3)})
    found = with_coloured_noise(group, p)
    assert found.error_floor['velocity'] < group.error_floor['velocity']
    assert found.noise['velocity'] ** 2 <= 1.001 * found.error_floor['velocity']


# Valve position, force, velocity and position of each seed have noise of their own. With seeds 8,
# 10, 42 and 101, errors of the valve's fit were taken for viscous friction, or noise for a gap.
@pytest.mark.parametrize(('colour', 'deadband', 'seed'), [
    ('a low-pass of 100 Hz', 0.0, 1), (0.9, 20.0, 10), *(
        pytest.param(*each, marks=pytest.mark.slow) for each in (
            (0.0, 0.0, 8), (0.5, 0.0, 8), (0.0, 20.0, 101), (0.85, 0.0, 1), (0.9, 20.0, 42),
            ('slow and white', 20.0, 1)))])
def test_coloured_noise_is_no_gap_and_hides_none(colour, deadband, seed):
    effect = {'valve_flexure.deadband': deadband}
    found = diagnose([recorded(LINEAR | effect, colour, seed)], LINEAR)
    assert found.verdict == (('valve_deadband',) if deadband else ())
    assert marginals(found.joined)['unknown'] < 0.2
    assert any('noise of the valve position' in note for note in found.notes) == (colour != 0.0)


@pytest.mark.slow
@pytest.mark.parametrize('colour', [0.0, 0.5, 0.8, 0.9, 0.95, *KINDS])
def test_whatever_the_noise_nothing_else_is_sure(colour):
    named = 0
    for seed in range(100, 106):
        for deadband in (0.0, 20.0):
            effect = {'valve_flexure.deadband': deadband}
            found = diagnose([recorded(LINEAR | effect, colour, seed)], LINEAR)
            right = 'valve_deadband' if deadband else 'no_gap'
            chance = marginals(found.joined)
            assert not {name for name in chance if chance[name] >= 0.9} - {right}
            named += chance.get(right, 0.0) >= 0.5
    assert named >= 11
