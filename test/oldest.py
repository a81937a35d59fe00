"""Print the lower bounds of setup.py as constraints for pip: `make test-oldest`."""

import re
from pathlib import Path
from unittest.mock import patch

LOWER = re.compile(r'^([A-Za-z0-9_.-]+)>=([0-9.]+)')


def constraints() -> list[str]:
    """Return name==version of each requirement that has a lower bound."""
    setup_file = Path(__file__).parents[1] / 'setup.py'
    with patch('setuptools.setup') as setup:
        exec(compile(setup_file.read_text(), str(setup_file), 'exec'), {})
    found = map(LOWER.match, setup.call_args.kwargs['install_requires'])
    return [f'{each[1]}=={each[2]}' for each in found if each]


if __name__ == '__main__':
    print('\n'.join(constraints()))
