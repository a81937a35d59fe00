"""What the answer says beside the verdict: shares of a pair, limits of tolerance, what next."""

import dataclasses
import re
from types import SimpleNamespace

import numpy as np
import pytest
from documented import problems
from test_gap import TEXTBOOK, recorded

from asi_actuator.model.effects import BLOCKS
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.gap.actuator import actuator_groups
from asi_analysis.gap.answer.command import diagnose as asi_diagnose
from asi_analysis.gap.answer.command import (
    model_tolerances,
    nominal_model,
    parse_tolerances,
    recorded_model,
)
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.document import document, plain
from asi_analysis.gap.experiment.next_experiment import suggestion
from asi_analysis.gap.findings import localisation
from asi_analysis.gap.findings.localisation import by_block, explained
from asi_analysis.gap.inference.fit import LinearScreen, fit_null, fit_variants
from asi_analysis.gap.inference.hypotheses import Candidate, Weighed, effective_hypotheses
from asi_analysis.gap.model.effects import EFFECTS
from asi_analysis.gap.words import between, in_words, percent, sentences, unit_of, with_id


def weighed_pair(run: Run, forms: dict[str, int]) -> Weighed:
    """Return a recording that is surely of a pair of effects, each in the form of this number."""
    group = actuator_groups([run], TEXTBOOK, 0.2, [False])[0][-1]
    null, names = fit_null(group), tuple(forms)
    variants = tuple(EFFECTS[name][form] for name, form in forms.items())
    both = Candidate(names, variants, fit_variants(group, LinearScreen(null), variants))
    return Weighed(group, {(): Candidate((), (), null), names: both}, {(): 0.0, names: 1.0})


@pytest.mark.slow
def test_shares_of_blocks_are_numbers():
    """Without a backlash, what a form of it fixes beside its size is null too."""
    run = recorded(backlash__gap=3e-4, force_sensor__offset=15.0)[:2500]
    floating = EFFECTS['backlash'][2]
    assert floating.fixed == (('backlash_floating', 1.0),)
    share = by_block([weighed_pair(run, {'backlash': 2, 'sensor_offset': 0})])
    assert sum(share.values()) == pytest.approx(1.0) and share['mechanics'] > 0.1


def test_each_effect_of_a_pair_has_the_share_that_it_explains():
    run = recorded(load__external_force=80.0, force_sensor__offset=15.0)
    weighed = weighed_pair(run, {'disturbance_force': 0, 'sensor_offset': 0})
    found = explained(weighed, ('disturbance_force', 'sensor_offset'), 'load')
    assert 0.0 < found['sensor_offset'] < 0.5 * found['disturbance_force']
    share = by_block([weighed])
    assert share['mechanics'] > 0.5 and 0.0 < share['sensor'] < 0.45
    assert sum(share.values()) == pytest.approx(1.0)


def test_effect_of_size_zero_is_no_hypothesis():
    costs = {(): 100.0, ('valve_lag',): 50.0, ('valve_bias',): 99.95,
             ('valve_bias', 'valve_lag'): 49.99, ('transport_delay', 'valve_lag'): 40.0}
    found = {names: Candidate(names, (), SimpleNamespace(cost=cost))
             for names, cost in costs.items()}
    assert set(effective_hypotheses(found)) == {
        (), ('valve_lag',), ('transport_delay', 'valve_lag')}


@pytest.mark.slow
def test_parameter_at_the_limit_of_its_tolerance_is_said():
    heavy = {**TEXTBOOK, 'load.mass': 0.5 * 1.26}
    # Block by block, a tolerance is a bound.
    answer = plain(document(diagnose([recorded(real=heavy)], TEXTBOOK, simulate=False)))
    limit = next(row for row in answer['at_limit'] if row['parameter'] == 'load.mass')
    assert limit['limit'] == 'high'
    assert limit['value'] == pytest.approx(1.2 * limit['nominal'], rel=1e-3)
    assert 'At the limit of the tolerance: ' in ' '.join(sentences(answer))
    answer |= {'report': None, 'exports': [], 'quality': [], 'reliable': True}
    assert problems(answer, 'asi gap') == []


@pytest.mark.parametrize(('times', 'sure'), [
    (1.25, False), pytest.param(1.6, True, marks=pytest.mark.slow)])
def test_parameter_beyond_its_tolerance_is_an_answer(times, sure):
    """At the edge other parameters and a sensor's gain do the same; they share the probability."""
    stiff = {**TEXTBOOK, 'load.stiffness': 2e5 * times}
    answer = plain(document(diagnose([recorded(real=stiff)[:1500]], TEXTBOOK)))
    name = 'parameter:load.stiffness'
    assert name in answer['ambiguity_set']
    row = next(row for row in answer['which'] if row['effect'] == name)
    assert row['block'] == 'mechanics'
    assert (answer['probability'] > 0.9) == sure
    if sure:
        assert answer['verdict'] == name
        assert row['parameters']['load_stiffness'] == pytest.approx(2e5 * times, rel=0.1)
        assert 'load.stiffness is 1.6' in sentences(answer)[0]
        assert 'beyond the tolerance of 20 %' in sentences(answer)[0]


def test_a_parameter_may_have_a_tolerance_of_its_own(tmp_path):
    stiff = recorded(real={**TEXTBOOK, 'load.stiffness': 3.2e5})
    known = diagnose([stiff], TEXTBOOK, tolerances={'load.stiffness': 0.7})
    assert known.verdict == ()
    fitted = document(known)['nuisance']['velocity']
    assert fitted['load_stiffness'] == pytest.approx(3.2e5, rel=0.1)
    with pytest.raises(InputError, match='tolerance load.radius: no uncertain .* load.mass'):
        diagnose([stiff], TEXTBOOK, tolerances={'load.radius': 0.7})
    assert parse_tolerances(['0.3', 'load.mass=0.5']) == (0.3, {'load.mass': 0.5})
    for text in ('load.mass=2', 'load.mass', 'load.mass=much', '0'):
        with pytest.raises(InputError, match=f'tolerance {text} is not allowed: a share from'):
            parse_tolerances([text])
    path = tmp_path / 'model.yaml'
    path.write_text('asi_actuator: {ros__parameters: {load.mass: 0.5}}\n'
                    'asi_gap: {ros__parameters: {tolerance: {load.mass: 0.5}}}\n')
    assert model_tolerances(path) == {'load.mass': 0.5}
    assert nominal_model(path) == {'load.mass': 0.5}


def test_words_of_a_joint_have_no_valve():
    assert with_id('valve_deadband', 'actuator') == 'dead band of the valve (valve_deadband)'
    assert with_id('backlash', 'actuator') == 'backlash'
    named = [in_words(name, 'joint') for name in (*EFFECTS, *BLOCKS)]
    assert not any('valve' in each for each in named)
    torque = Run(np.arange(4.0), command_n=np.zeros(4), position_m=np.zeros(4),
                 information={'signals': {'command': 'Nm', 'position': 'rad'}})
    assert [unit_of(unit, 'load', torque, 'joint') for unit in ('N', 'N s/m', 'kg', 's')] == [
        'Nm', 'Nm s/rad', 'Nm s2/rad', 's']
    register = dataclasses.replace(torque, information={
        'signals': {'command': '1', 'position': 'rad'}})
    assert [unit_of(unit, 'load', register, 'joint')
            for unit in ('N', 'N s/m', 'kg', 'N/m', '1/s')] == [
        '', 's/rad', 's2/rad', '1/rad', '1/s']
    counts = dataclasses.replace(torque, information={
        'signals': {'command': 'N', 'position': '1'}})
    assert [unit_of(unit, 'load', counts, 'joint') for unit in ('N', 'N s/m', 'N s2/m2', 'm')] == [
        'N', 'N s', 'N s2', '']
    curve = Run(np.arange(4.0), command_n=np.arange(4.0), position_m=np.arange(4.0),
                information={'signals': {'command': '1', 'position': 'mV'}})
    assert [unit_of(unit, 'static', curve, 'static')
            for unit in ('input', 'output', 'output/input', 'output/input2')] == [
        '', 'mV', 'mV', 'mV']


def answer_of(verdict: str, **changed: object) -> dict[str, object]:
    """Return the part of an answer that becomes sentences."""
    gap = {'signal': 'force', 'channel': 'load', 'noise_floor_nrmse': 0.02,
           'before_nrmse': 0.902, 'refitted_nrmse': 0.9, 'after_nrmse': 0.915,
           'shrink': -0.015, 'shrink_low': -0.07, 'shrink_high': 0.036}
    return {'plant': 'joint', 'verdict': verdict, 'probability': 0.5, 'ambiguity_set': [verdict],
            'at_limit': [], 'which': [], 'where': [{'block': 'mechanics', 'share': 1.0}],
            'next_experiment': None, 'baseline': None, 'unexplained': '', 'gap': gap} | changed


def test_an_error_that_rises_is_not_said_to_fall():
    text = ' '.join(sentences(answer_of('coulomb_friction')))
    assert 'rises from 90.2 % to 91.5 %' in text
    assert 'does not shrink: its shrink is -1.5 %' in text
    answer = answer_of('coulomb_friction')
    answer['gap'] = {**answer['gap'], 'after_nrmse': 0.902, 'shrink': 0.0}   # type: ignore
    assert 'stays at 90.2 %' in ' '.join(sentences(answer))


def test_only_no_error_is_said_to_be_none():
    assert [percent(share) for share in (0.0, 1e-9, 4e-6, 6e-6, 0.0968)] == [
        '0 %', 'below 0.001 %', 'below 0.001 %', '0.001 %', '9.68 %']


@pytest.mark.parametrize(('change', 'begins'), [
    ('none', 'Nothing has'), ('cannot_tell', 'Perhaps nothing has')])
def test_what_is_uncertain_is_not_said_to_be_so(change: str, begins: str):
    healthy = {'change': change, 'sources': ['a'], 'parameters': [], 'left': [
        {'channel': 'load', 'signal': 'force', 'healthy_nrmse': 0.1, 'now_nrmse': 0.1}]}
    said = sentences(answer_of('no_gap', baseline=healthy))
    assert any(sentence.startswith(begins) for sentence in said)


@pytest.mark.parametrize(('value', 'low', 'high', 'text'), [
    (1.41, 1.38, 1.45, '1.41 m (1.38 to 1.45)'), (150.0, 0.0, 1e4, '150 m (0.00 to 1.00e+04)'),
    (-30.0, -40.0, -20.0, '-30.0 m (-40.0 to -20.0)'),
    (2e-4, 1.9996e-4, 2.0004e-4, '0.000200 m ± 0.02 %')])
def test_a_size_has_three_digits_and_its_interval(value, low, high, text):
    assert between(value, low, high, 'm') == text


@pytest.mark.parametrize(('separation', 'missing', 'words', 'command'), [
    (8.0, [], 'record this: chirp (asi run)', True),
    (3e-6, [], 'no recording of these signals separates them: measure the pressure', False),
    (3e-6, ['position'], 'record the position too', False),
    (8.0, ['position'], 'record the position too; record this: chirp (asi run)', True)])
def test_next_experiment_is_only_suggested_if_it_separates(separation, missing, words, command):
    left = [('entrained_air',), ('sensor_lag',)]
    found = suggestion('chirp', 'asi run', separation, {'chirp': separation}, left, missing)
    assert found['advice'].startswith(words)
    assert (found['command'] is not None) == found['separates'] == command


@pytest.mark.slow
def test_model_is_what_the_bag_tells_unless_another_is_given():
    recorded_values = {**TEXTBOOK, 'load.stiffness': 2.2e5}
    run = dataclasses.replace(recorded()[:1000], information={'actuator': recorded_values})
    assert recorded_model([run]) == recorded_values
    told = 'recorded with the load spring, .* has the load locked'
    with pytest.warns(InputWarning, match=told):
        answer = asi_diagnose([run], {**TEXTBOOK, 'load.type': 'locked'})
    # A locked load that gives way is a spring.
    assert answer['verdict'] == 'load_compliance'
    assert any(re.search(told, note) for note in answer['notes'])
    spoilt = dataclasses.replace(run, information={'actuator': {'load.type': 'cloud'}})
    with pytest.raises(InputError, match='real: metadata of the run: load.type'):
        asi_diagnose([spoilt])
    with pytest.raises(InputError, match='--set: load.mass'):
        asi_diagnose([run], settings=['load.mass=-1.0'])


def test_force_of_a_spring_is_not_that_of_a_free_load():
    with pytest.raises(InputError, match='or the model: its load is free'):
        diagnose([recorded()], {**TEXTBOOK, 'load.type': 'free'}, simulate=False)


def test_setting_overrides_what_the_bag_tells():
    run = dataclasses.replace(recorded()[:1500], information={'actuator': TEXTBOOK})
    answer = asi_diagnose([run], settings=['load.stiffness=220000.0'])
    assert answer['verdict'] == 'no_gap'
    assert answer.model == {**TEXTBOOK, 'load.stiffness': 2.2e5}
    assert answer['notes'][0] == (
        'nominal model: from the metadata of real; load spring, 1000 Hz')


@pytest.mark.slow
def test_effects_of_the_nominal_model_are_said_to_be_approximate():
    run = dataclasses.replace(recorded()[:1000], information={'actuator': TEXTBOOK})
    # A hysteresis without width: its law could be formulated in another way than the simulator's.
    notes = asi_diagnose([run], settings=['load.external_force=1.0', 'valve_hysteresis.model=full',
                                          'valve_hysteresis.radius=0.0'])['notes']
    assert sum('load.external_force, which the diagnosis does not' in note for note in notes) == 1
    assert not any('which the diagnosis does not' in note for note in asi_diagnose([run])['notes'])


def test_a_ripple_by_the_position_is_told_with_its_period(monkeypatch):
    """Two recordings, whose positions have other origins; beside noise and a slow course."""
    rng, time = np.random.default_rng(1), np.linspace(0.0, 10.0, 4000)
    turned = 0.8 * np.sin(1.3 * time) + 0.1 * np.sin(7.1 * time)
    rest = np.sin(40.0 * turned) + 0.3 * rng.standard_normal(time.size) + 0.2 * np.sin(0.3 * time)
    recordings = [SimpleNamespace(
        motion=SimpleNamespace(position=turned + origin, inner=slice(None), measured=True),
        valid=np.ones(time.size, bool), fit=np.ones(time.size, bool)) for origin in (0.0, 0.3)]
    monkeypatch.setattr('asi_analysis.gap.findings.localisation.unexplained', lambda *_: rest)
    found = localisation.ripple(SimpleNamespace(recordings=recordings), 'load', None)
    assert found.period == pytest.approx(2.0 * np.pi / 40.0, rel=0.01)
    assert found.share == pytest.approx(0.5 / np.mean(rest ** 2), rel=0.1)
    words = localisation.in_words([], {'position': 0.1, 'velocity': 0.3}, found, 'rad')
    assert 'a ripple with a period of 0.15' in words and 'of the velocity' in words
