"""A few hundred odd values of the numbers that commands take; `make torture` tries thousands."""

import sys
from random import Random

import pytest

from asi_analysis import cli
from torture.options import accepted_only, clean, material, numbers, problem_before_computing


@pytest.mark.parametrize(('times', 'some'), [
    (1, 60), pytest.param(3, 200, marks=pytest.mark.slow)])
def test_an_odd_number_is_accepted_or_refused_in_one_line(times, some, tmp_path, monkeypatch):
    """Every option of the application; of --set, which has hundreds, some."""
    material(tmp_path, 0.2)
    monkeypatch.chdir(tmp_path)
    random, known = Random(1), list(numbers())
    own = [option for option in known if option.name.startswith('--')]
    problems = []
    for option in [*(times * own), *random.sample(known, some)]:
        arguments = option.call(random)
        if problem := problem_before_computing(option, arguments):
            problems.append((arguments, problem))
        clean(tmp_path)
    assert problems == []


def test_every_number_of_a_command_is_found():
    known = {(option.command, option.name) for option in numbers()}
    assert {('run', '--gain'), ('run', '--duration'), ('run', 'load.mass'), ('predict', '--steps'),
            ('quench', '--rates'), ('quench', 'reference.amplitude'), ('gap of', '--tolerance'),
            ('gap check', '--jobs'), ('import', '--map'), ('tune', '--seed')} <= known


@pytest.mark.parametrize('call', [
    ('sweep', '--over', 'controller.gain=1', '--csv'), ('compare', 'lead4', '--markdown')])
@pytest.mark.parametrize('file', ['.', 'nowhere/file', 'there/file'])
def test_a_file_that_cannot_be_written_is_refused_before_the_computation(
        call, file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'there').write_text('')
    monkeypatch.setattr(sys, 'argv', ['asi', *call, file])
    with accepted_only():
        assert cli.main() == 2
    assert capsys.readouterr().err.startswith(f'asi: {file} cannot be written: ')
