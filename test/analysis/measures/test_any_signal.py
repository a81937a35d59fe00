"""Steps, delay and oscillation of a position, a velocity or a pressure, as of a force."""

import numpy as np
import pytest
from scipy import signal

from asi_analysis.bags.bag import read_bag, write_bag
from asi_analysis.bags.exchange.importing import import_recording
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.limit_cycle.detection.agreement import judge_run
from asi_analysis.measures.analysis import analyze, oscillation
from asi_analysis.measures.frequency_response import loop_bandwidth

T = np.arange(4000) * 1e-3
STEP = np.where(T >= 0.5, 0.2, 0.0)
SERVO = ([900.0], [1.0, 42.0, 900.0])     # 30 rad/s, damping ratio 0.7
UNITS = {'position': 'rad', 'velocity': 'rad/s', 'pressure': 'Pa'}


def followed(name: str, reference: np.ndarray, delay: int = 0) -> Run:
    motion = np.roll(signal.lsim(SERVO, reference, T)[1], delay)
    field = {'position': 'position_m', 'velocity': 'velocity_m_s', 'pressure': 'pressure_pa'}[name]
    units = {'reference': UNITS[name], name: UNITS[name]}
    return Run(T, reference_n=reference, force_n=np.sin(2.0 * np.pi * 40.0 * T),
               information={'signals': units}, **{field: motion})


@pytest.mark.parametrize('name', UNITS)
def test_a_step_of_any_signal_has_the_figures_of_a_second_order_lag(name):
    found = analyze(followed(name, STEP))
    assert (found.signal, found.unit) == (name, UNITS[name])
    assert found.overshoot_percent == pytest.approx(4.6, abs=0.1)
    t, share = signal.step(SERVO, T=np.linspace(0.0, 0.2, 20_001))
    ten, ninety = (t[np.argmax(share >= level)] for level in (0.1, 0.9))
    assert found.rise_time_s == pytest.approx(ninety - ten, abs=1e-4)
    assert found.steady_state_error_n == pytest.approx(0.0, abs=1e-6)
    assert found.steps[0]['final_n'] == 0.2
    assert found.pictures()['step'][0].axes[0].get_ylabel() == f'{name} (% of the step)'


def test_the_delay_of_a_position_behind_its_reference():
    noise = signal.lfilter([0.05], [1.0, -0.95], np.random.default_rng(1).standard_normal(T.size))
    run = Run(T, reference_n=noise, position_m=np.roll(noise, 25),
              information={'signals': {'reference': 'm'}})
    assert analyze(run).correlation_delay_s == pytest.approx(0.025, abs=0.001)


@pytest.mark.parametrize('delay', [5, 208, 390])
@pytest.mark.parametrize('kind', ['staircase', 'short stairs', 'noise'])
def test_a_long_delay_is_told_and_does_not_hide_the_response(kind, delay):
    """A delay turns the phase between lines: their average vanished, and nothing was told."""
    random, count = np.random.default_rng(4), T.size + 400
    reference = {'staircase': np.repeat(random.uniform(-1.0, 1.0, 25), 176),
                 'short stairs': np.repeat([0.0, 1.0, 2.0, 3.0, 2.0, 1.0, 0.0, 1.0], 550),
                 'noise': random.standard_normal(count)}[kind]
    position = reference[400 - delay:count - delay] + 0.02 * random.standard_normal(T.size)
    found = loop_bandwidth(Run(T, reference_n=reference[400:], position_m=position,
                               information={'signals': {'reference': 'm', 'position': 'm'}}))
    assert found.correlation_delay_s == pytest.approx(1e-3 * delay, rel=0.02, abs=1e-3)
    if kind == 'noise':
        assert found.delay_s == pytest.approx(1e-3 * delay, rel=0.02, abs=1e-3)


def test_another_signal_than_the_controlled_one_has_no_step_but_may_oscillate():
    found = analyze(followed('position', STEP), 'force')
    assert found.rise_time_s is None and found.tracking_error_rms_n is None
    assert 'the reference is that of a position, not of the force' in found.notes[0]
    assert found.oscillation['frequency_hz'] == pytest.approx(40.0, abs=0.1)
    assert oscillation(followed('position', STEP)).signal == 'position'
    with pytest.raises(InputError, match='no pressure in this run'):
        analyze(followed('position', STEP), 'pressure')


def test_a_pressure_is_imported_and_judged(tmp_path):
    wave = np.cos(2.0 * np.pi * 5.0 * T) + 0.1 * np.cos(2.0 * np.pi * 15.0 * T)
    noise = 0.01 * np.random.default_rng(2).standard_normal(T.size)
    rows = [f'{t:g},{100.0 + 5.0 * value:.6f},100' for t, value in zip(T, wave + noise,
                                                                      strict=True)]
    (tmp_path / 'log.csv').write_text('\n'.join(['t,p,set', *rows]))
    import_recording(tmp_path / 'log.csv', ['time=t', 'pressure=p[bar]', 'reference=set[bar]'],
                     out=tmp_path / 'bag')
    run = read_bag(tmp_path / 'bag')
    assert run.controlled() == run.output() == 'pressure'
    segment, = judge_run(run)
    assert (segment.verdict, segment.unit) == ('limit_cycle', 'Pa')
    assert segment.amplitude == pytest.approx(5e5, rel=0.01)
    write_bag(run, tmp_path / 'again')
    assert np.array_equal(read_bag(tmp_path / 'again').pressure_pa, run.pressure_pa)


def test_a_slow_oscillation_has_its_frequency_and_a_drive_is_not_ruled_out():
    # It was "0.0 Hz, 1 m, sustained", without a word on what may have driven it.
    t = np.arange(3000.0)
    noise = np.random.default_rng(2).standard_normal(t.size)
    found = analyze(Run(t, position_m=np.sin(2.0 * np.pi * 0.0123 * t) + 0.01 * noise))
    assert '0.0123 Hz' in str(found)
    assert any('no reference is recorded' in note for note in found.notes)
