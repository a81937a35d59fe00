"""A preview of a file, logs in several files, and ROS 1 bags."""

import shlex
from pathlib import Path

import numpy as np
import pytest
from documented import problems
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore
from typer.testing import CliRunner

import asi_analysis as asi
from asi_analysis.bags import bag_file
from asi_analysis.bags.bag import read_bag
from asi_analysis.bags.exchange.importing import import_recording
from asi_analysis.bags.exchange.preview import preview
from asi_analysis.bags.exchange.summary import Previews
from asi_analysis.cli import app
from asi_analysis.errors import InputError, InputWarning

T = np.arange(200) * 0.01


def table(path: Path, header: str, *columns: np.ndarray) -> Path:
    rows = [','.join(f'{cell:.9g}' for cell in row) for row in zip(*columns, strict=True)]
    path.write_text('\n'.join([header, *rows]) + '\n')
    return path


@pytest.mark.parametrize('header, mapping', [
    ('time_ms,angle_deg,angleCmd_deg,torque (Nm)',
     ['time=time_ms[ms]', 'position=angle_deg[deg]', 'reference=angleCmd_deg[deg]',
      'force=torque (Nm)[Nm]']),
    ('t,q,q_des,tau', ['time=t[s]', 'position=q[rad]', 'reference=q_des[rad]', 'force=tau[Nm]']),
    ('clock,supply_bar,p_set_bar,valve_V',
     ['time=clock[s]', 'pressure=supply_bar[bar]', 'reference=p_set_bar[bar]']),
    ('t_s,force_mN,pos_MM,p_MPa', ['time=t_s[s]', 'force=force_mN[mN]', 'position=pos_MM[mm]',
                                   'pressure=p_MPa[MPa]']),
    ('t_s,Position [°],posRef,rpm', ['time=t_s[s]', 'position=Position [°][°]',
                                     'reference=posRef[°]', 'velocity=rpm[rpm]']),
    ('t_s,force kN,pos mm,posRef', ['time=t_s[s]', 'force=force kN[kN]', 'position=pos mm[mm]',
                                    'reference=posRef[mm]']),
    ('t_s,u_in,x_ft,force', ['time=t_s[s]', 'command=u_in[N]', 'position=x_ft[ft]',
                             'force=force[N]']),
    ('time_s,valve_position_m,position_m,spool_pos_mm', [
        'time=time_s[s]', 'valve_position=valve_position_m[m]', 'position=position_m[m]']),
    ('t_s,i_q_A,theta [mdeg],note', ['time=t_s[s]', 'command=i_q_A[A]',
                                     'position=theta [mdeg][mdeg]']),
    ('t_s,I (mA),p_A,note', ['time=t_s[s]', 'command=I (mA)[mA]', 'pressure=p_A[Pa]']),
    ('t_s,SP %,PV %,OP %', ['time=t_s[s]', 'reference=SP %[m]', 'position=PV %[m]',
                            'command=OP %[%]']),
    ('t_s,q_deg,tau_m,note', ['time=t_s[s]', 'position=q_deg[deg]', 'force=tau_m[Nm]']),
])
def test_the_names_and_units_of_the_columns_are_read(tmp_path, header, mapping):
    found = preview(table(tmp_path / 'log.csv', header, T, np.sin(T), np.cos(T), np.ones(200)))
    assert found.mapping == mapping
    assert [each['name'] for each in found.columns if each['signal']] == [
        each.partition('=')[2].rpartition('[')[0] for each in mapping]


def test_a_unit_that_no_signal_has_is_not_taken_for_another(tmp_path):
    # "Q (l/min) has no unit: rad is assumed", it said.
    found = preview(table(tmp_path / 'log.csv', 't_s,Q (l/min),x (raw)', *np.ones((3, 200)) * T))
    assert found.mapping == ['time=t_s[s]', 'position=x (raw)[m]']
    assert 'no signal has the unit l/min' in found.notes[0]


def test_elements_of_lists_and_of_objects_are_previewed(tmp_path):
    path = tmp_path / 'log.jsonl'
    path.write_text('\n'.join(f'{{"ts_ms": {k}, "goal_deg": 1, "present": {{"deg": {k % 7}}}}}'
                              for k in range(50)))
    assert preview(path).mapping == ['time=ts_ms[ms]', 'reference=goal_deg[deg]',
                                     'position=present.deg[deg]']


def test_what_is_assumed_is_said_and_gaps_are_counted(tmp_path):
    found = preview(table(tmp_path / 'log.csv', 't,q1,q2', np.delete(T, [50, 51]),
                          *np.ones((2, 198))))
    assert found.gaps == 1 and found.longest_gap_s == pytest.approx(0.03)
    assert found.rate_hz == pytest.approx(100.0) and found.duration_s == pytest.approx(1.99)
    assert found.notes == ['t has no unit: with s a step is 0.01 s',
                           'q2 may be the position as well as q1',
                           'q1 has no unit: rad is assumed']


def test_the_printed_command_imports_the_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    table(tmp_path / 'log.csv', 'time_ms,angle_deg', 1e3 * T, 90.0 * T)
    printed = CliRunner().invoke(app, ['import', 'log.csv'])
    assert printed.exit_code == 0
    command = shlex.split(printed.output.splitlines()[-1].removeprefix('to import: '))
    assert command[:3] == ['asi', 'import', 'log.csv']
    assert CliRunner().invoke(app, command[1:]).exit_code == 0
    assert read_bag('log_bag').position_m == pytest.approx(0.5 * np.pi * T)
    assert problems(Previews.of([preview('log.csv')]).to_dict(), 'asi import FILE') == []


def test_the_printed_command_has_the_options_that_the_files_were_read_with(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, column in (('a', 'force_N'), ('b', 'u_V')):
        rows = '\n'.join(f'{0.01 * k},{k}' for k in range(50))
        Path(f'{name}.csv').write_text(f'remark,1\nanother,2\nt_s,{column}\n{rows}\n')
    for call in (['a.csv', '--skip-lines', '2', '--rate', '100'],
                 ['a.csv', 'b.csv', '--skip-lines', '2']):
        printed = CliRunner().invoke(app, ['import', *call]).stdout
        command = shlex.split(printed.splitlines()[-1].removeprefix('to import: '))
        assert command[command.index('--skip-lines') + 1] == '2'
        done = CliRunner().invoke(app, [*command[1:-1], f'bag_{len(call)}_{call[1]}'])
        assert done.exit_code == 0, done.exception


def test_columns_that_say_nothing_are_left_to_the_user(tmp_path):
    found = preview(table(tmp_path / 'log.csv', 'a,b', np.cos(T), np.sin(T)))
    assert 'SIGNAL=a[UNIT]' in found.command and '--rate HZ' in found.command
    assert len(found.notes) == 2


@pytest.mark.parametrize('bad', ['err', 'inf'])
def test_a_column_that_cannot_be_imported_is_named_with_its_row(tmp_path, bad):
    rows = [f'{0.01 * k},{bad if k == 50 else k},{k}' for k in range(100)]
    for count, header in ((3, 't,force_N,pos_m'), (2, 't,force_N')):
        (tmp_path / 'log.csv').write_text('\n'.join(
            [header, *(row.rsplit(',', 3 - count)[0] for row in rows)]))
        found = preview(tmp_path / 'log.csv')
        assert found.mapping == ['time=t[s]', 'position=pos_m[m]'][:count - 1]
        assert found.notes[0].startswith('left out: column force_N, row 51: ')


def two_files(folder: Path, offset: float = 0.0) -> list[Path]:
    return [table(folder / 'state.csv', 't,angle', T, 90.0 * T),
            table(folder / 'command.csv', 't,u', offset + T[::10], np.arange(20.0))]


def test_a_log_in_two_files_is_joined_at_the_times_of_the_first(tmp_path):
    files = two_files(tmp_path, 0.055)
    with pytest.warns(InputWarning, match=r'begins \+0.055 s after the first file'):
        run = import_recording(files, ['time=t', 'position=angle[deg]', 'command=u[Nm]'])
    assert run.position_m == pytest.approx(0.5 * np.pi * T)
    assert np.isnan(run.command_n[:6]).all()
    assert run.command_n[6:].tolist() == np.repeat(np.arange(20.0), 10)[:194].tolist()
    own = ['time=state/t', 'time=command/t-0.055', 'position=angle[deg]', 'command=u[Nm]']
    with pytest.warns(InputWarning, match=r'begins \+0 s after'):
        shifted = import_recording(files, own)
    assert shifted.command_n.tolist() == np.repeat(np.arange(20.0), 10).tolist()


def test_a_gap_in_another_file_is_told(tmp_path):
    state, command = two_files(tmp_path)
    table(command, 't,u', np.delete(T[::10], slice(5, 9)), np.arange(16.0))
    with pytest.warns(InputWarning, match='0.1 s later, up to 0.5 s across a gap'):
        import_recording([state, command], ['time=t', 'position=angle[deg]', 'command=u[Nm]'])


@pytest.mark.parametrize('mapping, words', [
    (['time=t', 'position=angle[deg]', 'command=t'], 'write command=state/'),
    (['time=t', 'position=angle[deg]'], 'command.csv: no signal of it is mapped'),
    (['time=state/t', 'position=angle', 'command=u'], 'command.csv: 0 columns are mapped to time'),
    (['time=t', 'position=angle', 'command=v'], 'names no column'),
    (['time=state/t', 'time=command/t+99', 'position=angle', 'command=u'], 'do not overlap')])
def test_what_is_open_in_several_files_is_asked(tmp_path, mapping, words):
    with pytest.raises(InputError, match=words):
        import_recording(two_files(tmp_path), mapping)


def test_dates_of_two_files_are_of_one_clock(tmp_path):
    for name, first in (('a', 0), ('b', 2)):
        (tmp_path / f'{name}.csv').write_text('when,' + name + '\n' + ''.join(
            f'2024-05-01 10:00:{k + first:02d},{k}\n' for k in range(10)))
    with pytest.warns(InputWarning, match=r'begins \+2 s'):
        run = import_recording([tmp_path / 'a.csv', tmp_path / 'b.csv'],
                               ['time=when', 'position=a', 'command=b'])
    assert run.command_n[2:].tolist() == list(range(8))


def test_a_reference_without_a_unit_is_asked_for(tmp_path):
    file = table(tmp_path / 'log.csv', 't,q,r', T, T, T)
    with pytest.raises(InputError, match=r'write reference=r\[rad\] if it is that of the posi'):
        import_recording(file, ['time=t', 'position=q[rad]', 'reference=r'])


def test_the_x_of_a_wrench_is_no_position(tmp_path):
    asi.simulate({}, {}, 0.1, out=tmp_path / 'run')
    found = preview(tmp_path / 'run/bag')
    assert {'reference=/force_reference/wrench/force/x[N]',
            'command=/valve_command/wrench/force/x[N]'} <= set(found.mapping)
    assert 'a joint state has no units: those of a rotary joint are assumed' in found.notes


def test_a_bag_that_was_cut_off_is_previewed_as_it_is_imported(tmp_path):
    asi.simulate({}, {}, 0.1, out=tmp_path / 'run')
    whole = preview(tmp_path / 'run/bag')
    (tmp_path / 'run/bag/metadata.yaml').unlink()
    data = (tmp_path / 'run/bag/bag_0.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(data[:len(data) // 2])
    for path, words in (('run/bag', 'no metadata.yaml'), ('cut.mcap', 'cut off')):
        with pytest.warns(InputWarning, match=words):
            found = preview(tmp_path / path)
        assert found.mapping == whole.mapping and 0 < found.samples <= whole.samples


def test_a_ros_1_bag_is_read_as_a_rosbag2(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    state, header, time, number = (store.types[name] for name in (
        'sensor_msgs/msg/JointState', 'std_msgs/msg/Header', 'builtin_interfaces/msg/Time',
        'std_msgs/msg/Float64'))
    file = tmp_path / 'robot.bag'
    with Writer(file) as writer:
        states, commands = (writer.add_connection(topic, of.__msgtype__, typestore=store)
                            for topic, of in (('/joint_states', state), ('/u', number)))
        for k in range(50):
            stamp = 10**11 + k * 10**7
            message = state(header(k, time(100, k * 10**7), ''), ['hip', 'knee'],
                            np.array([1.0, 0.1 * k]), np.array([0.0, 1.0]), np.array([]))
            writer.write(states, stamp, store.serialize_ros1(message, state.__msgtype__))
            if k % 5 == 0:
                writer.write(commands, stamp, store.serialize_ros1(number(float(k)),
                                                                   number.__msgtype__))
    found = preview(file)
    assert found.mapping[0] == 'position=/joint_states/hip/position[rad]'
    assert '/joint_states/knee/position' in [each['name'] for each in found.columns]
    with pytest.warns(InputWarning, match='/u has no stamps'):
        run = import_recording(file, ['position=/joint_states/knee/position[rad]',
                                      'command=/u/data[Nm]'])
    assert run.time_s == pytest.approx(0.01 * np.arange(50))
    assert run.position_m == pytest.approx(0.1 * np.arange(50))
    assert run.command_n.tolist() == np.repeat(np.arange(0.0, 50.0, 5.0), 5).tolist()
    with pytest.raises(InputError, match='it has /joint_states, /u'):
        import_recording(file, ['position=/nothing/x'])
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(InputError, match='cannot be read'):
        preview(file)


@pytest.mark.parametrize('form', [Writer.CompressionFormat.BZ2, Writer.CompressionFormat.LZ4])
def test_chunks_of_a_ros_1_bag_are_unpacked_up_to_a_limit(form, tmp_path, monkeypatch):
    store = get_typestore(Stores.ROS1_NOETIC)
    number, text = (store.types[name] for name in ('std_msgs/msg/Float64', 'std_msgs/msg/String'))
    for name, size in (('small', 10), ('bomb', 10_000_000)):
        writer = Writer(tmp_path / f'{name}.bag')
        writer.set_compression(form)
        with writer:
            topics = [writer.add_connection(topic, of.__msgtype__, typestore=store)
                      for topic, of in (('/u', number), ('/text', text))]
            for k in range(50):
                writer.write(topics[0], 10**11 + k * 10**7, store.serialize_ros1(
                    number(float(k)), number.__msgtype__))
            writer.write(topics[1], 2 * 10**11, store.serialize_ros1(
                text(size * '0'), text.__msgtype__))
    monkeypatch.setattr(bag_file, 'MOST_UNPACKED', 1_000_000)
    with pytest.warns(InputWarning, match='has no stamps'):
        run = import_recording(tmp_path / 'small.bag', ['command=/u/data[N]'])
    assert run.command_n.tolist() == [*range(50)]
    with pytest.raises(InputError, match=r'bomb.bag cannot be read: it unpacks to more than'):
        import_recording(tmp_path / 'bomb.bag', ['command=/u/data[N]'])
