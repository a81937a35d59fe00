"""Limit cycles found in recordings: the accuracy, the verdicts, and what shows isolation."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from documented import problems
from scipy import signal

from asi_analysis.bags.bag import write_bag
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.limit_cycle.detection.agreement import judge_run
from asi_analysis.limit_cycle.detection.answer import detect_limit_cycles
from asi_analysis.limit_cycle.detection.drive import flat_share
from asi_analysis.limit_cycle.detection.feedback import follows_a_law
from asi_analysis.limit_cycle.detection.resolution import quantisation
from asi_analysis.limit_cycle.detection.segments import middle_cuts
from asi_analysis.limit_cycle.detection.verdict import judge_once
from asi_analysis.loop.closed_loop import simulate_loop
from asi_analysis.measures.oscillation import oscillation
from asi_analysis.measures.sinusoids.noise import BLOCK, _triangle_of_lags
from asi_analysis.measures.sinusoids.record import compressed, reduce, uncompressed
from asi_analysis.measures.sinusoids.sinusoid import analytic_signal, fit_record
from bench.limit_cycle_verdicts import (
    FAMILIES,
    check_accuracy,
    check_robustness,
    check_verdicts,
    relay,
    undriven,
)


@pytest.mark.parametrize('case', [(3, 5, 10), (3, 12, 40), (30, 5, 40), (300, 6, 10)])
def test_errors_reach_the_cramer_rao_bound(case):
    # 100 sines: the ratio spreads by 7 %, the coverage by 2 %.
    row = check_accuracy(*case, count=100, seed=1)
    assert row['frequency_error_over_bound'] < 1.5
    assert row['amplitude_error_over_bound'] < 1.5
    assert 0.88 <= row['frequency_coverage'] <= 0.995
    assert 0.88 <= row['amplitude_coverage'] <= 0.995


@pytest.mark.parametrize('missing', [0.0, 0.1])
def test_compressed_record_has_the_same_fit_as_its_samples(missing):
    random = np.random.default_rng(4)
    t = np.arange(24000) / 12.0 - 1000.0
    t = t[random.random(t.size) >= missing]
    angle = 2.0 * np.pi * (1.01 * t + 3e-7 * t * t)
    y = (np.exp(-2e-4 * t) * (np.cos(angle) + 0.1 * np.sin(3.0 * angle)) + (t / 1000.0) ** 3
         + 0.01 * random.standard_normal(t.size))
    short = compressed(t, y, 1.01, 5)
    assert len(short.values) < 0.2 * t.size
    found, expected = (fit_record(record, 1.01, 5, True)
                       for record in (short, uncompressed(t, y)))
    assert len(found.harmonics) == len(expected.harmonics) == 3
    for value in ('frequency_hz', 'amplitude', 'rate'):
        deviation = getattr(expected, f'{value}_sd'.replace('hz_sd', 'sd_hz'))
        assert getattr(found, value) == pytest.approx(getattr(expected, value),
                                                    abs=0.01 * deviation)
        assert np.diff(found.interval(value)) == pytest.approx(
            np.diff(expected.interval(value)), rel=1e-4)
    assert found.noise == pytest.approx(expected.noise, rel=1e-6)
    assert found.at(t) == pytest.approx(expected.at(t), abs=1e-3)


def test_noise_model_of_a_long_record_is_that_of_its_rows():
    values = np.cumsum(np.random.default_rng(2).standard_normal(2 * BLOCK))
    rows = np.lib.stride_tricks.sliding_window_view(values, 25)[:, ::-1]
    assert _triangle_of_lags(values, 24) == pytest.approx(np.linalg.cholesky(rows.T @ rows).T)
    # What its neighbours foretell is left to the rows: products of lags would lose the digits.
    assert _triangle_of_lags(np.sin(0.01 * np.arange(2 * BLOCK)), 24) is None


# Of each verdict there are others, which take less time.
LONG = ('Van der Pol, approach', 'Duffing, self-excited', 'Duffing, damped')


@pytest.mark.parametrize(('family', 'count'), [
    *((family, 1) for family in FAMILIES if family not in LONG),
    *(pytest.param(family, 2, marks=pytest.mark.slow) for family in FAMILIES)])
def test_each_family_gets_its_verdict(family, count):
    row = check_verdicts(family, count, seed=3)
    assert row['right'] == count, row
    assert row['false_limit_cycles'] == 0


@pytest.mark.parametrize('family', [
    'Van der Pol', *(pytest.param(family, marks=pytest.mark.slow) for family in (
        'cycle between rests', 'driven linear loop', 'white noise'))])
def test_a_sure_verdict_survives_cuts_decimation_and_an_offset(family):
    row = check_robustness(family, count=1, seed=5)
    assert row['sure'] == row['survived'] == 1


def simulated(gain, step=100.0, duration=1.0):
    run = simulate_loop({}, {'gain': gain, 'reference.shape': 'step',
                             'reference.amplitude': step}, duration)
    return Run(run.time_s, run.reference_n, run.command_n, run.force_n, run.valve_position_m,
               source=f'gain {gain}', information={'actuator': {}})


def test_actuator_cycles_at_high_gain():
    last = judge_run(simulated(11.0, duration=0.4))[-1]
    assert last.verdict == 'limit_cycle' and last.confidence > 0.9
    assert 80.0 < last.frequency_hz < 100.0


@pytest.mark.slow   # test_a_step_of_our_actuator_that_settles_has_no_oscillation_to_attribute
def test_actuator_settles_at_low_gain():
    assert all(s.verdict != 'limit_cycle' for s in judge_run(simulated(3.0)))


def _cycle(amplitude_of_time, source):
    t = np.arange(3000) / 1000.0
    angle = 2 * np.pi * 20.0 * t
    wave = np.cos(angle) + 0.1 * np.cos(3 * angle)
    noise = 0.01 * np.random.default_rng(5).standard_normal(t.size)
    return Run(t, force_n=amplitude_of_time(t) * wave + noise, source=source)


def test_isolation_needs_the_orbit_from_both_sides():
    inside = _cycle(lambda t: 1.0 - 0.9 * np.exp(-5 * t), 'inside')
    outside = _cycle(lambda t: 1.0 + 1.5 * np.exp(-5 * t), 'outside')
    alone = detect_limit_cycles([inside])['segments'][-1]
    assert alone['verdict'] == 'limit_cycle' and alone['came_from'] == 'inside'
    assert not alone['isolated'] and 'isolation not shown' in alone['why']
    both = [s for s in detect_limit_cycles([inside, outside])['segments']
            if s['verdict'] == 'limit_cycle']
    assert len(both) == 2 and all(s['isolated'] for s in both)


def test_orbits_of_different_size_are_no_evidence_for_each_other():
    inside = _cycle(lambda t: 1.0 - 0.9 * np.exp(-5 * t), 'inside')
    outside = _cycle(lambda t: 1.5 + 1.5 * np.exp(-5 * t), 'outside')
    assert not any(s['isolated'] for s in detect_limit_cycles([inside, outside])['segments'])


def test_return_to_the_orbit_after_a_push_shows_isolation():
    pushed = _cycle(lambda t: 1.0 + np.where(t > 1.5, -0.7 * np.exp(-8 * (t - 1.5)), 0.0), 'push')
    last = detect_limit_cycles([pushed])['segments'][-1]
    assert last['isolated'] and 'disturbance' in last['why']


def test_flat_share_tells_a_stop_from_a_relay_and_a_sine():
    angle = np.linspace(0.0, 40.0 * np.pi, 4000)
    assert flat_share(np.sin(angle)) == 0.0
    assert flat_share(np.sign(np.sin(angle))) == 0.0
    assert flat_share(np.round(20 * np.sin(angle)) / 20) == 0.0
    assert flat_share(np.clip(2 * np.sin(angle), -1, 1)) == pytest.approx(2 / 3, abs=0.01)


def _moved(reference, motion):
    """Return a run of 4 s whose reference moves, and its longest segment."""
    noise = 0.01 * np.random.default_rng(7).standard_normal(reference.size)
    run = Run(np.arange(reference.size) / 1000.0, reference, force_n=motion + noise)
    return max(judge_run(run, undriven=True), key=lambda s: s.end_s - s.start_s)


@pytest.mark.slow
def test_what_follows_a_moving_reference_is_forced_and_a_cycle_beside_it_is_not():
    t = np.arange(4000) / 1000.0
    chirp = np.sin(2 * np.pi * (1.0 + 4.0 * t) * t)
    assert _moved(chirp, np.tanh(2 * np.roll(chirp, 7))).verdict == 'forced'
    steps = np.repeat(np.random.default_rng(1).choice([-1.0, 1.0], 400), 10)
    cycle = np.cos(2 * np.pi * 40 * t) + 0.1 * np.cos(2 * np.pi * 120 * t)
    beside = _moved(steps, 0.1 * np.roll(steps, 7) + cycle)
    assert beside.verdict == 'limit_cycle' and beside.confidence > 0.9
    assert beside.frequency_hz == pytest.approx(40.0, abs=0.01)


@pytest.mark.parametrize('ratio', [1 / 2, 1 / 5, 2 / 3])
def test_a_cycle_whose_frequency_is_only_near_a_ratio_of_the_reference_is_not_forced(ratio):
    t = np.arange(4000) / 1000.0
    cycle = np.cos(2 * np.pi * 10 * t) + 0.1 * np.cos(2 * np.pi * 30 * t)
    assert _moved(0.01 * np.sin(2 * np.pi * 10.02 * ratio * t), cycle).verdict == 'limit_cycle'


def test_a_harmonic_of_the_reference_is_forced():
    t = np.arange(4000) / 1000.0
    reference = np.sin(2 * np.pi * 5 * t)
    found = _moved(reference, 3.0 * reference - 4.0 * reference ** 3)   # at 15 Hz
    assert found.verdict == 'forced' and found.frequency_hz == pytest.approx(15.0, abs=0.01)


def _pushed(load, gain):
    return Run(*simulate_loop(load, {'gain': gain, 'reference.amplitude': 0.0}, 3.0),
               information={'actuator': load})


@pytest.mark.parametrize('load, driver', [
    ({'load.type': 'prescribed', 'load.velocity': 0.5, 'load.frequency': 2.0},
     'prescribed motion'),
    ({'load.type': 'spring', 'load.external_force': 200.0, 'load.external_force_frequency': 5.0},
     'external force')])
def test_what_moves_the_piston_from_outside_drives_it(load, driver):
    run = _pushed(load, 3.0)
    assert {segment.verdict for segment in judge_run(run)} == {'forced'}
    assert driver in judge_run(run)[0].why


def test_oscillation_in_bursts_beside_a_forced_motion_is_told():
    load = {'load.type': 'prescribed', 'load.velocity': 0.5, 'load.frequency': 2.0}
    run = _pushed(load, 5.5)
    found = max(judge_run(run), key=lambda segment: segment.end_s - segment.start_s)
    assert found.verdict == 'forced' and 'in bursts' in found.why


def test_without_a_reference_nobody_is_sure_of_a_cycle():
    run = _cycle(lambda t: np.ones(t.size), 'free')
    alone, = judge_run(run)
    assert alone.verdict == 'limit_cycle' and alone.confidence <= 0.5
    assert 'no reference' in alone.why and '--undriven' in alone.why
    segment, = judge_run(run, undriven=True)
    assert segment.verdict == 'limit_cycle' and segment.confidence > 0.9
    held = Run(run.time_s, np.zeros(run.time_s.size), force_n=run.force_n)
    segment, = judge_run(held)
    assert segment.verdict == 'limit_cycle' and segment.confidence == 0.8
    assert 'no load is recorded' in segment.why and '--undriven' in segment.why
    # The metadata of a bag of this package name its load.
    segment, = judge_run(replace(held, information={'actuator': {}}))
    assert segment.verdict == 'limit_cycle' and segment.confidence > 0.9


@pytest.mark.parametrize('starts', [0.0, pytest.param(20.0, marks=pytest.mark.slow)])
def test_a_load_that_nobody_recorded_is_no_sure_limit_cycle(starts):
    """A PI loop whose load is a triangle, from the beginning on or after a rest."""
    level, total, rows = 0.0, 0.0, []
    random = np.random.default_rng(1)
    time_s = 0.02 * np.arange(4000)
    load = np.where(time_s < starts, 0.0, signal.sawtooth(1.3 * time_s, 0.5))
    for each in load:
        measured = level + 0.005 * random.standard_normal()
        total -= 0.01 * measured
        command = total - 0.8 * measured
        level += 0.02 * (command + each - level)
        rows.append((command, measured))
    command, output = np.array(rows).T
    for segment in judge_run(undriven(time_s, output, command)):
        assert segment.verdict != 'limit_cycle' or segment.confidence <= 0.8


def test_a_motion_that_excites_itself_is_a_sure_limit_cycle():
    t = np.arange(6000) / 200.0
    noise = 0.003 * np.random.default_rng(2).standard_normal(t.size)

    def last(amplitude):
        wave = np.cos(10.0 * np.pi * t) + 0.1 * np.cos(30.0 * np.pi * t)
        return judge_run(undriven(t, amplitude * wave + noise))[-1]
    assert last(1.0 / np.sqrt(1.0 + 999.0 * np.exp(-1.2 * t))).confidence > 0.9
    # A load that starts moves a linear loop so.
    assert last(1.0 - np.exp(-0.5 * t)).confidence <= 0.8


def test_a_recording_driven_open_loop_is_no_limit_cycle():
    t = np.arange(6000) * 0.01
    random = np.random.default_rng(2)
    command = signal.sawtooth(2.0 * np.pi * 0.2 * t, 0.5)
    motion = signal.lsim(([1.0], [1.0, 3.0, 3.0, 1.0]), command, t)[1]
    driven = Run(t, force_n=motion + 0.01 * random.standard_normal(t.size), command_n=command)
    for segment in judge_run(driven):
        assert segment.verdict != 'limit_cycle'
    assert 'nothing shows that the command answers the output' in segment.why


@pytest.mark.parametrize('reference', [0.0, np.nan])
def test_a_reference_at_rest_is_no_proof_of_a_closed_loop(reference):
    t = np.arange(2500) / 500.0
    command = np.sign(np.sin(10.0 * np.pi * t + 0.01))
    motion = signal.lsim(([3600.0], [1.0, 36.0, 3600.0]), command, t)[1]
    motion += 0.01 * np.random.default_rng(1).standard_normal(t.size)
    segments = judge_run(Run(t, np.full(t.size, reference), command, motion))
    assert all(segment.verdict != 'limit_cycle' for segment in segments)


def test_a_loop_that_repeats_itself_is_closed_if_a_law_of_the_output_gives_the_command():
    t = np.arange(2000) / 100.0
    random = np.random.default_rng(3)
    segment = judge_run(relay(random))[-1]   # or a square wave, into a process that lags
    assert segment.verdict == 'limit_cycle' and segment.confidence == 0.8
    triangle = signal.sawtooth(2.0 * np.pi * 0.51 * t, 0.5)
    action = 1.2 * triangle + 3.0 * np.cumsum(triangle) * 0.01
    output = triangle + 0.01 * random.standard_normal(t.size)
    assert follows_a_law(Run(t, None, action, output), 'force', 0.0, 20.0, 0.51)
    process = signal.lfilter([0.02], [1.0, -0.98], triangle)    # open loop
    output = process + 0.01 * random.standard_normal(t.size)
    assert not follows_a_law(Run(t, None, triangle, output), 'force', 0.0, 20.0, 0.51)


def test_a_relay_whose_reference_creeps_is_not_told_to_have_one_at_rest():
    run = relay(np.random.default_rng(2))
    creeping = replace(run, reference_n=np.linspace(0.0, 1e-3, len(run)))
    assert 'its command switches' in judge_run(creeping)[-1].why


def test_an_undamped_linear_loop_that_rings_after_a_step_has_no_amplitude_that_settles():
    t = np.arange(0.0, 7.0, 0.0046)
    noise = 0.005 * np.random.default_rng(2).standard_normal(t.size)
    ringing = np.where(t < 2.4, 0.0, 1.0 - np.cos(10.8 * np.pi * (t - 2.4)))
    for reference in (np.where(t < 2.4, 0.0, 1.0), np.zeros(t.size)):
        last = judge_once(Run(t, reference, force_n=ringing + noise))[-1]
        assert last.verdict != 'limit_cycle'


def test_an_amplitude_that_grows_for_some_cycles_and_then_lasts_settles():
    t = np.arange(4000) / 200.0
    amplitude = 1.0 / np.sqrt(1.0 + 99.0 * np.exp(-2.0 * t))
    noise = 0.01 * np.random.default_rng(2).standard_normal(t.size)
    last = judge_once(undriven(t, amplitude * np.cos(10.0 * np.pi * t) + noise))[-1]
    assert last.verdict == 'limit_cycle' and 'an amplitude that settles' in last.why


def test_a_command_that_answers_the_output_shows_a_closed_loop():
    run = simulated(10.0)
    last = judge_run(Run(run.time_s, command_n=run.command_n, force_n=run.force_n))[-1]
    assert last.verdict == 'limit_cycle' and 0.7 < last.confidence <= 0.8


def test_the_band_about_any_frequency_can_be_filtered():
    values = np.random.default_rng(1).standard_normal(100)
    for frequency in (1e-6, 0.1, 0.49, 0.5):
        assert np.isfinite(analytic_signal(values, 1.0, frequency)).all()


def test_a_piece_far_shorter_than_a_cycle_is_one_block():
    t, y = reduce(np.arange(9) * 1e-3, np.arange(9.0), 1e-3)
    assert len(t) == len(y) == 1
    t = np.arange(20_000) * 1e-3
    run = undriven(t, np.cos(2.0 * np.pi * 0.2 * t) + 0.1 * np.cos(2.0 * np.pi * 0.6 * t))
    reference = np.where(t > 0.009, 1.0, 0.0)
    assert judge_run(Run(t, reference, force_n=run.force_n))


@pytest.mark.parametrize('levels, verdict', [(2.0, 'unsteady'), (400.0, 'limit_cycle')])
def test_harmonics_that_rounding_may_have_made_are_no_evidence(levels, verdict):
    run = _cycle(lambda t: np.ones(t.size), 'rounded')
    rounded, = judge_run(undriven(run.time_s, np.round(levels * run.force_n) / levels))
    assert rounded.verdict == verdict


def test_rounding_or_holding_a_pure_sine_makes_no_limit_cycle():
    t = np.arange(200) / 100.0
    rounded = np.round(6.0 * np.sin(10.0 * np.pi * t + 1.0)) / 6.0
    assert judge_once(undriven(t, rounded))[0].verdict == 'unsteady'
    assert quantisation(rounded + 1e4) == pytest.approx(1 / 6)
    assert quantisation(np.random.default_rng(1).standard_normal(500)) == 0.0
    fast, slow = np.arange(4000) / 1000.0, np.arange(202) / 50.0
    measured = np.sin(10.0 * np.pi * slow)
    for logged in (measured[(fast * 50.0 + 1e-9).astype(int)], np.interp(fast, slow, measured)):
        segment, = judge_once(undriven(fast, logged))
        assert segment.verdict == 'unsteady' and segment.amplitude == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize('noise', [0.0, 0.01])
def test_a_rest_before_or_after_a_short_cycle_changes_nothing(noise):
    t = np.arange(500) / 100.0
    wave = np.cos(2.0 * np.pi * t) + 0.1 * np.cos(6.0 * np.pi * t)
    random = np.random.default_rng(1)
    cycle = wave + 0.01 * random.standard_normal(t.size)
    rest = 0.02 + noise * random.standard_normal(200)
    time_s = np.arange(700) / 100.0
    alone, = judge_run(undriven(t, cycle))
    after = judge_run(undriven(time_s, np.concatenate([cycle, rest])))[0]
    before = judge_run(undriven(time_s, np.concatenate([rest, cycle])))[-1]
    for segment in (after, before):
        assert segment.verdict == alone.verdict == 'limit_cycle'
        assert segment.confidence == pytest.approx(alone.confidence, abs=0.02)
        assert segment.amplitude == pytest.approx(alone.amplitude, rel=0.001)


@pytest.mark.parametrize('noise, level', [(0.0, 0.0), (0.02, 0.0), (0.02, 5.0), (0.0, 5.0)])
def test_a_rest_in_the_middle_divides_the_record(noise, level):
    t = np.arange(1000) / 100.0
    wave = np.cos(2.0 * np.pi * t) + 0.1 * np.cos(6.0 * np.pi * t)
    random = np.random.default_rng(1)
    cycle = wave + 0.01 * random.standard_normal(t.size)
    rest = level + noise * random.standard_normal(400)
    values = np.concatenate([cycle[:620], rest, cycle[620:]])
    first, middle, last = judge_run(undriven(np.arange(1400) / 100.0, values), undriven=True)
    assert middle.why == 'the signal does not move'
    assert middle.start_s == pytest.approx(6.2, abs=0.02)
    assert middle.end_s == pytest.approx(10.19, abs=0.02)
    for segment in (first, last):
        assert segment.verdict == 'limit_cycle' and segment.confidence > 0.9
        assert segment.frequency_hz == pytest.approx(1.0, abs=0.01)


def test_every_rest_divides_the_record():
    """If the longest one looked coloured by chance, no other one was tried."""
    random = np.random.default_rng(1)
    wave, values = np.cos(2.0 * np.pi * np.arange(600) / 50.0), []
    for _ in range(12):
        values += [wave + 0.02 * random.standard_normal(600), 0.02 * random.standard_normal(200)]
    values[1] = signal.lfilter([1.0], [1.0, -0.9], values[1])
    cuts = np.array(middle_cuts(np.concatenate(values), 50.0))
    assert set(cuts // 800) == set(range(11))
    assert np.all((cuts - 575) % 800 <= 250)


@pytest.mark.parametrize('pole', [0.6, 0.9])
def test_a_quiet_stretch_of_coloured_noise_divides_the_record(pole):
    random = np.random.default_rng(0)
    t = np.arange(2000) / 25.0
    wave = np.cos(2.0 * np.pi * t) + 0.1 * np.cos(6.0 * np.pi * t)
    wave += 0.02 * random.standard_normal(t.size)
    quiet = 0.1 * signal.lfilter([1.0], [1.0, -pole], random.standard_normal(500))
    values = np.concatenate([wave[:1000], 0.1 / np.std(quiet) * quiet, wave[1000:]])
    first, middle, last = judge_run(undriven(np.arange(2500) / 25.0, values), undriven=True)
    assert first.verdict == last.verdict == 'limit_cycle'
    assert first.confidence > 0.9 and last.confidence > 0.9
    assert middle.verdict == 'noise'
    assert (middle.start_s, middle.end_s) == pytest.approx((40.0, 60.0), abs=1.0)


def test_the_trough_of_a_beat_is_no_quiet_stretch():
    t = np.arange(8000) / 25.0
    beat = np.cos(2.0 * np.pi * t) + np.cos(2.0 * np.pi * 1.02 * t)
    noise = 0.01 * np.random.default_rng(0).standard_normal(t.size)
    assert middle_cuts(beat + noise, 25.0) == []


def sticking_loop(random, duration=80.0, period=0.02):
    """Return output and command of a PI loop whose valve sticks and whose sensor is noisy."""
    delay = [0.0] * 10
    level, total, valve, before = 0.3, 0.0, 0.0, 0.0
    sticks, direction, rows = True, 0.0, []
    for _ in range(int((40.0 + duration) / period)):
        measured = level + 0.01 * random.standard_normal()
        total -= 3.0 * measured * period
        command = total - 1.2 * measured
        if sticks and abs(command - valve) > 0.15:
            sticks, direction = False, np.sign(command - valve)
        sticks = sticks or (command - before) * direction <= 0.0
        valve = valve if sticks else command - 0.1 * direction
        before = command
        rows.append((measured, command))
        level += 0.04 * (delay.pop(0) - level)
        delay.append(valve)
    return np.array(rows[-int(duration / period):]).T


def test_a_sticking_loop_in_noise_is_not_surely_noise():
    output, command = sticking_loop(np.random.default_rng(0))
    for segment in judge_run(undriven(0.02 * np.arange(output.size), output, command)):
        assert segment.verdict != 'noise' or segment.confidence < 0.9


@pytest.mark.slow
def test_coarsely_rounded_noise_and_spikes_in_noise_are_noise():
    random = np.random.default_rng(1)
    t = 0.01 * np.arange(1500)
    white = random.standard_normal(t.size)
    slow = signal.lfilter([1.0], [1.0, -0.9], white)
    for values in (np.round(0.5 * white), np.round(0.5 * slow), white + 30.0 * (t % 5.0 == 3.0)):
        assert {segment.verdict for segment in judge_run(undriven(t, values))} == {'noise'}


@pytest.mark.parametrize('size', [0.9, 0.3])
def test_a_second_harmonic_larger_than_the_fundamental_is_none(size):
    t = np.arange(2000) / 100.0
    wave = size * np.cos(8 * np.pi * t) + np.cos(16 * np.pi * t + 1) + 0.2 * np.cos(24 * np.pi * t)
    noise = 0.01 * np.random.default_rng(1).standard_normal(t.size)
    found, = judge_once(undriven(t, wave + noise))
    assert found.verdict == 'limit_cycle'
    assert found.frequency_hz == pytest.approx(4.0, abs=1e-3)
    assert found.amplitude == pytest.approx(size, rel=0.01)


def test_a_line_beside_the_oscillation_is_named():
    t = np.arange(2000) / 100.0
    wave = np.cos(10.0 * np.pi * t) + 0.2 * np.cos(26.6 * np.pi * t)
    noise = 0.01 * np.random.default_rng(1).standard_normal(t.size)
    found, = judge_once(undriven(t, wave + noise))
    assert found.verdict == 'unsteady' and 'a line of 13.3 Hz with 0.2' in found.why


@pytest.mark.parametrize('drift, verdict', [(0.1, 'limit_cycle'), (0.5, 'decaying')])
def test_a_cycle_may_drift_as_little_as_a_sustained_oscillation(drift, verdict):
    t = np.arange(4000) / 200.0
    wave = np.cos(10 * np.pi * t) + 0.1 * np.cos(30 * np.pi * t)
    noise = 0.005 * np.random.default_rng(1).standard_normal(t.size)
    run = undriven(t, (1.0 - drift * t / 20.0) * wave + noise)
    found, = judge_run(run)
    assert found.verdict == verdict
    assert oscillation(run).sustained is (verdict == 'limit_cycle')
    assert ('drifts by -9.9 %' in found.why) is (drift == 0.1)


def test_times_that_repeat_or_run_back_are_left_out():
    run = _cycle(lambda t: np.ones(t.size), 'stutter')
    twice = Run(np.repeat(run.time_s, 2), force_n=np.repeat(run.force_n, 2))
    assert judge_run(twice)[0].frequency_hz == judge_run(run)[0].frequency_hz
    with pytest.raises(InputError, match='at least 9'):
        judge_run(Run(run.time_s[::-1].copy(), force_n=run.force_n))


@pytest.mark.parametrize('run, words', [
    (Run(np.arange(100.0)), 'no signal'),
    (Run(np.arange(5.0), force_n=np.arange(5.0)), 'at least 9')])
def test_bad_input_is_named(run, words):
    with pytest.raises(InputError, match=words):
        judge_run(run)


# In this process: test_api.py; in one of its own: test_a_temporary_folder_that_is_full.
@pytest.mark.slow
def test_command_prints_what_is_documented(tmp_path):
    write_bag(simulated(10.0, duration=0.4), tmp_path / 'bag')
    result = subprocess.run(
        [sys.executable, '-m', 'asi_analysis.cli', 'limit-cycle', str(tmp_path / 'bag'),
         '--report', str(tmp_path), '--json'],
        capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    document = json.loads(result.stdout)
    assert problems(document, 'asi limit-cycle') == []
    assert document['segments'][-1]['verdict'] == 'limit_cycle'
    assert (tmp_path / 'cycle_1.png').read_bytes().startswith(b'\x89PNG')


@pytest.mark.slow
def test_isolation_experiment_shows_the_orbit_from_both_sides(tmp_path, ros_environment):
    result = subprocess.run(
        [sys.executable, '-m', 'asi_analysis.cli', 'run', '--experiment', 'isolation', '--gain',
         '8', '--step', '100', '--duration', '0.7', '--out', str(tmp_path / 'out'), '--json'],
        capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    document = json.loads(result.stdout)
    assert problems(document, 'asi run --experiment isolation') == []
    cycles = [s for s in document['segments'] if s['verdict'] == 'limit_cycle']
    assert {s['came_from'].split()[0] for s in cycles} == {'inside', 'outside'}
    assert all(s['isolated'] for s in cycles)
