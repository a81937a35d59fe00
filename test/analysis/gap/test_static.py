"""Static characteristics: effects with their sizes, and what must not matter or cannot be told."""

import json
from dataclasses import replace

import numpy as np
import pytest
from documented import problems
from scipy.signal import lfilter, sawtooth
from typer.testing import CliRunner

from asi_analysis.bags.bag import write_bag
from asi_analysis.bags.run import Run
from asi_analysis.cli import app
from asi_analysis.errors import InputError
from asi_analysis.gap.answer.command import diagnose
from asi_analysis.gap.answer.result import Gap
from asi_analysis.gap.course import cycle, turning_points
from asi_examiner.static import draw_static

CYCLE = 532   # samples
TIME_S = 0.03 * np.arange(3 * CYCLE)
RISING = sawtooth(2.0 * np.pi * TIME_S / (0.03 * CYCLE), 0.5)   # three cycles, -1 to 1
UNITS = {'signals': {'command': 'A', 'pressure': 'Pa'}}
pytestmark = pytest.mark.filterwarnings('ignore::asi_analysis.errors.InputWarning')


def run(given: np.ndarray, got: np.ndarray, seed: int = 0, faster: float = 1.0) -> Run:
    """Return 5e5 Pa + 2e5 Pa of `got` over 4 A + `given`, with 400 Pa of noise."""
    noise = 400.0 * np.random.default_rng(seed).standard_normal(got.size)
    return Run(TIME_S[:got.size] / faster, command_n=4.0 + given,
               pressure_pa=5e5 + 2e5 * got + noise, source=f'run {seed}', information=UNITS)


def play(given: np.ndarray, half: float) -> np.ndarray:
    out, at = np.empty_like(given), given[0]
    for k, u in enumerate(given):
        out[k] = at = min(max(at, u - half), u + half)
    return out


def late(given: np.ndarray, samples: float) -> np.ndarray:
    keep = np.exp(-1.0 / samples)
    return lfilter([1.0 - keep], [1.0, -keep], given, zi=[keep * given[0]])[0]


def asked(*runs: Run, **options) -> Gap:
    return diagnose(list(runs), plant='static', **options)


def size(answer: Gap, name: str) -> float:
    """Return a size of the first effect, and hold it to its own interval."""
    row = answer.which[0]
    assert row['parameters_low'][name] <= row['parameters'][name] <= row['parameters_high'][name]
    return row['parameters'][name]


@pytest.mark.parametrize(('effect', 'got', 'sizes'), [
    ('no_gap', RISING, {}),
    ('valve_hysteresis', play(RISING, 0.06), {'loop_width': 0.06}),
    ('valve_saturation', np.minimum(RISING, 0.7), {'limit_above': 6.4e5}),
    ('valve_deadband', np.sign(RISING - 0.2) * np.maximum(np.abs(RISING - 0.2) - 0.1, 0.0),
     {'command_deadband': 0.1, 'deadband_centre': 4.2}),
    ('gain_asymmetry', np.where(RISING > 0.1, 0.8 * (RISING - 0.1), 1.2 * (RISING - 0.1)),
     {'gain_asymmetry': -0.2, 'asymmetry_centre': 4.1}),
    ('curvature', np.sinh(1.5 * RISING) / np.sinh(1.5), {}),
    ('command_quantisation', 0.1 * np.round(RISING / 0.1 + 0.13), {'command_quantum': 0.1}),
    ('sensor_drift', RISING + 0.002 * TIME_S, {'sensor_drift': 400.0}),
    ('disturbance_force', RISING + 0.05 * np.sin(2.0 * np.pi * 0.29 * TIME_S),
     {'disturbance_wave': 1e4, 'disturbance_frequency': 0.29})])
def test_effect_is_named_with_its_size(effect, got, sizes):
    answer = asked(run(RISING, got))
    assert answer.verdict == effect
    for name, value in sizes.items():
        assert size(answer, name) == pytest.approx(value, rel=0.05)
    if effect not in ('no_gap', 'command_quantisation'):   # an edge lies between two samples
        assert answer.gap['after_nrmse'] < 1.2 * answer.gap['noise_floor_nrmse']
    assert 'Pa/A (fitted)' in str(answer)
    assert problems(json.loads(json.dumps(answer.to_dict(), allow_nan=False)), 'asi gap') == []


def test_figures_of_the_data_sheet():
    found = asked(run(RISING, play(RISING, 0.06))).characteristic
    assert found['hysteresis_percent'] == pytest.approx(6.0, abs=0.1)   # 0.12 of 2 A
    assert found['loop_percent'] == pytest.approx(6.0, abs=0.4)
    assert found['threshold_percent'] == pytest.approx(6.0, abs=0.2)
    assert found['deadband_percent'] is None and found['saturation_high'] is None
    assert (found['input_low'], found['input_high']) == pytest.approx((3.0, 5.0))


def test_neither_units_nor_origins_matter():
    usual = run(RISING, play(RISING, 0.06))
    other = replace(usual, command_n=-2e-6 * usual.command_n + 7.0,
                    pressure_pa=3e4 * usual.pressure_pa - 1e12)
    first, second = asked(usual), asked(other)
    assert first.verdict == second.verdict == 'valve_hysteresis'
    assert second.probability == pytest.approx(first.probability, abs=0.01)
    assert size(second, 'loop_width') == pytest.approx(2e-6 * size(first, 'loop_width'), rel=0.01)
    assert second.gap['shrink'] == pytest.approx(first.gap['shrink'], abs=0.002)


def test_neither_the_order_of_recordings_nor_of_equal_cycles_matters():
    quick = run(RISING, play(RISING, 0.06), 1, 3.0)
    slow = run(RISING, play(np.concatenate([RISING[-CYCLE:], RISING]), 0.06)[CYCLE:])   # periodic
    moved = replace(slow, pressure_pa=np.roll(slow.pressure_pa, CYCLE))
    widths = []
    for runs in ((slow, quick), (quick, slow), (moved, quick)):
        answer = asked(*runs)
        assert answer.verdict == 'valve_hysteresis'
        widths.append(size(answer, 'loop_width'))
    assert widths == pytest.approx([widths[0]] * 3, rel=0.01)


def test_one_rate_cannot_tell_a_lag_from_hysteresis_and_two_can():
    for effect, law in (('valve_lag', late), ('valve_hysteresis', play)):
        sizes = (20.0, 0.06) if law is late else (0.06, 0.06)   # samples: 0.6 s, or half width
        slow = run(RISING, law(RISING, sizes[0]))
        quick = run(RISING, law(RISING, 4.0 * sizes[0] if law is late else sizes[1]), 1, 4.0)
        alone, both = asked(slow), asked(slow, quick)
        assert alone.probability <= 0.86
        assert any('the same input at another rate separates them' in n for n in alone.notes)
        assert both.verdict == effect and both.probability > 0.95
        assert not any('one rate' in note for note in both.notes)
        if law is late:
            assert size(both, 'valve_lag') == pytest.approx(0.6, rel=0.03)


def test_gain_and_offset_may_be_given():
    recorded = run(RISING, RISING)   # 2e5 Pa/A, -3e5 Pa
    assert asked(recorded, settings=['gain=1.8e5']).verdict == 'no_gap'   # within 20 %
    narrow = asked(recorded, settings=['gain=1.8e5'], tolerances={'gain': 0.05})
    assert narrow.verdict == 'sensor_gain' and 'gain 5 %' in str(narrow)
    answer = asked(recorded, settings=['gain=1e5', 'offset=1e5'])
    assert answer.verdict == 'sensor_gain'
    assert size(answer, 'gain') == pytest.approx(2e5, rel=0.01)
    answer = asked(recorded, model={'gain': 2e5, 'offset': -3.3e5}, tolerance=0.01)
    assert answer.verdict == 'sensor_offset'
    assert size(answer, 'offset') == pytest.approx(3e4, rel=0.05)


def test_any_input_and_output():
    usual = run(RISING, play(RISING, 0.06))
    other = replace(usual, command_n=None, position_m=usual.command_n,
                    velocity_m_s=usual.pressure_pa, pressure_pa=None, information={})
    assert asked(other, signals=('position', 'velocity')).verdict == 'valve_hysteresis'
    back = asked(other, signals=('velocity', 'position'))
    assert (back.characteristic['input'], back.characteristic['output']) == (
        'velocity', 'position')
    with pytest.raises(InputError, match='no force that moves; there are: position, velocity'):
        asked(other, signals=('force', None))


@pytest.mark.parametrize(('options', 'said'), [
    ({'settings': ['load.mass=3']}, 'load.mass is no parameter of a static characteristic'),
    ({'settings': ['gain=0']}, 'gain = 0 is not allowed'),
    ({'settings': ['gain=true']}, 'gain = True is not allowed'),
    ({'tolerance': True}, 'tolerance True is not allowed'),
    ({'drive': 'force'}, '--drive takes --plant joint'),
    ({'tolerances': {'gain': 0.1}}, 'tolerance gain: no uncertain parameter of the nominal'),
    ({'baseline': [run(RISING, RISING)]}, '--baseline takes --plant actuator or joint')])
def test_what_it_cannot_take_is_refused(options, said):
    with pytest.raises(InputError, match=said):
        asked(run(RISING, RISING), **options)


def test_a_recording_that_cannot_tell_says_so():
    with pytest.raises(InputError, match='hardly moves'):
        asked(run(RISING, 1e-3 * RISING))
    with pytest.raises(InputError, match='takes an input and an output that move'):
        asked(replace(run(RISING, RISING), pressure_pa=None))
    with pytest.raises(InputError, match='does not follow from command: a curve of it explains'):
        asked(run(RISING, np.sin(3.0 * TIME_S)))
    with pytest.raises(InputError, match='too few samples: [12]. to fit, choose or judge on'):
        asked(run(RISING, RISING)[:110])
    half = run(RISING, RISING)[:250]
    assert any('the input never comes back' in note for note in asked(half).notes)


def test_neither_a_perfect_line_nor_a_coarse_converter_is_a_gap():
    perfect = replace(run(RISING, RISING), pressure_pa=5e5 + 2e5 * RISING)
    assert asked(perfect).verdict == 'no_gap'
    coarse = asked(replace(perfect, pressure_pa=1e4 * np.round(perfect.pressure_pa / 1e4)))
    assert coarse.verdict == 'no_gap'
    assert any('quantised in steps of 1e+04 Pa, which count as noise' in n for n in coarse.notes)


def test_a_bump_is_unknown():
    answer = asked(run(RISING, RISING + 0.1 * np.exp(-((RISING - 0.3) / 0.08) ** 2)))
    assert answer.unknown_probability > 0.5 or answer.probability < 0.9


def test_command_line_and_report(tmp_path):
    write_bag(run(RISING, play(RISING, 0.06)), tmp_path / 'bag')
    called = CliRunner().invoke(app, [
        'gap', str(tmp_path / 'bag'), '--plant', 'static', '--json', '--report',
        str(tmp_path / 'why'), '--output', 'pressure'])
    assert called.exit_code == 0, called.output
    page = (tmp_path / 'why/report.html').read_text()
    assert 'hysteresis' in page and (tmp_path / 'why/characteristic.png').exists()


def test_turning_points_and_cycle():
    assert turning_points(RISING)[1:-1] == pytest.approx(
        [CYCLE / 2 * number for number in range(1, 6)], abs=1)
    assert cycle(RISING) == pytest.approx(CYCLE, abs=1)
    assert cycle(RISING[:450]) == 0


@pytest.mark.parametrize('seed', range(3))
def test_case_of_the_examiner_is_what_its_answer_says(seed):
    case, again = draw_static(seed), draw_static(seed)
    np.testing.assert_array_equal(case.recordings[0].got, again.recordings[0].got)
    assert (case.kind in ('effect', 'pair')) <= (case.visibility > 0.0)
