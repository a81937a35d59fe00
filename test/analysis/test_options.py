"""A few hundred odd values of the numbers that commands take; `make torture` tries thousands."""

from random import Random

from torture.options import clean, material, numbers, problem_before_computing


def test_an_odd_number_is_accepted_or_refused_in_one_line(tmp_path, monkeypatch):
    """Every option of the application; of --set, which has hundreds, some."""
    material(tmp_path, 0.2)
    monkeypatch.chdir(tmp_path)
    random, known = Random(1), list(numbers())
    own = [option for option in known if option.name.startswith('--')]
    problems = []
    for option in [*(3 * own), *random.sample(known, 200)]:
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
