"""Texts of other programs are read as meant, or refused; no value is shifted or scaled."""

import re
import warnings
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow.parquet import write_table

from asi_analysis.bags.exchange.dates import since_first
from asi_analysis.bags.exchange.importing import import_joints, import_recording
from asi_analysis.bags.exchange.preview import preview
from asi_analysis.bags.exchange.table_file import read_table
from asi_analysis.errors import InputError, InputWarning

NAN = float('nan')


def read(folder: Path, content: str, columns: list[str] | None = None) -> dict[str, list[float]]:
    file = folder / 'a.csv'
    file.write_text(content)
    return {name: column.tolist() for name, column in read_table(file, columns=columns).items()}


@pytest.mark.parametrize(('content', 'message'), [
    ('t,pos,force\n0,1,10\n1,2,20\n2,30\n3,4,40\n', 'row 3 has 2 cells, expected 3'),
    ('time pos force\n0.00 1.0 10.0\n0.01      11.0\n0.02 1.2 12.0\n', 'row 2 has 2 cells, exp'),
    ('t x note\n0 1 ok\n1 2 ok\n2 ok\n', 'row 3 has 2 cells'),
    ('t,pos,force,cmd\n0,1\n1,2\n2,3,4,5\n3,4,5,6\n4,5,6,7\n', 'row 1 has 2 cells'),
    ('t,x,note\n0,0,5,ok\n1,1,5,ok\n2,2,5,ok\n', 'row 1 has 4 cells, expected 3.*decimal commas'),
    ('t,x,note\n0,1,"two\nlines"\n1,2,\n2,3,\n', 'row 2 has 1 cells'),
    ('t,x,f,note\n0,1,2,a\n1,3,b\n2,3,4,c\n', 'row 2 has 3 cells, expected 4'),
    ('t,x,f,note\n0,1,2,a\n1,3,\n2,3,4,c\n', 'row 2 has 3 cells, expected 4'),
    ('t,x,note\n0,1,a\n7,1,2,\n2,3,c\n3,4,c\n', 'row 2 has 4 cells, expected 3'),
    ('t,q,q#1\n0,"[1, 2]",3\n1,"[1, 2]",3\n', 'two columns are called q#1')])
def test_rows_of_another_width_are_refused(tmp_path: Path, content: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read(tmp_path, content)


@pytest.mark.parametrize(('content', 'expected'), [
    ('t,x,note\n0,1,start, slowly\n1,2\n2,3,\n', {'x': [1, 2, 3]}),
    ('t,x,\n0,1\n1,2\n', {'x': [1, 2]}),
    ('pos,force\n1,10\n2,20\n#N/A,30\n#DIV/0!,40\n', {'pos': [1, 2, NAN, NAN],
                                                      'force': [10, 20, 30, 40]}),
    ('x\n1\n#NUM!\n3\n# a remark, 4\n', {'x': [1, NAN, 3]}),
    ('pos\tforce\n1\t10\n\t\n\n3\t30\n', {'pos': [1, NAN, 3]}),
    ('t,x,note\n0,1,"\n1,2,"\n2,3,"stuck\n3,4,\n', {'x': [1, 2, 3, 4]}),
    ('t,cmd,pos\n0,NA,NA\n1,-,NA\n2,1.5,2.5\n3,1.6,2.6\n', {'pos': [NAN, NAN, 2.5, 2.6]}),
    ('a,b\nNA,NA\n1,2\n2,3\n3,4\n', {'a': [NAN, 1, 2, 3]}),
    ('t,x\n2024-01-01 10:00:00,NA\n2024-01-01 10:00:01,1\n2024-01-01 10:00:02,2\n',
     {'x': [NAN, 1, 2]}),
    ('t;x\n0;"[1,5; 2,5]"\n1;"[1,6; NA]"\n', {'x#1': [1.5, 1.6], 'x#2': [2.5, NAN]}),
    ('t\tx\n0,5\t[1, 2]\n1,5\t[3, 4]\n', {'t': [0.5, 1.5], 'x#1': [1, 3]}),
    ('t,x,x#2,x\n0,1,10,100\n1,2,20,200\n', {'x': [1, 2], 'x#2': [10, 20], 'x#3': [100, 200]}),
    ('LabVIEW Measurement\t\n***End_of_Header***\t\n\nChannels\t1\t\nX0\t0,0\t\n'
     '***End_of_Header***\t\t\nX_Value\tPos\tComment\n0,000\t1,5\t\n0,001\t2,5\t\n',
     {'X_Value': [0.0, 0.001], 'Pos': [1.5, 2.5]}),
    ('t,x\n0,1\n1,2\n# event: valve opened\n2,3\n3,4\n', {'x': [1, 2, 3, 4]}),
    ('Time,101,102\n0,1,2\n1,2,3\n', {'101': [1, 2], '102': [2, 3]}),
    ('t\tx\n0,0\t1,5\n0,1\t\n0,2\tNA\n0,3\t1,7\n0,4\t1,8\n', {'x': [1.5, NAN, NAN, 1.7, 1.8]}),
    ('t;note\n0;a\n1;b\n2', {'t': [0, 1, 2]}),
    ('t x\n0,001 1,5\n0,002 2,5\n', {'t': [0.001, 0.002], 'x': [1.5, 2.5]})])
def test_values_stay_in_their_rows_and_columns(
        tmp_path: Path, content: str, expected: dict[str, list[float]]) -> None:
    found = read(tmp_path, content)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values)


def test_no_first_row_of_missing_values_is_lost(tmp_path: Path) -> None:
    found = read(tmp_path, '0,NA,NA\n1,NA,NA\n2,1.5,2.5\n', ['t', 'a', 'b'])
    assert found['t'] == [0.0, 1.0, 2.0]
    assert read(tmp_path, 't,x\n0,OVERLOAD\n1,2\n2,3\n')['t'] == [0.0, 1.0, 2.0]


def test_a_row_that_is_cut_off_at_the_end_is_left_out_with_a_remark(tmp_path: Path) -> None:
    with pytest.warns(InputWarning, match="its last row, '2,3', is cut off"):
        assert read(tmp_path, 't,x,f\n0,1,2\n1,2,3\n2,3')['t'] == [0.0, 1.0]


@pytest.mark.parametrize(('mark', 'quote'), [(',', '"'), (';', ''), (' ', '"')])
def test_names_of_rows_without_a_name_in_the_header(tmp_path: Path, mark: str, quote: str) -> None:
    content = 't,x,note\n' + ''.join(f'{quote}{k}{quote},{0.1 * k},{k + 4},ok\n'
                                     for k in range(1, 9))
    with pytest.warns(InputWarning, match='has 3 names, its rows have 4 cells'):
        found = read(tmp_path, content.replace(',', mark))
    assert found['t'][:2] == [0.1, 0.2] and found['x'][:2] == [5.0, 6.0]


@pytest.mark.parametrize(('cells', 'expected'), [
    ('998 999 1,000', None), ('998.5 999.5 1,000', None), ('998.5 999.5 1,5', None),
    ('1,000.5 2 3', None), ('1,000,000 2 3', None),
    ('1,5 2 3', [1.5, 2.0, 3.0]), ('0,998 1 1,002', [0.998, 1.0, 1.002]),
    ('-1,25e3 NA 0', [-1250.0, NAN, 0.0]), ('-19,5m 2,5 3', '-19.5m')])
def test_commas_that_may_separate_thousands_stay_as_they_are_written(
        tmp_path: Path, cells: str, expected: list[float] | str | None) -> None:
    each = cells.split()
    content = 't;f\n' + ''.join(f'{k};{cell}\n' for k, cell in enumerate(each))
    with warnings.catch_warnings():
        warnings.simplefilter('error', InputWarning)
        found = read(tmp_path, content)['f']
    if isinstance(expected, list):
        np.testing.assert_array_equal(found, expected)
    else:
        assert found == each if expected is None else found[0] == expected


def test_commas_before_three_digits_alone_are_decimal_with_a_remark(tmp_path: Path) -> None:
    with pytest.warns(InputWarning, match='column f: 1,000 is read as 1.000, with a decimal comm'):
        assert read(tmp_path, 't\tf\n0\t1,000\n1\t1,250\n')['f'] == [1.0, 1.25]


@pytest.mark.parametrize(('cells', 'expected'), [
    (['23:59:59', '24:00:00', '100:00:01.5'], [0.0, 1.0, 273_602.5]),
    (['NA', '10:00:01', '10:00:02'], [NAN, 0.0, 1.0]),
    (['2020-12-31T10:00:00.123456789012', '2020-12-31T10:00:01.2'], [0.0, 1.076543211]),
    (['23:59:58', '23:59:60'], "row 2: there is no date or time '23:59:60'"),
    (['31.01.2020 10:00:00', '31.02.2020 10:00:00'], "row 2: .*'31.02.2020 10:00:00'"),
    (['1.4.2020 10:00', '4.13.2020 10:00'], "row 2: .*'4.13.2020 10:00'"),
    (['2020-01-01 23:59:59', '2020-01-01 24:00:00'], 'row 2: there is no')])
def test_dates_that_do_not_exist_are_refused_and_durations_may_exceed_a_day(
        tmp_path: Path, cells: list[str], expected: list[float] | str) -> None:
    column = np.array(cells, object)
    if isinstance(expected, str):
        with pytest.raises(InputError, match=f'a.csv: column t, {expected}'):
            since_first('t', column, Path('a.csv'))
    else:
        np.testing.assert_allclose(since_first('t', column, Path('a.csv')), expected, rtol=1e-12)


def test_hours_and_minutes_are_told_from_minutes_and_seconds() -> None:
    with pytest.warns(InputWarning, match="'1:00' is read as hours and minutes"):
        since_first('t', np.array(['1:00', '1:01'], object), Path('a.csv'))


@pytest.mark.parametrize(('state', 'command', 'term', 'begin'), [
    ('2024-01-01 10:00:0{k}', '2024-01-01 10:00:0{k}', 't+3', 3.0),
    ('2024-01-01 10:00:0{k}', '2024-01-01 10:00:0{k}', 't-0.5', -0.5),
    ('{k}000m', '{k}000', 't+2000[ms]', 2.0), ('{k}000m', '{k}000m', 't+2', 2.0)])
def test_each_of_several_files_has_its_own_unit_and_offset(
        tmp_path: Path, state: str, command: str, term: str, begin: float) -> None:
    for name, column, text in (('state', 'x', state), ('command', 'u', command)):
        (tmp_path / f'{name}.csv').write_text(f't,{column}\n' + ''.join(
            f'{text.format(k=k)},{k}\n' for k in range(9)))
    with pytest.warns(InputWarning, match=re.escape(f'begins {begin:+g} s after')):
        import_recording([tmp_path / 'state.csv', tmp_path / 'command.csv'], [
            'time=state/t', f'time=command/{term}', 'position=x[m]', 'command=u[N]'])


def test_dates_of_two_parquet_files_and_of_a_text_are_of_one_clock(tmp_path: Path) -> None:
    for name, column, first in (('a', 'x', 0), ('b', 'u', 2)):
        times = np.datetime64('2024-05-01T10:00:00', 'ns') + np.arange(
            first, first + 9) * np.timedelta64(1, 's')
        write_table(pa.table({'t': times, column: np.arange(9.0)}), tmp_path / f'{name}.parquet')
    (tmp_path / 'c.csv').write_text('t,u\n' + ''.join(
        f'2024-05-01 10:00:0{k},{k}\n' for k in range(2, 9)))
    for other in ('b.parquet', 'c.csv'):
        with pytest.warns(InputWarning, match=r'begins \+2 s after'):
            import_recording([tmp_path / 'a.parquet', tmp_path / other],
                             ['time=t', 'position=x[m]', 'command=u[N]'])
    (tmp_path / 'd.csv').write_text('t,u\n0,1\n1,2\n')
    with pytest.raises(InputError, match='d.csv: its time is a number, that of .*quet a date'):
        import_recording([tmp_path / 'a.parquet', tmp_path / 'd.csv'],
                         ['time=t', 'position=x[m]', 'command=u[N]'])


@pytest.mark.parametrize(('content', 'names'), [
    ('t,pos,force\nms,mm,kN\n0,1,5\n1,2,6\n', ['t [ms]', 'pos [mm]', 'force [kN]']),
    ('t;pos;flow\ns;mm;l/min\n0;1;5\n1;2;6\n', ['t [s]', 'pos [mm]', 'flow [l/min]']),
    ('%t,pos (raw),x [m]\n%[s],[mm],[m]\n0,1,5\n1,2,6\n', ['t [s]', 'pos (raw)', 'x [m]']),
    ('t\tpos\tn\ns\tmm\t-\n0\t1\t5\n1\t2\t6\n', ['t [s]', 'pos [mm]', 'n']),
    ('t x\n[s] [mm]\n0 1\n1 2\n', ['t [s]', 'x [mm]']),
    ('deg,rpm,current\n0,1,5\n1,2,6\n', ['deg', 'rpm', 'current']),
    ('s,mm\n0,1\n1,2\n', ['#1 [s]', '#2 [mm]']),
    ('t,"Force\n[kN]","Pos\n[mm]"\n0,1,5\n1,2,6\n', ['t', 'Force [kN]', 'Pos [mm]']),
    ('t;f\ns;N\n---;---\n0;1\n1;2\n', ['t [s]', 'f [N]']),
    ('t,x\n0,1;\n1,2;\n', ['t', 'x'])])
def test_a_line_of_units_is_the_unit_of_each_column(
        tmp_path: Path, content: str, names: list[str]) -> None:
    assert list(read(tmp_path, content)) == names


UNIT_LINE = 't,pos,q\nms,mm,%\n0,1,5\n1,2,6\n'
NAMES = 't (ms),pos (mm),volts (V),pos_mm,x_raw\n0,1,5,1,7\n1,2,6,2,8\n'


@pytest.mark.parametrize(('content', 'term', 'value', 'remark'), [
    (UNIT_LINE, 'position=pos', 0.001, "is read in mm, which the column 'pos [mm]' states"),
    (UNIT_LINE, 'position=pos[mm]', 0.001, ''), (UNIT_LINE, 'position=pos [mm]', 0.001, ''),
    (UNIT_LINE, 'position=pos*2[mm]', 0.002, ''), (UNIT_LINE, 'position=pos[m]', 1.0, ''),
    (UNIT_LINE, 'command=q', 0.05, 'is read in %'),
    (UNIT_LINE, 'position=pos*0.001', 0.001, 'taken in m, though the name'),
    (NAMES, 'position=pos (mm)', 0.001, "is read in mm, which the column 'pos (mm)' states"),
    (NAMES, 'reference=pos (mm)', 0.001, 'is read in mm'),
    (NAMES, 'force=volts (V)*250', 1250.0, ''),
    (NAMES, 'force=volts (V)', 5.0, "though the name of the column 'volts (V)' suggests V"),
    (NAMES, 'position=pos_mm', 1.0, 'suggests mm; if it is in mm, write position=pos_mm[mm]'),
    (NAMES, 'force=pos_mm', 1.0, ''), (NAMES, 'position=x_raw', 7.0, '')])
def test_a_mapping_without_a_unit_has_that_in_the_name_or_a_remark(
        tmp_path: Path, content: str, term: str, value: float, remark: str) -> None:
    (tmp_path / 'a.csv').write_text(content)
    time = 'time=t[ms]' if content == UNIT_LINE else 'time=t (ms)[ms]'
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter('always', InputWarning)
        run = import_recording(tmp_path / 'a.csv', [time, term])
    assert run.time_s.tolist() == [0.0, 0.001]
    assert run.signal(term.partition('=')[0])[0] == pytest.approx(value)
    said = [str(each.message) for each in warned if each.category is InputWarning]
    assert len(said) == bool(remark)
    assert remark in ''.join(said)


def test_a_line_of_units_is_previewed_and_kept_for_each_joint(tmp_path: Path) -> None:
    (tmp_path / 'a.csv').write_text('t,q_hip,q_knee\nms,deg,deg\n' + ''.join(
        f'{k},{k % 3},{k % 4}\n' for k in range(20)))
    assert preview(tmp_path / 'a.csv').mapping == ['time=t [ms][ms]', 'position=q_hip [deg][deg]']
    runs = import_joints(tmp_path / 'a.csv', ['time=t', 'position=q_{joint}'])
    assert list(runs) == ['hip', 'knee'] and runs['knee'].unit('position') == 'rad'


@pytest.mark.parametrize(('term', 'write'), [
    ('x/1000', r'x\*0\.001'), ('-x', r'x\*-1'), ('2*x', r'x\*2')])
def test_another_form_of_a_mapping_is_told(tmp_path: Path, term: str, write: str) -> None:
    (tmp_path / 'a.csv').write_text('t,x\n0,1\n1,2\n')
    with pytest.raises(InputError, match=f'names no column: write {write}; there are t, x'):
        import_recording(tmp_path / 'a.csv', ['time=t', f'position={term}'])


def test_a_time_whose_counter_began_again_is_told(tmp_path: Path) -> None:
    (tmp_path / 'a.csv').write_text('t,x\n4294966000,1\n4294967000,2\n704,3\n1704,4\n')
    with pytest.raises(InputError, match=r'at row 3: if its counter .* time=t\*int32\[ms\]'):
        import_recording(tmp_path / 'a.csv', ['time=t[ms]', 'position=x'])
    run = import_recording(tmp_path / 'a.csv', ['time=t*int32[ms]', 'position=x'])
    np.testing.assert_allclose(run.time_s, [0.0, 1.0, 2.0, 3.0])


def test_what_an_archive_holds_beside_numbers_is_read_or_told(tmp_path: Path) -> None:
    day = np.datetime64('2024-05-01T10:00:00', 'ms')
    np.savez(tmp_path / 'a.npz', t=day + np.arange(3) * np.timedelta64(500, 'ms'),
             on=np.array([True, False, True]), x=np.arange(3.0), mode=np.array(['a', 'b', 'c']),
             note='a remark')
    with pytest.warns(InputWarning, match='mode is left out') as warned:
        run = import_recording(tmp_path / 'a.npz', ['time=t', 'position=x', 'command=on[1]'])
    assert not [each for each in warned if 'note' in str(each.message)]
    assert run.time_s.tolist() == [0.0, 0.5, 1.0]
    assert run.signal('command').tolist() == [1.0, 0.0, 1.0]


@pytest.mark.parametrize(('header', 'mapping'), [
    ('time_usec,force_kip', ['time=time_usec[us]', 'force=force_kip[kip]']),
    ('time_min,pos_min', ['time=time_min[min]', 'position=pos_min[m]']),
    ('X_Value,Pos', ['time=X_Value[s]', 'position=Pos[m]']),
    ('time_sec,force_hand', ['time=time_sec[s]', 'force=force_hand[N]'])])
def test_the_preview_knows_units_that_are_written_out(
        tmp_path: Path, header: str, mapping: list[str]) -> None:
    (tmp_path / 'a.csv').write_text(header + '\n' + ''.join(f'{k},{k % 3}\n' for k in range(9)))
    assert preview(tmp_path / 'a.csv').mapping == mapping
