"""The command line: help, exit statuses, one line of complaint, the documented JSON."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import PATIENCE_S, wait_until
from documented import problems
from rosbags.rosbag2 import Reader

from asi_analysis import cli, terminal
from asi_analysis.bags.run import Run
from asi_analysis.cli import interrupt
from asi_analysis.errors import InputError
from asi_analysis.experiments import running
from asi_analysis.loop.closed_loop import simulate_loop
from asi_analysis.measures.analysis import analyze

ROOT = Path(__file__).parents[2]


def asi(*arguments, **options):
    """Run the command in a process of its own, as a user does."""
    return subprocess.run(
        [sys.executable, '-m', 'asi_analysis.cli', *arguments], capture_output=True, text=True,
        env={**os.environ, 'PYTHONPATH': str(ROOT)}, **options)


@pytest.fixture
def here(monkeypatch, capsys):
    """Return a function that runs the command in this process: what it returns, and printed."""
    def main(*arguments):
        monkeypatch.setattr(sys, 'argv', ['asi', *arguments])
        return cli.main(), *capsys.readouterr()
    return main


@pytest.mark.parametrize('command', ['run', 'analyze', 'import', 'export', 'reproduce', 'demo',
                                     'gap'])
def test_help_of_each_command_shows_an_example(command, here):
    status, output, _ = here(command, '--help')
    assert status == 0
    assert f'Example: asi {command} ' in ' '.join(output.split())


def test_a_process_of_its_own_shows_its_help():
    result = asi('--help')
    assert result.returncode == 0 and 'Usage: ' in result.stdout


def test_help_loads_nothing_heavy():
    code = ('import sys\nfrom asi_analysis import cli\nsys.argv = ["asi", "--help"]\n'
            'cli.main()\n'
            'heavy = {"rclpy", "numpy", "numba", "scipy", "matplotlib"} & set(sys.modules)\n'
            'sys.exit(f"loaded: {heavy}" if heavy else 0)')
    result = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                            env={**os.environ, 'PYTHONPATH': str(ROOT)})
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize('arguments, said', [
    ((), 'Usage'),
    (('bogus',), 'bogus'),
    (('analyze',), "Missing argument 'bag'"),
    (('analyze', 'nowhere'), 'nowhere'),
    (('analyze', 'empty.mcap'), 'empty.mcap'),
    (('run', '--compensator', 'pid'), 'compensator'),
    (('run', '--gain', 'nan'), 'gain'),
    (('run', '--gain', 'much'), 'gain'),
    (('run', '--duration', '-1'), 'duration'),
    (('run', '--duration', 'nan'), 'duration'),
    (('run', '--duration', 'inf'), 'duration'),
    (('run', '--duration', '1e7'), 'duration'),
    (('run', '--duration', '1e-5'), 'duration'),
    (('run', '--mode', 'warp'), 'lockstep, realtime'),
    (('run', '--rate', '1e9'), 'rate'),
    (('run', '--rate', 'nan'), 'rate'),
    (('run', '--rate', '100'), '180 Hz'),
    (('tune', '--rate', 'nan'), 'rate of nan Hz'),
    (('predict', '--rate', 'nan'), 'rate'),
    (('predict', '--rate', '0'), 'rate'),
    (('predict', '--gain', '0'), 'gain'),
    (('quench', '--rates', '5000,0'), 'rate'),
    (('quench', '--replay', '-1'), '--replay'),
    (('calibrate', '--spread', 'nan', '--out', 'new'), 'spread'),
    (('calibrate', '--front', 'load.mas=1'), 'load.mas'),
    (('calibrate', '--structure', 'round'), 'cylinder'),
    (('gap',), 'asi gap BAG...'),
    (('gap', 'nowhere', '--plant', 'robot'), 'joint'),
    (('run', '--step', '5', '--reference', 'sine'), '--step'),
    (('run', '--set', 'load.mass=1'), 'actuator.NAME=VALUE'),
    (('run', '--set', 'actuator.load.mas=1'), 'load.mass'),
    (('run', '--set', 'actuator.load.mass=heavy'), 'load.mass'),
    (('run', '--set', 'controller.custom.poles=5', '--compensator', 'custom'), 'custom.poles'),
    (('run', '--actuator', 'nowhere.yaml'), 'nowhere.yaml'),
    (('run', '--actuator', 'foreign.yaml'), 'foreign.yaml'),
    (('run', '--controller', 'broken.yaml'), 'broken.yaml'),
    (('run', '--controller', 'wrong.yaml'), 'gian'),
    (('run', '--out', 'used'), 'used'),
    (('demo', '--out', 'used'), 'used'),
    (('demo', '--out', 'table.csv'), 'table.csv'),
    (('limit-cycle',), 'bags'),
    (('import', 'nowhere.csv', '--out', 'new'), 'nowhere.csv'),
    (('import', 'table.csv', '--map', 'force=load', '--rate', '10', '--out', 'new'), 'load'),
    (('import', 'short.csv', '--map', 'force=f', '--rate', '10', '--out', 'new'), 'short.csv'),
    (('import', 'table.csv', '--map', 'colour=t', '--rate', '10', '--out', 'new'), 'colour'),
    (('import', 'table.csv', '--map', 'force=f', '--rate', '10', '--zero', '-1', '--out', 'new'),
     'zero'),
    (('export', 'nowhere', '--out', 'new.csv'), 'nowhere'),
])
def test_bad_calls_are_told_in_one_line(arguments, said, tmp_path, monkeypatch, capsys):
    (tmp_path / 'empty.mcap').touch()
    (tmp_path / 'foreign.yaml').write_text('camera:\n  ros__parameters: {exposure: 3}\n')
    (tmp_path / 'broken.yaml').write_text('asi_controller: [')
    (tmp_path / 'wrong.yaml').write_text('asi_controller:\n  ros__parameters: {gian: 3.0}\n')
    (tmp_path / 'table.csv').write_text('t,f\n0,1\n1,2\n')
    (tmp_path / 'short.csv').write_text('f\n1\n')
    (tmp_path / 'used').mkdir()
    (tmp_path / 'used' / 'thesis.tex').touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, 'argv', ['asi', *arguments])
    assert cli.main() == 2
    output, complaint = capsys.readouterr()
    if arguments not in ((), ('gap',)):   # they are shown the help
        assert output == ''
        assert len(complaint.splitlines()) == 1, complaint
    # Some versions of typer write the names of arguments in capitals.
    assert said.lower() in (output + complaint).lower()
    assert (tmp_path / 'used' / 'thesis.tex').exists()


def test_bad_domain_is_told_in_one_line(monkeypatch, tmp_path):
    monkeypatch.setenv('ROS_DOMAIN_ID', 'mine')
    result = asi('run', '--out', 'new', cwd=tmp_path)
    assert result.returncode == 2
    assert 'ROS_DOMAIN_ID' in result.stderr and len(result.stderr.splitlines()) == 1


def test_arguments_that_are_no_text_do_not_concern_ros(monkeypatch):
    """Of `asi run --out` or `asi demo --out` with a file name in Latin-1."""
    monkeypatch.setattr(sys, 'argv', ['asi', 'run', '--out', os.fsdecode(b'n\xff')])
    with running._environment() as environment, running._watched(environment) as status:
        assert status().ticks == 0


def test_two_runs_never_share_a_domain(monkeypatch):
    """The one's controller would answer the other's actuator, and neither would notice."""
    monkeypatch.delenv('ROS_DOMAIN_ID', raising=False)
    with running._environment() as first, running._environment() as second:
        assert first['ROS_DOMAIN_ID'] != second['ROS_DOMAIN_ID']
        monkeypatch.setenv('ROS_DOMAIN_ID', first['ROS_DOMAIN_ID'])
        with pytest.raises(InputError, match='another asi run'), running._environment():
            pass
    with running._environment() as again:
        assert again['ROS_DOMAIN_ID'] == first['ROS_DOMAIN_ID']


@pytest.mark.parametrize('controller', [
    {'reference.shape': 'step'}, {'reference.shape': 'step', 'gain': 10.5},
    {'reference.shape': 'sine'}, {'reference.shape': 'prbs', 'reference.frequency': 300.0}])
def test_analysis_is_as_documented(controller):
    answer = analyze(Run(*simulate_loop({}, controller, 0.5), source='in process'))
    assert problems(json.loads(json.dumps(answer, allow_nan=False)), 'asi analyze') == []


def test_one_sample_is_too_little_to_analyse():
    with pytest.raises(InputError, match='one.mcap: one sample'):
        analyze(Run(np.zeros(1), force_n=np.ones(1), source='one.mcap'))


def test_documentation_check_can_fail():
    answer = analyze(Run(*simulate_loop({}, {'reference.shape': 'step'}, 0.3)))
    del answer['bandwidth_hz']
    answer['oscillation']['sustained'] = 'yes'
    answer['colour'] = 'blue'
    assert len(problems(answer, 'asi analyze')) == 3


def test_table_becomes_a_bag_and_a_table_again(tmp_path, monkeypatch, here):
    """A step in a CSV of milliseconds and kilonewtons: imported, analysed, exported."""
    t = np.arange(2000)
    force = np.where(t > 100, 0.1 * (1.0 - np.exp(-(t - 100) / 20.0)), 0.0)
    np.savetxt(tmp_path / 'log.csv', np.column_stack([t, np.where(t >= 100, 0.1, 0.0), force]),
               delimiter=',', header='t,wanted,load', comments='')
    imported = asi('import', 'log.csv', '--map', 'time=t[ms]', '--map', 'reference=wanted[kN]',
                   '--map', 'force=load[kN]', '--out', 'bag', '--json', cwd=tmp_path)
    assert imported.returncode == 0, imported.stderr
    document = json.loads(imported.stdout)
    assert problems(document, 'asi import') == []
    assert (document['rate_hz'], document['signals']) == (1000.0, ['reference', 'force'])
    monkeypatch.chdir(tmp_path)
    answer = json.loads(here('analyze', 'bag', '--json')[1])
    assert answer['rise_time_s'] == pytest.approx(0.020 * np.log(9.0), rel=1e-3)
    assert answer['bandwidth_hz'] == pytest.approx(1.0 / (2.0 * np.pi * 0.020), rel=0.02)
    exported = here('export', 'bag', '--out', 'again.csv', '--json')[1]
    assert problems(json.loads(exported), 'asi export') == []
    table = np.genfromtxt(tmp_path / 'again.csv', delimiter=',', names=True)
    assert np.allclose(table['force_n'], 1e3 * force)


def test_run_over_ros_equals_the_loop_in_process(ros_environment, tmp_path, here):
    """The analysis of a bag from three processes is that of the same loop computed here."""
    out = tmp_path / 'out'
    result = asi('run', '--compensator', 'lead_lag', '--step', '150', '--load', 'spring',
                 '--set', 'actuator.load.mass=0.3', '--duration', '0.3', '--rate', '2000',
                 '--out', str(out), '--json')
    assert result.returncode == 0, result.stderr
    answer = json.loads(result.stdout)
    assert problems(answer, 'asi run') == []
    assert (answer['mode'], answer['ticks'], answer['compensator']) == (
        'lockstep', 600, 'lead_lag')
    expected = analyze(Run(*simulate_loop(
        {'load.type': 'spring', 'load.mass': 0.3},
        {'compensator': 'lead_lag', 'reference.shape': 'step', 'reference.amplitude': 150.0},
        0.3, 2000.0)))
    for key in ('rise_time_s', 'overshoot_percent', 'settling_time_5_s', 'steady_state_error_n',
                'bandwidth_hz'):
        assert answer[key] == pytest.approx(expected[key], rel=1e-6), key

    status, again, _ = here('analyze', answer['bag'], '--json')
    assert status == 0
    for key, value in json.loads(again).items():
        assert answer[key] == value
    _, table, _ = here('analyze', answer['bag'])
    assert f'{answer["overshoot_percent"]:.3g} %' in table
    assert 'oscillation none' in ' '.join(table.split())


def messages_of(bag):
    """Return the messages of a bag in its order: topic, type, times, bytes."""
    with Reader(bag) as reader:
        return [(connection.topic, connection.msgtype, time_ns, bytes(data))
                for connection, time_ns, data in reader.messages()]


@pytest.mark.slow
def test_same_command_gives_the_same_bag_twice_over_ros_and_once_in_one_process(
        ros_environment, tmp_path):
    bags = []
    for name, how in (('first', []), ('second', []), ('third', ['--in-process'])):
        result = asi('run', '--compensator', 'lead4', '--step', '100', '--duration', '0.1',
                     '--load', 'prescribed', '--set', 'actuator.load.velocity=0.2',
                     '--set', 'actuator.load.frequency=20', '--set',
                     'actuator.force_sensor.noise=0.5', '--seed', '3', *how,
                     '--out', str(tmp_path / name), '--json')
        assert result.returncode == 0, result.stderr
        bags.append(Path(json.loads(result.stdout)['bag']))
    first, second, third = map(messages_of, bags)
    assert len(first) == 7 * 500 + 1
    assert first == second == third
    # Not only the messages: the same files.
    for file in ('bag/bag_0.mcap', 'bag/metadata.yaml', 'experiment.json', 'actuator.yaml',
                 'controller.yaml'):
        assert (tmp_path / 'first' / file).read_bytes() == (
            tmp_path / 'third' / file).read_bytes(), file


def processes_of(directory):
    """Return the processes whose command line names a directory."""
    found = []
    for path in Path('/proc').glob('[0-9]*/cmdline'):
        try:
            if str(directory) in path.read_text():
                found.append(path)
        except OSError:
            continue
    return found


@pytest.fixture
def recording(ros_environment, tmp_path):
    """Return an `asi run` to tmp_path / 'out', without end, whose bag has begun to grow."""
    process = subprocess.Popen(
        [sys.executable, '-m', 'asi_analysis.cli', 'run', '--duration', '1000', '--out',
         str(tmp_path / 'out')], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**ros_environment, 'PYTHONPATH': str(ROOT)})

    def grows():
        assert process.poll() is None, process.stderr.read()
        return any(path.stat().st_size > 50_000 for path in tmp_path.glob('out/bag/*.mcap'))

    try:
        wait_until(grows, 'a bag that grows')
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize('how', [
    signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow), signal.SIGKILL])
def test_stopped_in_the_middle_leaves_a_bag_and_no_orphan(how, recording, tmp_path):
    out, process = tmp_path / 'out', recording
    process.send_signal(how)
    process.wait(PATIENCE_S)
    wait_until(lambda: not processes_of(out), 'the end of every node')
    if how == signal.SIGINT:
        assert process.returncode == 130
        assert process.stderr.read().strip() == (
            f'asi: what was recorded is in {out / "bag"}\nasi: interrupted')
    from asi_analysis.bags.bag import read_bag
    run = read_bag(out / 'bag')
    assert len(run) > 100
    assert np.allclose(np.diff(run.time_s), 1.0 / 5000.0)


def test_dead_node_is_named(recording, tmp_path):
    """Kill -9 of the controller: the run ends, says which node died, and keeps its bag."""
    out, process = tmp_path / 'out', recording
    controller, = (path for path in processes_of(out)
                   if 'asi_controller.controller_node' in path.read_text())
    os.kill(int(controller.parent.name), signal.SIGKILL)
    assert process.wait(PATIENCE_S) == 1
    # A slow machine is told to wait, which is no complaint.
    complaint, = (line for line in process.stderr.read().splitlines() if 'waiting for' not in line)
    assert 'controller' in complaint and 'SIGKILL' in complaint
    assert processes_of(out) == []
    from asi_analysis.bags.bag import read_bag
    assert len(read_bag(out / 'bag')) > 100


def test_run_that_ends_in_a_fault_is_no_result(ros_environment, tmp_path, here):
    said = []
    arguments = ('run', '--duration', '0.2', '--step', '2400', '--set',
                 'actuator.valve_characteristic.maximum_force=4000', '--out')
    result = asi(*arguments, str(tmp_path / 'run0'))
    status, _, complaint = here(*arguments, str(tmp_path / 'run1'), '--in-process')
    for name, code, text in (('run0', result.returncode, result.stderr),
                             ('run1', status, complaint)):
        out = tmp_path / name
        assert code == 1
        assert 'limit.valve_disagreement = 1e-05 m' in text
        assert 'Traceback' not in text
        line = text.replace('\n', '')
        assert f'the bag so far: {out / "bag"}' in line
        # Over ROS a run this short may end before its state is heard: then it is that of the log.
        said.append(re.search(r'valve_position less .*? = 1e-05 m', line).group())
    assert said[0] == said[1]
    over_ros, in_process = (messages_of(tmp_path / name / 'bag') for name in ('run0', 'run1'))
    # Over ROS it goes on until it is ended.
    assert in_process == over_ros[:len(in_process)]
    assert [topic for topic, *_ in in_process].count('/diagnostics') == 2


@pytest.mark.slow   # test_run_that_ends_in_a_fault_is_no_result has one in its midst
def test_run_whose_first_state_is_beyond_a_limit_is_no_result(ros_environment, tmp_path):
    result = subprocess.run(
        [sys.executable, '-m', 'asi_analysis.cli', 'run', '--out', str(tmp_path / 'run'),
         '--duration', '0.2', '--set', 'actuator.force_sensor.offset=3000'],
        env=ros_environment, capture_output=True, text=True)
    assert result.returncode == 1
    assert 'limit.force = 2500 N' in result.stderr and 'Traceback' not in result.stderr
    assert str(tmp_path / 'run' / 'bag') in result.stderr.replace('\n', '')


@pytest.mark.parametrize('arguments, said', [
    (('--mode', 'realtime'), 'realtime'), (('--reference', 'topic'), 'topic'),
    (('--rate', '20000', '--set', 'actuator.command_limit=1e5'), 'command_limit')])
def test_what_needs_nodes_is_refused_in_one_process(arguments, said, tmp_path, monkeypatch,
                                                    capsys):
    monkeypatch.setattr(sys, 'argv', ['asi', 'run', '--in-process', '--out',
                                      str(tmp_path / 'out'), *arguments])
    assert cli.main() == 2
    message = capsys.readouterr().err
    assert said in message and len(message.splitlines()) == 1 and not (tmp_path / 'out').exists()


def test_ctrl_c_ends_a_compilation(tmp_path):
    """LLVM compiles the loop for many seconds, in which Python handles no signal."""
    process = subprocess.Popen(
        [sys.executable, '-m', 'asi_analysis.cli', 'attribute'], stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'PYTHONPATH': str(ROOT), 'NUMBA_CACHE_DIR': str(tmp_path)})
    wait_until(lambda: any(tmp_path.rglob('*.nbi')), 'the first compiled function')
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=PATIENCE_S)[1] == 'asi: interrupted\n'
    assert process.returncode == 130
    assert not list(tmp_path.rglob('*_close_block*')), 'it went on to compile'


def _ctrl_c_while_compiling(script, before=''):
    """Run a process that gets SIGINT while numba compiles, between two calls of LLVM."""
    script.write_text(before + """
import signal
import numba
import asi_common.jit
from asi_analysis import command
def answer(): pass
@numba.extending.overload(answer)
def typed():
    signal.raise_signal(signal.SIGINT)
    return lambda: 1.0
signal.signal(signal.SIGINT, command._raise)
numba.njit(lambda: answer())()
""")
    process = subprocess.run([sys.executable, script], capture_output=True, text=True,
                             env={**os.environ, 'PYTHONPATH': str(ROOT)})
    assert (process.returncode, process.stderr) == (130, 'asi: interrupted\n')


def test_ctrl_c_between_two_calls_of_llvm_ends_at_once(tmp_path):
    """A KeyboardInterrupt in llvmlite left objects that were incomplete: once it crashed."""
    _ctrl_c_while_compiling(tmp_path / 'compiles.py')


def test_ctrl_c_while_compiling_is_said_once(tmp_path):
    """Two threads see it: the one that watches, and Python's handler if LLVM has just returned."""
    _ctrl_c_while_compiling(tmp_path / 'compiles.py', """
import os, time
write = os.write
def slow(*arguments):
    write(*arguments)
    time.sleep(0.5)     # in which the other thread comes to write
os.write = slow
from asi_analysis.cli import interrupt
interrupt.end_while_compiling()
""")


def test_too_many_open_files_are_told_in_one_line(monkeypatch, capsys):
    def full():
        raise OSError(24, 'Too many open files')

    interrupt.end_while_compiling.cache_clear()
    monkeypatch.setattr(os, 'pipe', full)
    monkeypatch.setattr(sys, 'argv', ['asi', '--help'])
    assert cli.main() == 2
    assert capsys.readouterr().err == 'asi: [Errno 24] Too many open files\n'


def test_ctrl_c_names_no_bag_that_does_not_exist(tmp_path, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr('asi_analysis.loop.in_process.run_in_process', interrupted)
    monkeypatch.setattr(sys, 'argv', ['asi', 'run', '--in-process', '--out', str(tmp_path / 'a')])
    assert cli.main() == 130
    assert capsys.readouterr().err == 'asi: interrupted\n'


def test_ctrl_c_while_the_commands_are_built_is_one_line(monkeypatch, capsys):
    """Typer looks at the signatures of all of them before it catches anything."""
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr('asi_analysis.cli.app', interrupted)
    assert cli.main() == 130
    assert capsys.readouterr().err == 'asi: interrupted\n'


def test_a_part_keeps_its_share_where_none_is_known():
    shown: list[tuple[str, float | None]] = []
    part = terminal.part_of(lambda *each: shown.append(each), 'run', 1, 4)
    part('fitting', 0.5)
    part('fitting', None)
    assert shown == 2 * [('run: fitting', 0.375)]


def test_a_bar_that_knows_no_share_any_more_shows_none(monkeypatch):
    from rich.progress import Progress as Bars
    monkeypatch.setattr(sys.stderr, 'isatty', lambda: True, raising=False)
    bars: list[Bars] = []
    enter = Bars.__enter__
    monkeypatch.setattr(Bars, '__enter__', lambda self: bars.append(self) or enter(self))
    with terminal.bar() as progress:
        for share in (0.9, None, 0.2, None):
            progress('fitting', share)
            assert bars[0].tasks[0].total == (None if share is None else 1.0)


def test_progress_is_written_now_and_then_without_a_terminal(
        monkeypatch, capfd):
    monkeypatch.setattr(terminal, 'LINE_S', 0.01)
    monkeypatch.setattr(sys, 'stderr', io.TextIOWrapper(io.FileIO(2, 'w', closefd=False)))
    said = ''

    def written() -> bool:
        nonlocal said
        said += capfd.readouterr().err
        return 'asi: reading, 50%, after 0 s\n' in said

    with terminal.bar() as progress:
        progress('reading', 0.5)
        wait_until(written, 'a line of progress')
    capfd.readouterr()
    time.sleep(0.05)
    assert capfd.readouterr().err == ''
