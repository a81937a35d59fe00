"""The examples in the docstrings of the Python API print what they say."""

import doctest
import importlib

import pytest

import asi_analysis

# Beside those of the API, modules whose functions have an example too.
MODULES = sorted({asi_analysis._HOME[name] for name in asi_analysis.__all__} | {
    'bags.exchange.preview', 'free_parameter', 'tuning.z_width'})


# That of the ablation says what test_attribution.py compares with the paper.
SLOW = ('limit_cycle.attribution.ablation',)


@pytest.mark.parametrize('module', [
    pytest.param(module, marks=pytest.mark.slow) if module in SLOW else module
    for module in MODULES])
def test_examples_of_the_api(module: str) -> None:
    failed, _ = doctest.testmod(importlib.import_module(f'asi_analysis.{module}'),
                                optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    assert failed == 0


@pytest.mark.parametrize('name', asi_analysis.__all__)
def test_public_functions_have_an_example(name: str) -> None:
    value = getattr(asi_analysis, name)
    if not isinstance(value, type):
        assert '>>> ' in (value.__doc__ or ''), f'{name} has no example'
