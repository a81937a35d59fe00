"""A linear nominal model: the simulator's own laws are asked first (own_laws.py)."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import butter, chirp, lfilter
from test_gap import REAL, TEXTBOOK, recorded

from asi_actuator.model.actuator import simulate
from asi_actuator.parameters import as_record
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputWarning
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.diagnosis import improved_of
from asi_analysis.gap.document import document
from asi_analysis.gap.inference.beyond_tolerance import _shares
from asi_analysis.gap.inference.bounded_least_squares import least_step
from asi_analysis.gap.inference.posterior import Best, Posterior, most_probable
from asi_analysis.gap.inference.simulated import uneven_delay
from asi_analysis.gap.inference.simulated.fits import null_fit, with_fine_substeps
from asi_analysis.gap.inference.simulated.found import Found
from asi_analysis.gap.inference.simulated.own_laws import _goal
from asi_analysis.gap.inference.simulated.special_cases import (
    from_values_of,
    never_slides,
    simpler_forms,
    special_cases,
)
from asi_analysis.gap.inference.simulated.uneven_delay import uneven
from asi_analysis.gap.model import blocks
from asi_analysis.gap.model.forms import EFFECTS
from asi_analysis.gap.model.group import simulator_group
from asi_analysis.gap.model.model_file import improved_model
from asi_analysis.gap.model.predict import plant_record
from asi_analysis.gap.model.simulator import has_linear_laws, simulator_record
from asi_analysis.gap.prepare import prepare
from asi_analysis.gap.sampling import whitened_by
from asi_common.jit import FULL


@pytest.mark.parametrize(('changed', 'effect'), [
    pytest.param({'valve_hysteresis__model': 'full', 'valve_hysteresis__radius': 4.0,
                  'valve_hysteresis__lag_time': 0.0, 'valve_hysteresis__rounding': 0.5,
                  'valve_hysteresis__saturation': 1e6}, 'valve_hysteresis',
                 marks=pytest.mark.slow),
    ({'fluid_dynamics__air_time': 3e-4, 'fluid_dynamics__air_force': 200.0}, 'entrained_air'),
])
def test_small_effect_is_found_beside_parameters_that_are_off(changed, effect):
    assert diagnose([recorded(**changed)], TEXTBOOK).verdict == (effect,)


@pytest.mark.slow
def test_small_effect_is_none_block_by_block():
    """There half a per cent of the signal counts as model error."""
    run = recorded(fluid_dynamics__air_time=3e-4, fluid_dynamics__air_force=200.0)
    assert diagnose([run], TEXTBOOK, simulate=False).verdict == ()


@pytest.mark.slow
def test_lag_of_two_poles_and_a_bias_are_no_delay():
    diagnosis = diagnose([recorded(
        valve_flexure__lag_time=0.007, valve_flexure__second_lag_time=0.003,
        valve_flexure__bias=52.0)], TEXTBOOK)
    assert diagnosis.verdict == ('valve_bias', 'valve_lag')
    improved = improved_of(diagnosis, TEXTBOOK)
    poles = sorted(improved[f'valve_flexure.{name}'] for name in ('lag_time', 'second_lag_time'))
    assert poles == pytest.approx([0.003, 0.007], rel=0.15)


def test_a_short_lag_beside_a_bias_is_not_a_parameter_of_the_valve():
    """Both have one law, so no model error hides that another pair leaves a little more."""
    diagnosis = diagnose([recorded(valve_flexure__lag_time=0.0004, valve_flexure__bias=33.0)],
                         TEXTBOOK)
    assert diagnosis.joined['valve_bias', 'valve_lag'] > 0.9


def test_a_delay_beyond_its_tolerance_leaves_room_for_another_second_effect():
    """Its probability is divided as the evidence is: a lag explains as much as that delay."""
    chance = {(): 0.0, ('valve_bias',): 0.9, ('valve_bias', 'valve_lag'): 0.06,
              ('transport_delay', 'valve_bias'): 0.02, ('transport_delay', 'valve_lag'): 0.02}
    delay, lag = ('transport_delay', 'valve_bias'), ('valve_bias', 'valve_lag')
    assert _shares(chance, ('valve_bias',), delay) == pytest.approx({delay: 0.25, lag: 0.75})
    bias_gain = ('valve_bias', 'valve_gain')   # whose evidence is not known
    assert _shares(chance, ('valve_bias',), bias_gain) == {bias_gain: 1.0}


def test_a_curved_sensor_beside_a_lag_is_no_second_effect():
    """A dead band explains a little more than the lag, which alone leaves only noise."""
    run = recorded(valve_flexure__lag_time=0.004)
    exact = simulate(as_record(REAL | {'valve_flexure.lag_time': 0.004}), run.command_n,
                     run.period_s).valve_position_m
    curved = exact + 5e-3 * exact ** 3 / np.abs(exact).max() ** 2
    noise = np.random.default_rng(1).normal(0.0, 1e-8, exact.size)
    diagnosis = diagnose([replace(run, valve_position_m=curved + noise)], TEXTBOOK)
    assert diagnosis.joined['valve_lag',] > 0.9


def test_steps_beside_a_lag_are_found_where_the_noise_of_the_valve_is_filtered():
    """They resemble such noise, and alone they explain most beside improbable parameters."""
    run = recorded(command_path__quantum=40.0, valve_flexure__lag_time=0.0025)
    noise = lfilter(*butter(2, 0.3), np.random.default_rng(8).normal(0.0, 1e-7, 6000))
    diagnosis = diagnose([replace(run, valve_position_m=run.valve_position_m + noise)], TEXTBOOK)
    assert diagnosis.joined['command_quantisation', 'valve_lag'] > 0.9


@pytest.mark.slow
def test_a_push_that_one_effect_leaves_as_noise_is_found():
    """Without another formulation of the laws, a smaller residual is evidence."""
    diagnosis = diagnose([recorded(
        coupling__stiffness=1.5e5, coupling__damping=40.0, coupling__piston_share=0.3,
        load__external_force=4.0, load__external_force_frequency=2.9)], TEXTBOOK)
    assert diagnosis.joined['disturbance_force', 'load_compliance'] > 0.9


@pytest.mark.slow   # test_a_constant_delay_is_not_called_uneven has one that does not differ
@pytest.mark.parametrize('spread', [0.0004, 0.0012])
def test_a_delay_that_differs_from_period_to_period_is_a_delay(spread):
    """It leaves up to five times the noise, which a constant delay does not explain."""
    diagnosis = diagnose([recorded(command_path__delay=0.004,
                                   command_path__delay_spread=spread)], TEXTBOOK)
    assert diagnosis.verdict == ('transport_delay',)
    improved = improved_of(diagnosis, TEXTBOOK)
    assert improved['command_path.delay'] == pytest.approx(0.004, rel=0.05)
    assert improved['command_path.delay_spread'] == pytest.approx(spread, rel=0.3)
    assert any('differs from period to period' in note for note in diagnosis.notes)


def test_the_spread_of_a_delay_is_at_most_the_delay():
    run = recorded()[:1500]
    short, recording = REAL | {'command_path.delay': 1e-4}, prepare([run])[0]
    mean, factor = uneven(recording, as_record(short), 0.003, 1e-16)
    again, same = uneven(recording, as_record(short), 1e-4, 1e-16)
    assert np.isfinite(factor).all()
    assert (mean == again).all() and (factor == same).all()


def test_an_uneven_delay_of_the_nominal_model_stays_in_the_improved_one():
    nominal = TEXTBOOK | {'command_path.delay': 0.004, 'command_path.delay_spread': 0.0001}
    given = simulator_record(nominal)
    assert given['command_path_delay_spread'] == 0.0
    given['force_sensor_offset'] = 3.0
    assert improved_model(nominal, [given])[0] == nominal | {'force_sensor.offset': 3.0}


@pytest.mark.parametrize('more', [
    {}, pytest.param({'valve_flexure__bias': 40.0}, marks=pytest.mark.slow)])
def test_a_constant_delay_is_not_called_uneven(more):
    diagnosis = diagnose([recorded(command_path__delay=0.004, **more)], TEXTBOOK)
    assert 'transport_delay' in diagnosis.verdict
    assert improved_of(diagnosis, TEXTBOOK).get('command_path.delay_spread', 0.0) == 0.0


@pytest.mark.slow
def test_what_an_uneven_delay_does_not_explain_is_no_delay():
    """A static law of the valve that is not linear, behind two lags: errors at each jump."""
    run = recorded(valve_flexure__lag_time=0.003, valve_flexure__second_lag_time=0.002)
    share = run.valve_position_m / np.abs(run.valve_position_m).max()
    bent = run.valve_position_m + 0.05 * np.abs(run.valve_position_m).max() * np.tanh(
        3.0 * share) ** 2
    with pytest.warns(InputWarning, match='without the force'):
        diagnosis = diagnose([Run(run.time_s, command_n=run.command_n, valve_position_m=bent,
                                  source='real')], TEXTBOOK)
    assert max(diagnosis.joined.values()) < 0.9


@pytest.mark.slow
@pytest.mark.parametrize('spread', [0.0008, 0.0031])
def test_errors_of_an_uneven_delay_are_made_white(monkeypatch, spread):
    """Mean and covariance are those of many runs of the simulator; better with finer cuts."""
    time = np.arange(1200) * 1e-3
    command = 500.0 * np.sign(np.sin(2.0 * np.pi * 12.0 * time + 0.1))
    late, noise = REAL | {'command_path.delay': 0.0031}, 2e-8
    even = simulate(as_record(late), command, 1e-3).valve_position_m
    runs = [simulate(as_record(late | {
        'command_path.delay_spread': spread, 'force_sensor.noise_seed': seed}),
        command, 1e-3).valve_position_m - even for seed in range(1, 2001)]
    recording = prepare([Run(time, command_n=command, force_n=0.0 * even,
                             valve_position_m=even, source='real')])[0]
    known = np.ones(1200, bool)

    def variance():
        mean, factor = uneven(recording, as_record(late), spread, noise ** 2)
        late_, sensor = ([whitened_by(factor, each - off, known) for each in errors]
                         for errors, off in ((runs, mean), (noise * np.eye(1200), 0.0)))
        white = np.mean(np.square(late_), axis=0) + np.sum(np.square(sensor), axis=0)
        return white[150:] / noise ** 2   # before it begins, the command may have been another

    coarse = variance()
    assert coarse.mean() == pytest.approx(1.0, abs=0.05)
    assert coarse.max() < 1.2   # else chance would be taken for an effect
    monkeypatch.setattr(uneven_delay, 'CUTS', 16)
    assert variance().min() > coarse.min() + 0.1


@pytest.mark.slow
def test_a_supply_that_sags_may_have_been_in_use_before_the_recording():
    """It is not in steady state at the mean opening of the valve."""
    run = recorded(valve_characteristic__supply_sag=0.9,
                   valve_characteristic__supply_time=0.6)[2500:]
    assert diagnose([run], TEXTBOOK).verdict == ('supply_pressure',)


@pytest.mark.slow
def test_two_effects_behind_the_valve_of_a_linear_machine_are_both_named():
    diagnosis = diagnose([recorded(
        force_sensor__gain=0.6, coupling__stiffness=5e5, coupling__damping=15.0,
        coupling__piston_share=0.25)], TEXTBOOK)
    assert diagnosis.verdict == ('load_compliance', 'sensor_gain')
    improved = improved_of(diagnosis, TEXTBOOK)
    assert improved['force_sensor.gain'] == pytest.approx(0.6, rel=0.15)
    assert improved['coupling.stiffness'] == pytest.approx(5e5, rel=0.5)


@pytest.mark.slow
def test_what_no_law_explains_is_unknown():
    run = recorded()[:1500]
    ripple = 6.0 * np.sin(2.0 * np.pi * run.position_m / 3e-4)
    assert diagnose([replace(run, force_n=run.force_n + ripple)],
                    TEXTBOOK).verdict == ('unknown',)


def test_only_a_wholly_linear_model_has_one_formulation():
    assert has_linear_laws(TEXTBOOK)
    assert not has_linear_laws({**TEXTBOOK, 'friction.model': 'full'})
    assert not has_linear_laws({})


def test_step_of_a_parameter_without_influence_stays_within_its_bounds():
    step, _ = least_step(np.diag([1.0, 0.0]), np.array([-0.5, 0.0]), np.full(2, -0.3),
                         np.full(2, 0.3))
    assert (np.abs(step) <= 0.3).all()


def test_there_is_no_step_of_what_is_not_finite():
    """As of a resonance that grows beyond all numbers at an initial guess."""
    step, gain = least_step(np.diag([1.0, np.inf]), np.array([-0.5, 0.0]), np.full(2, -0.3),
                            np.full(2, 0.3))
    assert not step.any() and gain == -np.inf


def test_step_within_bounds_is_where_no_bound_holds_it_back():
    """Of parameters that act nearly alike; at a bound the cost rises inwards, else it is flat."""
    rng = np.random.default_rng(5)
    for _ in range(50):
        rows = rng.standard_normal((40, 1)) + 0.05 * rng.standard_normal((40, 12))
        square, slope = rows.T @ rows, rows.T @ rng.standard_normal(40)
        step, gain = least_step(square, slope, np.full(12, -0.3), np.full(12, 0.3))
        push, size = slope + square @ step, np.abs(slope).max()
        assert gain == pytest.approx(-(slope + 0.5 * square @ step) @ step)
        assert np.abs(push[np.abs(step) < 0.3]).max(initial=0.0) < 1e-6 * size
        assert (push[step == 0.3] <= 1e-6 * size).all()
        assert (push[step == -0.3] >= -1e-6 * size).all()


@pytest.mark.slow
@pytest.mark.parametrize('damping', [0.0, 375.7])
def test_improved_model_of_friction_is_the_machine(damping):
    """Its own friction, with a thrust that is off, is explained to the noise when simulated."""
    run = recorded(friction__model='full', friction__coulomb=20.0, friction__stiction_push=20.0,
                   friction__stiction_pull=20.0, friction__presliding_damping=damping,
                   valve_characteristic__maximum_force=1100.0)[:1500]
    diagnosis = diagnose([run], TEXTBOOK)
    assert diagnosis.verdict == ('coulomb_friction',)
    again = simulate(as_record(improved_of(diagnosis, TEXTBOOK)), run.command_n, run.period_s)
    assert np.std(again.force_n - run.force_n) < 1.1   # N; the noise is 1 N


def test_gain_of_the_valve_goes_with_its_opening():
    run = recorded(valve_characteristic__maximum_force=1150.0)
    values = improved_of(diagnose([run], TEXTBOOK, simulate=False), TEXTBOOK)
    again = simulate(as_record(values), run.command_n, run.period_s)
    for name in ('force_n', 'valve_position_m'):
        real = getattr(run, name)
        assert np.std(getattr(again, name) - real) < 0.03 * np.std(real)


@pytest.mark.slow
def test_unknown_gap_adds_no_improbable_effect():
    run = recorded()[:3000]
    uneven = 8.0 * np.sign(np.sin(2.0 * np.pi * run.position_m / 1e-3))
    diagnosis = diagnose([replace(run, force_n=run.force_n + uneven)], TEXTBOOK)
    assert diagnosis.verdict == ('unknown',)
    assert [diagnosis.best(each).names for each in diagnosis.groups] == [(), ()]


@pytest.mark.slow
def test_free_load_is_explained():
    free = {'load.type': 'free'}
    run = recorded(real={**REAL, **free}, force_sensor__offset=20.0)[:1500]
    assert diagnose([run], {**TEXTBOOK, **free}).verdict == ('sensor_offset',)


WIDENING = {'valve_hysteresis.widening': 1.5, 'valve_hysteresis.widening_range': 300.0}


@pytest.mark.parametrize('values', [
    {}, {'valve_hysteresis.lagged': 1.0}, WIDENING, {**WIDENING, 'valve_hysteresis.lagged': 1.0},
    {'valve_hysteresis.model': 'linear', 'valve_hysteresis.lagged': 1.0}], ids=str)
def test_valve_of_the_block_wise_fits_is_the_simulators(values):
    p = plant_record(values)
    period, time = 2e-4, 2e-4 * np.arange(3000)
    command = 200.0 * np.sin(30.0 * time) + 60.0 * np.sin(145.0 * time + 1.0)
    valve = np.empty(time.size)
    blocks.valve(command, *blocks.parts(p), period, 8, valve, blocks.AT_REST)
    simulated = simulate(as_record(values), command, period).valve_position_m
    assert np.std((valve - simulated)[1000:]) < 1e-3 * np.std(simulated)


def test_a_fit_with_long_sub_steps_ends_where_one_with_short_ones_does():
    """The frequency of a resonance changes the integration error: its correction does not."""
    nominal = TEXTBOOK | {'valve_flexure.natural_frequency': 890.0}
    run = recorded(real=nominal | {'valve_flexure.coil_frequency': 23.0,
                                   'valve_flexure.delay': 0.00083})
    coarse = null_fit(simulator_group(simulator_record(nominal), prepare([run]), ('valve',),
                                      linear=True))
    fine, = with_fine_substeps({(): coarse}).values()

    def gain(found):
        """Return what a fit without longer sub-steps still gains, nats."""
        fixed = {'maximum_substep': found.problem.group.exact_substep_s}
        exact = found._replace(problem=replace(found.problem, fixed=tuple(fixed.items())))
        exact = exact.at(found.best.theta)
        return exact.best.cost - exact._replace(best=exact.best._replace(
            slopes=None)).refined(converged=0.0).best.cost

    assert gain(fine) < 0.5 < gain(coarse)


@pytest.mark.slow   # test_small_effect_is_found_beside_parameters_that_are_off names another
@pytest.mark.parametrize('missing', [(), ('position_m', 'velocity_m_s')])
def test_friction_behind_the_sensor_of_a_locked_load_is_named(missing):
    """The damper of the structure takes it up."""
    locked = {'load.type': 'locked'}
    run = recorded(real={**REAL, **locked, 'load.locked_damping': 15000.0})[:1500]
    run = replace(run, **dict.fromkeys(missing))
    diagnosis = diagnose([run], {**TEXTBOOK, **locked})
    assert diagnosis.verdict == ('viscous_friction',)
    assert improved_of(diagnosis, TEXTBOOK)['load.locked_damping'] == pytest.approx(15000.0,
                                                                                   rel=0.1)


def test_a_special_case_of_the_best_fit_is_fitted_from_its_values():
    """Stiction that is no larger than Coulomb friction is Coulomb friction in the same form."""
    friction = {'friction_coulomb': 20.0, 'friction_stiction_push': 20.0,
                'friction_stiction_pull': 20.0, 'friction_presliding_slip': 0.13,
                'friction_element_ratio': 1.8, 'friction_presliding_damping': 0.0}
    run = recorded(friction__model='full', **{
        name.replace('friction_', 'friction__'): value for name, value in friction.items()})
    group = simulator_group(simulator_record(REAL), prepare([run[:1500]]), ('force', 'velocity'),
                            linear=True)

    def fitted(name, variant, values):
        """Return a form of an effect, with given values where its parameters are free."""
        problem = Posterior(group, (*group.nuisance, *variant.free), variant.fixed)
        theta = np.array([problem.parameter(free).share(values[free.field])
                          if free.field in values else share
                          for free, share in zip(problem.free, problem.nominal, strict=True)])
        residual = problem.residual(theta)
        best = Best(theta, problem.cost(theta, residual), residual)
        return Found((name,), (variant,), problem, best)

    stiction = fitted('stiction', next(
        variant for variant in EFFECTS['stiction']
        if {free.field for free in variant.free} >= friction.keys()), friction)
    elsewhere = friction | {'friction_coulomb': 200.0, 'friction_presliding_slip': 1.0}
    forms = [fitted(name, variant, elsewhere) for name in ('coulomb_friction', 'viscous_friction')
             for variant in EFFECTS[name]]
    special = special_cases(stiction, forms)
    assert {each.names for each in special} == {('coulomb_friction',)}
    # Cylinder or behind the sensor: only in the right place it explains as much.
    costs = [from_values_of(stiction, each, math.inf).best.cost for each in special]
    assert min(costs) < stiction.best.cost + 5.0


def test_a_lag_of_two_poles_is_compared_as_one_of_one_pole_too():
    """What is free without need costs an effect probability beside one of fewer parameters."""
    run = recorded(valve_flexure__lag_time=0.004)[:1500]
    group = simulator_group(simulator_record(REAL), prepare([run]), ('valve',), linear=True)
    one, two, _ = EFFECTS['valve_lag']
    bias, _ = EFFECTS['valve_bias']
    problem = Posterior(group, (*group.nuisance, *two.free, *bias.free))
    best = most_probable(problem, problem.nominal)
    for names, variants in ((('valve_lag', 'valve_bias'), (two, bias)),
                            (('valve_bias', 'valve_lag'), (bias, two))):
        simpler, = simpler_forms(Found(names, variants, problem, best), math.inf)
        assert {*simpler.variants} == {one, bias} and simpler.names == names
        assert {free.field for free in simpler.problem.free} == {
            free.field for free in problem.free} - {'valve_flexure_second_lag_time'}
        assert simpler.best.cost < best.cost + 5.0


@pytest.mark.slow   # test_a_special_case_of_the_best_fit_is_fitted_from_its_values
def test_a_nominal_parameter_that_a_simpler_form_does_not_free_has_its_prior_again():
    group = simulator_group(simulator_record({'load.type': 'spring'}), prepare(
        [recorded()[:1000]]), ('force', 'velocity'))
    _, two, *_ = EFFECTS['stiction']
    problem = Posterior(group, (*(free for free in group.nuisance if free.field not in {
        each.field for each in two.free}), *two.free))
    theta = problem.nominal
    simpler = next(simpler_forms(Found(('stiction',), (two,), problem, Best(
        theta, problem.cost(theta), problem.residual(theta))), math.inf))
    pull, = (free for free in simpler.problem.free if free.field == 'friction_stiction_pull')
    assert pull.prior < math.inf


@pytest.mark.slow
def test_a_pair_that_is_far_off_where_a_chirp_begins_is_fitted_to_the_end():
    """Its first part hardly shows the masses; the rough fit was taken to be hopeless."""
    time = np.arange(4000) * 1e-3
    command = 400.0 * chirp(time, 0.5, time[-1], 60.0, phi=-90.0)
    real = simulate(as_record({**REAL, 'coupling.stiffness': 2e5, 'coupling.damping': 10.0,
                               'coupling.piston_share': 0.4, 'force_sensor.gain': 0.63}),
                    command, 1e-3)
    rng = np.random.default_rng(5)
    noise = {'force_n': 1.0, 'valve_position_m': 2e-8, 'position_m': 1e-6, 'velocity_m_s': 5e-4}
    run = Run(time, command_n=command, **{
        name: getattr(real, name) + level * rng.standard_normal(time.size)
        for name, level in noise.items()})
    assert diagnose([run], TEXTBOOK).verdict == ('load_compliance', 'sensor_gain')


@pytest.mark.slow
@pytest.mark.parametrize(('softening', 'stribeck'), [(0.0, 0.005), (1.0, 1e-6)])
def test_friction_whose_elements_slide_one_by_one_is_asymmetric(softening, stribeck):
    """With asymmetry for Dahl's law alone, this was even friction of elements, with certainty."""
    answer = diagnose([recorded(
        friction__model='full', friction__softening=softening,
        friction__stribeck_velocity=stribeck, friction__coulomb=30.0, friction__stiction_push=30.0,
        friction__stiction_pull=30.0, friction__presliding_stiffness=2.3e6,
        friction__presliding_slip=0.17, friction__element_ratio=1.8,
        friction__presliding_damping=630.0, friction__coulomb_asymmetry=0.57)], TEXTBOOK)
    assert answer.verdict == ('friction_asymmetry',)
    assert answer.joined[answer.verdict] > 0.9
    sizes = document(answer)['which'][0]['parameters']
    assert sizes['friction_coulomb_asymmetry'] == pytest.approx(0.57, abs=0.06)


def test_friction_that_hardly_slides_is_a_spring():
    """By Dahl's law all of the motion slides a little; elements slide one after the other."""
    run = recorded()[:3000]
    assert 1.5e-3 < np.abs(run.position_m).max() < 1.9e-3

    group = simulator_group(simulator_record(REAL), prepare([run]), ('force', 'velocity'),
                            linear=True)

    def is_spring(stiffness, **more):
        values = {'friction_model': FULL, 'friction_coulomb': 200.0,
                  'friction_presliding_stiffness': stiffness, **more}
        p = group.nominal.copy()
        for name, value in values.items():
            p[name] = value
        free = EFFECTS['coulomb_friction'][2].free
        found = SimpleNamespace(variants=[SimpleNamespace(free=free)], best=SimpleNamespace(
            theta=None), problem=SimpleNamespace(group=group, record=lambda _: p))
        return never_slides(found)

    dahl, elements = {'friction_presliding_slip': 1.0}, {'friction_element_ratio': 3.0}
    assert [is_spring(2e3, **dahl), is_spring(1.5e4, **dahl)] == [True, False]
    assert [is_spring(5e4), is_spring(5e4, **elements), is_spring(2e5)] == [True, False, False]
    # With more friction in one direction than in the other.
    assert is_spring(1.5e4, friction_coulomb_asymmetry=0.8, **dahl)


def test_beside_an_improbable_best_fit_what_mostly_explains_is_fitted_to_the_end():
    """If the best fit is probable, what is far above it cannot be the answer."""
    def leaving(residual, cost, improbable=False):
        return SimpleNamespace(
            relative_residual=np.array([residual]), improbable=improbable, largest_cost=1e3,
            best=SimpleNamespace(cost=cost), problem=SimpleNamespace(noise_cost=9e2))

    null = leaving(1e3, 1e6)
    probable, improbable = (_goal(leaving(1.0, 9e2, each), null) for each in (False, True))
    assert probable < 1e3 and improbable == pytest.approx(5.1e4)
    assert _goal(leaving(90.0, 9e4), null) == pytest.approx(9e4)   # it must leave less
