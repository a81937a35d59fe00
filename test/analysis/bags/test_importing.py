"""Recordings of others become runs and bags; the numbers agree with their sources."""

import gzip
import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow.parquet import write_table
from scipy import signal
from scipy.io import loadmat, savemat

import asi_analysis as asi
from asi_analysis.bags.bag import read_bag
from asi_analysis.bags.exchange.exporting import export
from asi_analysis.bags.exchange.importing import import_recording
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.measures.frequency_response import loop_bandwidth
from asi_analysis.measures.quality import findings

DATA = Path(os.environ.get('ASI_DATA', Path(__file__).parents[4] / 'shared/data'))
EMPS_MAP = ['time=t', 'position=qm', 'reference=qg[m]', 'command=vir*gtau[N]']
MTS_MAP = ['position=CHANNEL0[cm]', 'force=CHANNEL1[tf]', 'reference=CHANNEL2[cm]']


def data(name: str) -> Path:
    if not (DATA / name).exists():
        pytest.skip(f'{DATA / name} is not there (set ASI_DATA)')
    return DATA / name


def mts(current: str) -> Path:
    return data(f'servohydraulic_mts/actuator_chirp_damper_{current}.txt.gz')


def a_run() -> Run:
    rng = np.random.default_rng(3)
    force = rng.normal(size=200)
    force[7] = np.nan
    return Run(np.arange(200) / 3000.0, force_n=force, command_n=rng.normal(size=200),
               velocity_m_s=1e-9 * rng.normal(size=200))


@pytest.mark.parametrize('suffix', ['.csv', '.parquet'])
def test_export_and_import_give_the_same_run(tmp_path: Path, suffix: str) -> None:
    run = a_run()
    export(run, tmp_path / f'run{suffix}')
    again = import_recording(tmp_path / f'run{suffix}', [])
    np.testing.assert_array_equal(again.time_s, run.time_s)
    assert again.signals().keys() == run.signals().keys()
    for name, values in run.signals().items():
        np.testing.assert_array_equal(again.signals()[name], values)


def test_a_parquet_file_keeps_what_the_bag_says_so_that_altered_samples_are_found(
        tmp_path: Path) -> None:
    run = asi.simulate({}, {'compensator': 'proportional', 'reference.amplitude': 100.0}, 0.2)
    for name, each in {'same': run, 'altered': replace(
            run, reference_n=2.0 * run.signal('reference'))}.items():
        export(each, tmp_path / f'{name}.parquet')
    same, altered = (import_recording(tmp_path / f'{name}.parquet', [])
                     for name in ('same', 'altered'))
    assert same.information.items() >= run.information.items()
    assert findings(same) == []
    assert [each.kind for each in findings(altered)] == ['answer']


@pytest.mark.parametrize('text', [b'[', b'[1]', b'{"controller": 3}', b'\xff',
                                  b'{"controller": {"gain": 1e999}}'])
def test_a_parquet_file_with_other_metadata_is_read_without(tmp_path: Path, text: bytes) -> None:
    table = pa.table({'time_s': [0.0, 1.0, 2.0], 'force_n': [0.0, 1.0, 2.0]})
    write_table(table.replace_schema_metadata({b'asi.run': text}), tmp_path / 'a.parquet')
    with pytest.warns(InputWarning, match='metadata .* left out'):
        run = import_recording(tmp_path / 'a.parquet', [])
    assert run.information.keys() == {'imported'} and len(run) == 3


def test_mapping_scales_shifts_and_converts(tmp_path: Path) -> None:
    file = tmp_path / 'a.csv'
    file.write_text('Load cell-1 (V);stroke;t\n0.5;10;0\n1.5;20;1\n;30;2\n')
    run = import_recording(file, ['force=Load cell-1 (V)*-200+5[N]', 'position=stroke+2[mm]',
                                  'time=t[ms]'])
    assert run.signals()['force'][:2].tolist() == [-95.0, -295.0]
    assert np.isnan(run.signals()['force'][2])
    np.testing.assert_allclose(run.signals()['position'], [0.012, 0.022, 0.032], rtol=1e-15)
    assert run.time_s.tolist() == [0.0, 0.001, 0.002]
    assert import_recording(file, ['force=Load cell-1 (V)'], 10.0).rate_hz == 10.0


def test_joint_that_turns_keeps_its_units(tmp_path: Path) -> None:
    file = tmp_path / 'a.csv'
    file.write_text('t,counts,rpm,torque,pwm\n' + ''.join(
        f'{k},{k * 1024},30,{k * 100},{k}\n' for k in range(4)))
    import_recording(file, ['time=t[ms]', 'position=counts*0.087890625[deg]', 'velocity=rpm[rpm]',
                            'force=torque[mNm]', 'command=pwm[%]', 'reference=counts[mrad]'],
                     out=tmp_path / 'bag')
    run = read_bag(tmp_path / 'bag')
    np.testing.assert_allclose(run.signal('position'), np.pi / 2.0 * np.arange(4))
    np.testing.assert_allclose(run.signal('velocity'), np.pi)
    np.testing.assert_allclose(run.signal('force'), [0.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(run.signal('command'), [0.0, 0.01, 0.02, 0.03])
    assert [run.unit(name) for name in ('position', 'velocity', 'force', 'command', 'reference')
            ] == ['rad', 'rad/s', 'Nm', '1', 'rad']
    assert run.controlled() == 'position'
    with pytest.raises(InputError, match='commanded motion is a reference'):
        import_recording(file, ['command=counts[deg]'], 10.0)


def test_matrices_and_structures_of_a_mat_file(tmp_path: Path) -> None:
    savemat(tmp_path / 'a.mat', {'y': np.arange(12.0).reshape(2, 6),
                                 'log': {'u': np.arange(6.0), 'note': 'x'},
                                 'out': np.array([{'v': np.zeros(6)}, {'v': np.ones(6)}])})
    run = import_recording(tmp_path / 'a.mat', ['position=y#2', 'command=log.u[V]',
                                                'velocity=out#2.v'], 10.0)
    assert run.signal('velocity').tolist() == [1.0] * 6
    assert run.signal('position').tolist() == [6.0, 7.0, 8.0, 9.0, 10.0, 11.0]
    assert run.signal('command').tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


@pytest.mark.parametrize('text', [
    '# motor 3, 24 V\n# t f x\n0.5 1 2\n1.5 2 3\n2.5 3 4\n',                  # numpy.savetxt
    '%Date:,29/04/2021\n\n%t,f,x\n%[s],[N],[mm]\n0.5,1,2;\n1.5,2,3;\n2.5,3,4;\n',
    'Pruefstand;7\nt;f;x\ns;N;mm\n0,5;1,0;2\n1,5;2,0;3\n2,5;3,0;4\n',
    't\tf\tx\n0,5\t1\t2\n1,5\t2\t3\n2,5\t3\t4\n',
    't,f,x\n2020-03-16 17:04:51.5,1,2\n2020-03-16T17:04:52.5Z,2,3\n2020-03-16 17:04:53.5,3,4\n',
])
def test_remarks_units_dates_and_decimal_commas(tmp_path: Path, text: str) -> None:
    file = tmp_path / 'a.txt'
    file.write_text(text)
    run = import_recording(file, ['time=t', 'force=f', 'position=x[mm]'])
    assert run.time_s.tolist() == [0.0, 1.0, 2.0]
    assert run.signal('force').tolist() == [1.0, 2.0, 3.0]
    assert run.signal('position').tolist() == [0.002, 0.003, 0.004]


def test_columns_of_one_name_older_text_and_lists(tmp_path: Path) -> None:
    (tmp_path / 'a.csv').write_bytes('Zeit;Weg [µm];Weg [µm]\n12:00:00.5;1;2\n12:00:01.5;3;4\n'
                                     .encode('latin-1'))
    run = import_recording(tmp_path / 'a.csv', ['time=Zeit', 'position=Weg [µm]*1[um]',
                                                'force=Weg [µm]#2[N]'])
    assert run.time_s.tolist() == [0.0, 1.0]
    assert run.signal('position').tolist() == [1e-6, 3e-6]
    assert run.signal('force').tolist() == [2.0, 4.0]
    write_table(pa.table({'q': [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]]}), tmp_path / 'a.parquet')
    listed = import_recording(tmp_path / 'a.parquet', ['position=q#2[rad]'], 10.0)
    assert listed.signal('position').tolist() == [1.0, 3.0, 5.0]


def test_repeated_times_and_missing_values_and_units_in_the_header(tmp_path: Path) -> None:
    file = tmp_path / 'a.csv'
    file.write_text('time [ms],torque [Nm]\n0,1\n0,2\n1,N/A\nnan,3\n2,4\n')
    with pytest.warns(InputWarning, match='2 of 5 samples have no time, or that of'):
        run = import_recording(file, ['time=time [ms]', 'force=torque [Nm]'])
    assert run.time_s.tolist() == [0.0, 0.001, 0.002]
    np.testing.assert_array_equal(run.signal('force'), [1.0, np.nan, 4.0])
    assert run.unit('force') == 'Nm'


def test_units_that_pint_knows(tmp_path: Path) -> None:
    file = tmp_path / 'a.csv'
    file.write_text('p,f,q\n1,2,3\n2,3,4\n')
    run = import_recording(file, ['force=p*12.5[bar*cm^2]', 'command=q[psi]', 'position=f[ft]'],
                           10.0)
    np.testing.assert_allclose(run.signal('force'), [125.0, 250.0])
    np.testing.assert_allclose(run.signal('command'), [3 * 6894.757, 4 * 6894.757], rtol=1e-6)
    np.testing.assert_allclose(run.signal('position'), [0.6096, 0.9144])
    kip = import_recording(file, ['force=f[kip]'], 10.0)
    np.testing.assert_allclose(kip.signal('force'), [8896.443, 13344.665], rtol=1e-6)
    with pytest.raises(InputError, match='a pressure times an area is a force'):
        import_recording(file, ['force=p[bar]'], 10.0)


@pytest.mark.parametrize(('step', 'rows'), [(0.004, 'other'), (0.01, 'other'), (0.004, 'same')])
def test_a_rounded_time_is_refused_but_not_rows_that_are_there_twice(
        step: float, rows: str, tmp_path: Path) -> None:
    """Else every fourth sample would be kept, and an oscillation would have another frequency."""
    time = np.arange(400) / 1000.0
    file = tmp_path / 'log.csv'
    rounded = np.round(np.floor(time / step + 1e-9) * step, 3)
    force = np.sin(2.0 * np.pi * 330.0 * (time if rows == 'other' else rounded))
    file.write_text('t,f\n' + ''.join(f'{a},{b}\n' for a, b in zip(rounded, force, strict=True)))
    if rows == 'other':
        with pytest.raises(InputError, match='the time is rounded; leave it out'):
            import_recording(file, ['time=t', 'force=f'])
        assert len(import_recording(file, ['force=f'], 1000.0)) == 400
    else:
        with pytest.warns(InputWarning, match='300 of 400 samples have no time, or that of'):
            assert len(import_recording(file, ['time=t', 'force=f'])) == 100


@pytest.mark.parametrize('unit', ['10**10**8 N', '0x9**0x9**0x9999 N', 'N*9^9^9^9', 'N*1e400'])
def test_a_unit_that_takes_for_ever_to_compute_is_refused(unit: str, tmp_path: Path) -> None:
    file = tmp_path / 'a.csv'
    file.write_text('f\n2\n3\n')
    with pytest.raises(InputError, match='force takes N, Nm and their'):
        import_recording(file, [f'force=f[{unit}]'], 10.0)


@pytest.mark.parametrize(('cells', 'seconds'), [
    (['31.12.2020 23:59:59', '01.01.2021 00:00:01'], 2.0),
    (['12/31/2020 11:59:59 PM', '1/1/2021 12:00:01 AM'], 2.0),
    (['11:59:59 AM', '12:00:01 PM'], 2.0),
    (['2020-01-01T00:00:00+01:00', '2020-01-01T00:00:00.5+01:00'], 0.5)])
def test_dates_of_other_countries(tmp_path: Path, cells: list[str], seconds: float) -> None:
    (tmp_path / 'a.csv').write_text('t;f\n' + ''.join(f'{cell};1\n' for cell in cells))
    run = import_recording(tmp_path / 'a.csv', ['time=t', 'force=f'], columns=['t', 'f'],
                           skip_lines=1)
    assert run.time_s.tolist() == [0.0, seconds]


def test_a_date_that_can_be_read_in_two_ways_is_refused(tmp_path: Path) -> None:
    (tmp_path / 'a.csv').write_text('t;f\n3/4/2020 10:00;1\n4/4/2020 10:00;2\n')
    with pytest.raises(InputError, match='the day or the month first'):
        import_recording(tmp_path / 'a.csv', ['time=t', 'force=f'], columns=['t', 'f'],
                         skip_lines=1)


def test_numbers_of_labview_and_durations(tmp_path: Path) -> None:
    (tmp_path / 'a.csv').write_text('f\n-19m\n2.5k\n1\n')
    with pytest.warns(InputWarning, match='2 cells such as -19m'):
        run = import_recording(tmp_path / 'a.csv', ['force=f'], 10.0)
    assert run.signal('force').tolist() == [-0.019, 2500.0, 1.0]
    write_table(pa.table({'t': pa.array([0, 500_000_000], pa.duration('ns')), 'f': [1.0, 2.0]}),
                tmp_path / 'a.parquet')
    timed = import_recording(tmp_path / 'a.parquet', ['time=t', 'force=f'])
    assert timed.time_s.tolist() == [0.0, 0.5]


@pytest.mark.parametrize('row', [
    '{0:.3f},"[{1}, {2:.3f}]"', '{0:.3f};[{1},{2:.3f}]', '{0:.3f},[{1} {2:.3f}]',
    """{0:.3f},"array('d', [{1}, {2:.3f}])\"""", '{0:.3f}\t({1}; {2:.3f})'])
def test_lists_in_the_cells_of_a_text_are_columns(tmp_path: Path, row: str) -> None:
    path = tmp_path / 'log.csv'
    mark = next(each for each in ';\t,' if each in row.partition('[')[0].partition('(')[0])
    lines = [row.format(0.1 * k, k, 0.5 * k) for k in range(25_000)]
    lines[3] = f'0.300{mark}'
    path.write_text('\n'.join([f't{mark}q', *lines]))
    run = import_recording(path, ['time=t', 'position=q#2[rad]', 'reference=q#1[rad]'])
    assert run.position_m is not None and run.reference_n is not None
    assert np.isnan(run.position_m[3]) and run.position_m[24_999] == 12499.5
    assert run.reference_n[24_999] == 24_999.0
    lines[21_000] = f'2100.0{mark}' + row.format(0, 7, 8.0).partition(mark)[2].replace('7', '1')
    lines[21_001] = f'2100.1{mark}"[1, 2, 3]"' if mark == ',' else f'2100.1{mark}[1, 2, 3]'
    path.write_text('\n'.join([f't{mark}q', *lines]))
    with pytest.raises(InputError, match='row 21002: the list has 3 numbers, the first has 2'):
        import_recording(path, ['time=t', 'position=q#2[rad]'])


@pytest.mark.parametrize(('unit', 'scale'), [('ms', 1e3), ('us', 1e6), ('ns', 1e9)])
def test_the_rate_of_times_since_1970(tmp_path: Path, unit: str, scale: float) -> None:
    # It was 1000.07 Hz, since 1.7e9 s is only known to 0.24 us.
    path = tmp_path / 'log.csv'
    path.write_text('t,q\n' + '\n'.join(
        f'{int(1_700_000_000 * scale) + int(k * scale / 1000)},{k}' for k in range(2000)))
    assert import_recording(path, [f'time=t[{unit}]', 'position=q']).rate_hz == pytest.approx(
        1000.0, rel=1e-7)


def test_a_motion_without_a_unit_beside_a_torque_is_remarked(tmp_path: Path) -> None:
    path = tmp_path / 'log.csv'
    path.write_text('t,q,tau\n' + '\n'.join(f'{0.1 * k},{k % 5},{k % 3}' for k in range(50)))
    with pytest.warns(InputWarning, match="'position=q' has no unit and is taken in m, beside Nm"):
        import_recording(path, ['time=t', 'position=q', 'command=tau[Nm]'])


def test_the_rate_of_a_process_with_dates_is_not_doubted(tmp_path: Path) -> None:
    path = tmp_path / 'log.csv'
    path.write_text('t,sp,pv\n' + '\n'.join(
        f'2024-06-03 09:{k // 60:02d}:{k % 60:02d},50,{50 + k % 7}' for k in range(600)))
    run = import_recording(path, ['time=t', 'reference=sp[m]', 'position=pv'],
                           out=tmp_path / 'bag')
    for each in (run, read_bag(tmp_path / 'bag')):
        assert not [found for found in findings(each) if found.kind == 'slow']


def test_zero_takes_off_the_start(tmp_path: Path) -> None:
    file = tmp_path / 'a.tsv'
    file.write_text('\n'.join(f'{3 + (k > 4)}\t{k}' for k in range(10)))
    run = import_recording(file, ['force=#1', 'position=b[mm]'], 10.0, columns=['#1', 'b'],
                           zero_s=0.5)
    assert run.signals()['force'].tolist() == [0.0] * 5 + [1.0] * 5
    assert run.signals()['position'][0] == pytest.approx(-0.002)


@pytest.mark.parametrize(('mapping', 'message'), [
    (['force'], 'is not a mapping'), (['thrust=a'], 'there is no signal thrust'),
    (['force=c'], 'names no column; there are a, b'), (['force=a[mm]'], "not 'mm'"),
    (['force=a*c'], "the scale 'c' is neither a number"), (['force=b'], "row 2: 'x' is not a num"),
    (['force=a', 'force=a'], 'mapped twice'), (['force=a', 'time=a'], 'does not rise at row 3'),
    ([], 'no signal is mapped')])
def test_says_what_is_wrong_with_a_mapping(tmp_path: Path, mapping: list[str], message: str
                                           ) -> None:
    file = tmp_path / 'a.csv'
    file.write_text('a,b\n1,2\n2,x\n1,3\n')
    rate_hz = None if 'time=a' in mapping else 10.0
    with pytest.raises(InputError, match=message) as refusal:
        import_recording(file, mapping, rate_hz)
    assert '\n' not in str(refusal.value)


@pytest.mark.parametrize(('name', 'content', 'message'), [
    ('a.csv', b'', 'is empty'), ('a.csv', b'a,b\n', 'has no rows'),
    ('a.csv', b'\xff\xfe\x00', 'cannot be read'), ('a.csv.gz', b'a,b', 'cannot be read'),
    ('a.mat', b'nothing', 'cannot be read'), ('a.parquet', b'nothing', 'cannot be read'),
    ('a.xlsx', b'', 'expected a .csv'), ('a.csv', b'a,b,c\n1,2,3\n1\n', 'row 2 has 1 cells'),
    ('a.csv', b'a\ninf\n', 'row 1: infinite')])
def test_refuses_files_it_cannot_read(tmp_path: Path, name: str, content: bytes, message: str
                                      ) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as refusal:
        import_recording(tmp_path / name, ['force=a'], 10.0)
    assert str(tmp_path / name) in str(refusal.value)
    with pytest.raises(InputError, match='absent'):
        import_recording(tmp_path / 'absent.csv', ['force=a'], 10.0)


@pytest.mark.parametrize('suffix', ['mat', 'npz', 'parquet'])
def test_a_variable_that_is_no_column_is_left_out_with_a_note(tmp_path: Path, suffix: str) -> None:
    path, time = tmp_path / f'a.{suffix}', np.arange(100.0)
    if suffix == 'mat':
        savemat(path, {'t': time, 'cube': np.ones((3, 3, 3))})
    elif suffix == 'npz':
        np.savez(path, t=time, cube=np.ones((80, 70)))
    else:
        write_table(pa.table({'t': time, 'cube': [[1.0] * (k % 3) for k in range(100)]}), path)
    with pytest.warns(UserWarning, match='cube is left out'):
        assert len(import_recording(path, ['time=t', 'force=t'])) == 100


def test_two_columns_of_one_name_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / 'a.npz', **{'t#1': np.arange(9.0), 't': np.ones((9, 2))})
    with pytest.raises(InputError, match='two columns are called t#1'):
        import_recording(tmp_path / 'a.npz', ['time=t#1', 'force=t#2'])


def test_a_refusal_names_a_few_of_many_columns(tmp_path: Path) -> None:
    names = ','.join(f'c{k}' for k in range(500))
    (tmp_path / 'a.csv').write_text(names + '\n' + 2 * (','.join(500 * '1') + '\n'))
    with pytest.raises(InputError, match='c39 and 460 more') as refusal:
        import_recording(tmp_path / 'a.csv', ['force=x'], 10.0)
    assert len(str(refusal.value)) < 500


def test_needs_either_a_rate_or_a_time(tmp_path: Path) -> None:
    savemat(tmp_path / 'a.mat', {'f': np.arange(5.0), 't': np.arange(5.0)})
    for mapping, rate_hz in ((['force=f'], None), (['force=f', 'time=t'], 10.0)):
        with pytest.raises(InputError, match='either a mapping time=COLUMN or a rate'):
            import_recording(tmp_path / 'a.mat', mapping, rate_hz)


@pytest.mark.parametrize('name', [
    'DATA_EMPS', pytest.param('DATA_EMPS_PULSES', marks=pytest.mark.slow)])
def test_emps(tmp_path: Path, name: str) -> None:
    """The numbers of the source, and the published parameters out of the imported bag."""
    file = data(f'emps/{name}.mat')
    import_recording(file, EMPS_MAP, out=tmp_path / 'bag')
    run = read_bag(tmp_path / 'bag')
    source = loadmat(file)
    assert len(run) == 24841
    assert run.rate_hz == pytest.approx(1000.0, rel=1e-4)
    np.testing.assert_array_equal(run.signals()['position'], source['qm'][:, 0])
    np.testing.assert_array_equal(run.signals()['reference'], source['qg'][:, 0])
    np.testing.assert_array_equal(run.signals()['command'],
                                  source['vir'][:, 0] * source['gtau'][0, 0])
    assert (run.controlled(), run.unit('reference')) == ('position', 'm')
    # The controller holds the position to within a millimetre of a reference of 246 mm.
    assert np.abs(run.signals()['reference'] - run.signals()['position']).max() < 1e-3
    if name == 'DATA_EMPS':
        # M, Fv, Fc and offset as published with the data (Janot et al. 2019), least squares.
        found = identified(run)
        np.testing.assert_allclose(found, [95.109, 203.50, 20.394, -3.165], rtol=0.01)


def identified(run: Run) -> np.ndarray:
    """Return M, Fv, Fc and offset of M a + Fv v + Fc sign(v) + offset = command."""
    position = signal.filtfilt(*signal.butter(4, 60.0, fs=1000.0), run.signals()['position'])
    velocity = np.gradient(position, run.time_s)
    regressors = np.column_stack([np.gradient(velocity, run.time_s), velocity,
                                  np.sign(velocity), np.ones(len(run))])[200:-200]
    command = run.signals()['command'][200:-200]
    return np.linalg.lstsq(signal.decimate(regressors, 25, axis=0),
                           signal.decimate(command, 25), rcond=None)[0]


@pytest.mark.parametrize(('current', 'count', 'force_kn'), [
    ('0A', 61500, 0.955), pytest.param('1A', 59100, 3.75, marks=pytest.mark.slow)])
def test_servohydraulic_press(tmp_path: Path, current: str, count: int, force_kn: float) -> None:
    file = mts(current)
    import_recording(file, MTS_MAP, 1000.0, skip_lines=6, zero_s=1.0, out=tmp_path / 'bag')
    run = read_bag(tmp_path / 'bag')
    assert (len(run), run.rate_hz) == (count, 1000.0)
    rows = [line.split(',')[2:5] for line in gzip.open(file, 'rt').read().splitlines()[7:]]
    source = np.array(rows, float)
    source -= source[:1000].mean(axis=0)
    np.testing.assert_allclose(run.signals()['position'], source[:, 0] / 100.0, atol=1e-12)
    np.testing.assert_allclose(run.signals()['force'], source[:, 1] * 9806.65, atol=1e-7)
    np.testing.assert_allclose(run.signals()['reference'], source[:, 2] / 100.0, atol=1e-12)
    assert np.ptp(run.signals()['force']) == pytest.approx(force_kn * 1e3, rel=1e-3)
    # The press follows its chirp of 2 mm with a lag of tens of milliseconds.
    found = loop_bandwidth(run)
    frequency, gain = by_bands(source[:, 2], source[:, 0])
    assert found.bandwidth_hz == pytest.approx(
        np.interp(-gain[0] * np.sqrt(0.5), -gain, frequency), rel=0.03)
    assert found.delay_s is not None and 0.015 < found.delay_s < 0.03
    assert found.correlation_delay_s == pytest.approx(
        np.argmax([source[:-k or None, 2] @ source[k:, 0] for k in range(60)]) / 1e3, abs=1e-3)


def by_bands(input_: np.ndarray, output: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return frequency (Hz) and gain in bands of 0.5 Hz of the whole recording's spectrum."""
    u, v = np.fft.rfft(input_), np.fft.rfft(output)
    line_hz = 1000.0 / len(input_)
    edges = np.arange(0.5, 15.5, 0.5)
    bands = [slice(int(low / line_hz), int((low + 0.5) / line_hz)) for low in edges]
    gain = [abs(np.vdot(u[band], v[band]) / np.vdot(u[band], u[band])) for band in bands]
    return edges + 0.25, np.array(gain)


def test_a_signed_register_read_as_unsigned_is_remarked_and_can_be_read(tmp_path: Path) -> None:
    register = np.array([5, 3, 1, 0, 65535, 65530, 65531, 65533, 65535, 2, 4])
    (tmp_path / 'a.csv').write_text('load\n' + '\n'.join(map(str, register)) + '\n')
    with pytest.warns(InputWarning, match=r'map force=load\*int16'):
        import_recording(tmp_path / 'a.csv', ['force=load'], 10.0)
    with warnings.catch_warnings():
        warnings.simplefilter('error', InputWarning)
        run = import_recording(tmp_path / 'a.csv', ['force=load*int16'], 10.0)
    assert run.signal('force').tolist() == [5, 3, 1, 0, -1, -6, -5, -3, -1, 2, 4]


def test_a_text_may_be_a_log(tmp_path: Path) -> None:
    (tmp_path / 'a.log').write_text('time, values[0]\n0, 1\n1, 2\n')
    run = import_recording(tmp_path / 'a.log', ['time=time', 'velocity=values[0][m/s]'])
    assert run.signal('velocity').tolist() == [1.0, 2.0]
