"""What is wrong with a recording is said, and no figure that rests on it stands alone."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap.prepare import prepare
from asi_analysis.limit_cycle.detection.answer import detect_limit_cycles
from asi_analysis.limit_cycle.detection.verdict import judge_once
from asi_analysis.loop.closed_loop import simulate_loop
from asi_analysis.measures.analysis import analyze
from asi_analysis.measures.quality import doubts, findings
from torture.inputs import cycle, with_command

STEP = 500      # sample of the jump of the reference


def a_run() -> Run:
    """Return a second-order response to a step of 100 N, at 1 kHz, with noise."""
    time_s = np.arange(2000) / 1000.0
    t = np.maximum(time_s - time_s[STEP], 0.0)
    damped = np.exp(-60.0 * t)
    force = 100.0 * (1.0 - damped * (np.cos(150.0 * t) + 0.4 * np.sin(150.0 * t)))
    noise = 0.05 * np.random.default_rng(1).normal(size=time_s.size)
    return Run(time_s, np.where(time_s < time_s[STEP], 0.0, 100.0), None, force + noise)


def without(run: Run, places: object) -> Run:
    kept = np.ones(len(run), bool)
    kept[places] = False    # type: ignore[index]
    assert run.reference_n is not None
    assert run.force_n is not None
    return Run(run.time_s[kept], run.reference_n[kept], None, run.force_n[kept])


def with_force(run: Run, change: Callable[[np.ndarray], np.ndarray]) -> Run:
    return replace(run, force_n=change(run.signal('force').copy()))


def put(values: np.ndarray, places: slice | int, value: float | np.ndarray) -> np.ndarray:
    values[places] = value
    return values


DAMAGED: dict[str, Callable[[Run], Run]] = {
    'gap': lambda run: without(run, slice(STEP - 4, STEP + 64)),
    'missing': lambda run: with_force(run, lambda f: put(f, slice(STEP, STEP + 20), np.nan)),
    'clipping': lambda run: with_force(run, lambda f: np.minimum(f, 105.0)),
    'spike': lambda run: with_force(run, lambda f: put(f, STEP + 300, 6.6e5)),
    'order': lambda run: with_force(run, lambda f: np.append(f[100:], f[-100:])),
    'unit': lambda run: with_force(run, lambda f: 1000.0 * f),
    'sign': lambda run: with_force(run, lambda f: -f),
    'jump': lambda run: with_force(run, lambda f: put(f, slice(STEP + 3, STEP + 40),
                                                      -f[STEP + 3:STEP + 40])),
    'frozen': lambda run: with_force(run, lambda f: put(f, slice(STEP + 8, STEP + 14),
                                                        f[STEP + 8])),
    'quantisation': lambda run: with_force(run, lambda f: 10.0 * np.round(f / 10.0)),
    'time_order': lambda run: replace(run, time_s=np.where(
        np.arange(len(run)) == STEP, run.time_s[STEP - 1], run.time_s)),
    'clock_step': lambda run: replace(run, time_s=run.time_s + 3600.0 * (
        np.arange(len(run)) > STEP)),
}


def test_a_clean_recording_has_nothing_wrong() -> None:
    document = analyze(a_run())
    assert document['quality'] == []
    assert all(document['reliable'].values())
    assert document['rise_time_s'] == pytest.approx(0.0097, rel=0.1)
    assert document['overshoot_percent'] > 20.0
    assert document['bandwidth_hz'] is not None


@pytest.mark.parametrize('kind', DAMAGED)
def test_each_kind_of_damage_is_found_and_its_figures_withheld(kind: str) -> None:
    document = analyze(DAMAGED[kind](a_run()))
    assert kind in {each['kind'] for each in document['quality']}
    for figure in ('rise_time_s', 'overshoot_percent', 'settling_time_2_s', 'bandwidth_hz'):
        assert document[figure] is None
        assert not document['reliable'].get(figure, False)
    assert any('withheld, because' in note or 'step:' in note for note in document['notes'])
    assert 'data: ' in str(document)


def test_many_spikes_are_found_as_few_are() -> None:
    """More than a hundredth of the samples, in signal or reference."""
    places = np.random.default_rng(5).choice(np.arange(50, 1950, 5), 60, replace=False)
    high = 300.0 * np.random.default_rng(6).choice((-1.0, 20.0), 60)
    run = a_run()
    for worse in (with_force(run, lambda f: put(f, places, high)),
                  replace(run, reference_n=put(run.signal('reference').copy(), places, high))):
        spike, = (each for each in findings(worse) if each.kind == 'spike')
        assert len(spike.intervals_s) == 60 and spike.severity == 'doubtful'


def test_a_signal_with_noise_that_is_constant_at_first_is_frozen() -> None:
    found = findings(with_force(a_run(), lambda f: put(f, slice(0, 53), 0.0)))
    assert [(each.kind, each.intervals_s) for each in found] == [('frozen', ((0.0, 0.052),))]
    time_s = np.arange(2000) / 1000.0
    rests = Run(time_s, *simulate_loop({'load.type': 'spring'}, {
        'reference.start': 0.1, 'reference.amplitude': 100.0}, 2.0, 1000.0)[1:])
    assert findings(rests) == []    # without noise it may rest


def test_a_run_of_this_package_without_its_reference_is_told() -> None:
    run = with_command()
    assert findings(run) == []
    note, = findings(replace(run, reference_n=None))
    assert (note.kind, note.signal) == ('absent', 'reference')
    assert 'lacks the reference' in note.text


def test_every_second_cell_empty() -> None:
    run = with_force(a_run(), lambda f: put(f, slice(None, None, 2), np.nan))
    document = analyze(run)
    assert document['rise_time_s'] is None
    assert document['bandwidth_hz'] is None
    assert document['oscillation']['frequency_hz'] is None


def test_many_gaps_are_counted() -> None:
    lost = np.random.default_rng(2).choice(2000, 300, replace=False)
    found = next(each for each in findings(without(a_run(), lost)) if each.kind == 'gap')
    assert len(found.intervals_s) > 200
    assert 'samples are missing in' in found.text


def test_a_gap_far_from_the_step_leaves_its_figures() -> None:
    clean, document = analyze(a_run()), analyze(without(a_run(), slice(1200, 1203)))
    assert [each['kind'] for each in document['quality']] == ['gap']
    for figure in ('rise_time_s', 'overshoot_percent', 'settling_time_2_s'):
        assert document[figure] == pytest.approx(clean[figure], rel=1e-3)
        assert document['reliable'][figure]


@pytest.mark.parametrize('change', [
    lambda f: f + 0.5 * np.random.default_rng(3).normal(size=f.size),       # noisy
    lambda f: 100.0 * np.sin(0.4 * np.arange(f.size)),                      # a limit cycle
    lambda f: np.round(f, 1),                                               # 1000 levels
    lambda f: np.repeat(f[::4], 4)])                                        # held
def test_what_is_only_unusual_is_not_accused(change: Callable[[np.ndarray], np.ndarray]) -> None:
    assert [each for each in findings(with_force(a_run(), change))
            if each.severity == 'doubtful'] == []


@pytest.mark.parametrize('kind, change', [
    ('clipping', lambda f: np.minimum(f, 130.0)),      # three samples of each cycle
    ('missing', lambda f: put(f, slice(900, 980), np.nan)), *(
        pytest.param(*each, marks=pytest.mark.slow) for each in (
            ('spike', lambda f: put(f, 900, 6.6e5)),
            ('unit', lambda f: 1e-3 * f),
            ('jump', lambda f: put(f, slice(900, None), 1e3 * f[900:])),
            ('jump', lambda f: put(f, slice(900, 960), -f[900:960])),
            ('frozen', lambda f: put(f, slice(900, 906), f[900]))))])
def test_a_limit_cycle_of_doubtful_samples_is_marked(
        kind: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    answer = detect_limit_cycles(with_force(cycle(), change))
    last = answer.segments[-1]
    assert kind in {each['kind'] for each in answer.quality}
    assert not last['reliable'] and last['confidence'] <= 0.5 and not last['isolated']
    assert 'doubtful, because' in last['why'] and 'doubtful, because' in str(answer)


def test_a_limit_cycle_before_the_damage_is_reliable() -> None:
    run = cycle()
    run = replace(run, reference_n=np.where(run.time_s > 1.0, 50.0, run.signal('reference')))
    answer = detect_limit_cycles(with_force(run, lambda f: put(f, slice(1300, 1310), np.nan)))
    assert [each['reliable'] for each in answer.segments][-2:] == [True, False]


@pytest.mark.parametrize('analysis', [judge_once, lambda run: prepare([run])])
def test_a_step_of_the_clock_is_refused_where_an_even_grid_is_needed(
        analysis: Callable[[Run], object]) -> None:
    run = cycle()
    later = replace(run, time_s=run.time_s + 1.7e9 * (run.time_s > 1.0), command_n=run.force_n)
    with pytest.raises(InputError, match='the time jumps ahead .* the parts on their own'):
        analysis(later)


@pytest.mark.parametrize('analysis, apart_s', [
    (analyze, 0.0), (analyze, 1e-9), (judge_once, 1e-9)])
def test_samples_in_bursts_are_refused(analysis: Callable[[Run], object], apart_s: float) -> None:
    """They had no rate, or one whose grid took 9 GB."""
    time_s = np.repeat(np.arange(750) / 500.0, 2) + np.tile([0.0, apart_s], 750)
    with pytest.raises(InputError, match='come in bursts'):
        analysis(replace(cycle(), time_s=time_s))


def test_a_gap_of_recordings_of_which_nothing_is_left_is_refused() -> None:
    force = np.random.default_rng(1).normal(size=200)
    time_s = np.arange(200) / 1000.0 + 1.2 * (np.arange(200) > 100)
    with pytest.raises(InputError, match='too few samples are left'):
        prepare([Run(time_s, None, force, force ** 3)])


def test_an_output_that_is_long_there_before_its_reference_is_found() -> None:
    run = a_run()
    late = replace(run, reference_n=np.where(run.time_s < 1.5, 0.0, run.signal('reference')))
    assert [each.kind for each in findings(late)] == ['order']


def test_an_output_that_only_jumps_is_cut_off() -> None:
    run = with_force(a_run(), lambda f: np.clip(f, 7.3, 8.5))
    assert [each.kind for each in findings(run)] == ['clipping']
    assert analyze(run).steady_state_error_n is None


@pytest.mark.parametrize('filler', [0.0, -1.0, 9999.0])
def test_many_dropouts_to_one_value_are_spikes(filler: float) -> None:
    places = np.random.default_rng(2).integers(0, 2000, 60)
    run = with_force(a_run(), lambda f: put(f, places, filler))
    assert 'spike' in [each.kind for each in findings(run)]
    assert analyze(run).overshoot_percent is None


@pytest.mark.parametrize(('kind', 'change'), [
    ('still', lambda f: np.full(len(f), 3.0)), ('still', lambda f: 0.0 * f),
    ('unit', lambda f: f - 3.0e4),
    ('frozen', lambda f: put(f, slice(STEP + 20, None), 0.0))])
def test_an_output_that_was_not_measured_is_found(
        kind: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    run = with_force(a_run(), change)
    finding, = findings(run)
    assert finding.kind == kind
    assert not analyze(run).reliable['steady_state_error_n']
    assert not analyze(run).reliable['tracking_error_rms_n']
    # Where nothing is commanded, nothing moves.
    assert findings(replace(with_force(run, lambda f: 0.0 * f), command_n=0.0 * run.time_s)) == []


def test_an_output_that_comes_before_any_reference_is_found() -> None:
    reference = np.convolve(np.random.default_rng(1).normal(size=2000), np.ones(20), 'same')
    late, early = (Run(np.arange(2000) / 1000.0, reference, None, np.roll(reference, shift))
                   for shift in (30, -30))
    assert findings(late) == []
    assert [each.kind for each in findings(early)] == ['order']


def test_a_spike_of_the_reference_is_found_and_a_jump_at_its_end_is_none() -> None:
    run = a_run()
    for place, value, found in ((1500, 1e4, ['spike']), (1999, 0.0, [])):
        reference = put(run.signal('reference').copy(), place, value)
        assert [each.kind for each in findings(replace(run, reference_n=reference))] == found


def test_a_spike_of_the_reference_does_not_part_a_limit_cycle() -> None:
    run = cycle()
    answer = detect_limit_cycles(replace(run, reference_n=put(
        run.signal('reference').copy(), 410, -1e4)))
    last = answer.segments[-1]
    assert (last['verdict'], last['reliable']) == ('limit_cycle', True)
    assert [each.kind for each in findings(run)] == []
    assert [each['kind'] for each in answer.quality] == ['spike']


def test_a_cell_that_is_cut_off_at_the_end_is_a_spike() -> None:
    found, = findings(with_force(a_run(), lambda f: put(f, 1999, 9.0)))
    assert found.kind == 'spike'


def test_samples_lost_soon_after_the_settling_time_make_it_doubtful() -> None:
    lost = analyze(with_force(a_run(), lambda f: put(f, slice(STEP + 44, STEP + 90), np.nan)))
    assert lost.settling_time_2_s is None or not lost['reliable']['settling_time_2_s']


def test_a_slow_sensor_that_answers_in_one_sample_does_not_jump() -> None:
    run = a_run()
    force = np.where(run.time_s < run.time_s[STEP + 12], 0.0, 100.0)
    quiet = 0.01 * np.random.default_rng(4).normal(size=force.size)
    assert findings(replace(run, force_n=force + quiet)) == []


def test_digits_lost_soon_after_a_step_are_spikes() -> None:
    found, = findings(with_force(a_run(), lambda f: put(f, slice(STEP + 12, STEP + 14), 10.0)))
    assert found.kind == 'spike'


def test_a_filler_soon_after_a_step_is_found() -> None:
    found = findings(with_force(a_run(), lambda f: put(f, slice(STEP + 4, STEP + 11), 65535.0)))
    assert 'jump' in {each.kind for each in found}


@pytest.mark.parametrize('digits', [np.trunc, np.round])
def test_a_steady_state_error_below_the_resolution_is_marked(digits: np.ufunc) -> None:
    """Also one of exactly 0 N."""
    document = analyze(with_force(a_run(), digits))
    assert digits is np.trunc or document['steady_state_error_n'] == 0.0
    assert not document['reliable']['steady_state_error_n']
    assert 'steady-state error: doubtful, because the force has a resolution of 1 N' in document[
        'notes']


def test_a_steady_state_error_of_nothing_is_told_by_numbers_of_many_digits() -> None:
    document = analyze(with_force(a_run(), lambda f: np.where(f > 90.0, 100.0 + 1e-13 * f, f)))
    assert document['reliable']['steady_state_error_n']


def test_frozen_samples_are_found_beside_two_that_are_nearly_equal() -> None:
    run = with_force(a_run(), lambda f: put(f, slice(STEP + 8, STEP + 14), f[STEP + 8]))
    run = with_force(run, lambda f: put(f, STEP + 14, f[STEP + 13] + 1e-9))
    assert [each.kind for each in findings(run)] == ['frozen']


@pytest.mark.parametrize('load', ['locked', 'free'])
def test_an_answer_within_a_sample_is_no_spike(load: str) -> None:
    """Velocity and force of a fast loop, of which every fifth sample is kept."""
    run = Run(*simulate_loop({'load.type': load}, {'reference.shape': 'step'}, 1.0, 1000.0))
    assert findings(run[::5]) == []


def test_a_signal_that_no_longer_answers_does_not_jump() -> None:
    force = with_force(a_run(), lambda f: np.where(f > 50.0, 100.0, 0.0) + 0.01 * f)
    reference = np.where(force.time_s > 1.2, 0.0, force.signal('reference'))
    assert findings(replace(force, reference_n=reference)) == []


def test_doubts_about_whole_runs_leave_out_samples_lost_singly() -> None:
    run, few = a_run(), [100, 200, *range(300, 305)]
    assert doubts([run, without(run, few)]) == []
    many = without(run, [*few, *range(400, 450)])
    doubt, = doubts([many])
    assert '57 samples are missing in 4 gaps' in doubt
    assert doubts([many], in_time=False) == []
    singly, = doubts([without(run, np.arange(100, 1900, 50))])
    assert '36 samples are missing in 36 gaps' in singly
    empty, = doubts([with_force(run, lambda f: put(f, slice(100, 1900, 50), np.nan))])
    assert '36 of 2000 samples of the force are missing' in empty
    assert len(doubts([DAMAGED['missing'](run)])) == 1
    assert doubts([with_force(run, lambda f: put(f, slice(0, 100), np.nan))]) == []
    doubt, = doubts([a_run(), replace(DAMAGED['unit'](a_run()), source='mine')])
    assert doubt.startswith('mine: the force moves 1.01e+03 times')


@pytest.mark.parametrize('analysis', [analyze, judge_once, lambda run: prepare([run])])
def test_numbers_that_overflow_are_refused(analysis: Callable[[Run], object]) -> None:
    with pytest.raises(InputError, match='the force reaches 1e.300 N, above'):
        analysis(with_force(a_run(), lambda f: put(f, 900, 1e300)))


@pytest.mark.parametrize('count', range(2, 12))
def test_a_recording_of_few_samples_is_answered(count: int) -> None:
    values = np.random.default_rng(count).normal(size=(6, count))
    answer = analyze(Run(np.arange(count) / 100.0, *values))
    assert answer.samples == count


def test_signals_that_were_never_there_together_have_no_bandwidth() -> None:
    run = a_run()
    late = replace(run, reference_n=np.where(run.time_s > 1.0, np.sin(300.0 * run.time_s), np.nan))
    assert analyze(with_force(late, lambda f: put(f, slice(1001, None), np.nan))
                   ).bandwidth_hz is None


def test_a_single_sample_with_a_reference_tells_no_delay() -> None:
    run = a_run()
    reference = np.where(np.arange(len(run)) == 700, 100.0, np.nan)
    assert analyze(replace(run, reference_n=reference)).correlation_delay_s is None


def test_a_clock_that_is_set_by_decades_takes_no_memory() -> None:
    run = a_run()
    late = replace(run, reference_n=None, time_s=run.time_s + 1.7e9 * (run.time_s > 0.5))
    assert analyze(late).oscillation['sustained'] is None


def test_a_signal_that_is_held_for_some_samples_is_marked() -> None:
    found, = findings(with_force(a_run(), lambda f: np.repeat(f[::2], 2)))
    assert (found.kind, found.severity) == ('held', 'note')
    assert 'measured at 500 Hz' in found.text


def test_numbers_of_two_digits_are_coarse_though_fine_near_zero() -> None:
    found = findings(with_force(a_run(), lambda f: np.array([float(f'{x:.2g}') for x in f])))
    assert any('has only 20 different values beyond 17 N, at least 1 N apart' in each.text
               for each in found)


@pytest.mark.parametrize(('actuator', 'controller'), [
    ({'load.type': 'prescribed'}, {'compensator': 'lead2', 'reference.shape': 'step',
                                   'reference.amplitude': 100.0}),
    ({'load.type': 'locked'}, {'compensator': 'lead4', 'reference.shape': 'chirp',
                               'reference.amplitude': 30.0})])
def test_a_ring_or_a_chirp_of_few_samples_a_period_neither_jumps_nor_has_spikes(
        actuator: dict, controller: dict) -> None:
    run = Run(*simulate_loop(actuator, controller | {'feedforward': 1.0}, 2.0, 500.0))
    assert findings(run) == []
