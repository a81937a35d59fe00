"""
Sphinx builds the documents with this: `make docs`.

Pages that follow from the code are written into doc/reference/generated first; tutorials run as
they are built, so what they show is what the code does.
"""

import os
import re
import sys
from pathlib import Path
from typing import Any

from myst_nb.core import render
from sphinx.application import Sphinx

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
# The tutorials call `asi`, and import what stands here.
os.environ['PATH'] = f'{Path(sys.executable).parent}{os.pathsep}{os.environ["PATH"]}'
os.environ['PYTHONPATH'] = os.pathsep.join([str(ROOT), os.environ.get('PYTHONPATH', '')])
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

# Functions are documented as they are written, not as what the compiler makes of them.
os.environ['NUMBA_DISABLE_JIT'] = '1'
import asi_actuator.model.actuator  # noqa: E402, F401

del os.environ['NUMBA_DISABLE_JIT']

from doc import generate  # noqa: E402 (after the path is set)

generate.write_reference()

project = 'asi_actuator'
copyright = 'the asi_actuator maintainers'  # noqa: A001 (Sphinx names it so)
extensions = ['myst_nb', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon', 'sphinx.ext.mathjax',
              'sphinx.ext.viewcode', 'sphinxcontrib.mermaid']
# Tables that commands write, each part of a page.
exclude_patterns = ['explanation/reproduction/*', 'reference/generated/[am]*']
html_theme = 'furo'
html_title = 'asi_actuator'
html_theme_options = {'source_directory': 'doc/'}
templates_path: list[str] = []

myst_enable_extensions = ['dollarmath', 'colon_fence', 'deflist']
myst_heading_anchors = 3
myst_fence_as_directive = ['mermaid']

nb_execution_mode = 'force'
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True

default_role = 'code'
ARRAY = re.compile(r'~?[.\w]*ndarray\[tuple\[~?[.\w]+, \.\.\.\], ~?[.\w]*dtype\[~?[.\w]+\]\]')
smartquotes = False
autodoc_preserve_defaults = True
autodoc_typehints_format = 'short'
autodoc_member_order = 'bysource'
maximum_signature_line_length = 90
# Types of other projects: their pages are not looked up, so that the build needs no network.
nitpick_ignore_regex = [('py:.*', r'.*')]


def setup(app: Sphinx) -> None:
    """Register how signatures are shortened, and which members need no entry of their own."""
    app.connect('autodoc-process-signature', lambda app, what, name, obj, options, signature, back:
                (_short(signature), _short(back)))
    # The fields of a NamedTuple stand in its signature.
    app.connect('autodoc-skip-member', lambda app, what, name, member, skip, options:
                skip or type(member).__name__ == '_tuplegetter')


def _joined(outputs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Join what a command printed piece by piece; myst-nb would end a line after each piece."""
    joined: list[dict[str, Any]] = []
    for output in outputs:
        if (joined and output['output_type'] == 'stream'
                and joined[-1].get('name') == output['name']):
            joined[-1]['text'] += output['text']
        else:
            joined.append(output)
    return joined


render.coalesce_streams = _joined


def _short(text: str | None) -> str | None:
    return text and ARRAY.sub('NDArray', text)
