"""What reference, command, controlled signal, position and velocity tell of each other."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import signal
from test_quality import a_run, put, with_force

import asi_analysis as asi
from asi_actuator.model.actuator import STATE_DTYPE, advance, measure, prepare
from asi_analysis.bags.run import SIGNALS, Run
from asi_analysis.loop.closed_loop import records, simulate_loop
from asi_analysis.loop.in_process import simulate
from asi_analysis.measures.analysis import analyze
from asi_analysis.measures.checks.control_law import ControlLaw, control_law
from asi_analysis.measures.checks.recomputed import recomputed
from asi_analysis.measures.quality import findings
from asi_controller.compensator import commands, compensate, compensator
from asi_controller.reference import reference_force

RATE_HZ = 1000.0
JUMP = 50       # sample of the step
NOISY = {'force_sensor.noise': 0.5}


def a_loop(shape: str = 'step', load: str = 'spring', rate_hz: float = RATE_HZ,
           compensator: str = 'lead4', **controller: float) -> Run:
    """Return a run of one second with noise."""
    return Run(*simulate_loop(
        {'load.type': load, **NOISY}, {'compensator': compensator, 'reference.shape': shape,
                                       'reference.amplitude': 100.0, **controller}, 1.0, rate_hz))


def law_of(run: Run) -> ControlLaw | None:
    return control_law(run.time_s, run.signal('command'), run.signal('reference'),
                       run.signal('force'))


def of_rows(run: Run, rows: np.ndarray, time_s: np.ndarray | None = None) -> Run:
    """Return these samples of a run, at even times unless others are given."""
    return replace(run, time_s=np.arange(len(rows)) / RATE_HZ if time_s is None else time_s, **{
        signal.field: run.signal(signal.name)[rows] for signal in SIGNALS
        if signal.name in run.signals()})


def with_digits(run: Run, digits: int) -> Run:
    """Return a run as of a text file with numbers of so many digits."""
    def rounded(values: np.ndarray) -> np.ndarray:
        return np.array([float(f'{value:.{digits}g}') for value in values])
    return replace(run, **{signal.field: rounded(run.signal(signal.name)) for signal in SIGNALS
                           if signal.name in run.signals()})


def late(values: np.ndarray, samples: int) -> np.ndarray:
    return np.concatenate([np.full(samples, values[0]), values[:-samples]])


ALTERED: dict[str, tuple[str, Callable[[Run], Run]]] = {
    'in mN': ('unit', lambda run: with_force(run, lambda f: 1e3 * f)),
    'in kN': ('unit', lambda run: with_force(run, lambda f: 1e-3 * f)),
    'in lbf': ('unit', lambda run: with_force(run, lambda f: f / 4.4482216)),
    'other sign': ('sign', lambda run: with_force(run, lambda f: -f)),
    'late': ('order', lambda run: with_force(run, lambda f: late(f, 5))),
    'late by more than its reaction': ('order', lambda run: with_force(
        run, lambda f: late(f, 20))),
    'a little late': ('order', lambda run: with_force(run, lambda f: np.roll(f, 1))),
    'copied': ('copy', lambda run: replace(run, force_n=run.signal('reference').copy())),
    'equal to the command': ('copy', lambda run: with_force(
        run, lambda f: run.signal('command').copy())),
    'late reference': ('order', lambda run: replace(
        run, reference_n=late(run.signal('reference'), 30))),
    'reference a little late': ('order', lambda run: replace(
        run, reference_n=np.roll(run.signal('reference'), 5))),
    'sign of a beginning': ('answer', lambda run: with_force(
        run, lambda f: put(f, slice(0, JUMP + 15), -f[:JUMP + 15]))),
    'bridged': ('answer', lambda run: with_force(
        run, lambda f: put(f, slice(60, 90), np.linspace(f[60], f[90], 30)))),
    'held': ('answer', lambda run: with_force(run, lambda f: put(f, slice(60, 63), f[60]))),
    'rows lost': ('answer', lambda run: of_rows(run, np.delete(np.arange(1000), slice(62, 67)))),
    'rows repeated': ('answer', lambda run: of_rows(
        run, np.concatenate([np.arange(100), np.arange(70, 1000)]))),
    'ms as s': ('motion', lambda run: replace(run, time_s=1e3 * run.time_s)),
    'backwards': ('motion', lambda run: of_rows(run, np.arange(1000)[::-1])),
    'position in mm': ('motion', lambda run: replace(
        run, position_m=1e3 * run.signal('position'))),
}


@pytest.mark.parametrize(('compensator', 'digits'), [
    ('lead_lag', 6), pytest.param('lead4', 17, marks=pytest.mark.slow)])
@pytest.mark.parametrize('how', ALTERED)
def test_samples_that_do_not_belong_together_are_found(
        how: str, compensator: str, digits: int) -> None:
    kind, alter = ALTERED[how]
    run = a_loop(compensator=compensator)
    assert findings(with_digits(run, digits)) == []
    altered = analyze(with_digits(alter(run), digits))
    # Of few digits a sign that is lost before the only step is told by the jump of the force.
    assert {kind, *(['jump'] if digits < 17 else [])} & {
        each['kind'] for each in altered['quality']}
    assert altered.rise_time_s is None or kind == 'answer' and altered['reliable']['rise_time_s']


# What a recording shows without position and velocity.
BY_CAUSE: dict[str, tuple[str, Callable[[Run], Run]]] = {
    'backwards': ('time_order', lambda run: of_rows(run, np.arange(1000)[::-1])),
    'force and command exchanged': ('order', lambda run: replace(
        run, force_n=run.signal('command'), command_n=run.signal('force'))),
    'reference and command exchanged': ('order', lambda run: replace(
        run, reference_n=run.signal('command'), command_n=run.signal('reference'))),
    'force and valve position exchanged': ('unit', lambda run: replace(
        run, force_n=run.signal('valve_position'), valve_position_m=run.signal('force'))),
    'late command': ('order', lambda run: replace(
        run, command_n=late(run.signal('command'), 20))),
    'other sign, without a command': ('sign', lambda run: replace(
        run, force_n=-run.signal('force'), command_n=None)),
    'command in kN': ('unit', lambda run: replace(run, command_n=1e-3 * run.signal('command'))),
    'interpolated': ('interpolated', lambda run: replace(run, command_n=None, force_n=put(
        run.signal('force'), slice(60, 90), np.linspace(*run.signal('force')[[60, 89]], 30)))),
}


@pytest.mark.parametrize('digits', [17, 6])
@pytest.mark.parametrize('how', BY_CAUSE)
def test_cause_and_effect_and_noise_tell_what_was_altered(how: str, digits: int) -> None:
    kind, alter = BY_CAUSE[how]
    run = replace(a_loop(compensator='lead_lag'), position_m=None, velocity_m_s=None)
    found = findings(with_digits(alter(run), digits))
    assert {kind, *(['order'] if digits < 17 else [])} & {each.kind for each in found}


@pytest.mark.parametrize('digits', [17, 6])
@pytest.mark.parametrize('compensator', ['lead_lag', 'proportional'])
def test_a_force_that_is_late_in_a_multisine(compensator: str, digits: int) -> None:
    run = replace(a_loop('multisine', compensator=compensator), position_m=None, velocity_m_s=None)
    found = findings(with_digits(with_force(run, lambda f: late(f, 20)), digits))
    assert [each.kind for each in found] == ['order']


def test_a_proportional_loop_that_runs_backwards_responds_before_its_step() -> None:
    run = replace(a_loop(compensator='proportional'), position_m=None, velocity_m_s=None)
    assert findings(run) == []
    assert 'order' in [each.kind for each in findings(of_rows(run, np.arange(1000)[::-1]))]


def test_every_second_row_is_lost_from_there() -> None:
    """The time of those rows is made up: half of that which they took."""
    run = a_loop('multisine', 'free')
    rows = np.concatenate([np.arange(500), np.arange(500, 1000, 2)])
    found = {each.kind: each for each in findings(of_rows(run, rows))}
    assert found['motion'].intervals_s[0][0] > 0.4


def test_rows_that_are_left_out_are_a_jump_of_the_position() -> None:
    """Also where the command tells nothing: the rise is among them."""
    for run in (a_loop(), a_loop(**{'gain_schedule.velocity': 0.1})):
        short = of_rows(run, np.delete(np.arange(len(run)), slice(JUMP - 5, JUMP + 60)))
        assert 'motion' in {each.kind for each in findings(short)}
        assert analyze(short).rise_time_s is None


def test_a_position_of_few_digits_or_late_stamps_does_not_jump() -> None:
    run = a_loop('multisine', 'free')
    position = run.signal('position')
    counts = np.ptp(position) / 500.0
    assert findings(replace(run, position_m=counts * np.round(position / counts))) == []
    late_by = np.where(np.arange(len(run)) == 400, 9e-4, 0.0)
    assert 'motion' not in {each.kind for each in findings(
        replace(run, time_s=run.time_s + late_by))}


@pytest.mark.parametrize('other', ['force', 'valve_position'])
def test_a_velocity_in_the_place_of_another_signal_is_found(other: str) -> None:
    run = a_loop('multisine')
    field = next(each.field for each in SIGNALS if each.name == other)
    exchanged = replace(run, velocity_m_s=run.signal(other), **{field: run.signal('velocity')})
    assert 'motion' in {each.kind for each in findings(exchanged)}


def test_a_force_that_rests_while_the_piston_moves_is_marked() -> None:
    """Also if the command is lost, too; all of a loop that is switched off may rest."""
    rests = replace(a_loop(), force_n=np.ones(1000), command_n=np.ones(1000))
    finding, = findings(rests)
    assert (finding.kind, finding.signal) == ('still', 'force')
    assert findings(replace(rests, position_m=None, velocity_m_s=None,
                            valve_position_m=None)) == []


@pytest.mark.parametrize('compensator', ['lead4', 'proportional'])
def test_a_reference_of_the_wrong_sign(compensator: str) -> None:
    run = a_loop(compensator=compensator)
    found = findings(replace(run, reference_n=-run.signal('reference')))
    assert [each.kind for each in found] == ['sign']


def test_a_reference_of_the_wrong_sign_that_a_free_piston_hardly_follows() -> None:
    run = a_loop('multisine', 'free', compensator='proportional')
    assert findings(run) == []
    assert [each.kind for each in findings(replace(
        run, reference_n=-run.signal('reference')))] == ['sign']


@pytest.mark.parametrize(('scale', 'kinds'), [(1.0, []), (4.4482216, ['unit']), (1e-3, ['unit'])])
def test_a_loop_that_rests_without_noise_tells_its_unit(scale: float, kinds: list[str]) -> None:
    """The only step is the first command after many that are 0."""
    run = Run(*simulate_loop({}, {'compensator': 'lead_lag', 'reference.shape': 'step',
                                  'reference.amplitude': 300.0}, 0.5, 5000.0))
    assert [each.kind for each in findings(with_force(run, lambda f: scale * f))] == kinds


def test_pieces_that_are_exchanged_with_a_controller_without_a_memory() -> None:
    """Each row satisfies its control law, in any order."""
    run = Run(*simulate_loop({}, {'compensator': 'proportional', 'gain': 12.0,
                                  'reference.shape': 'step', 'reference.amplitude': 100.0},
                             0.6, 5000.0))
    run = replace(run, position_m=None, velocity_m_s=None, valve_position_m=None)
    rows = np.concatenate([np.arange(553), np.arange(2281, 2581), np.arange(853, 2281),
                           np.arange(553, 853), np.arange(2581, 3000)])
    assert findings(run) == []
    exchanged = replace(of_rows(run, rows), time_s=run.time_s)
    assert [each.kind for each in findings(exchanged)] == ['jump']


@pytest.mark.parametrize('change', [lambda f: 5.0 + f, lambda f: 0.5 * f])
def test_another_scale_from_there(change: Callable[[np.ndarray], np.ndarray]) -> None:
    found, = findings(with_force(a_loop('multisine'), lambda f: put(
        f, slice(600, None), change(f[600:]))))
    assert found.kind == 'answer'
    assert found.intervals_s[0] == pytest.approx((0.6, 0.999), abs=0.01)


@pytest.mark.parametrize('shape', ['step', 'ramp', 'sine', 'triangle', 'chirp', 'prbs'])
@pytest.mark.parametrize('load', ['locked', 'spring', 'prescribed'])
def test_clean_runs_have_no_findings(shape: str, load: str) -> None:
    assert findings(a_loop(shape, load)) == []
    assert findings(a_loop(shape, load, 5000.0, gain=1.0)[::5]) == []


@pytest.mark.parametrize('digits', [5, 6, 7])
@pytest.mark.parametrize('load', ['locked', 'spring'])
def test_clean_runs_of_few_digits_have_no_findings(load: str, digits: int) -> None:
    quiet = Run(*simulate_loop({'load.type': load}, {
        'compensator': 'lead2', 'reference.shape': 'step', 'reference.amplitude': 100.0},
        1.0, RATE_HZ))
    for run in (quiet, a_loop('multisine', load)):
        assert findings(with_digits(run, digits)) == []


def test_a_turning_point_of_few_digits_is_not_frozen() -> None:
    """Near 0 its numbers are finer; beyond, the last digit rests for some samples."""
    t = np.maximum(np.arange(1000) / RATE_HZ - 0.05, 0.0)
    force = 94.0 * (1.0 - np.exp(-10.0 * t)) + 20.0 * np.sin(2.0 * np.pi * t) ** 2
    reference = np.where(t > 0.0, 94.0, 0.0)
    assert findings(with_digits(Run(np.arange(1000) / RATE_HZ, reference, None, force), 5)) == []


@pytest.mark.parametrize('digits', [17, 7])
@pytest.mark.parametrize(('load', 'rate_hz', 'controller'), [
    ('locked', 5000.0, {'reference.shape': 'sine', 'friction_feedforward.level': 10.0}),
    ('spring', 1000.0, {'reference.shape': 'sine', 'velocity_feedforward.share': 0.5}),
    ('spring', 1000.0, {'reference.shape': 'triangle', 'velocity_feedforward.share': 0.5})])
def test_a_sine_without_noise_tells_neither_sign_nor_direction_of_time(
        load: str, rate_hz: float, controller: dict[str, float | str], digits: int) -> None:
    """Any equation holds for it nearly, also with a controller that is not linear."""
    run = Run(*simulate_loop({'load.type': load}, {
        'compensator': 'lead_lag', 'feedforward': 1.0, 'reference.amplitude': 30.0, **controller},
        0.6, rate_hz))
    assert findings(with_digits(run, digits)) == []


@pytest.mark.parametrize('decimals', [1, 2, 3])
def test_the_resolution_of_a_signal_is_not_interpolated(decimals: int) -> None:
    quiet = Run(*simulate_loop({'load.type': 'locked'}, {
        'compensator': 'lead4', 'feedforward': 1.0, 'disturbance_observer.bandwidth': 5.0,
        'reference.shape': 'ramp', 'reference.amplitude': 30.0, 'reference.duration': 0.95},
        1.0, 2000.0))
    for run in (quiet, a_loop('ramp')):
        found = findings(with_force(run, lambda f: np.round(f, decimals)))
        assert 'interpolated' not in {each.kind for each in found}


def test_the_velocity_of_a_constant_motion_is_not_quantised() -> None:
    run = Run(*simulate_loop({'load.type': 'prescribed', 'load.velocity': 0.05}, {
        'reference.shape': 'step'}, 0.5, RATE_HZ))
    assert findings(run) == []


@pytest.mark.parametrize('addition', [
    {'hysteresis_inverse.size': 20.0}, {'friction_feedforward.level': 10.0},
    {'gain_schedule.velocity': 0.1}, {'velocity_feedforward.share': 0.5},
    {'reference_model.bandwidth': 50.0}, {'integrator.rate': 5.0}, {'saturation': 110.0}])
def test_a_controller_that_is_not_linear_is_not_accused(addition: dict[str, float]) -> None:
    for shape in ('sine', 'step'):
        assert findings(a_loop(shape, **addition)) == []


@pytest.mark.parametrize('shape', ['step', 'multisine'])
@pytest.mark.parametrize('ticks', [40, 300])
def test_a_gain_that_is_changed_for_a_while_is_not_accused(shape: str, ticks: int) -> None:
    settings = {'compensator': 'lead4', 'reference.shape': shape, 'reference.amplitude': 100.0}
    plant, controller, reference = records({'load.type': 'spring', **NOISY}, settings, RATE_HZ)
    state, rows = np.zeros(1, STATE_DTYPE)[0], []
    for tick in range(1000):
        if tick in (500, 500 + ticks):
            controller = compensator({
                'compensator': 'lead4', 'gain': 1.5 if tick == 500 else 1.92}, RATE_HZ, controller)
        force, _, _, velocity = measure(state, plant)
        desired = reference_force(tick / RATE_HZ, reference)
        command = compensate(controller, desired, force, velocity)
        rows.append((desired, command, force))
        advance(state, command, plant, prepare(plant, 1.0 / RATE_HZ))
    assert findings(Run(np.arange(1000) / RATE_HZ, *np.transpose(rows))) == []


def test_the_answer_of_a_proportional_controller() -> None:
    run = a_loop('multisine', compensator='proportional', gain=4.0, feedforward=1.0)
    found = law_of(run)
    assert found is not None
    assert (found.reference, found.signal) == pytest.approx((5.0, -4.0))
    assert found.factor == 1.0 and found.breaks == ()


def test_a_command_that_answers_nothing_tells_nothing() -> None:
    run = a_loop()
    noise = np.random.default_rng(1).normal(size=len(run))
    assert law_of(replace(run, command_n=noise)) is None
    assert findings(replace(run, command_n=np.zeros(len(run)))) == []
    assert findings(replace(run, command_n=run.reference_n)) == []      # open loop


@pytest.mark.parametrize('last', range(6, 20))
def test_a_wrong_sign_that_ends_soon_after_the_step_is_a_jump(last: int) -> None:
    """Without a command, and the only step is no longer the explanation."""
    run = with_force(a_run(), lambda f: put(f, slice(470, 500 + last), -f[470:500 + last]))
    assert {each.kind for each in findings(run)} & {'jump', 'sign'}


def a_recorded_run(**controller: float | str) -> Run:
    """Return a run that holds its controller, as those of `asi run` do."""
    return asi.simulate({'load.type': 'spring', **NOISY}, {
        'compensator': 'lead4', 'reference.shape': 'step', 'reference.amplitude': 100.0,
        **controller}, 0.5, RATE_HZ)


def low_pass(values: np.ndarray) -> np.ndarray:
    return np.asarray(signal.lfilter([0.4], [1.0, -0.6], values))


def without_a_bit(values: np.ndarray) -> np.ndarray:
    span = float(np.ptp(values))
    counts = np.round(4095.0 * (values - values.min()) / span).astype(int)
    return np.asarray(values.min() + (counts & ~64) * span / 4095.0)


def converted(values: np.ndarray) -> np.ndarray:
    """Return a signal of a converter that is saturated, with noise behind it."""
    noise = np.random.default_rng(3).normal(size=len(values))
    return np.asarray(np.minimum(values, 0.8 * values.max()) + 0.2 * noise)


# What no relation of the signals alone tells, as another controller would do the same.
REPLACED: dict[str, Callable[[Run], Run]] = {
    'reference in another scale': lambda run: replace(
        run, reference_n=2.0 * run.signal('reference')),
    'low pass': lambda run: with_force(run, low_pass),
    'drifting clock': lambda run: with_force(
        run, lambda f: np.interp(run.time_s / 1.03, run.time_s, f)),
    'saturated converter': lambda run: with_force(run, converted),
    'missing bit': lambda run: with_force(run, without_a_bit),
    'held': lambda run: with_force(run, lambda f: np.repeat(f[::2], 2)),
    'of another run': lambda run: with_force(run, lambda f: f + np.random.default_rng(9).normal(
        0.0, 0.5, len(f))),
    'median filter': lambda run: with_force(run, lambda f: signal.medfilt(f, 9)),
    'sign lost': lambda run: with_force(run, np.abs),
    'exchanged': lambda run: replace(
        run, force_n=run.signal('command'), command_n=run.signal('force')),
    'offset': lambda run: with_force(run, lambda f: 20.0 + f),
}


@pytest.mark.parametrize('addition', [
    {'gain_schedule.velocity': 0.1}, *(pytest.param(each, marks=pytest.mark.slow) for each in (
        {}, {'hysteresis_inverse.size': 20.0}, {'saturation': 110.0}))])
@pytest.mark.parametrize('how', REPLACED)
def test_a_command_that_its_controller_does_not_compute_is_found(
        how: str, addition: dict[str, float]) -> None:
    run = a_recorded_run(**addition)
    assert findings(run) == []
    again = recomputed(run)
    assert again is not None and (again == run.signal('command')).all()
    document = analyze(REPLACED[how](run))
    kinds = {'order'} if how == 'exchanged' else {'answer', 'unit', 'clipping', 'sign'}
    assert kinds & {each['kind'] for each in document['quality']}
    assert document.rise_time_s is None


def test_a_run_of_which_rows_are_left_out_is_marked() -> None:
    run = a_recorded_run()
    assert [each.kind for each in findings(run[::2])] == ['rate']
    assert findings(run[:300]) == []
    for factor in (1.2, 1000.0):
        late = replace(run, time_s=factor * run.time_s)
        finding = next(each for each in findings(late) if each.kind == 'rate' or factor > 2.0)
        assert finding.severity == 'doubtful'


def test_a_run_without_its_command_is_marked() -> None:
    """If the actuator is withheld, too; with it the force is that of the only run with both."""
    run = replace(a_recorded_run(), command_n=None)
    withheld = replace(run, information={
        name: value for name, value in run.information.items() if name != 'actuator'})
    finding, = findings(withheld)
    assert (finding.kind, finding.severity) == ('reading', 'note')
    assert findings(run) == []


FEW: dict[str, tuple[str, ...]] = {
    'no command': ('command_n',), 'no velocity': ('velocity_m_s',),
    'reference and force': ('command_n', 'velocity_m_s', 'position_m', 'valve_position_m')}


@pytest.mark.parametrize('addition', [
    {}, {'gain_schedule.velocity': 0.5}, {'saturation': 40.0, 'gain': 20.0},
    {'friction_feedforward.level': 10.0, 'velocity_feedforward.share': 0.5}])
@pytest.mark.parametrize('left', FEW)
def test_the_actuator_of_a_run_tells_what_was_altered(
        left: str, addition: dict[str, float]) -> None:
    run = replace(a_recorded_run(**addition), **dict.fromkeys(FEW[left]))
    assert findings(run) == []
    force = run.signal('force')
    later = np.minimum(np.arange(len(run)), len(run) - 1)
    later[JUMP + 3:] += 2    # two rows are left out while the command is saturated
    for altered in (with_force(run, lambda f: put(f, slice(200, 210), force[200:210] + 2.0)),
                    with_force(run, lambda f: f * np.where(run.time_s > 0.2, 1.05, 1.0)),
                    of_rows(run, later[:-2])):
        assert 'answer' in {each.kind for each in findings(altered)}


@pytest.mark.parametrize('information', [
    {}, {'controller': {}}, {'versions': {'asi_actuator': '0.0.1'}},
    {'experiment': {'mode': 'realtime', 'rate_hz': RATE_HZ}}, {'experiment': {'mode': 'lockstep'}},
    {'controller': {'compensator': 'of another'}}, {'controller': {'gain': 'much'}}])
def test_without_its_controller_a_run_is_not_accused(information: dict[str, dict]) -> None:
    run = a_recorded_run()
    other = replace(run, information={**run.information, **information} if information else {})
    assert recomputed(other) is None
    assert findings(other) == []


def test_a_reference_in_another_scale_is_found_without_the_controller() -> None:
    """By a controller with a memory; the answer of a proportional one may be a feed-forward."""
    for name, found in (('lead4', ['unit']), ('proportional', [])):
        run = a_loop('step', compensator=name, feedforward=0.5)
        assert findings(run) == []
        other = replace(run, reference_n=2.0 * run.signal('reference'))
        assert [each.kind for each in findings(other)] == found


def test_a_peak_of_the_velocity_that_moves_the_position_is_no_spike() -> None:
    """As when a piston breaks loose."""
    run = asi.simulate({'load.type': 'locked', 'force_sensor.noise': 0.5}, {
        'compensator': 'lead2', 'reference.shape': 'ramp', 'reference.amplitude': 30.0}, 2.0,
        RATE_HZ)
    assert findings(run) == []
    spoilt = put(run.signal('velocity').copy(), 1000, 1.0)
    assert findings(replace(run, velocity_m_s=spoilt))[0].kind == 'spike'


@pytest.mark.parametrize('rate_hz', [float('inf'), 10 ** 400, float('nan'), 0.0])
def test_a_rate_that_is_none_tells_nothing(rate_hz: float) -> None:
    run = a_recorded_run()
    odd = run.information | {'experiment': run.information['experiment'] | {'rate_hz': rate_hz}}
    assert recomputed(replace(run, information=odd)) is None
    findings(replace(run, information=odd))


def in_real_time(skipped: tuple[int, ...], **controller: float | str) -> Run:
    """Return a run as in real time: jitter, states without an answer, one from the middle."""
    run = a_recorded_run(**controller)
    answered = np.delete(np.arange(len(run)), skipped)
    record = compensator({name: value for name, value in run.information['controller'].items()
                          if not name.startswith('reference.')}, RATE_HZ)
    computed = commands(record, *(run.signal(name)[answered]
                                  for name in ('reference', 'force', 'velocity')))
    held = np.searchsorted(answered, np.arange(len(run)), side='right') - 1
    jitter = 2e-5 * np.random.default_rng(2).normal(size=len(run))
    return replace(run, command_n=computed[held], time_s=run.time_s + jitter, information={
        **run.information, 'experiment': {'mode': 'realtime', 'rate_hz': RATE_HZ}})[30:]


@pytest.mark.parametrize('addition', [
    {}, {'gain_schedule.velocity': 0.1}, {'reference_model.bandwidth': 50.0},
    {'integrator.rate': 5.0}, {'hysteresis_inverse.size': 20.0}])
def test_a_run_in_real_time_is_computed_again(addition: dict[str, float]) -> None:
    run = in_real_time((130, 131, 300), **addition)
    assert findings(run) == []
    altered = with_force(run, lambda f: put(f, slice(200, 210), f[200:210] + 5.0))
    assert 'doubtful' in {each.severity for each in findings(altered) if each.kind == 'answer'}
    noise = np.random.default_rng(9).normal(0.0, 0.5, len(run))
    changed, = findings(with_force(run, lambda f: f + noise))
    assert (changed.kind, changed.severity) == ('answer', 'note')
    rate = findings(replace(run, time_s=10.0 * run.time_s, position_m=None))[0]
    assert (rate.kind, rate.severity) == ('rate', 'doubtful')


def test_a_bag_that_was_cut_at_its_beginning_is_not_called_altered(tmp_path: Path) -> None:
    run = simulate({'load.type': 'spring', **NOISY}, {
        'compensator': 'lead4', 'reference.shape': 'step', 'reference.amplitude': 100.0,
        'gain_schedule.velocity': 0.5}, 0.6, RATE_HZ)
    asi.write_bag(run[20:], tmp_path / 'cut')
    with pytest.warns(UserWarning, match='20 of the 600 samples of this run are not in the reco'):
        cut = asi.read_bag(tmp_path / 'cut')
    found = findings(cut)
    assert [each.kind for each in found] == ['cut'], found
    altered = with_force(run, lambda f: put(f, slice(300, 302), 0.0))
    assert 'answer' in {each.kind for each in findings(altered)}


@pytest.mark.parametrize(('reference', 'force', 'other'), [
    (2.0, 1.0, {'gain': 4.0, 'feedforward': 1.0}),
    (1.0, 1.2, {'gain': 4.0 / 1.2, 'feedforward': 5.0 - 4.0 / 1.2})])
def test_another_scale_is_the_run_of_another_proportional_controller(
        reference: float, force: float, other: dict[str, float]) -> None:
    """So no note can be right in one of the two and wrong in the other."""
    run = a_loop('multisine', compensator='proportional', gain=4.0,
                 feedforward=5.0 * reference - 4.0)
    altered = replace(run, reference_n=reference * run.signal('reference'),
                      force_n=force * run.signal('force'))
    of_other = commands(compensator({'compensator': 'proportional', **other}, RATE_HZ),
                        altered.reference_n, altered.force_n, run.signal('velocity'))
    np.testing.assert_allclose(of_other, run.signal('command'), rtol=0.0, atol=1e-9)
    assert findings(altered) == []


def test_a_reference_that_is_altered_for_a_while_does_not_end_the_step() -> None:
    run = a_recorded_run()
    later = replace(run, reference_n=put(run.signal('reference').copy(), slice(400, 403), 105.0))
    document = analyze(later)
    assert document.steady_state_error_n is None


def test_a_saturated_command_is_the_same_for_another_force() -> None:
    run = a_recorded_run(saturation=40.0, compensator='proportional', gain=20.0)
    there = np.flatnonzero(np.abs(run.signal('command')) >= 40.0)
    assert len(there) > 20
    # Farther from the reference, so that the error, and the command, only become larger.
    altered = with_force(run, lambda f: put(f, there, f[there] - 5.0 * np.sign(
        run.signal('command')[there])))
    again = recomputed(altered)
    assert again is not None and (again == run.signal('command')).all()
    # The recorded actuator tells it; without it nothing does.
    finding, = findings(altered)
    assert (finding.kind, finding.signal) == ('answer', 'force')
    assert analyze(altered).rise_time_s is None
    assert findings(replace(altered, information={
        name: value for name, value in run.information.items() if name != 'actuator'})) == []


@pytest.mark.parametrize('name', ['valve_position', 'position', 'reference'])
def test_a_signal_that_the_command_does_not_depend_on_is_compared(name: str) -> None:
    """The reference is while the command is saturated."""
    run = a_recorded_run(saturation=40.0, compensator='proportional', gain=20.0)
    field = next(each.field for each in SIGNALS if each.name == name)
    values = run.signal(name).copy()
    values[JUMP + 2] += 0.01 * np.ptp(values)
    finding, = findings(replace(run, **{field: values}))
    assert (finding.kind, finding.signal) == ('answer', name)


@pytest.mark.parametrize('actuator', [
    {'load.type': 'no load'}, {'maximum_substep': 0.0}, {'of another': 1.0}, {'load.mass': 'x'}])
def test_an_actuator_that_is_none_tells_nothing(actuator: dict[str, float | str]) -> None:
    run = a_recorded_run()
    assert findings(replace(run, information=run.information | {'actuator': actuator})) == []


@pytest.mark.parametrize('how', ['drifting clock', 'of another run', 'median filter', 'sign lost'])
def test_what_is_altered_all_the_time_looks_as_a_controller_that_is_not_linear(how: str) -> None:
    scheduled = a_loop('multisine', **{'gain_schedule.velocity': 0.1})
    assert law_of(scheduled) is None and findings(scheduled) == []
    run = a_loop('multisine')
    assert law_of(run) is not None and law_of(REPLACED[how](run)) is None


def test_a_filtered_force_is_that_of_a_controller_with_the_inverse_filter() -> None:
    run = with_force(a_loop('multisine'), low_pass)
    found = law_of(run)
    assert found is not None and found.everywhere and found.breaks == ()


def test_a_settled_loop_is_not_far_from_its_reference() -> None:
    time = np.arange(2000) / 1000.0
    creep = 100.4 + 1e-4 * np.exp(-time)
    settled = Run(time, np.full(2000, 100.0), np.full(2000, 76.0) + 1e-4 * time, creep)
    assert not findings(settled)
    assert [each.kind for each in findings(replace(settled, force_n=creep + 50.0))] == ['unit']


ADDED: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    'offset': lambda t: np.full(len(t), 12.0),
    'drift': lambda t: 10.0 * t,
    'hum': lambda t: 2.0 * np.sin(2.0 * np.pi * 50.0 * t)}


@pytest.mark.parametrize('compensator_name', ['lead4', 'proportional'])
@pytest.mark.parametrize('what', ADDED)
def test_what_is_added_to_the_force_is_that_of_a_controller_with_a_trim(
        what: str, compensator_name: str) -> None:
    """One that adds to its command what this one answers to the addition: trim, drift, dither."""
    run = a_loop('multisine', compensator=compensator_name)
    added = ADDED[what](run.time_s)
    altered = with_force(run, lambda f: f + added)

    def answers(reference: np.ndarray, force: np.ndarray) -> np.ndarray:
        own = compensator({'compensator': compensator_name}, RATE_HZ)
        return np.asarray(commands(own, reference, force, run.signal('velocity')))

    trim = answers(np.zeros(len(run)), -added)
    np.testing.assert_allclose(answers(altered.reference_n, altered.force_n) + trim,
                               run.signal('command'), rtol=0.0, atol=1e-6)
    assert findings(altered) == []


@pytest.mark.parametrize('altered', [
    lambda f, r: (1.2 * f, r), lambda f, r: (f + 20.0, r), lambda f, r: (low_pass(f), r),
    lambda f, r: (f, r - 50.0), lambda f, r: (f, np.where(np.arange(len(r)) < 700, r, 0.0)),
    lambda f, r: (np.roll(f, 3), r), lambda f, r: (np.delete(f, slice(400, 500)),
                                                   np.delete(r, slice(400, 500)))])
def test_without_a_command_any_force_may_follow_any_reference(
        altered: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> None:
    """The loop may be slower, its sensor may have an offset or a lag, or it may be off."""
    run = a_loop()
    force, reference = altered(run.signal('force'), run.signal('reference'))
    assert findings(Run(np.arange(len(force)) / RATE_HZ, reference, force_n=force)) == []


def test_milliseconds_that_are_read_as_seconds_are_a_slower_loop() -> None:
    """The relation of the samples has no time; position and velocity have. The rate is noted."""
    run = a_loop()
    slow = replace(run, time_s=1e3 * run.time_s, position_m=None, velocity_m_s=None)
    assert [(each.kind, each.signal, each.severity) for each in findings(slow)] == [
        ('slow', 'time', 'doubtful')]
    assert analyze(slow).reliable['rise_time_s'] is False
    fast, slower = ((each.reference, each.signal) for each in map(law_of, (run, slow))
                    if each is not None)
    assert fast == pytest.approx(slower)


def test_a_recording_that_was_cut_is_that_of_a_shorter_run() -> None:
    run, shorter = a_loop(), Run(*simulate_loop(
        {'load.type': 'spring', **NOISY}, {'compensator': 'lead4', 'reference.shape': 'step',
                                           'reference.amplitude': 100.0}, 0.6, RATE_HZ))
    for name, values in run[:600].signals().items():
        assert (values == shorter.signal(name)).all()
    assert findings(run[:600]) == []


def test_the_samples_after_the_only_step_are_those_of_another_reference() -> None:
    """With fewer of them than the controller has a memory, any share of them is exact."""
    run = a_loop(compensator='proportional')
    early = put(run.signal('reference').copy(), slice(JUMP, JUMP + 3), 50.0)
    assert findings(replace(run, reference_n=early)) == []
