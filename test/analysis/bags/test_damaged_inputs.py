"""A few hundred damaged files and samples; `make torture` tries ten thousand."""

import warnings
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from asi_analysis.errors import InputError
from asi_common.parameter import ParameterError
from torture.inputs import (
    KEPT,
    corpus,
    figure_problem,
    file_problem,
    kept,
    read,
    recording,
    saturated,
    with_command,
    without_command,
)

few = settings(derandomize=True, deadline=None, database=None,
               suppress_health_check=list(HealthCheck))
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope='module')
def files(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Path]]:
    folder = tmp_path_factory.mktemp('corpus')
    yield corpus(folder)


@pytest.mark.parametrize('examples', [50, pytest.param(200, marks=pytest.mark.slow)])
def test_a_damaged_file_is_read_or_refused_in_one_line(files: list[Path], examples: int) -> None:
    """Any but the last, a MAT file, which is read in a process of its own."""
    @settings(few, max_examples=examples)
    @given(seed=seeds, number=st.integers(0, 14))
    def check(seed: int, number: int) -> None:
        assert not file_problem(files[number], files[0].parent / 'damaged', Random(seed))

    check()


@pytest.mark.parametrize('examples', [8, pytest.param(40, marks=pytest.mark.slow)])
def test_no_figure_of_spoilt_samples_differs_silently(examples: int) -> None:
    @settings(few, max_examples=examples)
    @given(seed=seeds)
    def check(seed: int) -> None:
        assert not figure_problem(recording(), Random(seed))

    check()


@pytest.mark.slow
@settings(few, max_examples=25)
@given(seed=seeds)
def test_no_figure_of_a_run_with_a_command_differs_silently(seed: int) -> None:
    assert not figure_problem(with_command(), Random(seed))


@pytest.mark.parametrize('examples', [2, pytest.param(6, marks=pytest.mark.slow)])
def test_nor_while_the_command_is_saturated_or_without_it(examples: int) -> None:
    @settings(few, max_examples=examples)
    @given(seed=seeds)
    def check(seed: int) -> None:
        for run in (saturated(), without_command()):
            assert not figure_problem(run, Random(seed))

    check()


@pytest.mark.parametrize('path', kept(), ids=lambda path: str(path.relative_to(KEPT)))
def test_an_input_that_is_kept_is_refused_in_one_line_or_has_a_note(path: Path) -> None:
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter('always')
        try:
            answer = read(path)
        except (InputError, ParameterError, OSError) as error:
            assert '\n' not in str(error)
            return
    assert noted or (answer and answer.said)
