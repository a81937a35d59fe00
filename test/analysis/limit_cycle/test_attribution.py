"""Attribution of a limit cycle: ablation of the model, and shape of other loops' recordings."""

import json

import numpy as np
import pytest
from documented import problems
from study import STUDY, STUDY_CONTROLLER

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.experiments.experiment import Experiment, checked, information
from asi_analysis.limit_cycle.attribution import figure, valves
from asi_analysis.limit_cycle.attribution.ablation import (
    NONLINEARITIES,
    PARTS,
    attribute_model,
    owen,
    shapley,
)
from asi_analysis.limit_cycle.attribution.classifier import LEAST_PROBABILITY, WEIGHTS
from asi_analysis.limit_cycle.attribution.recording import _weighed, attribute_cycle
from asi_analysis.limit_cycle.attribution.shape import FEATURES, shape
from asi_analysis.limit_cycle.detection.agreement import judge_run
from asi_analysis.limit_cycle.detection.verdict import Segment
from asi_analysis.loop.closed_loop import simulate_loop
from asi_analysis.loop.in_process import simulate
from asi_analysis.reporting.report import write_pictures
from bench.jumping_loads import chances
from bench.train_attribution import examples, validate
from bench.valve_loops import (
    VALVES,
    Inputs,
    Plant,
    Valve,
    _oscillates,
    _plant,
    loop,
    run_loop,
    run_without_noise,
    ultimate_gain,
)


def test_shapley_values_add_up_and_share_what_only_a_pair_does():
    # A game of known values: 6 for the first alone, 4 more for second and third together.
    def worth(subset):
        return (6.0 * (NONLINEARITIES[0] in subset)
                + 4.0 * ({NONLINEARITIES[1], NONLINEARITIES[2]} <= set(subset)))
    from itertools import combinations
    subsets = [s for size in range(5) for s in combinations(NONLINEARITIES, size)]
    values = shapley({subset: worth(subset) for subset in subsets})
    assert list(values.values()) == pytest.approx([6.0, 2.0, 2.0, 0.0])


def test_owen_values_divide_the_share_of_the_hysteresis():
    # 6 for the first part, 4 more for the other two together, 3 more with friction beside any.
    def worth(others, parts):
        return (6.0 * ('static_loop' in parts) + 4.0 * ({'rate', 'iron_saturation'} <= set(parts))
                + 3.0 * ('friction' in others and bool(parts)))
    from itertools import combinations
    values = owen({(others, parts): worth(others, parts)
                   for n in range(4) for others in combinations(NONLINEARITIES[1:], n)
                   for k in range(4) for parts in combinations(PARTS, k)})
    assert list(values.values()) == pytest.approx([6.5, 2.5, 2.5])


def test_parts_of_the_hysteresis_share_what_it_has(table):
    parts = {part['part']: part for part in table['hysteresis_parts']}
    whole = next(c for c in table['causes'] if c['nonlinearity'] == 'valve_hysteresis')
    assert sum(part['share'] for part in parts.values()) == pytest.approx(whole['share'])
    assert parts['rate']['alone_frequency_hz'] is not None


@pytest.fixture(scope='module')
def table():
    return attribute_model(STUDY, STUDY_CONTROLLER | {'reference.amplitude': 100.0}, 5000.0)


def test_hysteresis_alone_is_necessary_and_sufficient_as_the_paper_concludes(table):
    by_name = {cause['nonlinearity']: cause for cause in table['causes']}
    assert [name for name, c in by_name.items() if c['necessary'] and c['sufficient']] == [
        'valve_hysteresis']
    assert not any(c['necessary'] or c['sufficient'] for name, c in by_name.items()
                   if name != 'valve_hysteresis')
    # Section 4.2: damping regulates the amplitude, which is far too large without it.
    assert by_name['hydraulic_damping']['share'] < -0.1
    assert 'valve hysteresis causes the cycle' in table['verdict']


def test_balance_meets_each_simulated_cycle_of_the_table(table):
    compared = 0
    for cause in table['causes']:
        for prefix in ('alone', 'all_but'):
            if cause[f'{prefix}_frequency_hz'] is None:
                continue
            compared += 1
            assert cause[f'{prefix}_predicted_frequency_hz'] == pytest.approx(
                cause[f'{prefix}_frequency_hz'], rel=0.02)
            assert cause[f'{prefix}_predicted_amplitude_n'] == pytest.approx(
                cause[f'{prefix}_amplitude_n'], rel=0.05)
    assert compared == 4
    assert problems(table, 'asi attribute') == []


@pytest.mark.slow
def test_linear_instability_is_not_blamed_on_a_nonlinearity():
    found = attribute_model(STUDY, STUDY_CONTROLLER | {'reference.amplitude': 100.0}, 5000.0,
                            gain=14.0)
    assert 'linear instability' in found['verdict']


def test_play_and_stiction_do_what_their_words_say():
    up_and_down = np.concatenate([np.linspace(0, 1, 101), np.linspace(1, 0, 101)[1:]])
    play = valves.play(up_and_down, 0.2, 1)
    assert play[100] == pytest.approx(0.8) and play[120] == pytest.approx(0.8)
    assert play[-1] == pytest.approx(0.2)
    # It sticks at the reversal, leaps by 0.3 once the command is 0.5 back, and then follows it.
    stuck = valves.stick(up_and_down, 0.5, 0.3, 1)
    jumps = np.abs(np.diff(stuck[100:]))
    assert jumps.max() == pytest.approx(0.3, abs=0.02) and (jumps > 0.02).sum() == 1
    assert stuck[-1] == pytest.approx(0.1)
    # Without a leap it is a play of half the band.
    assert valves.stick(up_and_down, 0.4, 0.0, 1)[110:] == pytest.approx(play[110:], abs=0.011)


def _loop(cause: str, seed: int, world: str = 'learn') -> Run:
    random = np.random.default_rng(seed)
    run = None
    while run is None:
        run = loop(cause, random, world)
    return run


@pytest.mark.parametrize('world', VALVES)
def test_fault_is_the_cause_of_the_simulated_swing(world):
    # What `loop` leaves out for want of a cycle: a valve without fault in a loop that is stable.
    random = np.random.default_rng(3)
    plant = _plant(world, random)
    plant = plant._replace(gain=0.3 * ultimate_gain(plant, 4000))
    assert not _oscillates(run_without_noise(plant, Valve(), 1e9, 4000)[1])
    unstable = plant._replace(gain=8.0 * plant.gain)
    assert _oscillates(run_without_noise(unstable, Valve(), 1.0, 4000)[1])


def test_document_and_picture_of_a_foreign_loop(tmp_path):
    run = _loop('stiction', 77)
    found = attribute_cycle(run)
    assert problems(found, 'asi attribute BAG') == []
    assert sum(cause['probability'] for cause in found['causes']) == pytest.approx(1.0)
    page = write_pictures(tmp_path, 'title', str(found),
                          {'attribution': (figure.recorded(run, found), found['verdict'])})
    assert (tmp_path / 'attribution.png').read_bytes().startswith(b'\x89PNG')
    assert '<svg' in page.read_text() and found['verdict'].split(':')[0] in page.read_text()


def test_weights_are_right_on_loops_of_other_equations():
    features, causes = examples('judge', 5, seed=99)
    found = validate(features, causes, json.loads(WEIGHTS.read_text()))
    assert found['right'] > 0.5      # six causes: chance is 0.17
    # What it says of itself is not better than what it is.
    assert found['mean_probability'] < found['right'] + 0.15


def test_no_valve_is_blamed_for_a_tight_loop_that_its_sensor_shakes():
    # As Choudhury, Shah, Thornhill (Automatica 40, 2004): 3 exp(-10 s) / (10 s + 1), PI, gain
    # close to the limit. A play explains what a coarse linear model leaves over.
    none = np.zeros(4000)
    noise = 0.3 * np.random.default_rng(0).standard_normal(4000)
    plant = Plant((10.0, 0.05, 0.05), 10.0, False, 0.0, 1.0, 10.0, 0.0, 0.0)
    plant = plant._replace(gain=0.93 * ultimate_gain(plant, 2000))
    command, output = run_loop(plant, Valve(), 1e9, Inputs(none, none, noise, none), start=0.0)
    found = attribute_cycle(Run(np.arange(4000.0), command_n=command, force_n=output))
    assert found['causes'][0]['nonlinearity'] == 'tight_tuning'
    assert found['causes'][0]['probability'] > 0.8


def test_a_load_that_jumps_is_no_sticking_valve():
    stiction = [each['stiction'] for each in chances('sawtooth', 6)]
    assert np.mean(stiction) < 0.4
    assert sum(chance >= LEAST_PROBABILITY for chance in stiction) <= 1


def test_units_sign_and_time_scale_of_the_output_change_nothing():
    run = _loop('stiction', 5)
    plain = shape(run.time_s, run.command_n, run.force_n).features
    other = shape(60.0 * run.time_s, 5.0 + 0.01 * run.command_n,
                  100.0 - 30.0 * run.force_n).features
    # Upside down, cycles are cut at troughs for peaks: their lengths scatter otherwise.
    kept = [k for k, name in enumerate(FEATURES) if 'gain' not in name and 'scatter' not in name]
    assert other[kept] == pytest.approx(plain[kept], abs=0.05)


def test_bag_of_this_actuator_is_judged_by_its_model():
    experiment = checked(Experiment({}, {'compensator': 'proportional', 'gain': 10.0,
                                         'reference.shape': 'step',
                                         'reference.amplitude': 100.0}, 0.8))
    made = simulate_loop(experiment.actuator, experiment.controller, 0.8)
    found = attribute_cycle(Run(made.time_s, made.reference_n, made.command_n, made.force_n,
                              source='bag', information=information(experiment)))
    best = max(found['causes'], key=lambda cause: cause['probability'])
    assert best['nonlinearity'] == 'valve_hysteresis' and best['probability'] > 0.9
    assert 'valve hysteresis causes the cycle' in found['verdict']
    assert problems(found, 'asi attribute BAG') == []


def test_output_without_command_is_refused():
    t = np.arange(1000) / 100.0
    with pytest.raises(InputError, match='command and output'):
        attribute_cycle(Run(t, force_n=np.sin(t)))


def test_motion_that_answers_its_reference_has_no_cause_to_find():
    t = np.arange(3000) / 100.0
    reference = np.sin(2 * np.pi * (0.5 + 0.05 * t) * t)
    noise = 0.01 * np.random.default_rng(7).standard_normal((2, t.size))
    with pytest.raises(InputError, match='no oscillation of its own'):
        attribute_cycle(Run(t, reference_n=reference, command_n=2.0 * reference + noise[0],
                          force_n=np.roll(reference, 3) + noise[1]))


def test_a_command_that_rests_after_the_first_cycle_is_refused_in_one_line():
    """It moved, but no sample of it that a valve is fitted to; once an array without columns."""
    time_s = np.arange(2000) / 1000.0
    swing = 100.0 * np.sin(2.0 * np.pi * 10.0 * time_s)
    with pytest.raises(InputError, match='the command rests in the oscillation'):
        shape(time_s, np.where(time_s < 0.03, swing, 5.0), swing)


@pytest.mark.parametrize('swing', [0.0, 1e-12])
def test_a_quiet_run_has_no_oscillation_to_attribute(swing):
    """It was one of nan Hz and nan N."""
    time_s = np.arange(1000) / 1000.0
    force = 100.0 + swing * np.random.default_rng(1).normal(size=1000)
    with pytest.raises(InputError, match='oscillation|move'):
        attribute_cycle(Run(time_s, np.full(1000, 100.0), np.full(1000, 100.0), force))


def test_a_step_of_our_actuator_that_settles_has_no_oscillation_to_attribute():
    run = simulate({}, {'compensator': 'lead_lag', 'gain': 6.0, 'reference.amplitude': 300.0}, 0.5)
    with pytest.raises(InputError, match='no oscillation of its own.*fewer than 3 cycles'):
        attribute_cycle(run)


def test_a_switching_controller_is_told_by_its_command():
    command, x, rows = 1.0, np.array([0.5, 0.0, 0.0]), []
    for k in range(3000):      # an on-off controller with hysteresis and three lags
        command = -1.0 if x[2] > 0.05 else 1.0 if x[2] < -0.05 else command
        rows.append((0.02 * k, command, x[2]))
        x = x + 0.02 * np.array([command - x[0], x[0] - x[1], x[1] - x[2]])
    time_s, command_n, force_n = np.array(rows[1000:]).T
    found = attribute_cycle(Run(time_s, np.zeros(2000), command_n, force_n))
    assert found.causes[0]['nonlinearity'] == 'switching_controller'
    assert found.causes[0]['probability'] > 0.7 and 'a switching controller' in found.verdict
    assert sum(cause['probability'] for cause in found.causes) == pytest.approx(1.0)


def test_a_record_that_was_rounded_to_three_levels_is_no_switching_controller():
    time_s = 0.01 * np.arange(4000)
    output = np.sin(2.0 * np.pi * time_s) + 0.01 * np.random.default_rng(1).standard_normal(4000)
    run = Run(time_s, np.zeros(4000), np.round(-1.2 * output), output)
    assert all(segment.verdict != 'limit_cycle' for segment in judge_run(run))
    assert all(cause['nonlinearity'] != 'switching_controller' or cause['probability'] == 0.0
               for cause in attribute_cycle(run).causes)


def test_a_cycle_of_the_loop_is_no_disturbance_as_surely():
    shape_alone = {'disturbance': 0.95, 'stiction': 0.05}
    segment = Segment(0.0, 1.0, 'limit_cycle', 0.99, 'force', 'N', '')
    weighed = _weighed(shape_alone, Run(np.arange(9.0), command_n=np.arange(9.0)), segment)
    assert weighed['disturbance'] == pytest.approx(0.505) and sum(weighed.values()) == 1.0
