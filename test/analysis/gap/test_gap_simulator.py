"""The simulator as predictor: right on its own recordings, and silent about those that are not."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.signal import butter, cont2discrete, lfilter

from asi_actuator.model.actuator import (
    advance,
    advance_motion,
    advance_sensor,
    advance_valve,
    measure,
    prepare,
    rest,
)
from asi_actuator.parameters import as_record
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputWarning
from asi_analysis.gap.actuator import actuator_groups
from asi_analysis.gap.baseline import against, healthy_of
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.document import document
from asi_analysis.gap.findings.shrink import shrink_of
from asi_analysis.gap.formulation import with_formulation, with_lower_floor
from asi_analysis.gap.inference.beyond_tolerance import form_of
from asi_analysis.gap.inference.initial_guesses import initial_guesses
from asi_analysis.gap.inference.posterior import (
    PART,
    STEP,
    Best,
    Posterior,
    fitted,
    mean_squares,
    most_probable,
    of_first_part,
)
from asi_analysis.gap.inference.simulated import fits, formulation, one_more_effect, search
from asi_analysis.gap.inference.simulated.behind_valve import with_simulated_valve
from asi_analysis.gap.inference.simulated.evidence import weigh
from asi_analysis.gap.inference.simulated.explained import weighed_of
from asi_analysis.gap.inference.simulated.fits import (
    from_usual_parameters,
    null_fit,
    parameter_errors,
    with_noise_from_fit,
)
from asi_analysis.gap.inference.simulated.formulation import in_formulation, sufficient
from asi_analysis.gap.inference.simulated.found import Found, nearest_to_nominal
from asi_analysis.gap.inference.simulated.screen import screen
from asi_analysis.gap.inference.simulated.search import explained_by_simulator
from asi_analysis.gap.inference.uncertainty import interval, likelihood
from asi_analysis.gap.model import simulator
from asi_analysis.gap.model.effects import without_prior
from asi_analysis.gap.model.forms import OTHER_SHAPES
from asi_analysis.gap.model.group import (
    LEAST_ERROR,
    prepared_for,
    simulator_group,
    with_less_noisy_valve,
    with_lower_noise,
    with_valve_gain,
)
from asi_analysis.gap.model.model_file import improved_model
from asi_analysis.gap.model.predict import judged_error, measured, predict
from asi_analysis.gap.motion import mirrored, motion_of, noise_above
from asi_analysis.gap.prepare import prepare as prepared
from asi_analysis.gap.sampling import noise_of
from asi_analysis.gap.words import sentences
from asi_analysis.loop.closed_loop import simulate_loop
from asi_common.record import copy_of

NOISE = {'force_n': 1.0, 'valve_position_m': 1e-7, 'position_m': 2e-6, 'velocity_m_s': 5e-4}
LOOP = {'compensator': 'proportional', 'gain': 3.0, 'reference.shape': 'multisine',
        'reference.frequency': 0.5, 'reference.end_frequency': 60.0,
        'reference.amplitude': 200.0, 'reference.start': 0.05}
CHANNELS = ('force', 'velocity')


def recorded(machine, rate_hz=1000.0, noise=1.0, duration_s=2.5):
    """Return a recording of the simulator with these parameters."""
    signals = simulate_loop(machine, LOOP, duration_s, rate_hz)._asdict()
    rng = np.random.default_rng(4)
    for name, level in NOISE.items():
        signals[name] = signals[name] + noise * level * rng.standard_normal(signals[name].size)
    del signals['reference_n']
    return Run(**signals)


@pytest.mark.parametrize('load', ['locked', 'spring', 'free', 'prescribed'])
def test_valve_and_what_follows_it_move_alone_as_in_the_whole_actuator(load):
    p = as_record({'command_path.delay': 0.0013, 'valve_flexure.lag_time': 0.002,
                   'load.type': load, 'load.velocity': 0.1, 'force_sensor.delay': 0.0007,
                   'valve_characteristic.supply_sag': 0.2, 'force_sensor.mass_share': 0.3})
    whole, valve, motion, sensor = rest(), rest(), rest(), rest()
    steady = prepare(p, 1e-3)
    positions, felt = np.empty((2, steady.substeps + 1))
    for k in range(200):
        command = 300.0 * np.sin(0.2 * k)
        advance(whole, command, p, steady)
        advance_valve(valve, command, p, steady, positions)
        advance_motion(motion, positions, felt, p, steady)
        advance_sensor(sensor, felt, p, steady)
        assert valve['valve_position'] == whole['valve_position']
        assert (measure(sensor, p)[0], *measure(motion, p)[1:]) == measure(whole, p)


def test_parameters_of_the_force_sensor_do_not_move_the_piston_again(monkeypatch):
    nominal = {'load.type': 'spring'}
    recording, = prepared([recorded(nominal, duration_s=1.5)])
    p, motions, follow = simulator.simulator_record(nominal), [], simulator._follow
    monkeypatch.setattr(simulator, '_follow', lambda *args: motions.append(follow(*args)))
    predict(recording, 'velocity', p)
    slower = copy_of(p)
    slower['force_sensor_natural_frequency'] *= 0.5
    before, after = (predict(recording, 'force', each) for each in (p, slower))
    assert len(motions) == 1 and not np.allclose(before, after)
    slower['force_sensor_mass_share'] *= 2.0   # of the mass before the sensor
    predict(recording, 'force', slower)
    assert len(motions) == 2


def test_errors_of_the_valves_fit_are_parameters_of_what_follows_it():
    nominal = {'load.type': 'spring'}
    recordings = prepared([recorded(nominal, duration_s=1.5)])
    p = simulator.simulator_record(nominal)
    behind = simulator_group(p, recordings, CHANNELS)
    slower = p.copy()
    slower['valve_flexure_coil_frequency'] *= 0.97
    group = with_simulated_valve(behind, p, [p, slower])
    moved = with_simulated_valve(behind, slower)
    assert {'valve_error_0', 'valve_error_1'} <= {free.field for free in group.nuisance}
    q = group.nominal.copy()
    q['valve_error_0'] = q['valve_error_1'] = 1.0
    q['maximum_substep'] = moved.nominal['maximum_substep'] = group.exact_substep_s
    for channel in CHANNELS:
        none, errors = group.recordings[0].valve_errors[channel].T
        assert not none.any() and errors.any()
        assert predict(group.recordings[0], channel, q) == pytest.approx(predict(
            moved.recordings[0], channel, with_valve_gain(moved, moved.nominal)))


@pytest.mark.parametrize(('load', 'rate_hz'), [('spring', 1000.0), ('locked', 2000.0),
                                               pytest.param('free', 5000.0,
                                                            marks=pytest.mark.slow)])
def test_what_the_true_parameters_leave_is_the_noise(load, rate_hz):
    nominal = {'load.type': load}
    recordings = prepared([recorded(nominal, rate_hz, duration_s=3.0)])
    p = simulator.simulator_record(nominal)
    valve = simulator_group(p, recordings, ('valve',))
    rest_ = with_simulated_valve(simulator_group(p, recordings, CHANNELS), valve.nominal)
    for group, channel, level in ((valve, 'valve', 1e-7), (rest_, 'force', 1.0),
                                  (rest_, 'velocity', 5e-4)):
        recording = group.recordings[0]
        left = measured(recording, channel) - predict(recording, channel, group.nominal)
        assert np.std(left[recording.valid]) == pytest.approx(level, rel=0.06)


@pytest.mark.parametrize('slow', [0.0, 3e-7])
def test_the_valve_is_known_better_than_it_was_measured(slow):
    """Whether its model is right, or misses a slow part that stands out of the noise."""
    run = recorded({'load.type': 'spring'}, duration_s=6.0)
    exact = recorded({'load.type': 'spring'}, noise=0.0, duration_s=6.0).valve_position_m
    run = replace(run, valve_position_m=run.valve_position_m
                  + slow * np.sin(2.0 * np.pi * 1.3 * run.time_s))
    recording = prepared([run])[0]
    truth = exact + slow * np.sin(2.0 * np.pi * 1.3 * run.time_s)
    estimate, left = simulator.less_noisy_valve(recording, exact)
    error = float(np.sqrt(np.mean((estimate - truth)[recording.valid] ** 2)))
    assert error < 0.5 * NOISE['valve_position_m'] and 0.5 * error < left < 3.0 * error + 5e-8
    groups, _ = actuator_groups([run], {'load.type': 'spring'}, 0.2, [False])
    better = with_less_noisy_valve(groups[1], groups[0].nominal)
    assert better.noise['force'] < 0.7 * groups[1].noise['force']
    assert better.noise['load'] == groups[1].noise['load']
    # So is a fresh recording read, or its residual would be the noise that is not there.
    fresh = prepared_for(better, recording)
    assert np.array_equal(fresh.valve_estimate, better.recordings[0].valve_estimate)


def test_effects_of_a_free_load_are_sought_at_the_size_of_the_valve_force():
    recordings = prepared([recorded({'load.type': 'free'})])
    group = simulator_group(simulator.simulator_record({'load.type': 'free'}), recordings,
                            CHANNELS)
    # The sensor feels what moves the mass; the valve gives far more, and the damping holds it.
    assert group.scale['force'] > 5.0 * np.abs(recordings[0].force).max()
    assert group.scale['damping'] == pytest.approx(
        group.scale['force'] / group.scale['velocity'])


def test_effects_are_sought_at_the_size_of_a_motion_that_was_not_recorded():
    nominal = {'load.type': 'spring'}
    run = recorded(nominal)
    blind = replace(run, position_m=None, velocity_m_s=None)
    seen, unseen = (simulator_group(simulator.simulator_record(nominal), prepared([each]),
                                    ('force',)).scale for each in (run, blind))
    for name in ('velocity', 'position', 'damping', 'compliance'):
        assert unseen[name] == pytest.approx(seen[name], rel=0.1), name


@pytest.mark.parametrize(('period_s', 'counts'), [
    (1e-3, [1, 2, 3, 4, 6, 8, 12, 16, 23]), (2e-4, [1, 2, 3, 4, 5])])
def test_no_two_sub_steps_that_are_tried_cut_a_period_alike(period_s, counts):
    recording = replace(prepared([recorded({}, duration_s=1.2)])[0], period_s=period_s)
    tried = simulator.different_substeps([recording])
    assert [math.ceil(period_s / each * (1.0 - 1e-12)) for each in tried] == counts


def test_a_longer_sub_step_is_corrected():
    nominal = {'load.type': 'spring'}
    recordings = prepared([recorded(nominal, duration_s=2.0)])
    group = simulator_group(simulator.simulator_record(nominal), recordings, CHANNELS)
    assert group.nominal['maximum_substep'] > 2.0 * group.exact_substep_s
    p = group.nominal.copy()
    p['load_mass'] *= 1.1   # the correction is that of the nominal mass
    exact = simulator_group(simulator.simulator_record(nominal), recordings, CHANNELS)
    q = p.copy()
    q['maximum_substep'] = group.exact_substep_s
    plain = replace(exact.recordings[0], corrections={}, cache={})
    for channel in CHANNELS:
        error = predict(group.recordings[0], channel, p) - predict(plain, channel, q)
        assert np.std(error) < 0.05 * np.sqrt(group.error_floor[channel])


@pytest.mark.parametrize('noise', [1.0, pytest.param(0.0, marks=pytest.mark.slow)])
def test_the_unchanged_simulator_has_no_gap(noise):
    run = recorded({'load.type': 'spring'}, noise=noise, duration_s=1.2)
    answer = document(diagnose([run], {'load.type': 'spring'}))
    assert answer['verdict'] == 'no_gap'
    assert answer['unknown_probability'] < 0.2


def is_within_interval(answer, field, value):
    """Return whether a size is in its interval, and that is narrower than the tolerance, 20 %."""
    low, high = (answer['which'][0][f'parameters_{end}'][field] for end in ('low', 'high'))
    return low < value < high < 1.2 / 0.8 * low


@pytest.mark.slow
def test_thrust_is_told_from_the_gain_of_the_valve_with_its_size():
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'valve_characteristic.maximum_force': 600.0}, noise=0.5)
    answer = document(diagnose([run], nominal, tolerances={'force_sensor.gain': 0.02}))
    assert answer['verdict'] == 'parameter:valve_characteristic.maximum_force'
    # The gain and the full opening, which act as the thrust does, may be off by 20 %.
    low, high = (answer['which'][0][f'parameters_{end}']['valve_characteristic_maximum_force']
                 for end in ('low', 'high'))
    assert low < 600.0 < high < 1.2 * low


@pytest.mark.slow
def test_gains_opening_and_thrust_within_their_tolerance_are_no_gap_whatever_their_product():
    """The valve position is 1.5 times the nominal one."""
    nominal = {'load.type': 'spring'}
    answer = document(diagnose([recorded({
        **nominal, 'valve_characteristic.gain': 1.15, 'valve_characteristic.maximum_force': 880.0,
        'valve_characteristic.full_opening': 2.3e-5, 'force_sensor.gain': 0.87})], nominal))
    assert answer['verdict'] == 'no_gap' and answer['probability'] > 0.8


def test_every_uncertain_parameter_is_that_of_a_hypothesis():
    nominal = simulator.simulator_record({'load.type': 'spring'})
    recordings = prepared([recorded({'load.type': 'spring'}, duration_s=2.0)])
    for channels in (('valve',), CHANNELS):
        group = simulator_group(nominal, recordings, channels)
        group = replace(group, effects=group.effects | parameter_errors(group))
        for free in (*group.nuisance, *group.usual_shapes):
            assert free.prior == math.inf or free.field in {
                each.field for each in form_of(group, free.field)[1].free}


@pytest.mark.slow
@pytest.mark.parametrize(('damping', 'verdict'), [
    (36.0, 'parameter:load.damping'), (500.0, 'viscous_friction')])
def test_viscous_friction_behind_the_sensor_is_named_and_a_damper_that_is_off(damping, verdict):
    """The farther the damper is off, the less probable is that it is the damper."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'load.damping': damping}, noise=0.5)
    answer = document(diagnose([run], nominal))
    assert answer['verdict'] == verdict
    assert is_within_interval(answer, 'load_damping', damping)
    assert answer['which'][0]['parameters']['load_damping'] == pytest.approx(damping, rel=0.05)


BOOK = {'load.type': 'spring', 'friction.presliding_slip': 1.0,
        'friction.presliding_damping': 400.0}
LEVEL = {'friction.coulomb': 37.0, 'friction.stiction_push': 57.0, 'friction.stiction_pull': 45.0}


@pytest.mark.slow   # that of test_damping_as_another_book_has_it is another law
@pytest.mark.parametrize(('more', 'verdict'), [
    ({}, 'no_gap'), (LEVEL, 'coulomb_friction')])
def test_friction_as_another_book_has_it_is_no_gap_and_hides_none(more, verdict):
    """The nominal model has an elasto-plastic bristle, the machine that of LuGre."""
    run = recorded(BOOK | more, duration_s=1.5 if verdict == 'no_gap' else 2.5)
    answer = document(diagnose([run], {'load.type': 'spring'}))
    assert answer['verdict'] == verdict and answer['probability'] > 0.6


def null_behind_valve(run, nominal):
    """Return the fit of the nominal model to what follows the valve."""
    recordings, p = prepared([run]), simulator.simulator_record(nominal)
    valve = null_fit(simulator_group(p, recordings, ('valve',)))
    return null_fit(with_simulated_valve(
        simulator_group(p, recordings, CHANNELS), valve.as_fitted.record))


@pytest.mark.slow
def test_seals_in_parallel_that_soften_are_friction_of_another_form(monkeypatch):
    """With further shapes of friction, all parameters are as probable as they usually are."""
    nominal = {'load.type': 'spring', 'friction.element_ratio': 1.0}
    run = recorded({'load.type': 'spring', 'friction.element_ratio': 1.8,
                    'friction.softening': 1.0}, noise=0.3, duration_s=1.0)
    null = null_behind_valve(run, nominal)
    other = in_formulation({(): null}, True)[()]
    assert null.unexplained and null.prior_cost > 30.0
    assert not other.unexplained and other.prior_cost < 10.0
    improved = improved_model(nominal, [other.as_fitted.record])[0]
    assert improved['friction.element_ratio'] > 1.2 and improved['friction.softening'] > 0.2
    # So nothing else is fitted, unless there is a gap of which friction is not the cause.
    offset = null_behind_valve(replace(run, force_n=run.force_n + 40.0), nominal)
    pairs = []
    monkeypatch.setattr(search, 'with_pairs', lambda found, *_: pairs.append(found) or found)
    for each, count in (null, 0), (offset, 1):
        monkeypatch.setattr(search, 'single_effects', lambda *_, each=each: {(): each})
        found = search._hypotheses(each, None, lambda: None, False)
        assert each.unexplained and len(pairs) == count
        assert found[()].problem.group.other_formulation == (count == 0)
        assert (weighed_of(found, False) is None) == (count == 1)
    group = null.problem.group   # with a baseline, the model error is measured
    assert sufficient(null._replace(problem=replace(null.problem, group=replace(
        group, floor_measured=True)))) is None
    # Of a healthy machine they stay shapes of the law: no other value of one is a cause.
    healthy = {CHANNELS: healthy_of(other.as_fitted, 0.2, {})}
    group = against(null.problem.group, healthy)
    assert {*OTHER_SHAPES['force']} <= {*group.nuisance}
    assert group.nominal['friction_element_ratio'] == pytest.approx(
        improved['friction.element_ratio'])


@pytest.mark.parametrize(('channels', 'measured', 'far', 'enough', 'sought'), [
    (CHANNELS, True, False, True, False),
    (CHANNELS, True, False, False, True),
    (CHANNELS, True, True, True, True),       # no formulation explains so much
    (CHANNELS, False, False, True, True),     # with the valve, whose command may have steps
    (('valve',), True, False, True, True)])
def test_pairs_are_sought_unless_one_effect_is_enough_with_other_laws(
        monkeypatch, channels, measured, far, enough, sought):
    group = SimpleNamespace(channels=channels, measures_valve=measured, floor_measured=False)
    one = SimpleNamespace(problem=SimpleNamespace(group=group), far=far, unexplained=True,
                          may_lack_an_effect=True)
    found = {(): one, ('sensor_lag',): one}
    other = {(): one, ('sensor_lag',): SimpleNamespace(**{
        **vars(one), 'may_lack_an_effect': not enough})}
    for name in ('with_uneven_delay', 'with_noise_left', 'with_noise_from_fit'):
        monkeypatch.setattr(search, name, lambda found: found)
    monkeypatch.setattr(search, 'single_effects', lambda *_: found)
    monkeypatch.setattr(search, 'sufficient', lambda null: None)
    monkeypatch.setattr(search, 'in_formulation', lambda *_: other)
    pairs = []
    monkeypatch.setattr(search, 'with_pairs', lambda found, *_: pairs.append(found) or found)
    answer = search._hypotheses(one, None, lambda: None, False)
    assert answer is (found if sought else other)
    assert len(pairs) == sought


@pytest.mark.parametrize(('beyond', 'alone', 'sought'), [
    (500.0, False, True), (800.0, False, False), (800.0, True, True)])
def test_pairs_are_sought_where_they_promise_to_explain_every_channel(
        monkeypatch, beyond, alone, sought):
    """Else none of them would count, and their fits are in vain."""
    first = SimpleNamespace(cost_beyond=beyond, unexplained=True, may_lack_an_effect=True,
                            best=SimpleNamespace(cost=1e3))
    found, pairs = {(): first, ('sensor_lag',): first}, []
    monkeypatch.setattr(search, 'screen', lambda *_: SimpleNamespace(most=350.0))
    for name in ('with_noise_left', '_with_own_guesses'):
        monkeypatch.setattr(search, name, lambda found: found)
    monkeypatch.setattr(search, '_pairs', lambda *_: pairs.append(found) or {})
    search.with_pairs(found, lambda: None, alone)
    assert len(pairs) == sought


def test_what_one_channel_leaves_is_not_made_up_for_by_another():
    nominal = simulator.simulator_record({'load.type': 'spring'})
    recordings = prepared([recorded({'load.type': 'spring'}, noise=0.0, duration_s=1.5)])
    group = with_simulated_valve(simulator_group(nominal, recordings, CHANNELS), nominal)
    problem = Posterior(replace(group, valve_gain=None), group.nuisance)
    shape = problem.split(problem.residual(problem.nominal))[0].shape

    def at(rows):
        return Found((), (), problem, Best(
            problem.nominal, 0.5 * float(np.sum(rows ** 2)), rows.ravel()))

    def leaving(*shares):
        """Return a fit that leaves these shares of what is explained in each channel."""
        ones = at(np.ones(shape))
        return at(np.ones(shape) * np.sqrt(
            shares * ones._any_formulation / ones.relative_residual)[:, None])

    within, beyond = leaving(0.5, 0.9), leaving(0.0, 1.1)
    assert not within.far and within.cost_beyond == 0.0
    assert beyond.far and beyond.best.cost < beyond.largest_cost
    assert beyond.cost_beyond == pytest.approx(0.1 * leaving(0.0, 1.0).best.cost)


def test_damping_as_another_book_has_it_and_a_gain_of_the_sensor_are_usual():
    """Both within what is not known of a machine: its parameters stay as probable as they are."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'hydraulic_damping.tail': 0.6, 'force_sensor.gain': 0.87})
    null = null_behind_valve(run, nominal)
    assert not null.may_lack_an_effect and null.prior_cost < 4.0
    assert null.as_fitted.values['force_sensor_gain'] == pytest.approx(0.87, rel=0.03)


@pytest.mark.slow
def test_an_effect_of_a_machine_that_is_nominal_otherwise_is_found_alone():
    """Although errors of nominal parameters could imitate it nearly as well."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'hydraulic_damping.saturation_velocity': 0.05}, noise=0.0,
                   duration_s=1.2)
    null = null_behind_valve(run, nominal)
    found = search.changed_alone(null, lambda: None)
    assert 'hydraulic_damping' in {each.names[0] for each in found}
    best = min(found, key=lambda each: each.best.cost)
    assert best.prior_cost == 0.0
    assert best.as_fitted.values['hydraulic_damping_saturation_velocity'] == pytest.approx(
        0.05, rel=1e-3)


def test_a_parameter_within_its_tolerance_is_never_better_than_the_nominal_model():
    """It is free in that, too; but with a larger noise it was fitted elsewhere."""
    nominal = simulator.simulator_record({'load.type': 'spring'})
    recordings = prepared([recorded({'load.type': 'spring'}, noise=0.0, duration_s=1.5)])
    group = with_simulated_valve(simulator_group(nominal, recordings, CHANNELS), nominal)

    def at(names, variants, theta):
        problem = Posterior(group, without_prior(group.nuisance, variants))
        return Found(names, variants, problem, Best(theta, 0.0, theta)).at(theta)

    name = 'parameter:load.mass'
    mean, precision = Posterior(group, group.nuisance).prior
    off = np.where(precision > 0.0, 0.2 / np.sqrt(np.maximum(precision, 1.0)), 0.05)
    named = at((name,), parameter_errors(group)[name], mean)
    found = with_noise_from_fit({(): at((), (), mean + off), named.names: named})
    assert found[()].best.cost < found[named.names].best.cost + 1.0


def test_a_fit_that_left_the_nominal_values_for_noise_begins_there_again(monkeypatch):
    """As soon as the noise turns out to be smaller; else it may end elsewhere."""
    nominal = simulator.simulator_record({})
    group = simulator_group(nominal, prepared([recorded({}, noise=0.0, duration_s=1.5)]),
                            ('valve',))
    noisy = replace(group, noise={'valve': 1e3 * group.noise['valve']}, error_floor={
        'valve': 1e6 * group.noise['valve'] ** 2 + group.other_error['valve']})
    problem = Posterior(noisy, noisy.nuisance)
    off = np.clip(problem.nominal + 0.02, 0.0, 1.0)
    null = Found((), (), problem, Best(off, 0.0, off)).at(off)
    monkeypatch.setattr(Found, 'refined', lambda found, *_, **__: found)
    monkeypatch.setattr(fits, 'converged', lambda found, *_: found)
    found = with_noise_from_fit({(): null})[()]
    assert found.problem.group.noise['valve'] < noisy.noise['valve']
    np.testing.assert_allclose(found.best.theta, problem.nominal)


@pytest.mark.parametrize(('factor', 'low', 'high'), [(1.0, 0.0, 0.2), (2.0, 0.5, 0.9)])
def test_an_effect_beside_improbable_parameters_is_not_sure(factor, low, high):
    nominal = simulator.simulator_record({})
    off = {f'valve_{name}': factor * float(nominal[f'valve_{name.replace(".", "_")}'])
           for name in ('hysteresis.radius', 'hysteresis.lag_time', 'hysteresis.saturation')}
    group = simulator_group(nominal, prepared([recorded(
        {**off, 'valve_flexure.bias': 20.0}, duration_s=1.5)]), ('valve',))
    bias = group.effects['valve_bias'][:1]
    group = with_formulation(replace(group, effects={}), True)

    def fit(names, variants):
        problem = Posterior(group, (*group.nuisance, *(
            free for each in variants for free in each.free)))
        return Found(names, variants, problem, most_probable(problem, problem.nominal))

    weighed = weighed_of({(): fit((), ()), ('valve_bias',): fit(('valve_bias',), bias)}, False)
    unknown = sum(chance for names, chance in weighed.probability.items() if 'unknown' in names)
    assert low <= unknown <= high
    assert sum(weighed.probability.values()) == pytest.approx(1.0)


@pytest.mark.slow
def test_without_noise_a_small_residual_is_not_taken_for_model_error():
    """Nominal parameters within their tolerance leave less than 0.1 % here."""
    chirp = {'compensator': 'proportional', 'gain': 1e-6, 'reference.shape': 'chirp',
             'reference.frequency': 0.5, 'reference.end_frequency': 50.0,
             'reference.duration': 3.9, 'reference.amplitude': 180.0, 'reference.start': 0.05}
    nominal = {'load.type': 'free'}
    signals = simulate_loop({**nominal, 'hydraulic_damping.viscous': 281.0}, chirp, 4.0,
                            2000.0)._asdict()
    del signals['reference_n']
    answer = document(diagnose([Run(**signals)], nominal))
    assert answer['verdict'] == 'hydraulic_damping' and answer['probability'] > 0.9
    assert answer['which'][0]['parameters']['hydraulic_damping_viscous'] == pytest.approx(
        281.0, rel=1e-3)


def test_a_fit_that_leaves_nothing_has_an_interval(monkeypatch):
    group = simulator_group(simulator.simulator_record({}), prepared([recorded({})]), ('valve',))
    group = replace(group, noise={'valve': math.sqrt(group.error_floor['valve'])})
    problem = Posterior(group, group.nuisance)
    best = most_probable(problem, problem.nominal, rounds=1)
    residual = Posterior.residual
    monkeypatch.setattr(Posterior, 'residual', lambda *each: 0.0 * residual(*each))
    found = fitted(problem, best)
    low, high = interval(found, likelihood(found), 'valve_flexure_delay')
    assert low < found.values['valve_flexure_delay'] < high < 1.001 * low


@pytest.mark.slow
def test_other_laws_keep_their_model_error_in_a_quiet_recording():
    """Their error floor is not what the best hypothesis leaves; else the data were ignored."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'valve_hysteresis.rounding': 1.0, 'valve_flexure.bias': 12.0},
                   noise=0.02, duration_s=1.5)
    group = simulator_group(simulator.simulator_record(nominal), prepared([run]), ('valve',))
    weighed, = explained_by_simulator([group], lambda: None)
    assert weighed.probability[('valve_bias',)] > 0.9
    other = with_formulation(group, True)
    assert with_lower_floor(other, {'valve': 0.0}) is other
    lower = with_lower_floor(group, {'valve': 1e-6 * group.error_floor['valve']})
    assert lower.error_floor['valve'] == pytest.approx(1e-6 * group.error_floor['valve'])


def test_only_parameters_of_laws_of_several_forms_have_wider_tolerances_in_another_one():
    """A mass or a gain is the same whatever the law of the friction."""
    group = simulator_group(simulator.simulator_record({'load.type': 'spring'}),
                            prepared([recorded({'load.type': 'spring'})]), CHANNELS)
    other = {free.field: free.prior for free in with_formulation(group, True).nuisance}
    ratio = {free.field: other[free.field] / free.prior for free in group.nuisance
             if free.prior < math.inf and free.scale == 'nominal'}
    wider = {field for field, value in ratio.items() if value > 1.0}
    assert {field.partition('_')[0] for field in wider} == {'friction', 'hydraulic'}
    assert ratio['load_mass'] == ratio['force_sensor_gain'] == 1.0


def test_an_effect_is_as_sure_beside_another_shape_of_the_laws():
    """Without it a hundred times the noise is left, whatever the shape; with it nothing."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'valve_hysteresis.lagged': 1.0, 'valve_flexure.deadband': 15.0},
                   noise=0.02, duration_s=1.5)
    weighed, = explained_by_simulator([simulator_group(
        simulator.simulator_record(nominal), prepared([run]), ('valve',))], lambda: None)
    assert weighed.probability[('valve_deadband',)] > 0.99


@pytest.mark.parametrize(('bias', 'named'), [(2.8e-3, False), (0.1, True)])
def test_a_difference_as_small_as_the_simulations_own_error_is_no_evidence(bias, named):
    """Of a recording without noise: 1e-5 of the signal, and 5e-4."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'valve_flexure.bias': bias}, noise=0.0)
    group = with_lower_floor(simulator_group(
        simulator.simulator_record(nominal), prepared([run]), ('valve',)), {'valve': 0.0})
    # As of a signal whose noise was estimated to be more.
    group = replace(group, noise={'valve': math.sqrt(group.error_floor['valve'])})

    def found(names, *variants):
        problem = Posterior(group, (*group.nuisance[:2], *(
            free for each in variants for free in each.free)))
        return Found(names, variants, problem, most_probable(problem, problem.nominal))

    chance, _ = weigh(group, {(): found(()), ('valve_bias',): found(
        ('valve_bias',), group.effects['valve_bias'][0])})
    assert (chance[('valve_bias',)] > 0.9) == named


@pytest.mark.parametrize('kind', ['even', 'odd'])
@pytest.mark.parametrize('pad', [0, 1, 99, 100, 250])
def test_ends_are_mirrored_as_numpy_does(kind, pad):
    values = np.random.default_rng(1).standard_normal(100)
    np.testing.assert_array_equal(mirrored(values, pad, kind),
                                  np.pad(values, pad, 'reflect', reflect_type=kind))


def test_a_copy_of_a_record_is_another_one():
    record = simulator.simulator_record({})
    copied = copy_of(record)
    assert copied == record and type(copied) is type(record)
    copied['load_mass'] = 2.0 * record['load_mass']
    assert copied['load_mass'] == 2.0 * record['load_mass'] != record['load_mass']


def test_of_a_motion_only_its_band_is_judged_with_the_noise_that_is_there():
    run = recorded({'load.type': 'spring'}, duration_s=3.0)
    recording = prepared([run])[0]
    p = simulator.simulator_record({'load.type': 'spring'})
    left = judged_error(recording, 'velocity', p)
    ringing = replace(recording, raw_velocity=recording.raw_velocity
                      + 0.01 * np.sin(2.0 * np.pi * 400.0 * run.time_s))
    inner = slice(300, -300)
    assert np.std((judged_error(ringing, 'velocity', p) - left)[inner]) < 1e-5
    # Noise that is stronger at low frequency: nearly as strong as in the band.
    white = np.random.default_rng(1).normal(0.0, 1e-3, 20000)
    noise = lfilter(*butter(1, 60.0, fs=1000.0), white)
    motion, _ = motion_of(None, noise, {'velocity': noise_of(noise)}, 20.0, 1e-3)
    assert 3.0 * noise_of(noise) < noise_above(noise, motion, 1e-3) < 1e-3


class NextToNoPlant:
    """A posterior of one parameter whose derivative overflows, as next to an unstable plant."""

    prior = np.array([0.5]), np.array([0.0])

    def is_far(self, cost):
        return False

    def residual(self, theta):
        return np.array([1.0 - theta[0]])

    def cost(self, theta, residual):
        return 0.5 * float(residual @ residual)

    def jacobian(self, theta, known=None, base=None, size=0.0):
        return np.array([[np.inf]])


def test_a_fit_ends_where_derivatives_overflow():
    best = most_probable(NextToNoPlant(), np.array([0.5]))
    assert best.theta == 0.5 and best.cost == 0.125


class Valley(Posterior):
    """A narrow, winding valley, lowest (0) where x is 0.9."""

    prior, free = (np.full(3, 0.5), np.zeros(3)), ()

    def __init__(self):
        pass

    def is_far(self, cost):
        return False

    def residual(self, theta):
        x, y, z = theta
        return np.array([300.0 * (y - 0.5 - 0.4 * np.sin(9.0 * x)),
                         300.0 * (z - 0.5 - 0.4 * np.cos(7.0 * y)), 30.0 * (x - 0.9)])

    def prior_cost(self, theta):
        return 0.0

    def jacobian(self, theta, known=None, base=None, size=STEP):
        return np.array([(self.residual(theta + size * axis) - base) / size
                         for axis in np.eye(3)]).T


def test_a_fit_follows_a_narrow_winding_valley():
    best = most_probable(Valley(), np.array([0.1, 0.2, 0.8]), rounds=40)
    assert best.cost < 1.0 and best.theta[0] == pytest.approx(0.9, abs=0.02)


def test_a_fit_that_costs_far_more_than_a_better_one_is_found_roughly(monkeypatch):
    """Wherever it lies in the valley, much is left."""
    counted, residual = [], Valley.residual
    monkeypatch.setattr(Valley, 'residual', lambda self, theta: (
        counted.append(1), residual(self, theta) + [0.0, 0.0, 300.0])[1])

    def fit(beside):
        counted.clear()
        best = most_probable(Valley(), np.array([0.1, 0.2, 0.8]), rounds=40, beside=beside)
        return best.cost, len(counted)

    (cost, count), rough = fit(math.inf), fit(0.0)
    assert fit(1e9) == (cost, count)
    assert cost < rough[0] < 1.05 * cost and rough[1] < 0.7 * count


@pytest.mark.slow   # test_of_an_asymmetric_friction_the_right_sign_is_fitted screens too
def test_a_rival_begins_at_the_size_that_the_screen_expects():
    """An offset is linear: its best size is found without a fit."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'force_sensor.offset': 1.5}, duration_s=1.5)
    null = null_behind_valve(run, nominal).at_nominal
    start, = (start for start in screen(null, False, lambda: None).best(30)
              if start.name == 'sensor_offset')
    offset, guess = (start.problem.record(theta)['force_sensor_offset']
                     for theta in (start.nearest, start.theta))
    assert offset == pytest.approx(1.5, abs=0.3) and abs(guess - 1.5) > 1.0
    assert start.problem.cost(start.nearest) < start.problem.cost(start.theta)
    # A guess that costs less than its multiple is kept.
    assert (start._replace(amount=1e3).nearest == start.theta).all()


@pytest.mark.parametrize('asymmetry', [-0.6, pytest.param(0.6, marks=pytest.mark.slow)])
def test_of_an_asymmetric_friction_the_right_sign_is_fitted(asymmetry):
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'friction.coulomb': 30.0,
                    'friction.coulomb_asymmetry': asymmetry}, duration_s=1.5)
    null = null_behind_valve(run, nominal).at_nominal
    forms = [start.variant for start in screen(null, False, lambda: None).best(30)
             if start.name == 'friction_asymmetry']
    ranges = [(free.low, free.high) for form in forms for free in form.free
              if free.field == 'friction_coulomb_asymmetry']
    one_way = [low + high for low, high in ranges if low * high > 0.0]
    assert len(one_way) == 2 and all(middle * asymmetry > 0.0 for middle in one_way)


@pytest.mark.parametrize('duration_s', [
    1.2, *(pytest.param(each, marks=pytest.mark.slow) for each in (2.0, 5.0))])
def test_what_can_reach_a_goal_is_not_given_up_on_the_first_part(duration_s):
    """Of a short recording the first part, at least 1 s, is nearly all."""
    nominal = {'load.type': 'spring'}
    null = null_behind_valve(recorded(nominal, duration_s=duration_s), nominal)
    problem, goal = null.problem, null.best.cost + 50.0
    far = problem.nominal.copy()
    far[[free.field for free in problem.free].index('load_mass')] = 0.9
    part = of_first_part(problem, far, goal)
    assert part.cost < goal
    # All of the first part's cost counts, and some of the rest.
    alone = problem.first_part(PART).cost(part.theta)
    assert alone < part.cost < alone + 0.5 * goal + 1e-9
    assert most_probable(problem, far, goal=goal).cost < null.best.cost + 1.0


@pytest.mark.parametrize('share', [1.2, pytest.param(2.0, marks=pytest.mark.slow)])
def test_parameters_are_as_near_to_nominal_as_the_residual_may_grow(share):
    """No farther than those of fits with less and less weight of the data."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'load.mass': 0.58, 'friction.stiction_push': 25.0}, duration_s=1.0)
    found = null_behind_valve(run, nominal)

    def left(each):
        return mean_squares(found.problem, each.best.residual)

    near, lighter = nearest_to_nominal(found, share * left(found)), found
    assert 0.9 < (left(near) / left(found)).max() / share <= 1.0
    for halvings in range(1, 17):
        tried = lighter.lighter(0.5 ** (0.5 * halvings))
        if (left(tried) > share * left(found)).any():
            break
        lighter = tried
    assert near.prior_cost < lighter.prior_cost + 0.05 < found.prior_cost
    assert nearest_to_nominal(found, 0.9 * left(found)) is found


def test_a_fit_that_begins_far_is_made_on_the_first_part_before():
    """A gain of half hides behind other parameters, unless these stay near their values first."""
    run = recorded({'valve_characteristic.full_opening': 4e-5}, duration_s=4.0)
    group = simulator_group(simulator.simulator_record({}), prepared([run]), ('force',))
    opening = tuple(free for free in group.nuisance
                    if free.field == 'valve_characteristic_full_opening')
    others = tuple(free for free in group.nuisance if free not in opening)
    problem = Posterior(group, (*others, *(f._replace(prior=math.inf) for f in opening)))
    best = most_probable(problem, problem.nominal)
    assert problem.is_far(problem.cost(problem.nominal)) and not problem.is_far(best.cost)
    found = problem.record(best.theta)['valve_characteristic_full_opening']
    assert found == pytest.approx(4e-5, rel=0.05)   # but for the error of the sub-step
    # A parameter that does not explain it is given up after the first part.
    hopeless, sizes = Posterior(group, tuple(
        free for free in others if free.field == 'fluid_dynamics_frequency')), []
    residual = Posterior._residual_of
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Posterior, '_residual_of', lambda self, p: (
            sizes.append(self.group.recordings[0].fit.size), residual(self, p))[1])
        given_up = most_probable(hopeless, hopeless.nominal, goal=problem.noise_cost)
    assert given_up.cost > problem.noise_cost
    assert sum(size == run.time_s.size for size in sizes) < 5 < len(sizes)


@pytest.mark.parametrize('quantum', [8.0, pytest.param(33.0, marks=pytest.mark.slow)])
def test_steps_of_the_command_are_guessed_from_coarse_to_fine(quantum):
    """Of a controller whose command has large peaks; the hysteresis is as wide as a step."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'command_path.quantum': quantum}, noise=0.2, duration_s=2.0)
    assert np.abs(run.command_n).max() > 60.0 * 8.0
    fit = null_fit(simulator_group(simulator.simulator_record(nominal), prepared([run]),
                                          ('valve',)))
    assert initial_guesses(fit.as_fitted)['residual_step'] == pytest.approx(quantum, rel=3e-3)


def test_the_phase_of_a_push_is_guessed_beside_a_compliance_too():
    """A push on a rigid load would have the opposite sign."""
    nominal = {'load.type': 'spring', 'coupling.stiffness': 1.2e5, 'coupling.damping': 40.0,
               'coupling.piston_share': 0.3}
    run = recorded({**nominal, 'load.external_force': 8.0, 'load.external_force_frequency': 7.3,
                    'load.external_force_phase': 0.2}, duration_s=2.0)
    fitted = null_behind_valve(run, nominal).as_fitted
    guesses = initial_guesses(fitted)
    assert guesses['residual_frequency'] == pytest.approx(7.3, rel=0.01)
    assert guesses['residual_phase'] == pytest.approx(1.2, abs=0.05)
    # A simulation that overflows beside the push gives no better phase, and no error.
    missed = simulator.missed_force
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulator, 'missed_force', lambda recording, p: missed(recording, p) + (
            0.0 if p['load_external_force'] == 0.0 else math.nan))
        assert 1.0 <= initial_guesses(fitted)['residual_phase'] < 2.0


@pytest.mark.parametrize(('machine', 'steps'), [
    ({'command_path.quantum': 24.0}, True), *(
        pytest.param(each, False, marks=pytest.mark.slow) for each in (
            {}, {'valve_hysteresis.rounding': 0.3}))])
def test_steps_smaller_than_the_noise_are_evidence_beside_laws_of_another_form(machine, steps):
    """They change the residual by 8 %, as another law of hysteresis might."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, **machine}, duration_s=4.0)
    answered, = explained_by_simulator([simulator_group(
        simulator.simulator_record(nominal), prepared([run]), ('valve',))], lambda: None)
    assert (answered.probability.get(('command_quantisation',), 0.0) > 0.9) == steps


def valve_of_other_laws(command, period_s):
    """Return the position (m) of a valve with a Prandtl-Ishlinskii hysteresis: four plays."""
    p, finer = simulator.simulator_record({}), 5
    plays, driven = np.zeros(4), np.empty(command.size)
    width = p['valve_hysteresis_radius'] * np.array([0.2, 0.7, 1.3, 2.2])
    for k, value in enumerate(command):
        plays = np.clip(plays, value - width, value + width)
        driven[k] = plays @ [0.35, 0.3, 0.2, 0.15]
    coil = 2.0 * np.pi * 1.08 * p['valve_flexure_coil_frequency']
    pipe = 2.0 * np.pi * p['valve_flexure_natural_frequency']
    poles = np.polymul([1.0 / coil, 1.0],
                       [pipe ** -2.0, 2.0 * p['valve_flexure_damping_ratio'] / pipe, 1.0])
    (above,), below, _ = cont2discrete(([1.0], poles), period_s / finer)
    late = lfilter(above, below, np.append(0.0, np.repeat(driven, finer)))   # by the delay
    return 0.97 * simulator.metres_per_newton(p) * late[:-1:finer]


@pytest.mark.parametrize('quantum', [40.0, pytest.param(0.0, marks=pytest.mark.slow)])
def test_steps_show_beside_laws_that_the_simulator_does_not_have(quantum):
    """What they change has far more independent samples than the errors of a formulation."""
    rng = np.random.default_rng(4)
    time_s = np.arange(4000) * 1e-3
    command = 300.0 * np.interp(time_s, np.arange(40) * 0.12, rng.uniform(-1.0, 1.0, 40)) + (
        80.0 * np.sin(2.0 * np.pi * 11.3 * time_s))
    sent = quantum * np.round(command / quantum) if quantum else command
    none = np.zeros(time_s.size)
    run = Run(time_s, command_n=command, force_n=none, position_m=none, velocity_m_s=none,
              valve_position_m=valve_of_other_laws(sent, 1e-3) + rng.normal(0.0, 2e-8, none.size))
    answered, = explained_by_simulator([simulator_group(simulator.simulator_record(
        {'load.type': 'spring'}), prepared([run]), ('valve',))], lambda: None)
    steps = sum(value for names, value in answered.probability.items()
                if 'command_quantisation' in names)
    assert steps > 0.9 if quantum else steps < 0.05


@pytest.mark.parametrize('quantum', [60.0, pytest.param(120.0, marks=pytest.mark.slow)])
def test_large_steps_towards_zero_are_found_beside_other_nominal_parameters(quantum):
    """Without the steps, a lower gain and a wider hysteresis fit best: with these, other steps."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'command_path.quantum': quantum, 'command_path.rounding': 'zero',
                    'valve_hysteresis.radius': 22.0, 'valve_flexure.coil_frequency': 16.5})
    answered, = explained_by_simulator([simulator_group(
        simulator.simulator_record(nominal), prepared([run]), ('valve',))], lambda: None)
    assert answered.probability[('command_quantisation',)] > 0.9


@pytest.mark.parametrize(('quantum', 'rounding'), [
    (60.0, 'edge'), *(pytest.param(*each, marks=pytest.mark.slow) for each in (
        (60.0, 'zero'), (60.0, 'nearest'), (0.0, 'nearest')))])
def test_steps_beside_a_second_effect_do_not_pass_as_noise(quantum, rounding):
    """What the steps leave of a biased valve has the spectrum and the moments of noise."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'valve_flexure.bias': 40.0, 'command_path.quantum': quantum,
                    'command_path.rounding': rounding}, duration_s=1.5)
    answered, = explained_by_simulator([simulator_group(
        simulator.simulator_record(nominal), prepared([run]), ('valve',))], lambda: None)
    steps = ('command_quantisation',) if quantum else ()
    assert answered.probability[(*steps, 'valve_bias')] > 0.9


def test_a_fit_at_improbable_parameters_is_repeated_from_usual_ones():
    """The maximum force and the full opening act alike: only their ratio is known well."""
    nominal = {'load.type': 'spring'}
    run = recorded(nominal, duration_s=1.5)
    found = null_fit(simulator_group(simulator.simulator_record(nominal), prepared([run]),
                                     CHANNELS))
    assert not found.improbable and from_usual_parameters(found) is found
    fields = [free.field for free in found.problem.free]
    theta = found.best.theta.copy()
    for name in ('valve_characteristic_maximum_force', 'valve_characteristic_full_opening'):
        theta[fields.index(name)] = 0.95
    stuck = found.at(theta)
    assert stuck.improbable
    again = from_usual_parameters(stuck)
    assert not again.improbable and again.best.cost < found.best.cost + 1.0


def test_a_fit_is_not_given_up_for_a_jacobian_that_was_computed_elsewhere():
    nominal = {'load.type': 'spring'}
    run = recorded(nominal, duration_s=1.0)
    fit = null_fit(simulator_group(simulator.simulator_record(nominal), prepared([run]),
                                          ('valve',)))
    problem, start = fit.problem, fit.best.theta + 0.05
    fields = [free.field for free in problem.free]
    wrong = dict(zip(fields, -problem.jacobian(start).T, strict=True))   # its steps lead uphill
    goal = fit.best.cost + 1.0
    assert problem.cost(start) > goal
    assert most_probable(problem, start, known=wrong, goal=goal).cost < goal
    beside = problem.cost(start)   # nor for a fit without an effect that costs as much
    assert most_probable(problem, start, known=wrong, without=beside).cost < goal


@pytest.mark.slow
def test_a_parameter_surely_beyond_its_tolerance_is_no_no_gap():
    """The null hypothesis fits it too, beyond the tolerance: it is the same answer."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'valve_characteristic.gain': 1.41})
    answer = document(diagnose([run], nominal))
    assert answer['verdict'] == 'parameter:valve_characteristic.gain'
    assert answer['probability'] > 0.9 and answer['no_gap_probability'] == 0.0
    assert answer['at_limit'] == []
    assert is_within_interval(answer, 'valve_characteristic_gain', 1.41)
    known = document(diagnose([run], nominal, tolerances={'force_sensor.gain': 0.02}))
    assert 'valve_characteristic.gain is 1.41 times nominal' in sentences(known)[0]
    within = document(diagnose([run], nominal, tolerances={'valve_characteristic.gain': 0.6}))
    assert within['verdict'] == 'no_gap'


def test_a_parameter_far_beyond_its_tolerance_is_named_though_its_effect_has_more_parameters():
    """The lag of the flux, with which the effect frees the radius of the hysteresis."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'valve_hysteresis.lag_time': 2.2 * float(
        simulator.simulator_record(nominal)['valve_hysteresis_lag_time'])}, duration_s=1.5)
    group = simulator_group(simulator.simulator_record(nominal), prepared([run]), ('valve',))
    chance = weighed_of({(): null_fit(group)}, False, False).probability
    assert chance[('valve_hysteresis',)] > 0.55


def test_a_parameter_that_is_named_is_not_drawn_to_its_nominal_value():
    """In a noisy recording the prior of a nominal parameter would draw its size."""
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'valve_flexure.coil_frequency': 30.0}, noise=40.0, duration_s=1.5)
    group = simulator_group(simulator.simulator_record(nominal), prepared([run]), ('valve',))
    weighed = weighed_of({(): null_fit(group)}, True)
    named = weighed.candidates[('valve_lag',)].fitted   # the effect that holds it
    assert named.record['valve_flexure_coil_frequency'] == pytest.approx(30.0, rel=0.03)
    drawn = weighed.candidates[()].fitted.record['valve_flexure_coil_frequency']
    assert drawn < 27.0


@pytest.mark.slow
def test_one_parameter_far_beyond_its_tolerance_is_not_taken_for_laws_of_another_form():
    nominal = {'load.type': 'free'}
    run = recorded({**nominal, 'valve_characteristic.gain': 2.1}, rate_hz=5000.0)
    answer = document(diagnose([run], nominal))
    assert answer['verdict'] == 'parameter:valve_characteristic.gain'


@pytest.mark.slow   # test_the_withheld_effect_is_found_and_the_gap_shrinks does it with another
def test_an_effect_is_named_and_the_improved_model_is_the_machine():
    nominal = {'load.type': 'spring'}
    machine = {**nominal, 'friction.coulomb': 25.0}
    diagnosis = diagnose([recorded(machine, duration_s=1.5)], nominal)
    assert diagnosis.verdict == ('coulomb_friction',)
    values, missing = improved_model(
        nominal, [diagnosis.best(weighed).fitted.record for weighed in diagnosis.groups])
    assert missing == []
    fresh = {**LOOP, 'reference.amplitude': 120.0, 'reference.seed': 3}
    force = [simulate_loop(each, fresh, 2.0, 1000.0).force_n
             for each in (machine, nominal, values)]
    assert np.std(force[2] - force[0]) < 0.1 * np.std(force[1] - force[0])


@pytest.mark.slow
def test_an_effect_that_looks_like_the_best_one_is_weighed_too(monkeypatch):
    # The first screen ranks an offset of the sensor first: nominal parameters that are off hide
    # that the friction is asymmetric. Only the effect that it ranks first is fitted here.
    monkeypatch.setattr(one_more_effect, 'ROUGH_FITS', 1)
    monkeypatch.setattr(search, 'ROUGH_FITS', 1)
    off = {'hydraulic_damping.maximum_force': 1100.0, 'valve_characteristic.maximum_force': 900.0,
           'friction.stiction_push': 24.0, 'load.stiffness': 2.2e5, 'load.mass': 0.5}
    nominal = {'load.type': 'spring', 'load.stiffness': 2e5, 'load.mass': 0.45}
    run = recorded({**nominal, **off, 'friction.coulomb_asymmetry': -0.9}, duration_s=2.0)
    assert diagnose([run], nominal).verdict == ('friction_asymmetry',)


@pytest.mark.slow
def test_what_the_simulator_cannot_explain_is_left_to_the_other_models():
    nominal = {'load.type': 'spring'}
    run = recorded(nominal, duration_s=3.0)
    # A force that depends on the position as nothing in the simulator does.
    run = Run(**{**{name: getattr(run, name) for name in (
        'time_s', 'command_n', 'valve_position_m', 'position_m', 'velocity_m_s')},
        'force_n': run.force_n + 40.0 * np.sin(run.position_m / 1e-4)})
    recordings = prepared([run])
    p = simulator.simulator_record(nominal)
    groups = [simulator_group(p, recordings, channels) for channels in (('valve',), CHANNELS)]
    valve, behind = explained_by_simulator(groups, lambda: None)
    assert behind is None
    # The valve is the simulator's own: no fit of other models may accuse it.
    assert valve is not None
    assert valve.probability[()] > 0.9


def test_a_parameter_whose_prior_is_costly_leads_the_screen_to_its_effect():
    # Only stiction differs, so much that the nominal model follows with an improbable one.
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'friction.stiction_push': 30.0, 'friction.stiction_pull': 20.0},
                   duration_s=1.5)
    p = simulator.simulator_record(nominal)
    null = null_fit(simulator_group(p, prepared([run]), CHANNELS))
    screened = screen(null, True, lambda: None)
    fields = [free.field for free in null.problem.free]
    same = [start for start in screened.ranked if start.name == 'stiction' and all(
        start.problem.record(start.theta)[field] == pytest.approx(
            null.problem.record(null.best.theta)[field]) for field in fields)]
    assert same   # the fitted values themselves, without their priors
    # No more can be gained than the priors cost and the residual is above the noise.
    assert screened.most < null.best.cost


def groups_of(monkeypatch, valve, behind):
    """Return what is said of two groups, of which these are the fits without and with effect."""
    def explained(group, tick, alone):
        costs, other = valve if group.channels == ('valve',) else behind
        if costs is None:
            return None
        found = {names: SimpleNamespace(best=SimpleNamespace(cost=cost))
                 for names, cost in zip(((), ('valve_lag',)), costs, strict=True)}
        return search._Explained(SimpleNamespace(
            group=SimpleNamespace(other_formulation=other)), found)

    monkeypatch.setattr(search, '_explained', explained)
    monkeypatch.setattr(search, 'weighed_of', lambda found, alone, other: 'of other laws')
    monkeypatch.setattr(search, 'most_probable_of', lambda weighed: SimpleNamespace(
        fitted=SimpleNamespace(record=None)))
    monkeypatch.setattr(search, 'behind_valve', lambda group, valve, gain: group)
    monkeypatch.setattr(search, 'with_noise_of_valve', lambda group, valve: group)
    monkeypatch.setattr(search, 'with_free_gain', lambda group: (group, None))   # it is certain
    return explained_by_simulator([SimpleNamespace(channels=('valve',)),
                                   SimpleNamespace(channels=CHANNELS)], lambda: None)


@pytest.mark.parametrize('behind', [(None, False), ((90.0, 80.0), True)])
def test_valve_has_other_laws_as_what_follows_it_unless_its_own_need_an_effect(
        monkeypatch, behind):
    assert groups_of(monkeypatch, ((120.0, 100.0), False), behind)[0] == 'of other laws'
    kept = groups_of(monkeypatch, ((1000.0, 100.0), False), behind)[0]
    assert not kept.group.other_formulation


def test_what_follows_a_valve_that_is_not_explained_is_not_judged_by_the_simulator(monkeypatch):
    assert groups_of(monkeypatch, (None, False), ((90.0, 80.0), False)) == [None, None]


@pytest.mark.slow
def test_a_gain_of_the_valve_is_told_though_what_follows_is_answered_by_blocks(monkeypatch):
    explained = search._explained
    monkeypatch.setattr(search, '_explained', lambda group, *rest: (
        explained(group, *rest) if group.channels == ('valve',) else None))
    nominal = {'load.type': 'spring'}
    answer = diagnose([recorded({**nominal, 'valve_characteristic.gain': 2.0}, duration_s=1.1)],
                      nominal)
    assert 'parameter:valve_characteristic.gain' in answer.verdict


@pytest.mark.slow
def test_contacts_are_found_though_they_take_shorter_sub_steps():
    nominal = {'load.type': 'spring'}
    answer = document(diagnose([recorded({**nominal, 'backlash.gap': 2e-4}, noise=0.0)], nominal))
    assert answer['verdict'] == 'backlash'
    assert answer['which'][0]['parameters']['backlash_gap'] == pytest.approx(2e-4, rel=0.02)


@pytest.mark.slow
def test_the_origin_of_the_position_of_a_piston_at_rest_does_not_matter():
    nominal = {'load.type': 'spring'}
    pushed = nominal | {'load.external_force': 40.0}
    for machine, verdict in ((nominal, 'no_gap'), (pushed, 'disturbance_force')):
        run = recorded(machine)
        shifted = replace(run, position_m=run.position_m + 1e-3)
        with pytest.warns(InputWarning, match='starts at rest at 0.001'):
            answer = document(diagnose([shifted], nominal))
        assert answer['verdict'] == verdict
    assert answer['which'][0]['parameters']['load_external_force'] == pytest.approx(40.0, rel=0.05)


@pytest.mark.slow
def test_a_shifted_position_that_may_be_a_constant_force_is_said():
    nominal = {'load.type': 'spring'}
    run = recorded(nominal, duration_s=4.0)[1337:]   # the middle of a motion
    assert document(diagnose([run], nominal))['verdict'] == 'no_gap'
    answer = document(diagnose([replace(run, position_m=run.position_m + 1e-3)], nominal))
    assert answer['verdict'] == 'disturbance_force'
    assert any('a shifted zero looks like a constant force' in note for note in answer['notes'])


def test_noise_that_is_zero_is_not_lowered_again():
    """Else a recording without noise that the simulator repeats exactly is fitted for ever."""
    group = simulator_group(simulator.simulator_record({}), prepared([recorded({})]), ('valve',))
    silent = replace(group, noise={'valve': 0.0})
    assert with_lower_noise(silent, {'valve': 0.0}) is silent
    lower = with_lower_noise(group, {'valve': 0.0})
    size = np.sqrt(np.mean(measured(group.recordings[0], 'valve') ** 2))
    assert lower.noise['valve'] == pytest.approx(LEAST_ERROR * size, rel=0.05)


def test_errors_of_a_motion_are_told_in_the_band_in_which_it_is_compared():
    """What rings above it changes no verdict, nor what is reported of it."""
    nominal = {'load.type': 'spring'}
    run = recorded(nominal)
    group = simulator_group(simulator.simulator_record(nominal), prepared([run]), CHANNELS)
    edge = group.recordings[0].motion.edge_hz
    ringing = 0.2 * np.std(run.velocity_m_s) * np.sin(2.0 * math.pi * 300.0 * run.time_s)
    other = replace(group, recordings=[replace(
        each, raw_velocity=each.raw_velocity + ringing) for each in group.recordings])
    assert edge < 150.0
    changed = group.nominal.copy()
    changed['load_mass'] *= 1.3

    def shrink(of):
        return shrink_of(of, 'velocity', changed, changed, False)

    assert shrink(group).edge_hz == edge and shrink_of(
        group, 'force', changed, changed, False).edge_hz is None
    for name in 'nominal', 'refitted', 'noise_floor':
        assert getattr(shrink(other), name) == pytest.approx(getattr(shrink(group), name),
                                                             rel=0.01), name
    assert shrink(other).nominal < 0.02   # ringing is 0.2 of it


@dataclass(frozen=True)
class _Landscape:
    """A problem whose cost is a table; a fit goes down to the left as long as it gets cheaper."""

    cost: tuple[float, ...]
    free: tuple[()] = ()
    noise_cost: float = 0.0


class _AtPlace(NamedTuple):
    """A fit of a `_Landscape`, in place of a `Found`."""

    names: tuple[str, ...]
    problem: _Landscape
    best: Best
    variants: tuple[()] = ()

    def at(self, place):
        return self._replace(best=Best(place, self.problem.cost[place], np.zeros(0)))

    def refined(self, goal=math.inf, beside=math.inf):
        place = self.best.theta
        while place and self.problem.cost[place - 1] < self.problem.cost[place]:
            place -= 1
        return self.at(place)


def test_the_nominal_model_is_fitted_from_what_its_rivals_have_found(monkeypatch):
    """In laws of another form a healthy machine was an effect: only its fit had found them."""
    monkeypatch.setattr(formulation, 'at_values_of',
                        lambda each, leader, fields: each.at(leader.best.theta))
    monkeypatch.setattr(formulation, 'converged', lambda found: found)
    found = {names: _AtPlace(names, _Landscape(cost), Best(0, 0.0, np.zeros(0))).at(4)
             for names, cost in {
                 (): (60.0, 65.0, 90.0, 87.0, 88.0), ('a',): (99.0, 61.0, 63.0, 70.0, 80.0),
                 ('b',): (99.0, 99.0, 99.0, 71.0, 72.0)}.items()}
    fits = formulation._refitted(found)
    assert {names: each.best.cost for names, each in fits.items()} == {
        (): 60.0, ('a',): 61.0, ('b',): 71.0}
