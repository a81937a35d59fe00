"""
Odd values of every number that a command takes: refused in one line, or computed.

The options are read from the application, so a new one is tried without a change here. Failures
are a traceback, another exit status than 0, 1, 2 or 130, a refusal that does not name the option,
and a command that Ctrl-C does not end. `make test` tries a few hundred up to the point where the
computation begins, `make torture` lets some of ten thousand compute.
"""

import contextlib
import inspect
import io
import os
import shutil
import signal
import subprocess
import sys
import time
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from random import Random
from typing import Any, Final, NamedTuple

import typer

from asi_analysis import cli
from asi_analysis.bags.bag import write_bag
from asi_analysis.bags.exchange.exporting import export
from asi_analysis.bags.run import Run
from asi_analysis.experiments.experiment import TABLES
from asi_analysis.loop.closed_loop import simulate_loop
from torture.rig import ROOT, Rig, Tally

CALLS: Final = 10_000
STATUSES: Final = (0, 1, 2, 130)
VALUES: Final = (
    'nan', 'inf', '-inf', '-1', '0', '-0.0', '1', '2', '1e-3', '-1e-3', '1e3', '1e12', '-1e12',
    '1e-308', '5e-324', '1e308', '-1e308', '1e400', '2147483647', '9223372036854775807',
    '9223372036854775808', '1' + 40 * '0', '-1' + 40 * '0', 5000 * '9', '', ' ', '1.5', '1,5',
    '1;2', '0x10', '1_000', 'ten', '∞', '½', '１２', '٣', '1\n2', '1 N', 'true', '--', '[1, 2]',
    '{}', '\u202e1', '\x00')
# Texts with numbers in them, {} stands for one; --set is tried with each parameter.
TEXTS: Final = {'steps': ('{}', '100,{}'), 'rates': ('{}', '5000,{}'),
                'springs': ('{}', '1e5,{}'),
                'over': ('controller.gain={}', 'controller.gain=1:{}:3', 'load.mass=1:2:{}'),
                'tolerance': ('{}', 'load.mass={}'),
                'limit': ('position={}:1[rad]', 'velocity={}[rad/s]', 'command={}[Nm]'),
                'noise': ('position={}[rad]',),
                'front': ('load.mass={}', 'load.mass=0.5,{}'),
                'map_': ('reference=force_n*{}', 'reference=force_n+{}', 'reference=force_n[{}]')}
# Further arguments that make a call complete, and short if the value is accepted.
NEEDED: Final = {
    'run': ['--out', 'new'], 'analyze': ['bag'], 'export': ['bag', '--out', 'new.csv'],
    'import': ['table.csv', '--map', 'time=time_s', '--map', 'force=force_n', '--out', 'new'],
    'quench': ['--out', 'new'], 'demo': ['--out', 'new'], 'calibrate': ['--out', 'new'],
    'ensemble': ['--out', 'new', '--pictures', 'new'], 'gap of': ['bag'],
    'gap check': ['--out', 'new'],
    'gap plan': ['joint.yaml', '--limit', 'position=-1:1[rad]', '--limit',
                 'velocity=3[rad/s]'],
    'live': ['--no-browser'], 'compare': ['lead4'],
    'sweep': ['--over', 'controller.feedforward=1']}
FILES: Final = ('bag:', 'table.csv')   # what a refusal may name instead of an option
# One call of so many computes.
COMPUTED: Final = 20
# How long it computes until Ctrl-C, and how long it may then take to end on a busy machine, s.
COMPUTES_S: Final = 4.0
PATIENCE_S: Final = 60.0


class Option(NamedTuple):
    """A number that a command takes."""

    command: str        # 'gap of'
    name: str           # '--tolerance', or the parameter that --set sets
    forms: tuple[str, ...]      # texts of the argument, {} stands for the number

    def call(self, random: Random) -> list[str]:
        """Return the arguments of `asi` with an odd value of the option."""
        argument = random.choice(self.forms).replace('{}', random.choice(VALUES))
        return [*self.command.split(), *NEEDED.get(self.command, []), argument]


class Outcome(NamedTuple):
    """Exit status of a command, and what it has said on stderr."""

    status: int
    complaint: str


class ComputingError(BaseException):
    """The arguments are accepted."""


def numbers(app: typer.Typer = cli.app, prefix: str = '') -> Iterator[Option]:
    """Yield every number of every command."""
    for group in app.registered_groups:
        assert group.typer_instance is not None
        yield from numbers(group.typer_instance, f'{prefix}{group.name} ')
    for each in app.registered_commands:
        assert each.callback is not None
        for name, hint in typing.get_type_hints(each.callback, include_extras=True).items():
            if hint is type(None):
                continue
            kinds = {*typing.get_args(typing.get_args(hint)[0]), typing.get_args(hint)[0]}
            info = next(one for one in typing.get_args(hint) if hasattr(one, 'param_decls'))
            option = next((one for one in info.param_decls or () if one.startswith('--')),
                          '--' + name.strip('_').replace('_', '-'))
            command = f'{prefix}{each.name}'
            if name == 'set_':
                yield from _settings(command)
            elif {int, float} & kinds or name in TEXTS:
                yield Option(command, option,
                             tuple(f'{option}={form}' for form in TEXTS.get(name, ('{}',))))


def _settings(command: str) -> Iterator[Option]:
    for which, table in TABLES.items():
        for parameter in table:
            if not isinstance(parameter.default, str):
                prefix = '' if command == 'gap of' else f'{which}.'
                if prefix or which == 'actuator':
                    yield Option(command, parameter.name,
                                 (f'--set={prefix}{parameter.name}={{}}',))


def material(folder: Path, duration_s: float) -> None:
    """Write the files that the calls name, of a recording of so many seconds."""
    run = Run(*simulate_loop({'load.type': 'spring'}, {
        'reference.shape': 'multisine', 'reference.amplitude': 50.0}, duration_s))
    write_bag(run, folder / 'bag')
    export(run, folder / 'table.csv')
    (folder / 'joint.yaml').write_text('/**:\n  ros__parameters:\n    load.mass: 0.05\n')


def outcome(arguments: Sequence[str]) -> Outcome:
    """Run `asi` in this process and return how it ended; raises what `asi` lets through."""
    before, sys.argv = sys.argv, ['asi', *arguments]
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(complaint):
            status = cli.main()
    except SystemExit as error:
        status = int(error.code or 0)
    finally:
        sys.argv = before
    return Outcome(status, complaint.getvalue())


def refused_badly(option: Option, result: Outcome) -> str:
    """Return what is wrong with the end of a call; '' if nothing."""
    said = result.complaint
    if result.status not in STATUSES or 'Traceback' in said:
        return f'status {result.status}: {said[-600:]}'
    if result.status != 2:
        return ''
    name = option.name.lstrip('-').rstrip('s')
    shown = [name, name.replace('-', '_'), *FILES,
             *(form.partition('=')[2].partition('{')[0] for form in option.forms)]
    lines = said.splitlines()      # notes may precede the refusal
    if not lines or not all(line.startswith('asi: ') for line in lines):
        return f'the refusal is not of one line: {said[:600]}'
    if not any(each and each in lines[-1] for each in shown):
        return f'the refusal does not name {option.name}: {said[:600]}'
    return ''


@contextlib.contextmanager
def accepted_only() -> Iterator[None]:
    """Let commands end by ComputingError where their computation reports its first progress."""
    def progress(text: str, share: float | None) -> None:
        if not text.startswith('reading'):
            raise ComputingError

    @contextlib.contextmanager
    def cut() -> Iterator[Any]:
        yield progress

    groups = [each for each in vars(cli).values() if inspect.ismodule(each)
              and hasattr(each, 'bar')]
    before = [vars(each)['bar'] for each in groups]
    try:
        for each in groups:
            vars(each)['bar'] = cut
        yield
    finally:
        for each, bar in zip(groups, before, strict=True):
            vars(each)['bar'] = bar


def problem_before_computing(option: Option, arguments: Sequence[str]) -> str:
    """Call `asi` up to the first progress of its computation; return what is wrong, '' if none."""
    try:
        with accepted_only():
            return refused_badly(option, outcome(arguments))
    except ComputingError:
        return ''
    except Exception as error:  # noqa: B902 - whatever it is, a user would see it
        return f'{type(error).__name__}: {error}'


def problem_in_a_process(option: Option, arguments: Sequence[str], folder: Path) -> str:
    """Call `asi` as a user does, with Ctrl-C if it computes; return what is wrong, '' if none."""
    process = subprocess.Popen(
        [sys.executable, '-m', 'asi_analysis.cli', *arguments], stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, text=True, cwd=folder,
        env={**os.environ, 'PYTHONPATH': str(ROOT)})
    try:
        _, said = process.communicate(timeout=COMPUTES_S)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        try:
            _, said = process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            return f'Ctrl-C does not end it within {PATIENCE_S:g} s'
    return refused_badly(option, Outcome(process.returncode, said))


def options(rig: Rig, tally: Tally, end: float) -> None:
    """Try odd values of the options: ten thousand, or until the time is over."""
    folder = rig.folder / 'options'
    folder.mkdir()
    material(folder, 1.2)
    known = list(numbers())
    before = Path.cwd()
    os.chdir(folder)
    try:
        for number in range(CALLS):
            if time.monotonic() > end:
                return
            option = rig.random.choice(known)
            arguments = option.call(rig.random)
            computed = number % COMPUTED == 0 and '\x00' not in arguments[-1]
            problem = (problem_in_a_process(option, arguments, folder) if computed else
                       problem_before_computing(option, arguments))
            tally.count(f'asi {option.command}' + (' (computing)' if computed else ''),
                        problem and f'asi {" ".join(arguments)[:200]}: {problem}')
            clean(folder)
    finally:
        os.chdir(before)


def clean(folder: Path) -> None:
    """Remove what calls have written."""
    for path in folder.glob('new*'):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
